"""The floor: the largest plane that nothing lies below.

Planes are tried through three neighbouring points each (Fischler and Bolles, 1981); the best is fitted to all of its
points by least squares. A table is no floor as long as something of the floor beside it is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from headvox.data import F64, DepthImage, Frame
from headvox.frames import inverse

TRIES = 600
MOST_POINTS, FEW_POINTS = 20_000, 4_000  # to fit a plane to, and to compare planes by
NEAR_M, NEAR_PER_M2 = (
    0.015,
    0.006,
)  # how far a point of the floor may lie off it: noise grows with distance squared
BELOW_SHARE = 0.02  # mirror images in polished floors, flying pixels
LEAST_HEIGHT_M = 0.2  # of the sensor above it
LEAST_SHARE = 0.05  # of the points: less is no floor
PLAIN_SHARE = 0.15  # from this on a floor is worth a warning
UP_THE_IMAGE = np.array([0.0, -1.0, 0.0])  # where up is for a camera that is held upright
STEEPEST = np.cos(np.radians(60.0))  # between the floor's normal and where up is thought to be
REACH_M = 0.6  # between the points that a plane is laid through
REFITS = 4


@dataclass(frozen=True, slots=True)
class Floor:
    """The plane ``normal . p + height_m = 0``: ``normal`` (3,) points up, ``height_m`` is that of the frame's origin.

    ``share`` is how many of the points lie on it, ``rms_m`` how far off they lie.
    """

    normal: F64
    height_m: float
    share: float
    rms_m: float


def find_floor(points: F64, up: F64, origin: F64 | None = None, seed: int = 0) -> Floor | None:
    """Return the floor under ``points`` (N, 3), metres; None where there is none to be seen.

    ``up`` (3,) is roughly where up is, within 60 degrees. Noise is taken to grow with the distance from ``origin``,
    the sensor, by default that of the points' frame. The same points and ``seed`` give the same floor.
    """
    rng = np.random.default_rng(seed)
    points = np.asarray(points, np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) > MOST_POINTS:
        points = points[np.sort(rng.choice(len(points), MOST_POINTS, replace=False))]
    if len(points) < 100:
        return None
    origin = np.zeros(3) if origin is None else origin
    away = points - origin
    near = NEAR_M + NEAR_PER_M2 * (away**2).sum(axis=1)
    few = rng.permutation(len(points))[:FEW_POINTS]
    best, most = None, 0.0
    for normal, height in _planes(points, up, rng):
        if normal @ origin + height < LEAST_HEIGHT_M:
            continue
        above = points[few] @ normal + height
        if (above < -3.0 * near[few]).mean() > BELOW_SHARE:
            continue
        share = float((np.abs(above) < near[few]).mean())
        if share > most:
            best, most = (normal, height), share
    if best is None or most < LEAST_SHARE:
        return None
    normal, height = best
    for _ in range(REFITS):
        on = np.abs(points @ normal + height) < near
        normal, height = _fit(points[on], 1.0 / near[on], up)
    if normal @ up < STEEPEST or normal @ origin + height < LEAST_HEIGHT_M:
        return None
    off = points @ normal + height
    on = np.abs(off) < near
    return Floor(normal, height, float(on.mean()), float(np.sqrt((off[on] ** 2).mean())))


def _planes(points: F64, up: F64, rng: np.random.Generator) -> list[tuple[F64, float]]:
    """Return planes through three points each that lie near each other and could be level."""
    first = rng.integers(0, len(points), TRIES)
    chosen = []
    for a in first:
        beside = rng.integers(0, len(points), 200)
        beside = beside[((points[beside] - points[a]) ** 2).sum(axis=1) < REACH_M**2]
        if len(beside) < 2:
            continue
        normal = np.cross(points[beside[0]] - points[a], points[beside[1]] - points[a])
        length = float(np.sqrt((normal**2).sum()))
        if length < 0.02 * REACH_M**2:
            continue
        normal = normal / length * (1.0 if normal @ up > 0 else -1.0)
        if normal @ up >= STEEPEST:
            chosen.append((normal, float(-normal @ points[a])))
    return chosen


def _fit(points: F64, weights: F64, up: F64) -> tuple[F64, float]:
    """Return the plane with the least weighted squares."""
    centre = (weights[:, None] * points).sum(axis=0) / weights.sum()
    offset = (points - centre) * weights[:, None]
    _, axes = np.linalg.eigh(offset.T @ offset)
    normal = axes[:, 0] * (1.0 if axes[:, 0] @ up > 0 else -1.0)
    return normal, float(-normal @ centre)


def level(floor: Floor) -> F64:
    """Return T_level_camera (4, 4): z up, the origin on the floor below the camera, x where the camera looks."""
    ahead = np.array([0.0, 0.0, 1.0])
    if abs(floor.normal @ ahead) > 0.95:  # it looks straight down, or up: its top is ahead
        ahead = np.array([0.0, -1.0, 0.0])
    x = ahead - (ahead @ floor.normal) * floor.normal
    x /= np.sqrt((x**2).sum())
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(floor.normal, x), floor.normal])
    T[2, 3] = floor.height_m
    return T


def camera_points(image: DepthImage, most: int = MOST_POINTS) -> F64:
    """Return points (N, 3) of an image in the camera's own optical frame, evenly over the image."""
    step = max(1, int(np.sqrt(image.depth.size / most)))
    depth = image.depth[::step, ::step]
    v, u = np.nonzero(depth)
    lens = image.intrinsics
    z = depth[v, u] * lens.depth_scale
    return np.stack([(u * step - lens.cx) / lens.fx * z, (v * step - lens.cy) / lens.fy * z, z], axis=-1)


@dataclass(frozen=True, slots=True)
class Stated:
    """What is wrong with a floor as the extrinsics have it: how steep it is, and how high under the sensor."""

    tilt_deg: float
    z_m: float

    @property
    def is_level(self) -> bool:
        """Whether heads can be looked for with it."""
        return self.tilt_deg < 6.0 and abs(self.z_m) < 0.25


def stated(floor: Floor, T_world_sensor: F64) -> Stated:
    """Return where a floor, in the sensor's frame, is by ``T_world_sensor``."""
    normal = T_world_sensor[:3, :3] @ floor.normal
    tilt = float(np.degrees(np.arccos(np.clip(normal[2], -1.0, 1.0))))
    return Stated(tilt, float(T_world_sensor[2, 3] - floor.height_m))


def floor_of(images: Sequence[DepthImage]) -> Floor | None:
    """Return the floor in images of one camera that stands still, in its optical frame; None where none is to be seen.

    It is looked for where the extrinsics have it, and if it is not there, towards the lower edge of the image.
    """
    points = np.concatenate([camera_points(image) for image in images])
    T_world_camera = images[0].T_world_camera
    as_told = find_floor(points, inverse(T_world_camera)[:3, 2])
    if as_told is not None and stated(as_told, T_world_camera).is_level:
        return as_told
    return find_floor(points, UP_THE_IMAGE) or as_told


def wrong_floor(frame: Frame) -> str | None:
    """Return a line about a floor that is not where z = 0, by the first camera that sees one; None if all is well."""
    for image in frame.depths:
        floor = floor_of([image])
        if floor is None or floor.share < PLAIN_SHARE:
            continue
        told = stated(floor, image.T_world_camera)
        if told.is_level:
            return None
        return (
            f"{image.name}: what looks like the floor tilts by {told.tilt_deg:.0f} degrees and lies at "
            f"z = {told.z_m:.2f} m: heads are sought above a level floor at z = 0 (see headvox align)"
        )
    return None
