"""How long it takes from the start of Python to the first heads."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from headvox.bench.input import Input
from headvox.data import Intrinsics
from headvox.errors import HeadvoxError

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


def first_result(data: Input, cascade: str, refine: str, times: int) -> dict[str, Any]:
    """Start a fresh Python ``times`` times, and let it find the heads in one frame; return the medians, in seconds.

    Raises:
        HeadvoxError: it failed.
    """
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
