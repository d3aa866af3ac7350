"""Points or depth images -> an occupancy grid.

A voxel of a *parts* grid is one byte with a bit for each of its 2x2x2 parts (or one bit for the voxel itself, with a
subdivision of 1): a bit says "some point fell in here". A voxel of a *count* grid is the number of its points. Both
are integers that do not depend on the order of the points. Each of several threads has a grid of its own: a bit of any
of them, or their numbers added up, are the frame's, which so are the same for any number of threads.

Cells are half-open: a point on the border of two cells belongs to the upper one. Coordinates are float32; a cell is
``floor((world - origin) / cell edge)``, the sum taken as written in the kernels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.data import F32, I64, U16, Cloud, DepthImage
from headvox.lattice import MOST_BITS, Lattice
from headvox.machine.kernels import bare_kernel, rule
from headvox.machine.simd import (
    LANES,
    add,
    below,
    bit_and,
    compress,
    equal,
    fill,
    larger,
    load,
    load_triples,
    mul,
    shift_left,
    shift_right,
    shifted,
    smaller,
    store,
    sub,
    times,
    to_float,
    to_int,
    where,
)  # fmt: skip
from headvox.machine.threads import new_blocks, take

NOWHERE = np.int32(-1)
FARTHEST = np.int32(2**31 - 1)
NO_BOX = np.repeat(np.array([FARTHEST, NOWHERE], np.int64), 3)
ALL = np.uint32(0xFFFFFFFF)
ROWS, POINTS = 32, 1 << 14  # that a thread takes at a time
MOST_NEW = 4096  # codes that are entered at a time

Cells = npt.NDArray[np.uint8] | npt.NDArray[np.uint32]


def new_box() -> I64:
    """Return an empty box of cells: lowest and highest in x, y, z."""
    return NO_BOX.copy()


@rule
def moved(T, axis, x, y, z):
    """Return where ``T`` (4, 4) takes places, along an axis."""
    turned = add(mul(fill(T[axis, 0]), x), mul(fill(T[axis, 1]), y))
    return add(fill(T[axis, 3]), add(turned, mul(fill(T[axis, 2]), z)))


@rule
def along_ray(t, far, column, row):
    """Return where pixels with these depths are, along an axis: see :class:`Rays`."""
    return add(fill(t), mul(far, add(column, fill(row))))


@rule
def inside(x, y, z, limits):
    """Return a bit for each place, in parts from the origin: whether it is within the region, and not NaN."""
    dx, dy, dz = sub(x, fill(limits[0])), sub(y, fill(limits[1])), sub(z, fill(limits[2]))
    distance = add(add(mul(dx, dx), mul(dy, dy)), mul(dz, dz))
    return below(distance, fill(limits[3])) & ~below(z, fill(limits[4])) & below(z, fill(limits[5]))


@rule
def code_of(x, y, z, ny, nz, shift):
    """Return cell * 8 + part of places inside, given in whole parts."""
    cell = add(times(add(times(shift_right(x, shift), ny), shift_right(y, shift)), nz), shift_right(z, shift))
    one = fill(shift)
    part = add(add(times(bit_and(x, one), 4), times(bit_and(y, one), 2)), bit_and(z, one))
    return add(times(cell, 8), part)


@rule
def _mark(x, y, z, known, left, codes, at, limits, bits, counting, new, count):
    """Write the packed parts of LANES places, in parts from the origin, to ``new`` from ``count`` on.

    Left out are places whose bit in ``known`` is not set, and such as repeat others. ``left`` are the parts of the
    LANES places before, and ``codes`` from ``at`` on are others that may be repeated: neighbours mostly fall into one
    part, and a part has to be entered but once. ``codes`` is overwritten. Return the parts and the new count.
    """
    within = known & inside(x, y, z, limits)
    mine = fill(NOWHERE)
    if within:
        mine = where(within, packed(to_int(x), to_int(y), to_int(z), bits), mine)
        if not counting:
            above = equal(mine, load(codes, at)) | equal(mine, load(codes, at + 1))
            within &= ~(above | equal(mine, shifted(left, mine)))
        count = compress(new, count, within, mine)
    store(codes, at, mine)
    return mine, count


@rule
def packed(x, y, z, bits):
    """Return whole parts x, y, z as one number; see :attr:`Lattice.bits`."""
    return add(shift_left(add(shift_left(x, bits[0]), y), bits[1]), z)


@bare_kernel
def enter(new, count, bits, shape, shift, counting, box, codes, cells):
    """Enter ``count`` packed parts into the flat grid ``cells``, and widen ``box``, see :func:`new_box`.

    ``new`` has room for LANES more; ``codes`` (LANES,) is working memory.
    """
    if count == 0:
        return
    store(new, count, fill(new[0]))  # the last vector of codes is a whole one
    low = (fill(FARTHEST), fill(FARTHEST), fill(FARTHEST))
    high = (fill(NOWHERE), fill(NOWHERE), fill(NOWHERE))
    m = np.int32(shift)
    last_y, last_z = np.int32((1 << bits[0]) - 1), np.int32((1 << bits[1]) - 1)
    last_x = np.int32((1 << (MOST_BITS - bits[0] - bits[1])) - 1)  # the highest bit is no sign
    for first in range(0, count, LANES):
        part = load(new, first)
        xy = shift_right(part, bits[1])
        x, y, z = shift_right(xy, bits[0]), bit_and(xy, fill(last_y)), bit_and(part, fill(last_z))
        x = bit_and(x, fill(last_x))
        low = smaller(low[0], x), smaller(low[1], y), smaller(low[2], z)
        high = larger(high[0], x), larger(high[1], y), larger(high[2], z)
        store(codes, 0, code_of(x, y, z, shape[1], shape[2], m))
        # Unsigned, because a signed index costs a check for counting from the end.
        for k in range(np.uint64(min(LANES, count - first))):
            code = np.uint32(codes[k])
            if counting:
                cells[code >> np.uint32(3)] += 1
            else:
                cells[code >> np.uint32(3)] |= np.uint8(1) << (code & np.uint32(7))
    for k in range(3):
        store(codes, 0, low[k])
        for lane in range(LANES):
            box[k] = min(box[k], codes[lane] >> shift)
        store(codes, 0, high[k])
        for lane in range(LANES):
            box[3 + k] = max(box[3 + k], codes[lane] >> shift)


@bare_kernel
def mark_points(
    points, blocks, T, limits, bits, shape, shift, counting, codes, new, few, few_codes, box, cells
):
    """Enter ``points`` (N, 3) into the flat grid ``cells``, and widen ``box``, see :func:`new_box`.

    Points are taken :data:`POINTS` at a time by whichever thread is free: ``blocks`` (1,) counts what was taken.
    ``codes``, ``new`` and ``few`` are working memory, see :class:`Marking`.
    """
    xyz, count = points.reshape(-1), 0
    first = 3 * POINTS * take(blocks, 0)
    while first < xyz.shape[0]:
        codes[:] = NOWHERE  # the grid may have been emptied since
        left = fill(NOWHERE)
        for at in range(first, min(first + 3 * POINTS, xyz.shape[0]), 3 * LANES):
            if at + 3 * LANES <= xyz.shape[0]:
                px, py, pz = load_triples(xyz, at)
            else:
                few[:] = np.nan
                for k in range(xyz.shape[0] - at):
                    few[k] = xyz[at + k]
                px, py, pz = load_triples(few, 0)
            x, y, z = moved(T, 0, px, py, pz), moved(T, 1, px, py, pz), moved(T, 2, px, py, pz)
            left, count = _mark(x, y, z, ALL, left, codes, 0, limits, bits, counting, new, count)
            if count > MOST_NEW:
                enter(new, count, bits, shape, shift, counting, box, few_codes, cells)
                count = 0
        first = 3 * POINTS * take(blocks, 0)
    enter(new, count, bits, shape, shift, counting, box, few_codes, cells)


@bare_kernel
def mark_depth(
    depth,
    blocks,
    column,
    row,
    t,
    limits,
    bits,
    shape,
    shift,
    counting,
    codes,
    new,
    few,
    few_codes,
    box,
    cells,
):
    """As :func:`mark_points`, for a depth image, :data:`ROWS` at a time; see :class:`Rays`.

    A pixel's neighbours are the one before it, the one above, and the next to that.
    """
    flat, height, width, count = depth.reshape(-1), depth.shape[0], depth.shape[1], 0
    first = ROWS * take(blocks, 0)
    while first < height:
        codes[:] = NOWHERE
        for v in range(first, min(first + ROWS, height)):
            left = fill(NOWHERE)
            for u in range(0, width, LANES):
                if u + LANES <= width:
                    raw = load(flat, v * width + u)
                else:
                    few[:] = 0
                    for k in range(width - u):
                        few[k] = flat[v * width + u + k]
                    raw = load(few, 0)
                far = to_float(raw)
                x = along_ray(t[0], far, load(column[0], u), row[0, v])
                y = along_ray(t[1], far, load(column[1], u), row[1, v])
                z = along_ray(t[2], far, load(column[2], u), row[2, v])
                known = ~equal(raw, sub(raw, raw))
                left, count = _mark(x, y, z, known, left, codes, u, limits, bits, counting, new, count)
                if count > MOST_NEW:
                    enter(new, count, bits, shape, shift, counting, box, few_codes, cells)
                    count = 0
        first = ROWS * take(blocks, 0)
    enter(new, count, bits, shape, shift, counting, box, few_codes, cells)


@bare_kernel
def join_boxes(boxes):
    """Widen the first of ``boxes`` (N, 6) by the others."""
    for box in range(1, boxes.shape[0]):
        for k in range(3):
            boxes[0, k] = min(boxes[0, k], boxes[box, k])
            boxes[0, 3 + k] = max(boxes[0, 3 + k], boxes[box, 3 + k])


@bare_kernel
def empty(cells):
    """Clear a flat grid."""
    cells[:] = 0


@dataclass(frozen=True, slots=True)
class Marking:
    """The working memory of one thread that enters readings into a grid."""

    codes: npt.NDArray[np.int32]
    new: npt.NDArray[np.int32]
    few_points: F32
    few_pixels: U16
    few_codes: npt.NDArray[np.int32]

    @classmethod
    def of(cls, width: int) -> Marking:
        """Return memory for images as wide as that, and for points."""
        codes = np.empty(_whole_vectors(width) + LANES, np.int32)
        return cls(
            codes,
            np.empty(MOST_NEW + 2 * LANES, np.int32),
            np.empty(3 * LANES, np.float32),
            np.empty(LANES, np.uint16),
            np.empty(LANES, np.int32),
        )

    def for_points(self) -> tuple[npt.NDArray[Any], ...]:
        """Return what :func:`mark_points` needs."""
        return self.codes[: 2 * LANES], self.new, self.few_points, self.few_codes

    def for_depth(self, width: int) -> tuple[npt.NDArray[Any], ...]:
        """Return what :func:`mark_depth` needs for an image as wide as that, as wide as it was made for at most."""
        return self.codes[: _whole_vectors(width) + LANES], self.new, self.few_pixels, self.few_codes


def _whole_vectors(width: int) -> int:
    return -(-width // LANES) * LANES


@dataclass(frozen=True, slots=True)
class Rays:
    """A depth camera as the kernels read it: a pixel's point, in parts from the lattice's origin, is
    ``t + depth * (column[:, u] + row[:, v])`` with the raw depth value. ``column`` goes on to a whole vector.
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
        column = np.pad(column, ((0, 0), (0, _whole_vectors(camera.width) - camera.width)))
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
    T, limits, memory = part_transform(cloud, lattice), lattice.limits(), Marking.of(LANES).for_points()
    mark_points(
        cloud.points, new_blocks(1)[0], T, limits, lattice.bits, lattice.shape, lattice.subdivision - 1, count, *memory,
        new_box(), cells,
    )  # fmt: skip
    return cells.reshape(lattice.shape)


def voxelize_depth(image: DepthImage, lattice: Lattice, count: bool = False) -> Cells:
    """Return the grid of one depth image, without making a cloud; else as :func:`voxelize_points`."""
    cells: npt.NDArray[Any] = np.zeros(math.prod(lattice.shape), dtype=np.uint32 if count else np.uint8)
    rays, width = Rays.of(image, lattice), image.depth.shape[1]
    memory = Marking.of(width).for_depth(width)
    mark_depth(
        image.depth, new_blocks(1)[0], rays.column, rays.row, rays.t, lattice.limits(), lattice.bits, lattice.shape,
        lattice.subdivision - 1, count, *memory, new_box(), cells,
    )  # fmt: skip
    return cells.reshape(lattice.shape)
