"""Depth cameras off the shelf, and the places where robots and rooms have them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from headvox.data import F64, Intrinsics
from headvox.errors import HeadvoxError
from headvox.frames import inverse, transform
from headvox.synth.camera import IDEAL, Lidar, Sensor, d435i, kinect
from headvox.synth.rays import Mesh, look
from headvox.synth.room import Room

Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class Camera:
    """A depth camera that stands still."""

    name: str
    intrinsics: Intrinsics
    T_world_camera: F64
    sensor: Sensor = IDEAL


@dataclass(frozen=True, slots=True)
class PlacedLidar:
    """A LiDAR that stands still; x forward, z up in its own frame."""

    lidar: Lidar
    T_world_sensor: F64


def camera_pose(xyz: Sequence[float], yaw_rad: float, down_rad: float, roll_rad: float = 0.0) -> F64:
    """T_world_camera (4, 4) of a camera that looks along ``yaw_rad``, ``down_rad`` below the horizontal."""
    # from optical axes to x forward, y left, z up
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = Rotation.from_euler("ZYX", (yaw_rad, down_rad, roll_rad)).as_matrix() @ level
    T_world_camera[:3, 3] = xyz
    return T_world_camera


def lens(kind: str, rng: Rng | None = None) -> Intrinsics:
    """Intrinsics of "kinect" and "d435i-vga" (640x480), "d435i" (848x480) or "d435i-small" (424x240)."""
    spread = 0.0 if rng is None else float(rng.uniform(-1.0, 1.0))
    if kind == "kinect":
        f = 547.0 + 23.0 * spread
        return Intrinsics(640, 480, f, f, 319.5 + 4.0 * spread, 239.5 - 3.0 * spread)
    modes = {"d435i": (848, 480, 430.0), "d435i-vga": (640, 480, 387.0), "d435i-small": (424, 240, 215.0)}
    if kind not in modes:
        raise HeadvoxError(f"Expected a lens kinect, {', '.join(modes)}, got {kind!r}.", "Name one of them.")
    width, height, f = modes[kind]
    f *= 1.0 + 0.03 * spread
    return Intrinsics(width, height, f, f, width / 2 - 0.5 + 3.0 * spread, height / 2 - 0.5 - 2.0 * spread)


def sample_device(rng: Rng) -> tuple[Intrinsics, Sensor]:
    """A camera off the shelf, from clean to terrible; behind one in thirty the background is cut away."""
    kind = str(rng.choice(["kinect", "d435i", "d435i-vga", "d435i-small"], p=[0.45, 0.2, 0.2, 0.15]))
    sensor = kinect(rng) if kind == "kinect" else d435i(rng)
    return lens(kind, rng), replace(sensor, cut_out=bool(rng.uniform() < 1.0 / 30.0))


def sample_camera_pose(rng: Rng, room: Room, targets: F64, intrinsics: Intrinsics) -> F64:
    """A place that a robot, a tripod, a shelf or a wall offers; most see some of ``targets`` (N, 3)."""
    tries = 1 if len(targets) == 0 or rng.uniform() < 0.15 else 4
    poses = [_camera_somewhere(rng, room, targets) for _ in range(tries + 2)]
    mesh = room.mesh()
    clear = [pose for pose in poses if _is_clear(mesh, pose)]
    return max((clear or poses)[:tries], key=lambda pose: _in_view(targets, intrinsics, pose))


def _is_clear(mesh: Mesh, T_world_camera: F64) -> bool:
    """Whether the camera is neither in a thing nor right in front of one, seen through a coarse lens."""
    view = look(mesh, Intrinsics(32, 24, 20.0, 20.0, 15.5, 11.5), T_world_camera)
    return bool((view.distance_m < 0.4).mean() < 0.2)


def _in_view(targets: F64, intrinsics: Intrinsics, T_world_camera: F64) -> int:
    """How many points (N, 3) fall well into the image, no farther than most depth cameras see."""
    x, y, z = transform(inverse(T_world_camera), targets).T
    u, v = intrinsics.fx * x / z + intrinsics.cx, intrinsics.fy * y / z + intrinsics.cy
    inside = (u > 0) & (v > 0) & (u < intrinsics.width) & (v < intrinsics.height)
    return int((inside & (z > 0.5) & (z < 5.5)).sum())


def _camera_somewhere(rng: Rng, room: Room, targets: F64) -> F64:
    for attempt in range(40):
        kind = rng.uniform()
        if kind < 0.2:  # a low robot
            height, at_wall = float(rng.uniform(0.3, 0.7)), False
        elif kind < 0.7:  # a robot's head, a tripod, a table
            height, at_wall = float(rng.uniform(0.8, 1.7)), False
        else:  # a shelf, a wall, a corner
            height, at_wall = float(rng.uniform(1.6, 2.6)), True
        half = np.array([room.x_m, room.y_m]) / 2.0 - 0.12
        xy = rng.uniform(-half, half)
        if at_wall:
            side = int(rng.integers(2))
            xy[side] = half[side] * float(rng.choice([-1.0, 1.0]))
        reach = xy + 0.08 * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1], [0, 0]])
        if height < 1.8 and room.plan.conflict(reach) > 0.0 and attempt < 30:
            continue
        aimed = len(targets) > 0 and rng.uniform() < 0.85
        middle = np.array([*(rng.uniform(-0.3, 0.3, 2) * (room.x_m, room.y_m)), 1.0])
        target = targets[int(rng.integers(len(targets)))] if aimed else middle
        away = target[:2] - xy
        distance = float(np.hypot(away[0], away[1]))
        if not 0.7 < distance < 7.0 or (len(targets) and np.hypot(*(targets[:, :2] - xy).T).min() < 0.6):
            continue
        # Cameras are set up for a place, not for a person: heads end up anywhere in the image.
        yaw = float(np.arctan2(away[1], away[0]) + rng.normal(0.0, 0.22))
        down = float(np.arctan2(height - target[2] + 0.2, distance) + rng.normal(0.0, 0.12))
        down = float(np.clip(down, np.radians(-20.0), np.radians(45.0)))
        return camera_pose((xy[0], xy[1], height), yaw, down, float(rng.normal(0.0, 0.02)))
    return camera_pose(
        (-room.x_m / 2 + 0.2, -room.y_m / 2 + 0.2, 2.0), float(np.arctan2(room.y_m, room.x_m)), 0.3
    )
