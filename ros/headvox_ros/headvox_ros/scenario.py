"""The command ``scenario``: two cameras, a walking person and the node, each a process; how well and how fast?

It plays a depth recording that has true heads, in real time, to a ``head_detector`` of its own, listens to both as any
other node would, and prints what came of it.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray

from headvox.errors import HeadvoxError
from headvox.evaluate.match import Match, Rules, match
from headvox.evaluate.truth import TrueHeads, read_truth
from headvox.ros.messages import stamp_ns
from headvox.ros.synchronise import NS
from headvox.sources import open_source
from headvox_ros import processes

INPUTS = {"depth": ("depths", "depth/image_rect_raw"), "cloud": ("clouds", "depth/points")}
RULES = Rules()


@dataclass(slots=True)
class Heard:
    """What the listener heard: for each answer its stamp, when it came, and the centres in it; and diagnostics."""

    first_ns: int = 0
    skipped: int = 0
    """Frames that the player could not send in time."""

    answers: list[tuple[int, int, np.ndarray[Any, Any]]] = field(default_factory=list)
    rows: list[dict[str, str]] = field(default_factory=list)

    def on_poses(self, message: PoseArray) -> None:
        """Take an answer."""
        centres = np.array([(p.position.x, p.position.y, p.position.z) for p in message.poses]).reshape(-1, 3)
        self.answers.append((stamp_ns(message.header.stamp), time.time_ns(), centres))

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        """Take the node's own figures."""
        self.rows += [{row.key: row.value for row in status.values} for status in message.status]


def play(
    recording: str,
    sensors: str,
    rate_hz: float,
    loops: int,
    silent: str = "",
    reliability: str = "best_effort",
) -> Heard:
    """Run node and player, and return what was heard."""
    parameter, topic = INPUTS[sensors]
    topics = processes.topics(recording, topic)
    with tempfile.TemporaryFile("w+") as said:
        node = processes.start(
            "head_detector",
            [f"{parameter}:={topics}", "target_frame:=world", f"reliability:={reliability}"],
            said,
        )
        player = None
        listener = rclpy.create_node("scenario")
        heard = Heard()
        listener.create_subscription(PoseArray, "/head_detector/poses", heard.on_poses, 10)
        listener.create_subscription(DiagnosticArray, "/diagnostics", heard.on_diagnostics, 10)
        try:
            processes.spin_until(listener, lambda: bool(heard.rows), processes.START_S, node)
            settings = [f"recording:={recording}", f"rate_hz:={rate_hz}", f"loops:={loops}", "delay_s:=2.0"]
            settings += [
                f"clouds:={sensors == 'cloud'}",
                f"depths:={sensors == 'depth'}",
                f"reliability:={reliability}",
            ]
            settings += [f"silent:=['{silent}']"]
            player = processes.start("play_recording", settings, said)
            processes.spin_until(listener, lambda: player.poll() is not None, float("inf"), node)
            told = len(heard.rows)  # and figures that the node took after the last frame
            processes.spin_until(listener, lambda: len(heard.rows) > told + 1, processes.END_S, node)
        finally:
            processes.end(process for process in (player, node) if process is not None)
            listener.destroy_node()
        said.seek(0)
        text = said.read()
    played = re.search(r"from (\d+) ns on.*, (\d+) frames skipped", text, re.DOTALL)
    if played is None or node.returncode != 0:
        raise HeadvoxError(f"The nodes did not run: {text.strip()[-500:]}", "")
    heard.first_ns, heard.skipped = int(played[1]), int(played[2])
    return heard


def report(recording: str, heard: Heard, rate_hz: float, loops: int) -> dict[str, float]:
    """Return the figures: every frame of the recording counts, answered or not."""
    truth = read_truth(Path(recording) / "heads.jsonl")
    stamps = [frame.stamp_ns for frame in open_source(recording)]
    step = int(NS / rate_hz) if rate_hz > 0.0 else (stamps[-1] - stamps[0]) // (len(stamps) - 1)
    answers = {stamp: (came, centres) for stamp, came, centres in heard.answers}
    matches: list[Match] = []
    delays = []
    heads = 0
    for k in range(loops * len(stamps)):
        true = truth[stamps[k % len(stamps)]]
        heads += int((~true.ignored).sum())
        stamp = heard.first_ns + k * step
        answer = answers.get(stamp)
        if answer is not None:
            delays.append(1e-6 * (answer[0] - stamp))
            matches.append(_match(answer[1], true))
    if not delays:
        raise HeadvoxError("No frame was answered.", "See the diagnostics of head_detector.")
    errors = np.concatenate([one.distances for one in matches])
    came = np.sort([came for came, _ in answers.values()])
    windows = [row for row in heard.rows if row["latency_p50_ms"]]
    return {
        "frames": loops * len(stamps),
        "frames the player skipped": heard.skipped,
        "frames answered": len(delays),
        "frames left out for fresher ones": max(int(row["replaced_by_fresher"]) for row in heard.rows),
        "messages lost": max(int(row["lost"]) for row in heard.rows),
        "answers a second": (len(came) - 1) / (1e-9 * float(came[-1] - came[0])) if len(came) > 1 else 0.0,
        "longest gap [ms]": 1e-6 * float(np.diff(came).max(initial=0)),
        "arrival to publish, p50 [ms]": float(np.median([float(row["latency_p50_ms"]) for row in windows])),
        "arrival to publish, p99 [ms]": max(float(row["latency_p99_ms"]) for row in windows),
        "exposure to listener, p50 [ms]": float(np.percentile(delays, 50)),
        "exposure to listener, p99 [ms]": float(np.percentile(delays, 99)),
        "heads": heads,
        "recall": len(errors) / max(heads, 1),
        "false a frame": sum(len(one.false) for one in matches) / len(matches),
        "centre error, mean [cm]": 100 * float(errors.mean()) if len(errors) else float("nan"),
        "centre error, p95 [cm]": 100 * float(np.percentile(errors, 95)) if len(errors) else float("nan"),
    }


def _match(centres: np.ndarray[Any, Any], true: TrueHeads) -> Match:
    return match(centres, true.centres, ~true.ignored, RULES)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument(
        "recording", help="a depth recording with heads.jsonl, say of `headvox synth two-cameras`"
    )
    parser.add_argument(
        "--input", choices=sorted(INPUTS), default="depth", help="what the cameras publish (depth)"
    )
    parser.add_argument("--rate", type=float, default=0.0, help="frames a second (as recorded)")
    parser.add_argument("--loops", type=int, default=1, help="how often to play it (1)")
    parser.add_argument("--silent", default="", help="NAME:FROM:TO, a camera that stops for some seconds")
    args = parser.parse_args(arguments)

    def measure() -> None:
        heard = play(args.recording, args.input, args.rate, args.loops, args.silent)
        for name, value in report(args.recording, heard, args.rate, args.loops).items():
            print(f"{name:32} {value:.4g}")

    return processes.run("scenario", measure, measurement=True)


if __name__ == "__main__":
    sys.exit(main())
