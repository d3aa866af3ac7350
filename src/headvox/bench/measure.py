"""How fast is it here? Detectors beside yardsticks, in the same rounds.

The yardsticks are a copy of the cloud, a read of the images, and another library's voxel grid.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from typing import Any

import numpy as np

from headvox import __version__
from headvox.bench.first import first_result
from headvox.bench.input import SHELL_POINTS, Input, describe_machine, load_average, make_input
from headvox.bench.memory import watch_memory
from headvox.bench.rounds import BURST, Case, percentiles, run_rounds
from headvox.config import DetectorConfig
from headvox.data import F32, F64, Frame, Heads
from headvox.masks.compile import compile_cascade
from headvox.masks.read import parse_cascade
from headvox.pipeline import Detector
from headvox.warmup import warm_up

Values = dict[str, Any]

MAX_RANGE_M = 3.5
CENTRE = (0.0, 0.0, 1.65)  # between the cameras
SHARES = (8, 4, 2, 1)  # every 8th point, every 4th, ...
BOX_VOXELS = (3, 5, 9, 13, 17, 21)
OPEN3D_EVERY = 5  # it takes as long as many of the others together
COPY, OPEN3D = "np.copy of the cloud", "Open3D voxel_down_sample, 2.5 cm"
STEPS = 16_000
PLAIN = f"a plain loop of {STEPS} steps"

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

        clouds, cameras, depth, depth_2, shell = (
            detector(settings) for settings in (config, config, config, two, alone)
        )
        calls: dict[str, tuple[Detector, Callable[[], Heads]]] = {
            "detect, cloud": (clouds, lambda: clouds.detect(data.cloud)),
            "detect_frame, clouds of 2 cameras": (
                cameras,
                lambda: cameras.detect_frame(Frame(0, clouds=data.clouds)),
            ),
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
        memory = watch_memory(depth, data, frames)
        found = {name: len(call()) for name, (_, call) in calls.items()}
        same = _same(depth.detect_depth(data.images), depth_2.detect_depth(data.images))
    note("starting fresh processes")
    first = first_result(data, cascade, refine, 1 if small else 5)
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
                **percentiles(case.ms),
                **_named("cold", percentiles(case.cold_ms)),
                **_named("second", percentiles(case.second_ms)),
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
            case.name: {stage: percentiles(ms) for stage, ms in case.stages.items()} for case in detections
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
        Case(PLAIN, _count_steps),
        Case(COPY, lambda: np.copyto(target, data.cloud)),
        Case("pure read (sum) of the cloud", lambda: data.cloud.sum()),
        Case("pure read (sum) of the depth", lambda: [depth.sum(dtype=np.uint32) for depth in stacked]),
    ]
    if open3d is not None:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(data.cloud.astype(np.float64)))
        cases.append(Case(OPEN3D, lambda: cloud.voxel_down_sample(0.025), every=OPEN3D_EVERY))
    return cases


def _count_steps() -> None:
    """Take about as long as a small frame and use no memory: what its slowest calls take more is the system's own."""
    for _ in range(STEPS):
        pass


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


def _same(one: Heads, other: Heads) -> bool:
    pairs = ((one.centres, other.centres), (one.radii, other.radii), (one.scores, other.scores))
    return all(a.tobytes() == b.tobytes() for a, b in pairs)


def _named(calls: str, told: Values) -> Values:
    """Return the median and the 99th percentile under names that tell of which calls they are."""
    return {f"{calls}_{name}": told[name] for name in ("p50", "p99")}


def _ratio(ms: list[float], yardstick: list[float] | None) -> float | None:
    return None if not yardstick else round(float(np.median(ms) / np.median(yardstick)), 4)
