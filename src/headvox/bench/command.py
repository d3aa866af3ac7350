"""How fast is it here? ``headvox bench`` makes its own input, measures, and says on what machine.

Everything that is compared is called in turn, a few calls each, round after round, so that whatever else the machine
does hits all of it alike; the yardsticks (a copy of the cloud, a read of the images, another library's voxel grid) are
in the same rounds. The first call of a few finds in the caches what the others left there: it is told apart, as "cold".
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from headvox import __version__
from headvox.bench.input import SHELL_POINTS, Input, describe_machine, load_average, make_input
from headvox.bench.report import report
from headvox.commands.flags import whole_number
from headvox.config import DetectorConfig
from headvox.data import F32, F64, Heads, Intrinsics
from headvox.errors import HeadvoxError
from headvox.masks.compile import compile_cascade
from headvox.masks.read import parse_cascade
from headvox.pipeline import Detector
from headvox.warmup import warm_up

Values = dict[str, Any]

MAX_RANGE_M = 3.5
CENTRE = (0.0, 0.0, 1.65)  # between the cameras
SHARES = (8, 4, 2, 1)  # every 8th point, every 4th, ...
BOX_VOXELS = (3, 5, 9, 13, 17, 21)
BURST = 5  # calls in a row, the first of which is cold
OPEN3D_EVERY = 5  # it takes as long as many of the others together
COPY, OPEN3D = "np.copy of the cloud", "Open3D voxel_down_sample, 2.5 cm"

# A gate whose eight boxes nothing can fill, and a box of full size that only keeps the searched volume, and the type
# of the sums, the same.
ONE_SIZE = """
format = "headvox-cascade"
version = 1
name = "boxes of {voxels} voxels"
summary = "for measuring"
voxel_m = 0.05
subdivision = 2
occupancy = "parts"
min_score = 1.0
[[gate]]
name = "measured"
ring = {{ radius = 0.2, height = 0.0, size = [{size}, {size}, {size}] }}
min = 1.1
[[gate]]
name = "never reached"
ring = {{ radius = 0.2, height = 0.0, size = [{most}, {most}, {most}] }}
min = 1.1
[[group]]
name = "one"
boxes = [{{ centre = [0, 0, 0], size = [0.05, 0.05, 0.05] }}]
[[stage]]
name = "one"
trees = [["one.sum", 0.5, 0.0, 1.0]]
"""

# What a fresh process does until it has its first heads.
FIRST = """
import sys, time
begun = time.perf_counter()
import numpy as np
import headvox
from headvox.config import DetectorConfig
data = np.load(sys.argv[1])
images = [
    headvox.DepthImage(f"camera {k}", data[f"depth{k}"], headvox.Intrinsics(*size, *lens), data[f"T{k}"])
    for k, (size, lens) in enumerate(zip(data["sizes"].tolist(), data["lenses"].tolist()))
]
read = time.perf_counter()
detector = headvox.Detector(DetectorConfig(cascade=sys.argv[2], refine=sys.argv[3], max_range_m=3.5))
ready = time.perf_counter()
detector.detect_depth(images)
print(ready - read, time.perf_counter() - ready, time.perf_counter() - begun)
"""


# ------------------------------------------------------------------------------------------------- the rounds


@dataclass(slots=True)
class Case:
    """One thing that is called a few times a round, or once in ``every`` rounds."""

    name: str
    call: Callable[[], object]
    detector: Detector | None = None
    every: int = 1
    ms: list[float] = field(default_factory=list)
    cold_ms: list[float] = field(default_factory=list)
    stages: dict[str, list[float]] = field(default_factory=dict)

    def measure(self) -> None:
        """Call a few times and keep the times, and those of each stage; the first apart from the others."""
        self.cold_ms.append(self._time())
        if self.every > 1:  # slow enough not to care about caches
            self.ms.append(self.cold_ms[-1])
            return
        for _ in range(BURST - 1):
            self.ms.append(self._time())
            if self.detector is not None:
                for stage, ms in self.detector.stage_ms.items():
                    self.stages.setdefault(stage, []).append(ms)

    def _time(self) -> float:
        begun = time.perf_counter()
        self.call()
        return 1e3 * (time.perf_counter() - begun)


def run_rounds(cases: list[Case], rounds: int) -> None:
    """Measure each case in turn, ``rounds`` times, after a call each without looking at the clock."""
    for case in cases:
        case.call()
    gc.collect()
    for index in range(rounds):
        for case in cases:
            if index % case.every == 0:
                case.measure()


def _percentiles(ms: Iterable[float]) -> Values:
    p50, p99 = (float(v) for v in np.percentile(np.array(list(ms)), (50, 99)))
    return {
        "p50": round(p50, 4),
        "p99": round(p99, 4),
        "p99_over_p50": round(p99 / p50, 3) if p50 > 0 else None,
    }


# ------------------------------------------------------------------------------------------------ the sections


def measure(
    cascade: str, refine: str, rounds: int, frames: int, small: bool, note: Callable[[str], None]
) -> Values:
    """Measure everything and return it, ready for JSON; ``note`` is told what is going on.

    Raises:
        HeadvoxError: no such cascade.
    """
    alone = DetectorConfig(cascade=cascade, refine=refine, max_range_m=MAX_RANGE_M)
    config = replace(alone, centre=CENTRE)
    two = replace(config, threads=2)
    note("compiling, where that was not done before")
    for one in (config, two):
        warm_up(one)
    note("making the input")
    data = make_input(small)
    machine, open3d = describe_machine(), _import_open3d()
    with ExitStack() as stack:

        def detector(settings: DetectorConfig) -> Detector:
            return stack.enter_context(closing(Detector(settings)))

        clouds, depth, depth_2, shell = (detector(settings) for settings in (config, config, two, alone))
        calls: dict[str, tuple[Detector, Callable[[], Heads]]] = {
            "detect, cloud": (clouds, lambda: clouds.detect(data.cloud)),
            "detect_depth": (depth, lambda: depth.detect_depth(data.images)),
            "detect_depth, 2 threads": (depth_2, lambda: depth_2.detect_depth(data.images)),
            f"detect, shell of {SHELL_POINTS}": (shell, lambda: shell.detect(data.shell)),
        }
        detections = [Case(name, call, detector) for name, (detector, call) in calls.items()]
        cases = [*detections, *_yardsticks(data, open3d)]
        parts = [(len(points), points) for points in (data.cloud[::step].copy() for step in SHARES)]
        by_points = [_case_of_points(count, points, detector(config)) for count, points in parts]
        by_boxes = [_case_of_boxes(voxels, data, detector(config)) for voxels in BOX_VOXELS]
        note(f"measuring, {rounds} rounds")
        run_rounds([*cases, *by_points, *by_boxes], rounds)
        note(f"watching the memory over {frames} frames")
        memory = _memory(depth, data, frames)
        found = {name: len(call()) for name, (_, call) in calls.items()}
        same = _same(depth.detect_depth(data.images), depth_2.detect_depth(data.images))
    note("starting fresh processes")
    first = _first_result(data, cascade, refine, 1 if small else 5)
    machine["load_average_after"] = load_average()
    copy, grid = (
        next((case.ms for case in cases if case.name == name and case.ms), None) for name in (COPY, OPEN3D)
    )
    return {
        "headvox": __version__,
        "cascade": cascade,
        "refine": refine,
        "machine": machine,
        "input": {
            "cameras": [f"{image.intrinsics.width}x{image.intrinsics.height}" for image in data.images],
            "points": len(data.cloud),
            "points_within_range": int((np.linalg.norm(data.cloud - CENTRE, axis=1) < MAX_RANGE_M).sum()),
            "shell_points": len(data.shell),
            "people": data.people,
            "max_range_m": MAX_RANGE_M,
        },
        "rounds": rounds,
        "calls_in_a_row": BURST,
        "ms": {
            case.name: {
                **_percentiles(case.ms),
                "cold_p50": _percentiles(case.cold_ms)["p50"],
                "calls": len(case.ms),
                "times_the_copy": _ratio(case.ms, copy),
                "times_open3d": _ratio(case.ms, grid),
                "heads": found.get(case.name),
            }
            for case in cases
        },
        "open3d": open3d.__version__ if open3d else None,
        "same_heads_with_2_threads": same,
        "candidates": {"detect, cloud": clouds.candidates, "detect_depth": depth.candidates},
        "stages_ms": {
            case.name: {stage: _percentiles(ms) for stage, ms in case.stages.items()} for case in detections
        },
        "by_points": _by_points(by_points, parts),
        "by_box_size": _by_box_size(by_boxes),
        "memory": memory,
        "first_result_s": first,
    }


def _yardsticks(data: Input, open3d: Any) -> list[Case]:
    target = np.empty_like(data.cloud)
    stacked = [image.depth for image in data.images]
    cases = [
        Case(COPY, lambda: np.copyto(target, data.cloud)),
        Case("pure read (sum) of the cloud", lambda: data.cloud.sum()),
        Case("pure read (sum) of the depth", lambda: [depth.sum(dtype=np.uint32) for depth in stacked]),
    ]
    if open3d is not None:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(data.cloud.astype(np.float64)))
        cases.append(Case(OPEN3D, lambda: cloud.voxel_down_sample(0.025), every=OPEN3D_EVERY))
    return cases


def _import_open3d() -> Any:
    try:
        import open3d
    except (ImportError, OSError):  # OSError: a library of the system that it needs is missing
        return None
    return open3d


def _case_of_points(count: int, points: F32, detector: Detector) -> Case:
    return Case(f"{count} points", lambda: detector.detect(points), detector)


def _case_of_boxes(voxels: int, data: Input, detector: Detector) -> Case:
    text = ONE_SIZE.format(voxels=voxels, size=0.05 * voxels, most=0.05 * max(BOX_VOXELS))
    detector.cascade = compile_cascade(parse_cascade(text, "bench"))
    return Case(f"{voxels} voxels", lambda: detector.detect_depth(data.images), detector)


def _by_points(cases: list[Case], parts: list[tuple[int, F32]]) -> Values:
    """Fit straight lines to the medians: what a frame costs whatever it holds, and what a point costs."""
    counts = np.array([count for count, _ in parts], dtype=np.float64)
    medians = np.array([np.median(case.ms) for case in cases])
    voxelize = np.array([np.median(case.stages["voxelize"]) for case in cases])
    rows = [
        {"points": int(count), "p50": round(float(ms), 4), "voxelize": round(float(v), 4)}
        for count, ms, v in zip(counts, medians, voxelize, strict=True)
    ]
    return {"rows": rows, "detect": _line(counts, medians), "voxelize": _line(counts, voxelize)}


def _line(counts: F64, ms: F64) -> Values:
    slope, fixed = (float(v) for v in np.polyfit(counts, ms, 1))
    off = float(np.abs(ms - (fixed + slope * counts)).max() / ms.max())
    return {
        "fixed_ms": round(fixed, 4),
        "ms_a_million_points": round(1e6 * slope, 4),
        "farthest_from_the_line": round(off, 4),
    }


def _by_box_size(cases: list[Case]) -> Values:
    medians = [float(np.median(case.stages["gate"])) for case in cases]
    rows = [{"voxels": n, "gate_p50": round(ms, 4)} for n, ms in zip(BOX_VOXELS, medians, strict=True)]
    return {"rows": rows, "slowest_over_fastest": round(max(medians) / min(medians), 3)}


def _memory(detector: Detector, data: Input, frames: int) -> Values:
    """Tell what a frame allocates once everything is there, and whether anything is kept."""
    tracemalloc.start()
    peaks = []
    for _ in range(5):
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        detector.detect_depth(data.images)
        peaks.append(tracemalloc.get_traced_memory()[1] - before)
    gc.collect()
    before, _ = tracemalloc.get_traced_memory()
    for _ in range(traced := max(1, frames // 10)):
        detector.detect_depth(data.images)
    gc.collect()
    kept = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    for _ in range(traced):  # until the memory that the tracing needed is given back
        detector.detect_depth(data.images)
    resident = _resident_bytes()
    for _ in range(frames):
        detector.detect_depth(data.images)
    after = _resident_bytes()
    return {
        "peak_bytes_a_frame": int(np.median(peaks)),
        "image_bytes": sum(image.depth.nbytes for image in data.images),
        "kept_bytes_a_frame": max(0, kept) // traced,
        "frames": frames,
        "resident_growth_bytes": None if resident is None or after is None else after - resident,
    }


def _resident_bytes() -> int | None:
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):  # not Linux
        return None


def _first_result(data: Input, cascade: str, refine: str, times: int) -> Values:
    """Start a fresh Python, and let it find the heads in one frame, from the loops that are kept on the disk."""
    arrays: dict[str, Any] = {}
    for k, image in enumerate(data.images):
        arrays |= {f"depth{k}": image.depth, f"T{k}": image.T_world_camera}
    lenses = [image.intrinsics for image in data.images]
    arrays["sizes"] = np.array([[lens.width, lens.height] for lens in lenses])
    arrays["lenses"] = np.array([_lens(lens) for lens in lenses])
    rows = []
    with tempfile.TemporaryDirectory(prefix="headvox-bench-") as folder:
        file = Path(folder) / "frame.npz"
        np.savez(file, **arrays)
        for _ in range(times):
            begun = time.perf_counter()
            done = subprocess.run(
                [sys.executable, "-c", FIRST, str(file), cascade, refine],
                capture_output=True,
                text=True,
                check=False,
            )
            wall = time.perf_counter() - begun
            if done.returncode:
                raise HeadvoxError(
                    "A fresh process failed.", (done.stderr.splitlines() or ["It said nothing."])[-1]
                )
            rows.append([wall, *(float(word) for word in done.stdout.split())])
    wall, make, detect, _ = (round(float(v), 3) for v in np.median(np.array(rows), axis=0))
    return {"from_start_of_python": wall, "make_a_detector": make, "first_frame": detect, "processes": times}


def _lens(lens: Intrinsics) -> tuple[float, ...]:
    return lens.fx, lens.fy, lens.cx, lens.cy, lens.depth_scale


def _same(one: Heads, other: Heads) -> bool:
    pairs = ((one.centres, other.centres), (one.radii, other.radii), (one.scores, other.scores))
    return all(a.tobytes() == b.tobytes() for a, b in pairs)


def _ratio(ms: list[float], yardstick: list[float] | None) -> float | None:
    return None if not yardstick else round(float(np.median(ms) / np.median(yardstick)), 4)


# ------------------------------------------------------------------------------------------------- the command


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "headvox bench",
        description="Measure how fast headvox is on this machine. It makes its own input.",
        epilog="Close what else runs: two threads on two busy cores are slower than one.",
        allow_abbrev=False,
    )
    parser.add_argument("--cascade", default="default", metavar="NAME|FILE", help="which masks (default)")
    parser.add_argument(
        "--refine",
        choices=("pose", "sphere", "none"),
        default="pose",
        help="how a head's centre is found (pose)",
    )
    parser.add_argument(
        "--backend", choices=("cpu", "cuda"), default="cpu", help="measure the CPU (default) or a GPU"
    )
    parser.add_argument("--rounds", type=whole_number, metavar="N", help="rounds of calls (100)")
    parser.add_argument(
        "--quick", action="store_true", help="a few rounds on small images: only to see it work"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    return parser


def main(argv: list[str]) -> int:
    """Run ``headvox bench`` with the flags ``argv``; return the exit code.

    Raises:
        HeadvoxError: no such cascade.
    """
    try:
        args = _parser().parse_args(argv)
    except SystemExit as done:  # after --help or wrong usage
        return int(done.code or 0)
    rounds = args.rounds or (5 if args.quick else 100)
    frames = 20 if args.quick else 1000

    def note(text: str) -> None:
        print(f"headvox bench: {text}", file=sys.stderr, flush=True)

    if args.backend == "cuda":
        from headvox.cuda.device import check_real_device

        check_real_device()
        from headvox.cuda import bench as gpu

        result = gpu.bench(args.cascade, args.refine, MAX_RANGE_M, rounds, args.quick, note)
        print(json.dumps(result, indent=1) if args.json else gpu.report(result))
        return 0
    result = measure(args.cascade, args.refine, rounds, frames, args.quick, note)
    print(json.dumps(result, indent=1) if args.json else report(result))
    return 0
