"""Points or depth images -> an occupancy grid.

A voxel of a *parts* grid is one byte with a bit for each of its 2x2x2 parts (or one bit for the voxel itself, with a
subdivision of 1): a bit says "some point fell in here". A voxel of a *count* grid is the number of its points. Both
are integers that do not depend on the order of the points, so any number of threads gives the same grid.

Cells are half-open: a point on the border of two cells belongs to the upper one. Coordinates are float32; a cell is
``floor((world - origin) / cell edge)``, the sum taken as written in the kernels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.data import F32, F64, U16, Cloud, DepthImage
from headvox.errors import HeadvoxError
from headvox.fuse import Region
from headvox.kernels import kernel, rule

NOWHERE = np.int32(-1)
FARTHEST = np.int32(2**31 - 1)
MOST_CELLS = 1 << 28  # a cell's number and its part fit an int32
BLOCK = 1024  # points coded at a time: the codes stay in the first-level cache

Cells = npt.NDArray[np.uint8] | npt.NDArray[np.uint32]


@dataclass(frozen=True, slots=True)
class Lattice:
    """The voxels of a region: ``shape`` cells of ``voxel_m``, the corner of cell 0, 0, 0 at ``origin`` (world, m).

    The origin is a whole number of voxels, so that the cells of two overlapping regions coincide.
    """

    origin: tuple[float, float, float]
    voxel_m: float
    shape: tuple[int, int, int]
    subdivision: int
    region: Region

    @classmethod
    def over(cls, region: Region, voxel_m: float, subdivision: int) -> Lattice:
        """Return the lattice that covers ``region``.

        Raises:
            HeadvoxError: more voxels than a grid can number.
        """
        (cx, cy, _), radius = region.centre, region.radius_m
        ox, oy, oz = (
            math.floor(v / voxel_m) * voxel_m for v in (cx - radius, cy - radius, region.min_height_m)
        )
        # The same shape wherever the centre lies, and a spare layer at the upper end: in float32 a point just below a
        # limit may round onto it.
        nx = ny = math.ceil(2 * radius / voxel_m) + 2
        nz = math.ceil((region.max_height_m - region.min_height_m) / voxel_m) + 2
        if nx * ny * nz > MOST_CELLS:
            raise HeadvoxError(
                f"The region has {nx} x {ny} x {nz} voxels of {voxel_m:g} m: more than {MOST_CELLS} are not searched.",
                "Set a smaller max_range_m, less height, or larger voxels.",
            )
        return cls((ox, oy, oz), voxel_m, (nx, ny, nz), subdivision, region)

    @property
    def part_m(self) -> float:
        """Edge of the smallest thing the grid can tell apart."""
        return self.voxel_m / self.subdivision

    @property
    def odd(self) -> int:
        """Whether cell 0, 0, 0 is an odd number of voxels from the world's origin, along the axes: 0 or 1."""
        return sum(round(v / self.voxel_m) for v in self.origin) & 1

    def limits(self) -> F32:
        """Return the region's limits in parts from the origin, as the kernels read them."""
        # In float64 up to the last step: a centre in earth coordinates, rounded to float32 first, is off by more
        # than the spare layer, and the kernels would write outside of the grid.
        region, scale = self.region, 1.0 / self.part_m
        return np.array(
            [
                *((region.centre[k] - self.origin[k]) * scale for k in range(3)),
                region.radius_m * region.radius_m * scale * scale,
                (region.min_height_m - self.origin[2]) * scale,
                (region.max_height_m - self.origin[2]) * scale,
            ],
            dtype=np.float32,
        )

    def centres(self, cells: npt.NDArray[Any]) -> F64:
        """Return the world centres (N, 3) of ``cells`` (N, 3)."""
        centres: F64 = (np.asarray(cells, dtype=np.float64) + 0.5) * self.voxel_m + np.array(self.origin)
        return centres


def new_span() -> npt.NDArray[np.int32]:
    """Return an empty span of codes: lowest and highest."""
    return np.array([FARTHEST, NOWHERE], dtype=np.int32)


@rule
def _code(x, y, z, limits, ny, nz, shift):  # type: ignore[no-untyped-def]
    """Return cell * 8 + part of a place in parts from the origin, or NOWHERE if it is outside the region or NaN."""
    dx = x - limits[0]
    dy = y - limits[1]
    dz = z - limits[2]
    keep = (dx * dx + dy * dy + dz * dz < limits[3]) & (z >= limits[4]) & (z < limits[5])
    ix = np.int32(x)
    iy = np.int32(y)
    iz = np.int32(z)
    cell = ((ix >> shift) * ny + (iy >> shift)) * nz + (iz >> shift)
    part = ((ix & shift) << 2) | ((iy & shift) << 1) | (iz & shift)
    return (cell << 3 | part) if keep else NOWHERE


@kernel
def _code_points(xyz, T, limits, shape, shift, span, codes):  # type: ignore[no-untyped-def]
    """Write the code of each point to ``codes``; widen ``span`` by them.

    ``xyz`` is flat: with a row length that the compiler knows, it loads whole vectors.
    """
    ny, nz, m = np.int32(shape[1]), np.int32(shape[2]), np.int32(shift)
    bounds = (limits[0], limits[1], limits[2], limits[3], limits[4], limits[5])
    tx, ty, tz = T[0, 3], T[1, 3], T[2, 3]
    xx, xy, xz = T[0, 0], T[0, 1], T[0, 2]
    yx, yy, yz = T[1, 0], T[1, 1], T[1, 2]
    zx, zy, zz = T[2, 0], T[2, 1], T[2, 2]
    lowest, highest = span[0], span[1]
    for i in range(xyz.shape[0] // 3):
        px, py, pz = xyz[3 * i], xyz[3 * i + 1], xyz[3 * i + 2]
        x = tx + (xx * px + xy * py + xz * pz)
        y = ty + (yx * px + yy * py + yz * pz)
        z = tz + (zx * px + zy * py + zz * pz)
        code = _code(x, y, z, bounds, ny, nz, m)
        codes[i] = code
        lowest = min(lowest, code if code >= 0 else FARTHEST)
        highest = max(highest, code)
    span[0], span[1] = lowest, highest


@kernel
def _code_depth_row(line, column, row_x, row_y, row_z, t, limits, shape, shift, span, codes):  # type: ignore[no-untyped-def]
    """As :func:`_code_points`, for one row of a depth image: a pixel's point is ``t + depth * (column + row)``."""
    ny, nz, m = np.int32(shape[1]), np.int32(shape[2]), np.int32(shift)
    bounds = (limits[0], limits[1], limits[2], limits[3], limits[4], limits[5])
    tx, ty, tz = t[0], t[1], t[2]
    column_x, column_y, column_z = column[0], column[1], column[2]
    lowest, highest = span[0], span[1]
    for u in range(line.shape[0]):
        depth = np.float32(line[u])
        x = tx + depth * (column_x[u] + row_x)
        y = ty + depth * (column_y[u] + row_y)
        z = tz + depth * (column_z[u] + row_z)
        code = _code(x, y, z, bounds, ny, nz, m)
        code = code if line[u] > 0 else NOWHERE
        codes[u] = code
        lowest = min(lowest, code if code >= 0 else FARTHEST)
        highest = max(highest, code)
    span[0], span[1] = lowest, highest


@kernel
def _mark(codes, counting, cells):  # type: ignore[no-untyped-def]
    """Enter coded points into the flat grid; ``codes`` is used up.

    What lies nowhere is taken out first, without a branch: whether a point is kept is nothing a processor can guess.
    Indices are unsigned, because a signed one costs a check for counting from the end.
    """
    kept = np.uint64(0)
    for i in range(codes.shape[0]):
        code = codes[i]
        codes[kept] = code
        kept += np.uint64(code >= 0)
    if counting:
        for i in range(kept):
            cells[np.uint32(codes[i]) >> np.uint32(3)] += 1
    else:
        for i in range(kept):
            code = np.uint32(codes[i])
            cells[code >> np.uint32(3)] |= np.uint8(1) << (code & np.uint32(7))


@kernel
def mark_points(points, T, limits, shape, shift, counting, span, cells):  # type: ignore[no-untyped-def]
    """Enter ``points`` (N, 3) into ``cells`` and widen ``span``."""
    codes = np.empty(BLOCK, np.int32)
    xyz = points.reshape(-1)
    for start in range(0, points.shape[0], BLOCK):
        count = min(BLOCK, points.shape[0] - start)
        _code_points(xyz[3 * start : 3 * (start + count)], T, limits, shape, shift, span, codes)
        _mark(codes[:count], counting, cells)


@kernel
def mark_depth(depth, first, last, column, row, t, limits, shape, shift, counting, span, cells):  # type: ignore[no-untyped-def]
    """Enter rows ``first`` to ``last`` (exclusive) of a depth image into ``cells`` and widen ``span``."""
    codes = np.empty(depth.shape[1], np.int32)
    for v in range(first, last):
        _code_depth_row(
            depth[v], column, row[0, v], row[1, v], row[2, v], t, limits, shape, shift, span, codes
        )
        _mark(codes, counting, cells)


@kernel
def occupied_box(cells, span, box):  # type: ignore[no-untyped-def]
    """Write to ``box`` the lowest and highest occupied cell in x, y, z; the codes in ``cells`` lie within ``span``."""
    _, ny, nz = cells.shape
    box[0], box[3] = (span[0] >> 3) // (ny * nz), (span[1] >> 3) // (ny * nz)
    box[1], box[4] = ny, -1
    over = np.zeros(nz, np.uint8)
    for x in range(box[0], box[3] + 1):
        for y in range(ny):
            column = cells[x, y]
            any_bits = np.uint8(0)
            for z in range(nz):
                bit = np.uint8(column[z] != 0)
                any_bits |= bit
                over[z] |= bit
            if any_bits:
                box[1] = min(box[1], y)
                box[4] = max(box[4], y)
    box[2], box[5] = nz, -1
    for z in range(nz):
        if over[z]:
            box[2] = min(box[2], z)
            box[5] = z


@kernel
def merge(cells, other, span, counting):  # type: ignore[no-untyped-def]
    """Add what another thread marked within ``span`` of the flat grid, and clear it there."""
    first, last = span[0] >> 3, (span[1] >> 3) + 1
    mine, theirs = cells[first:last], other[first:last]
    if counting:
        for i in range(mine.shape[0]):
            mine[i] += theirs[i]
    else:
        for i in range(mine.shape[0]):
            mine[i] |= theirs[i]
    theirs[:] = 0


@dataclass(frozen=True, slots=True)
class Rays:
    """A depth camera as the kernels read it: a pixel's point, in parts from the lattice's origin, is
    ``t + depth * (column[:, u] + row[:, v])`` with the raw depth value.
    """

    column: F32
    row: F32
    t: F32

    @classmethod
    def of(cls, image: DepthImage, lattice: Lattice) -> Rays:
        """Return the rays of ``image``'s camera in ``lattice``."""
        camera, T = image.intrinsics, image.T_world_camera
        scale = camera.depth_scale / lattice.part_m
        across = (np.arange(camera.width) - camera.cx) / camera.fx
        down = (np.arange(camera.height) - camera.cy) / camera.fy
        column = (T[:3, 0, None] * across + T[:3, 2, None]) * scale
        row = T[:3, 1, None] * down * scale
        t = (T[:3, 3] - np.array(lattice.origin)) / lattice.part_m
        return cls(
            np.ascontiguousarray(column, dtype=np.float32),
            np.ascontiguousarray(row, dtype=np.float32),
            t.astype(np.float32),
        )


def part_transform(cloud: Cloud, lattice: Lattice) -> F32:
    """Return (4, 4) float32 from ``cloud``'s frame to parts from the lattice's origin."""
    T = np.eye(4) if cloud.T_world_sensor is None else np.array(cloud.T_world_sensor, dtype=np.float64)
    T[:3, 3] -= np.array(lattice.origin)
    T[:3] /= lattice.part_m
    return T.astype(np.float32)


def voxelize_points(cloud: Cloud, lattice: Lattice, count: bool = False) -> Cells:
    """Return the grid of one cloud: uint8 parts, or uint32 points a voxel with ``count``; shape as the lattice."""
    cells: npt.NDArray[Any] = np.zeros(math.prod(lattice.shape), dtype=np.uint32 if count else np.uint8)
    mark_points(
        cloud.points,
        part_transform(cloud, lattice),
        lattice.limits(),
        lattice.shape,
        lattice.subdivision - 1,
        count,
        new_span(),
        cells,
    )
    return cells.reshape(lattice.shape)


def voxelize_depth(image: DepthImage, lattice: Lattice, count: bool = False) -> Cells:
    """Return the grid of one depth image, without making a cloud; else as :func:`voxelize_points`."""
    cells: npt.NDArray[Any] = np.zeros(math.prod(lattice.shape), dtype=np.uint32 if count else np.uint8)
    rays = Rays.of(image, lattice)
    depth: U16 = image.depth
    mark_depth(
        depth,
        0,
        depth.shape[0],
        rays.column,
        rays.row,
        rays.t,
        lattice.limits(),
        lattice.shape,
        lattice.subdivision - 1,
        count,
        new_span(),
        cells,
    )
    return cells.reshape(lattice.shape)
