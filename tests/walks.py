"""What the trackers of the tests are fed: heads that stand and walk, and a camera that looks at one place."""

from __future__ import annotations

import numpy as np
import scenes

from headvox.data import DepthImage, Frame, Heads, Intrinsics, Tracks
from headvox.tracking.tracker import Tracker

MS = 1_000_000
RATE_MS = 100


def heads(*centres, sure=True, score=5.0) -> Heads:
    n = len(centres)
    return Heads(
        np.array(centres, np.float64).reshape(n, 3),
        np.full((n, 4), np.nan),
        np.full(n, 0.1),
        np.full(n, score),
        sure=np.full(n, sure),
    )


def at(step: float) -> Frame:
    return Frame(round(step * RATE_MS) * MS)


def follow(tracker: Tracker, path, first: int = 0) -> Tracks:
    """Feed a head at each of ``path``, None where it is not seen; return the last tracks."""
    for k, centre in enumerate(path, first):
        tracks = tracker.update(heads() if centre is None else heads(centre), at(k))
    return tracks


STANDING = [(1.0, 0.5, 1.6)]


def walk(steps: int, first: int = 0, speed=(0.8, 0.3)) -> list[tuple[float, float, float]]:
    return [(speed[0] * 0.1 * k, speed[1] * 0.1 * k, 1.6) for k in range(first, first + steps)]


CAMERA = Intrinsics(80, 60, 60.0, 60.0, 39.5, 29.5)
LOOKING = scenes.looking_along_x(0.0, 0.0, 1.6)
PLACE = (2.0, 0.0, 1.6)


def image(depth_m: float, camera: Intrinsics = CAMERA, T: np.ndarray = LOOKING) -> DepthImage:
    depth = np.full((camera.height, camera.width), round(1000 * depth_m), np.uint16)
    return DepthImage("front", depth, camera, T)
