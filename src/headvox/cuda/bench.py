"""``headvox bench --backend cuda``: how fast the search is on this GPU, and how near to what its memory allows."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numba import cuda

from headvox import __version__
from headvox.bench.input import describe_machine, make_input
from headvox.commands.table import table
from headvox.config import DetectorConfig
from headvox.cuda import gate
from headvox.cuda.device import BATCH
from headvox.cuda.search import Search
from headvox.data import DepthImage, Frame, Heads
from headvox.errors import HeadvoxError
from headvox.pipeline import Detector

Values = dict[str, Any]

LAUNCHES = 20  # that an event is recorded about
COPY_WORDS = 1 << 26  # 256 MB, more than a cache holds
BATCH_FRAMES = 8 * BATCH
PAPER_EVALUATIONS = 9.5e7  # of masks a second, on the GPU of the paper


def measure(
    config: DetectorConfig, images: tuple[DepthImage, ...], rounds: int, note: Callable[[str], None]
) -> Values:
    """Measure the search of ``images`` on the GPU, ``rounds`` times each; return it ready for JSON.

    Raises:
        HeadvoxError: the GPU failed.
    """
    frame = Frame(0, depths=images)
    note("compiling the kernels")
    on_gpu, on_cpu = Detector(config, backend="cuda"), Detector(config, backend="cpu")
    bare = Detector(replace(config, refine="none"), backend="cuda")
    bare_on_cpu = Detector(replace(config, refine="none"), backend="cpu")
    heads, on_cpu_heads = on_gpu.detect_frame(frame), on_cpu.detect_frame(frame)
    same = bare.detect_frame(frame).centres.tobytes() == bare_on_cpu.detect_frame(frame).centres.tobytes()
    off_m = _farthest(heads, on_cpu_heads)
    batch = [frame] * BATCH_FRAMES
    on_gpu.detect_batch(batch)
    note(f"measuring, {rounds} rounds")
    calls: dict[str, Callable[[], object]] = {
        "end to end": lambda: on_gpu.detect_frame(frame),
        "end to end, without refinement": lambda: bare.detect_frame(frame),
        "end to end, on the CPU": lambda: on_cpu.detect_frame(frame),
    }
    ms: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            ms[name].append(_timed(call))
    search, bare_search = _search_of(on_gpu), _search_of(bare)
    sensors = len(images)
    for name, one in (("kernels", search), ("kernels, without refinement", bare_search)):
        ms[name] = [_event_ms(one, partial(one.launch, 1, sensors)) for _ in range(rounds)]
    ms["upload"] = [_event_ms(search, search.upload) for _ in range(rounds)]
    ms["download"] = [_event_ms(search, search.download) for _ in range(rounds)]
    batches = [_timed(lambda: on_gpu.detect_batch(batch)) for _ in range(max(1, rounds // 10))]
    gate_ms, evaluations = _gate(search, rounds)
    bytes_a_second = _copy_speed(search)
    floor_ms = 1e3 * _least_bytes(search) / bytes_a_second
    device = cuda.get_current_device()
    name = device.name.decode() if isinstance(device.name, bytes) else str(device.name)
    return {
        "headvox": __version__,
        "device": name,
        "compute_capability": ".".join(map(str, device.compute_capability)),
        "machine": describe_machine(),
        "cameras": [f"{image.intrinsics.width}x{image.intrinsics.height}" for image in images],
        "cascade": config.cascade,
        "refine": config.refine,
        "rounds": rounds,
        "ms": {
            name: dict(zip(("p50", "p99"), np.percentile(of, (50, 99)).round(4).tolist(), strict=True))
            for name, of in ms.items()
        },
        "heads": len(heads),
        "same_candidates_and_peaks_as_cpu": same,
        "farthest_from_cpu_m": off_m,
        "one_graph": search.is_graph,
        "candidates": bare.candidates,
        "mask_evaluations": {
            "count": evaluations,
            "ms": gate_ms,
            "a_second": 1e3 * evaluations / gate_ms,
            "times_the_paper": 1e3 * evaluations / gate_ms / PAPER_EVALUATIONS,
        },
        "memory": {
            "copy_bytes_a_second": bytes_a_second,
            "least_bytes": _least_bytes(search),
            "floor_ms": floor_ms,
            "floor_over_kernels": floor_ms / float(np.median(ms["kernels, without refinement"])),
        },
        "batch": {"frames": BATCH_FRAMES, "frames_a_second": 1e3 * BATCH_FRAMES / float(np.median(batches))},
    }


def _farthest(heads: Heads, others: Heads) -> float | None:
    """Return how far apart the same heads are at most, in metres; None where they are not as many."""
    if len(heads) != len(others):
        return None
    return float(np.linalg.norm(heads.centres - others.centres, axis=1).max(initial=0.0))


def _search_of(detector: Detector) -> Search:
    """Return what searches single frames on the GPU.

    Raises:
        HeadvoxError: the GPU failed meanwhile.
    """
    if detector.device is None or detector.device.device is None:
        raise HeadvoxError("The GPU failed while it was measured.", "What it said is above.")
    return detector.device.device.for_frames(1)


def _timed(call: Callable[[], object]) -> float:
    begun = time.perf_counter()
    call()
    return 1e3 * (time.perf_counter() - begun)


def _event_ms(search: Search, call: Callable[[], None]) -> float:
    """Return what a call takes on the device, the mean of several in a row."""
    begun, ended = cuda.event(), cuda.event()
    begun.record(search.stream)
    for _ in range(LAUNCHES):
        call()
    ended.record(search.stream)
    ended.synchronize()
    return float(begun.elapsed_time(ended)) / LAUNCHES


def _gate(search: Search, rounds: int) -> tuple[float, int]:
    """Return the median time of the gate when every voxel is asked for every condition, and how many that are."""
    boxes, weights, spans, rank, limits = search.gate
    least, greatest = np.iinfo(np.int32).min, np.iinfo(np.int32).max
    every = np.tile(np.array([least, greatest], np.int32), (limits.shape[0], 1))
    every[-1] = greatest, least  # so that all others hold, and the last never does
    tables = (boxes, weights, spans, rank, cuda.to_device(every))
    spacing = search.cascade.gate.spacing
    voxels = math.prod(search.shape)

    def sweep() -> None:
        gate.gate[search.on(voxels, 1)](search.S, search.whole, *tables, spacing, search.passed)

    sweep()
    looked_at = voxels // spacing
    return float(np.median([_event_ms(search, sweep) for _ in range(rounds)])), looked_at * limits.shape[0]


def _copy_speed(search: Search) -> float:
    """Return how many bytes a second a copy within the device reads and writes."""
    one, other = (cuda.device_array(COPY_WORDS, np.int32) for _ in range(2))

    def copy() -> None:
        other.copy_to_device(one, stream=search.stream)

    copy()
    return 2.0 * 4.0 * COPY_WORDS / (1e-3 * min(_event_ms(search, copy) for _ in range(5)))


def _least_bytes(search: Search) -> int:
    """Return what has to be moved at least: readings read, grid written and read, sums written and read."""
    return int(search.whole.nbytes + 2 * search.cells.nbytes + 2 * search.S.nbytes) // search.frames


def report(result: Values) -> str:
    """Return what :func:`measure` found, as tables."""
    masks, memory, batch = result["mask_evaluations"], result["memory"], result["batch"]
    head = [
        ["device", f"{result['device']}, compute capability {result['compute_capability']}"],
        ["input", f"{len(result['cameras'])} depth images of {result['cameras'][0]}"],
        ["cascade, refine", f"{result['cascade']}, {result['refine']}"],
        ["heads", f"{result['heads']}, {_against_cpu(result)}"],
        ["launches", "one graph" if result["one_graph"] else "one by one"],
        ["candidates", str(result["candidates"])],
        ["mask evaluations", f"{masks['a_second']:.3g} a second ({masks['count']} in {masks['ms']:.4f} ms), "
         f"{masks['times_the_paper']:.3g} times the paper's"],
        ["memory", f"{memory['copy_bytes_a_second'] / 1e9:.0f} GB/s in a copy; floor {memory['floor_ms']:.4f} ms"],
        ["floor / kernels, without refinement", f"{memory['floor_over_kernels']:.3f}"],
        ["batches", f"{batch['frames_a_second']:.0f} frames a second"],
    ]  # fmt: skip
    rows = [[name, f"{of['p50']:.4f}", f"{of['p99']:.4f}"] for name, of in result["ms"].items()]
    return "\n\n".join([table([], head), table(["ms", "p50", "p99"], rows)])


def _against_cpu(result: Values) -> str:
    off_m = result["farthest_from_cpu_m"]
    if not result["same_candidates_and_peaks_as_cpu"] or off_m is None:
        return "NOT THE SAME as the CPU's"
    return f"the same as the CPU's, refined within {1e6 * off_m:.3g} µm"


def bench(
    cascade: str, refine: str, max_range_m: float, rounds: int, small: bool, note: Callable[[str], None]
) -> Values:
    """Measure on the two cameras that ``headvox bench`` makes.

    Raises:
        HeadvoxError: no such cascade, or the GPU failed.
    """
    note("making the input")
    config = DetectorConfig(cascade=cascade, refine=refine, max_range_m=max_range_m)
    return measure(config, make_input(small).images, rounds, note)
