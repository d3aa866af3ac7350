"""What the tests of the command look at: small recordings, and a cascade that finds something in them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

# Finds something wherever there is a surface, and is sure of it: what it finds does not matter here.
CASCADE = """
format = "headvox-cascade"
version = 1
name = "anything"
summary = "Every surface is a head"
voxel_m = 0.05
subdivision = 2
occupancy = "parts"
min_score = 0.0
[[gate]]
name = "shell"
boxes = [{ centre = [0, 0, 0], size = [0.25, 0.25, 0.25] }]
min = 0.03
[[group]]
name = "ring"
ring = { radius = 0.1, height = 0.0, size = [0.1, 0.1, 0.1] }
[[stage]]
name = "only"
trees = [["ring.sum", 0.1, 4.25, 4.5]]
"""


def write_recording(folder: Path, frames: int, bad: tuple[int, ...] = ()) -> Path:
    """A camera 1.5 m high that looks ahead at a wall 2 m away with a ball before it."""
    (folder / "cam").mkdir(parents=True)
    depth = np.full((60, 80), 2000, np.uint16)
    v, u = np.mgrid[:60, :80]
    depth[(u - 40) ** 2 + (v - 30) ** 2 < 36] = 1500
    for name in ("good", "bad"):
        Image.fromarray(depth).save(folder / "cam" / f"{name}.png")
    (folder / "cam" / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\n and then nothing")
    camera: dict[str, Any] = {
        "width": 80,
        "height": 60,
        "fx": 70.0,
        "fy": 70.0,
        "cx": 39.5,
        "cy": 29.5,
        "depth_scale": 0.001,
    }
    camera["T_world_camera"] = [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]]
    lines = [
        {"stamp_ns": 100_000_000 * k, "depth": {"cam": f"cam/{'bad' if k in bad else 'good'}.png"}}
        for k in range(frames)
    ]
    text = {"format": "headvox-recording", "version": 1, "cameras": {"cam": camera}, "frames": lines}
    (folder / "recording.json").write_text(json.dumps(text))
    return folder
