"""What a frame allocates once everything is there, and whether anything is kept."""

from __future__ import annotations

import gc
import os
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np

from headvox.bench.input import Input
from headvox.pipeline import Detector


def watch_memory(detector: Detector, data: Input, frames: int) -> dict[str, Any]:
    """Return what a frame of depth images allocates and keeps, and what the process grew by in ``frames``."""
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
