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
import platform
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from headvox import __version__
from headvox.cli import whole_number
from headvox.config import DetectorConfig
from headvox.data import F32, F64, DepthImage, Heads, Intrinsics
from headvox.errors import HeadvoxError
from headvox.masks import compile_cascade, parse_cascade
from headvox.pipeline import Detector
from headvox.table import table
from headvox.warmup import warm_up

Values = dict[str, Any]

SEED = 2
MAX_RANGE_M = 3.5
CENTRE = (0.0, 0.0, 1.65)  # between the cameras
SHELL_POINTS = 9000
SHELL_REACH_M = 0.155
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
detector = headvox.Detector(DetectorConfig(cascade=sys.argv[2], max_range_m=3.5))
ready = time.perf_counter()
detector.detect_depth(images)
print(ready - read, time.perf_counter() - ready, time.perf_counter() - begun)
"""


# -------------------------------------------------------------------------------------------------- the input


@dataclass(frozen=True, slots=True)
class Input:
    """What is measured on: the same room as two depth images and as a cloud (N, 3) in the world, and a head alone."""

    images: tuple[DepthImage, ...]
    cloud: F32
    shell: F32
    people: int


def make_input(small: bool = False) -> Input:
    """Return three people in a furnished room before two cameras, 4 m apart, 1.65 m high, that face the middle.

    The cameras are 848x480, or 424x240 if ``small``; the bytes are the same every time.
    """
    from headvox.frames import unproject
    from headvox.mesh import sample_surface
    from headvox.synth.presets import two_cameras

    postures = ("standing", "walking", "sitting")
    mode = "d435i-small" if small else "d435i"
    scene = two_cameras(SEED, None, 0.1, postures, ("stay",) * len(postures), mode)
    frame, _ = scene.frame(0)
    points = [unproject(image.depth, image.intrinsics, image.T_world_camera) for image in frame.depths]
    body = scene.actors[0].body(scene.people, 0)
    T = body.T_world_head
    local = (body.vertices - T[:3, 3]) @ T[:3, :3]
    middle = local[body.faces].mean(axis=1)
    is_head = ((middle**2).sum(axis=1) < SHELL_REACH_M**2) & (middle[:, 2] > -0.11)
    used, corners = np.unique(body.faces[is_head], return_inverse=True)
    shell = sample_surface(local[used], corners.reshape(-1, 3), 0.004)
    chosen = np.linspace(0, len(shell) - 1, SHELL_POINTS).round().astype(np.int64)
    return Input(
        frame.depths,
        np.ascontiguousarray(np.concatenate(points), dtype=np.float32),
        np.ascontiguousarray(shell[chosen]),
        len(postures),
    )


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


def measure(cascade: str, rounds: int, frames: int, small: bool, note: Callable[[str], None]) -> Values:
    """Measure everything and return it, ready for JSON; ``note`` is told what is going on.

    Raises:
        HeadvoxError: no such cascade.
    """
    config = DetectorConfig(cascade=cascade, max_range_m=MAX_RANGE_M, centre=CENTRE)
    alone = DetectorConfig(cascade=cascade, max_range_m=MAX_RANGE_M)
    two = DetectorConfig(cascade=cascade, max_range_m=MAX_RANGE_M, centre=CENTRE, threads=2)
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
        cases = [
            Case("detect, cloud", lambda: clouds.detect(data.cloud), clouds),
            Case("detect_depth", lambda: depth.detect_depth(data.images), depth),
            Case("detect_depth, 2 threads", lambda: depth_2.detect_depth(data.images), depth_2),
            Case(f"detect, shell of {SHELL_POINTS}", lambda: shell.detect(data.shell), shell),
            *_yardsticks(data, open3d),
        ]
        parts = [(len(points), points) for points in (data.cloud[::step].copy() for step in SHARES)]
        by_points = [_case_of_points(count, points, detector(config)) for count, points in parts]
        by_boxes = [_case_of_boxes(voxels, data, detector(config)) for voxels in BOX_VOXELS]
        note(f"measuring, {rounds} rounds")
        run_rounds([*cases, *by_points, *by_boxes], rounds)
        note(f"watching the memory over {frames} frames")
        memory = _memory(depth, data, frames)
        found = {case.name: len(case.call()) for case in cases[:4]}  # type: ignore[arg-type]
        same = _same(depth.detect_depth(data.images), depth_2.detect_depth(data.images))
    note("starting fresh processes")
    first = _first_result(data, cascade, 1 if small else 5)
    machine["load_average_after"] = _load_average()
    copy, grid = (
        next((case.ms for case in cases if case.name == name and case.ms), None) for name in (COPY, OPEN3D)
    )
    return {
        "headvox": __version__,
        "cascade": cascade,
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
            case.name: {stage: _percentiles(ms) for stage, ms in case.stages.items()} for case in cases[:4]
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


def _first_result(data: Input, cascade: str, times: int) -> Values:
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
                [sys.executable, "-c", FIRST, str(file), cascade], capture_output=True, text=True, check=False
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


# ------------------------------------------------------------------------------------------------- the machine


def describe_machine() -> Values:
    """Return what a time depends on: processor, cores, versions, and how busy it is."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "cores_for_this_process": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "numba": version("numba"),
        "load_average": _load_average(),
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _load_average() -> list[float] | None:
    return [round(v, 2) for v in os.getloadavg()] if hasattr(os, "getloadavg") else None


# -------------------------------------------------------------------------------------------------- the report


def report(result: Values) -> str:
    """Return what :func:`measure` found, as tables."""
    machine, data = result["machine"], result["input"]
    cores = f"{machine['cores_for_this_process'] or machine['cores']} of {machine['cores']} cores"
    versions = f"Python {machine['python']}, numpy {machine['numpy']}, numba {machine['numba']}"
    head = [
        ["machine", f"{machine['processor']}, {cores}, {machine['system']}"],
        ["software", f"headvox {result['headvox']}, {versions}"],
        [
            "load average",
            f"{_loads(machine['load_average'])} before, {_loads(machine['load_average_after'])} after",
        ],
        ["cascade", result["cascade"]],
        [
            "input",
            f"{len(data['cameras'])} depth images of {data['cameras'][0]}, {data['points']} points, "
            f"{data['points_within_range']} of them within {data['max_range_m']:g} m; {data['people']} people",
        ],
        ["candidates", ", ".join(f"{count} in {name}" for name, count in result["candidates"].items())],
        [
            "rounds",
            f"{result['rounds']}, everything in turn: {BURST} calls in a row, of which the first is cold",
        ],
    ]
    columns = ["ms", "p50", "p99", "p99/p50", "cold p50", "x copy", "x Open3D", "heads"]
    rows = [
        [
            name, f"{row['p50']:.3f}", f"{row['p99']:.3f}", _number(row["p99_over_p50"], 2), f"{row['cold_p50']:.3f}",
            _number(row["times_the_copy"], 2), _number(row["times_open3d"], 3), _number(row["heads"], 0),
        ]
        for name, row in result["ms"].items()
    ]  # fmt: skip
    parts = [table([], head), table(columns, rows)]
    if result["open3d"] is None:
        parts.append("Open3D is not installed: its voxel grid was not measured.")
    parts += [_stage_table(result), _points_table(result["by_points"]), _boxes_table(result["by_box_size"])]
    parts.append(
        _memory_table(result["memory"], result["first_result_s"], result["same_heads_with_2_threads"])
    )
    return "\n\n".join(parts)


def _stage_table(result: Values) -> str:
    stages = result["stages_ms"]
    names = list(next(iter(stages.values())))
    rows = [[stage, *(f"{of[stage]['p50']:.3f}" for of in stages.values())] for stage in names]
    return table(["ms a stage, p50", *stages], rows)


def _points_table(by_points: Values) -> str:
    rows = [[str(row["points"]), f"{row['p50']:.3f}", f"{row['voxelize']:.3f}"] for row in by_points["rows"]]
    lines = [
        f"{name}: {line['fixed_ms']:.3f} ms + {line['ms_a_million_points']:.3f} ms a million points, "
        f"{line['farthest_from_the_line']:.1%} off at most"
        for name, line in by_points.items()
        if name != "rows"
    ]
    return "\n".join([table(["points", "detect, ms", "voxelize, ms"], rows), *lines])


def _boxes_table(by_size: Values) -> str:
    rows = [[str(row["voxels"]), f"{row['gate_p50']:.3f}"] for row in by_size["rows"]]
    text = table(["edge of the boxes, voxels", "gate of 8 boxes, ms"], rows)
    return f"{text}\nslowest / fastest: {by_size['slowest_over_fastest']:.2f}"


def _memory_table(memory: Values, first: Values, same: bool) -> str:
    growth = memory["resident_growth_bytes"]
    rows = [
        ["allocated at a time, a frame", f"{memory['peak_bytes_a_frame']} bytes"],
        ["the images of a frame", f"{memory['image_bytes']} bytes"],
        ["kept, a frame", f"{memory['kept_bytes_a_frame']} bytes"],
        [
            f"resident memory over {memory['frames']} frames",
            "not known here" if growth is None else f"{growth:+d} bytes",
        ],
        ["the same heads with 2 threads, bit for bit", "yes" if same else "NO"],
        ["first heads, from the start of Python", f"{first['from_start_of_python']:.2f} s"],
        ["of that: making a detector", f"{first['make_a_detector']:.2f} s"],
        ["of that: the first frame", f"{first['first_frame']:.2f} s"],
    ]
    return table([], rows)


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _loads(loads: list[float] | None) -> str:
    return "unknown" if loads is None else " ".join(f"{v:.2f}" for v in loads)


# ------------------------------------------------------------------------------------------------- the command


def main(argv: list[str]) -> int:
    """Run ``headvox bench`` with the flags ``argv``; return the exit code.

    Raises:
        HeadvoxError: no such cascade.
    """
    parser = argparse.ArgumentParser(
        "headvox bench",
        description="Measure how fast headvox is on this machine. It makes its own input.",
        epilog="Close what else runs: two threads on two busy cores are slower than one.",
        allow_abbrev=False,
    )
    parser.add_argument("--cascade", default="default", metavar="NAME|FILE", help="which masks (default)")
    parser.add_argument("--rounds", type=whole_number, metavar="N", help="rounds of calls (100)")
    parser.add_argument(
        "--quick", action="store_true", help="a few rounds on small images: only to see it work"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    try:
        args = parser.parse_args(argv)
    except SystemExit as done:  # after --help or wrong usage
        return int(done.code or 0)
    rounds = args.rounds or (5 if args.quick else 100)
    frames = 20 if args.quick else 1000

    def note(text: str) -> None:
        print(f"headvox bench: {text}", file=sys.stderr, flush=True)

    result = measure(args.cascade, rounds, frames, args.quick, note)
    print(json.dumps(result, indent=1) if args.json else report(result))
    return 0
