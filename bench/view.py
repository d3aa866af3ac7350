"""What `headvox run --view` costs the loop: the same frames with and without, in turns, in one process.

    python bench/view.py [RECORDING] [--hz 30] [--rounds 6] [--show]

The loop runs at a camera's rate, and the frames are stamped so. Timed is what the loop does for a frame: find the
heads, follow them, hand the frame over. Without ``--show`` the frames go into an rrd file, with it to the viewer on the
screen.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

import headvox
from headvox.data import Frame
from headvox.run import look
from headvox.sample import sample_folder
from headvox.tracking.tracker import Tracker
from headvox.view.watch import SHOWN_HZ, Watch
from headvox.warmup import warm_up


def times_ms(detector: headvox.Detector, frames: list[Frame], hz: float, watch: Watch | None) -> list[float]:
    """Return what the loop took for each frame."""
    tracker, took = Tracker(), []
    due = time.perf_counter()
    for number, frame in enumerate(frames):
        begun = time.perf_counter()
        result, _ = look(detector, tracker, frame, number)
        if watch is not None:
            watch.show(frame, result)
        took.append(1e3 * (time.perf_counter() - begun))
        due += 1.0 / hz
        time.sleep(max(due - time.perf_counter(), 0.0))
    return took


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recording", type=Path, nargs="?", default=sample_folder())
    parser.add_argument("--hz", type=float, default=30.0)
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--show", action="store_true")
    args = parser.parse_args()
    detector = headvox.Detector()
    warm_up(detector.config)
    frames = [frame for frame in headvox.open_source(args.recording) if isinstance(frame, Frame)]
    frames = [replace(frame, stamp_ns=int(1e9 * k / args.hz)) for k, frame in enumerate(frames)]
    without: list[float] = []
    with_view: list[float] = []
    dropped = 0
    with tempfile.TemporaryDirectory() as folder:
        times_ms(detector, frames, args.hz, None)
        with closing(Watch(detector, None if args.show else Path(folder) / "run.rrd")) as watch:
            times_ms(detector, frames[:3], args.hz, watch)
            time.sleep(5.0)  # the other process starts
            for _ in range(args.rounds):
                without += times_ms(detector, frames, args.hz, None)
                before = watch.dropped
                with_view += times_ms(detector, frames, args.hz, watch)
                dropped += watch.dropped - before
                time.sleep(0.5)
    bare, shown = ((np.mean(took), *np.percentile(took, (50, 99))) for took in (without, with_view))
    print(f"{'ms a frame':14}{'mean':>8}{'p50':>8}{'p99':>8}")
    for name, row in (("without", bare), ("with --view", shown)):
        print(f"{name:14}" + "".join(f"{ms:8.2f}" for ms in row))
    print(f"{'cost':14}" + "".join(f"{b / a - 1.0:8.1%}" for a, b in zip(bare, shown, strict=True)))
    print(
        f"{len(with_view)} frames at {args.hz:g} Hz, shown {SHOWN_HZ} a second at most; "
        f"{dropped} more left out because the viewer was busy"
    )


if __name__ == "__main__":
    main()
