"""What ``headvox bench`` measures on: an input that is the same everywhere, and a machine that is not."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from headvox.data import F32, Cloud, DepthImage

SEED = 2
SHELL_POINTS = 9000
SHELL_REACH_M = 0.155


@dataclass(frozen=True, slots=True)
class Input:
    """What is measured on: the same room as two depth images, as a cloud (N, 3) in the world and as the clouds of the
    two cameras, each in its frame; and a head alone.
    """

    images: tuple[DepthImage, ...]
    cloud: F32
    clouds: tuple[Cloud, ...]
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
    clouds = (
        Cloud(
            image.name,
            unproject(image.depth, image.intrinsics, np.eye(4)).astype(np.float32),
            image.T_world_camera,
        )
        for image in frame.depths
    )
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
        tuple(clouds),
        np.ascontiguousarray(shell[chosen]),
        len(postures),
    )


def describe_machine() -> dict[str, Any]:
    """Return what a time depends on: processor, cores, versions, and how busy it is."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "cores_for_this_process": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "numba": version("numba"),
        "load_average": load_average(),
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def load_average() -> list[float] | None:
    """Return how many processes wanted to run over the last 1, 5 and 15 minutes; None where that is not known."""
    return [round(v, 2) for v in os.getloadavg()] if hasattr(os, "getloadavg") else None
