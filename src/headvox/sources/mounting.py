"""Where the sensor of clouds in files stood, when a user tells it: files mostly do not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from headvox.data import F32, F64, Cloud
from headvox.frames import OPTICAL, inverse
from headvox.pixelgrid import AXES, Grid, grid_of

WORDS = (
    "z forward, x right and y down (optical)",
    "x forward, y left and z up (REP 103)",
    "z backward, x right and y up (OpenGL)",
)
"""Of each of :data:`~headvox.pixelgrid.AXES`, and"""
BODY = 1
"""the one of them that is z up."""
AHEAD, PLAINLY = 0.3, 0.99
"""What is ahead of a sensor: where this share of the distance is along its axis (72 degrees); how many points are."""


class Mounting:
    """Places the clouds of one sensor, whose body (x forward, y left, z up) stands at ``T_world_mount`` (4, 4).

    Which way its axes point is told by the first cloud, for all of them, and ``say`` is told. Clouds whose file places
    them already are moved from there. Where ``T_world_mount`` is None nothing is moved, and ``say`` is told of a depth
    camera whose z is plainly not up.
    """

    def __init__(self, T_world_mount: F64 | None, say: Callable[[str], None]) -> None:
        self.T_world_mount = T_world_mount
        self._say = say
        self._axes: int | None = None

    def placed(self, cloud: Cloud) -> Cloud:
        """Return ``cloud`` in the world."""
        T_world_mount, T = self.T_world_mount, cloud.T_world_sensor
        if T is not None:
            return cloud if T_world_mount is None else replace(cloud, T_world_sensor=T_world_mount @ T)
        if T_world_mount is None:
            self._remark(cloud)
            return cloud
        if self._axes is None:
            self._axes = axes_of(cloud.points)
            self._say(f"{cloud.name}: its points are taken to have {WORDS[self._axes]}")
        T_body_sensor = OPTICAL @ inverse(AXES[self._axes])
        return replace(cloud, T_world_sensor=T_world_mount @ T_body_sensor)

    def _remark(self, cloud: Cloud) -> None:
        if self._axes is None:
            grid = grid_of(cloud.points)
            self._axes = BODY if grid is None else _index(grid)
            if self._axes != BODY:
                self._say(
                    f"{cloud.name}: its points are a depth camera's, {WORDS[self._axes]}, and are taken to be z up all "
                    "the same: say where it stands with --mount X Y Z ROLL PITCH YAW"
                )


def axes_of(points: F32) -> int:
    """Return which of :data:`~headvox.pixelgrid.AXES` the frame of ``points`` (N, 3) has.

    A depth camera's pixels tell it. Else it is the only one along which nearly all points lie ahead, or x forward.
    """
    grid = grid_of(points)
    if grid is not None:
        return _index(grid)
    lengths = np.linalg.norm(points, axis=1)
    known = np.isfinite(lengths) & (lengths > 0.0)
    directions = points[known] / lengths[known, None]
    shown = [np.count_nonzero(directions @ T[:3, 2] > AHEAD) for T in AXES]
    ahead = [k for k, count in enumerate(shown) if count >= PLAINLY * len(directions)]
    return ahead[0] if len(ahead) == 1 else BODY


def _index(grid: Grid) -> int:
    return next(k for k, T in enumerate(AXES) if np.array_equal(T, grid.T_sensor_optical))
