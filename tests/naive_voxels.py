"""The slow and obvious twin of points, voxels and boxes: what is where, and how much of it is in a box.

Cascades are read as their file has them, in metres, and are turned into voxels by a rule of this file's own.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from headvox.data import Cloud, DepthImage
from headvox.fuse import Region
from headvox.masks.cascade import Box

f32 = np.float32


# --------------------------------------------------------------------------------------------------------------- points


def inside(x, y, z, limits) -> bool:
    dx, dy, dz = x - limits[0], y - limits[1], z - limits[2]
    return bool(dx * dx + dy * dy + dz * dz < limits[3] and limits[4] <= z < limits[5])


def moved(T, x, y, z):
    """Return T (4, 4) applied to a point, in the type of both, summed as documented."""
    return tuple(T[k, 3] + (T[k, 0] * x + T[k, 1] * y + T[k, 2] * z) for k in range(3))


def fuse(clouds: list[Cloud], region: Region) -> np.ndarray:
    limits = [f32(v) for v in (*region.centre, region.radius_m**2, region.min_height_m, region.max_height_m)]
    kept = []
    with np.errstate(all="ignore"):
        for cloud in clouds:
            T = np.eye(4) if cloud.T_world_sensor is None else cloud.T_world_sensor
            for point in cloud.points:
                world = moved(T.astype(f32), *point)
                if inside(*world, limits):
                    kept.append(world)
    return np.array(kept, f32).reshape(-1, 3)


# --------------------------------------------------------------------------------------------------------------- voxels


@dataclass
class Lattice:
    """Voxels from ``origin`` on; ``limits`` is the region in parts of voxels from the origin, in float32."""

    origin: tuple[float, float, float]
    shape: tuple[int, int, int]
    part: float
    parts: int
    limits: list[np.float32]


def lattice_over(region: Region, voxel: float, subdivision: int) -> Lattice:
    lowest = (region.centre[0] - region.radius_m, region.centre[1] - region.radius_m, region.min_height_m)
    origin = tuple(math.floor(v / voxel) * voxel for v in lowest)
    across = math.ceil(2 * region.radius_m / voxel) + 2
    high = math.ceil((region.max_height_m - region.min_height_m) / voxel) + 2
    part = voxel / subdivision
    per_part = 1.0 / part
    limits = [f32((region.centre[k] - origin[k]) * per_part) for k in range(3)]
    limits.append(f32(region.radius_m * region.radius_m * per_part * per_part))
    limits.append(f32((region.min_height_m - origin[2]) * per_part))
    limits.append(f32((region.max_height_m - origin[2]) * per_part))
    return Lattice(origin, (across, across, high), part, subdivision, limits)


class Grid:
    """Which parts of which voxels hold points, and how many points a voxel holds."""

    def __init__(self, lattice: Lattice) -> None:
        self.lattice = lattice
        self.bits = np.zeros(lattice.shape, np.uint8)
        self.counts = np.zeros(lattice.shape, np.uint32)

    def enter(self, x, y, z) -> None:
        """Enter a point, in parts from the origin."""
        if inside(x, y, z, self.lattice.limits):
            # Rounding may put a point that is just within range a hair below the first cell.
            steps = [max(0, math.floor(v)) for v in (x, y, z)]
            voxel = tuple(step // self.lattice.parts for step in steps)
            a, b, c = (step % self.lattice.parts for step in steps)
            self.bits[voxel] |= 2 ** (4 * a + 2 * b + c)
            self.counts[voxel] += 1

    def enter_cloud(self, cloud: Cloud) -> None:
        T = np.eye(4) if cloud.T_world_sensor is None else np.array(cloud.T_world_sensor, dtype=np.float64)
        to_parts = T.copy()
        to_parts[:3, 3] -= self.lattice.origin
        to_parts[:3] /= self.lattice.part
        to_parts = to_parts.astype(f32)
        with np.errstate(all="ignore"):
            for point in cloud.points:
                self.enter(*moved(to_parts, *point))

    def enter_depth(self, image: DepthImage) -> None:
        camera, T, part = image.intrinsics, image.T_world_camera, self.lattice.part
        scale = camera.depth_scale / part
        t = [f32((T[k, 3] - self.lattice.origin[k]) / part) for k in range(3)]
        with np.errstate(all="ignore"):
            for v in range(camera.height):
                down = (v - camera.cy) / camera.fy
                for u in range(camera.width):
                    if image.depth[v, u] == 0:
                        continue
                    depth = f32(image.depth[v, u])
                    across = (u - camera.cx) / camera.fx
                    ray = [
                        f32((T[k, 0] * across + T[k, 2]) * scale) + f32(T[k, 1] * down * scale)
                        for k in range(3)
                    ]
                    self.enter(*(t[k] + depth * ray[k] for k in range(3)))

    def amounts(self, counting: bool) -> np.ndarray:
        """Return what an integral volume adds up, as int64."""
        return weights(self.counts if counting else self.bits)


def weights(cells: np.ndarray) -> np.ndarray:
    """Return the number of points of a count grid, or the number of bits of a parts grid."""
    if cells.dtype == np.uint8:
        return np.array([bin(value).count("1") for value in cells.ravel()], np.int64).reshape(cells.shape)
    return cells.astype(np.int64)


def integral_volume(cells: np.ndarray) -> np.ndarray:
    """Return S[x, y, z] = the sum of everything below x, y and z, modulo 2**32."""
    amount = weights(cells)
    S = np.zeros([n + 1 for n in cells.shape], np.uint32)
    for x in range(S.shape[0]):
        for y in range(S.shape[1]):
            for z in range(S.shape[2]):
                S[x, y, z] = int(amount[:x, :y, :z].sum()) % 2**32
    return S


def box_sum(amount: np.ndarray, box) -> int:
    """Return the sum of ``amount`` over x0 x1 y0 y1 z0 z1, half-open; nothing lies outside of the grid."""
    x0, x1, y0, y1, z0, z1 = (max(0, int(edge)) for edge in box)
    return int(amount[x0:x1, y0:y1, z0:z1].sum())


# ----------------------------------------------------------------------------------------------------- metres to voxels


@functools.cache
def voxel_range(centre: float, size: float, voxel: float) -> tuple[int, int]:
    """Return the half-open range of voxels whose middle is nearest to ``centre``; of two, the one farther out."""
    count = max(1, round(size / voxel))
    wanted = Fraction(round(centre / voxel, 6))
    nearest = None
    for start in range(math.floor(wanted) - count - 2, math.ceil(wanted) + count + 3):
        middle = start + Fraction(count - 1, 2)
        rank = (abs(middle - wanted), -start if wanted >= 0 else start)
        if nearest is None or rank < nearest[0]:
            nearest = (rank, start)
    return nearest[1], nearest[1] + count


@functools.cache
def voxel_box(box: Box, voxel: float, yaw: float = 0.0) -> list[int]:
    x, y, z = box.centre
    if yaw:
        x, y = math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y
    edges = []
    for centre, size in zip((x, y, z), box.size, strict=True):
        edges += voxel_range(centre, size, voxel)
    return edges


def volume(box: list[int]) -> int:
    return (box[1] - box[0]) * (box[3] - box[2]) * (box[5] - box[4])


def about(cell, box) -> list[int]:
    return [int(cell[k // 2]) + edge for k, edge in enumerate(box)]
