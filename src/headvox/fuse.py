"""Sensors -> world points: rigid transforms, range and height limits, no NaN.

The detector itself never makes the fused cloud (it voxelizes each sensor's readings as they are read); this stage is
for those who want the cloud. It keeps the points that the detector keeps, but for roundings at the very limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from headvox.data import F32, F64, Cloud
from headvox.machine.kernels import kernel, rule


@dataclass(frozen=True, slots=True)
class Region:
    """Where heads are searched: a ball of ``radius_m`` about ``centre``, between two world heights (metres)."""

    centre: tuple[float, float, float]
    radius_m: float
    min_height_m: float
    max_height_m: float

    def limits(self) -> F32:
        """Return (6,) float32: centre, radius squared, lowest and highest height, as the kernels read it."""
        return np.array(
            [*self.centre, self.radius_m * self.radius_m, self.min_height_m, self.max_height_m],
            dtype=np.float32,
        )


@rule
def inside(x, y, z, limits):
    """Tell whether a world point is within range and height. False for NaN: every comparison with NaN is."""
    dx = x - limits[0]
    dy = y - limits[1]
    dz = z - limits[2]
    return (dx * dx + dy * dy + dz * dz < limits[3]) & (z >= limits[4]) & (z < limits[5])


@kernel
def _fuse_cloud(points: F32, T: F32, limits: F32, out: F32) -> int:
    kept = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        wx = T[0, 3] + (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z)
        wy = T[1, 3] + (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z)
        wz = T[2, 3] + (T[2, 0] * x + T[2, 1] * y + T[2, 2] * z)
        if inside(wx, wy, wz, limits):
            out[kept, 0] = wx
            out[kept, 1] = wy
            out[kept, 2] = wz
            kept += 1
    return kept


def fuse(clouds: Sequence[Cloud], region: Region) -> F32:
    """Return the points of all ``clouds`` that lie in ``region``, (N, 3) float32 in the world frame.

    Points are in the order of the sensors and of their own; NaN and infinite points are dropped.
    """
    out = np.empty((sum(len(cloud.points) for cloud in clouds), 3), dtype=np.float32)
    kept = 0
    for cloud in clouds:
        kept += _fuse_cloud(cloud.points, placement(cloud.T_world_sensor), region.limits(), out[kept:])
    return out[:kept]


def placement(T_world_sensor: F64 | None) -> F32:
    """Return the transform as the kernels read it, (4, 4) float32; points without one are in the world already."""
    return np.eye(4, dtype=np.float32) if T_world_sensor is None else T_world_sensor.astype(np.float32)
