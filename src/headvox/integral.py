"""Grid -> integral volume, and the sum over any box in eight look-ups.

S[x, y, z] is the sum of the grid over all cells below x, y and z, so the sum over a half-open box is

    S[x1, y1, z1] - S[x0, y1, z1] - S[x1, y0, z1] - S[x1, y1, z0]
                  + S[x0, y0, z1] + S[x0, y1, z0] + S[x1, y0, z0] - S[x0, y0, z0]

(Viola and Jones's summed-area table in 3-D). S is unsigned and wraps around: every box sum that fits the type is
exact all the same, because the wraps cancel. So S can be half the size, and faster, than its largest entry asks for.

Where S is searched, its columns are *in halves*: first S at all even z, then at all odd z (:func:`place`). A gate that
looks at every other voxel then finds the corners of a vector full of them next to each other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.machine.kernels import bare_kernel, rule
from headvox.machine.simd import (
    LANES,
    add,
    beginning,
    bit_counts,
    bit_or,
    firsts,
    last,
    load,
    load_pairs,
    resized,
    running_sums,
    seconds,
    store,
    sub,
    where,
)

Integral = npt.NDArray[np.uint16] | npt.NDArray[np.uint32]

FIRST_HALF = np.uint32((1 << LANES // 2) - 1)


@rule
def place(z, half):
    """Return where z lies in a column in halves, each ``half`` as long: first the even ones, then the odd ones."""
    return (z >> 1) + (z & 1) * half


@bare_kernel
def integrate(grids, shape, box, first, counting, row, S):
    """Fill ``S`` with the integral volume of the cells in ``box``, its columns in halves.

    ``grids`` (G, see :func:`room_for`) are the cells of a lattice of ``shape`` as several threads entered them, each
    some of the readings; a parts grid is summed by its bits. ``box`` is lowest and highest cell (inclusive); what lies
    outside of it counts as empty. S[0, 0, 0] is at the lower corner of the cell ``first``, which may lie before the
    grid, and S may go on behind it: see :func:`shape_with_margins` for its shape, and :func:`place` for the order of a
    column. ``row``, see :func:`row_for`, is working memory.
    """
    flat, cells = S.reshape(-1), grids.reshape(-1)
    columns, length, step = S.shape[1], S.shape[2], shape[2]
    bottom, height, half = box[2] - first[2] + 1, box[5] - box[2] + 1, length // 2
    lowest, highest = box[1] - first[1] + 1, box[4] - first[1] + 1  # the columns of S with cells of their own
    none = load(row, 0)
    none = sub(none, none)
    for z in range(0, columns * length, LANES):
        store(flat, z, none)
    for x in range(S.shape[0] - 1):
        for z in range(0, length + LANES, LANES):
            store(row, z, none)
        slice_at = ((first[0] + x) * shape[1] + first[1] - 1) * step + box[2]
        occupied = box[0] <= first[0] + x <= box[3]
        for y in range(columns):
            if occupied and lowest <= y <= highest:
                _add_column(cells, slice_at + y * step, grids, height, counting, row, bottom, half)
            here = (x * columns + y) * length
            after = here + columns * length
            for z in range(0, length, LANES):
                store(flat, after + z, add(load(flat, here + z), _sums_at(row, z, half)))


@rule
def _add_column(cells, at, grids, height, counting, row, bottom, half):
    """Add to ``row``, from ``bottom`` on, what is in the column at ``at`` up to each of its cells."""
    lower, upper = place(bottom, half + LANES), place(bottom + 1, half + LANES)  # of the first two cells
    total = load(row, 0)
    total = sub(total, total)
    for z in range(0, height, 2 * LANES):
        pairs = load_pairs(cells, at + z)
        for grid in range(1, grids.shape[0]):
            other = load_pairs(cells, at + z + grid * grids.shape[1])
            pairs = add(pairs, other) if counting else bit_or(pairs, other)
        evens = beginning(firsts(pairs), (height - z + 1) // 2)
        odds = beginning(seconds(pairs), (height - z) // 2)
        if not counting:
            evens, odds = bit_counts(evens), bit_counts(odds)
        one, other = resized(evens, total), resized(odds, total)
        sums = add(running_sums(add(one, other)), total)
        k = z // 2
        store(row, lower + k, add(load(row, lower + k), sub(sums, other)))
        store(row, upper + k, add(load(row, upper + k), sums))
        total = last(sums)
    done = (height + 2 * LANES - 1) // (2 * LANES) * LANES
    for k in range(done, half - bottom // 2, LANES):
        store(row, lower + k, add(load(row, lower + k), total))
        store(row, upper + k, add(load(row, upper + k), total))


def room_for(cells: int) -> int:
    """Return how long a grid of so many cells has to be: vectors that begin at its last cell go on behind it."""
    return cells + 2 * LANES


def row_for(length: int, sum_type: npt.DTypeLike) -> npt.NDArray[Any]:
    """Return the working memory for columns so long: two halves, each with a vector of room behind it.

    So what is written to one half never lies where the other is read next, which a processor would wait for.
    """
    return np.zeros(length + 2 * LANES, sum_type)


@rule
def _sums_at(row, z, half):
    """Return a vector of a column in halves from ``z`` on, of which ``row`` holds the halves apart."""
    if z + LANES <= half:
        return load(row, z)
    if z >= half:
        return load(row, z + LANES)
    return where(FIRST_HALF, load(row, z), load(row, z + LANES))  # as many of the one half as of the other


@rule
def box_sum(S, x0, x1, y0, y1, z0, z1):
    """Return the sum over the half-open box, cut off at the edges of ``S``."""
    nx, ny, nz = S.shape[0] - 1, S.shape[1] - 1, S.shape[2] - 1
    x0, x1 = min(max(x0, 0), nx), min(max(x1, 0), nx)
    y0, y1 = min(max(y0, 0), ny), min(max(y1, 0), ny)
    z0, z1 = min(max(z0, 0), nz), min(max(z1, 0), nz)
    high = S[x1, y1, z1] - S[x0, y1, z1] - S[x1, y0, z1] + S[x0, y0, z1]
    low = S[x1, y1, z0] - S[x0, y1, z0] - S[x1, y0, z0] + S[x0, y0, z0]
    return high - low


@rule
def sum_about(S, x, y, z, box):
    """Return the exact sum over ``box`` about the voxel x, y, z as a signed number."""
    value = box_sum(S, x + box[0], x + box[1], y + box[2], y + box[3], z + box[4], z + box[5])
    mask = 0xFFFF if S.itemsize == 2 else 0xFFFFFFFF
    return np.int64(value) & mask


@bare_kernel
def set_corners(S, boxes, corners):
    """Write where the corners of ``boxes`` (B, 6) lie in the flat S, which is in halves, to (B, 8).

    First where the columns x1 y1, x0 y1, x1 y0 and x0 y0 begin, from that of the voxel that a box is about. Then where
    z0 lies in them, from half the voxel's z, if that is even, and what to add if it is odd; likewise z1. So a voxel is
    told by where its column begins plus half its z, and by -1 if its z is odd, else 0.
    """
    along_x, along_y, half = S.shape[1] * S.shape[2], S.shape[2], S.shape[2] // 2
    for b in range(boxes.shape[0]):
        x0, x1 = boxes[b, 0] * along_x, boxes[b, 1] * along_x
        y0, y1 = boxes[b, 2] * along_y, boxes[b, 3] * along_y
        corners[b, 0], corners[b, 1], corners[b, 2], corners[b, 3] = x1 + y1, x0 + y1, x1 + y0, x0 + y0
        for k in range(2):
            z = boxes[b, 4 + k]
            corners[b, 4 + 2 * k], corners[b, 5 + 2 * k] = place(z, half), place(z + 1, half) - place(z, half)


def integral_volume(cells: npt.NDArray[Any], narrow: bool = False) -> Integral:
    """Return the integral volume (nx+1, ny+1, nz+1) of a parts grid (uint8) or a count grid (uint32).

    It is uint32, or uint16 if ``narrow``, which is for parts grids only.
    """
    nx, ny, nz = cells.shape
    S: npt.NDArray[Any] = np.empty((nx + 1, ny + 1, _rounded_up(nz + 1)), np.uint16 if narrow else np.uint32)
    box = np.array([0, 0, 0, nx - 1, ny - 1, nz - 1], dtype=np.int64)
    grid = np.zeros((1, room_for(cells.size)), cells.dtype)
    grid[0, : cells.size] = cells.reshape(-1)
    row = row_for(S.shape[2], S.dtype)
    integrate(grid, cells.shape, box, np.zeros(3, np.int64), cells.dtype != np.uint8, row, S)
    return in_order(S)[:, :, : nz + 1].copy()


def in_order(S: Integral) -> Integral:
    """Return a copy of ``S``, whose columns are in halves (see :func:`place`), with columns in the order of z."""
    half = S.shape[2] // 2
    whole: npt.NDArray[Any] = np.empty_like(S)
    whole[:, :, 0::2], whole[:, :, 1::2] = S[:, :, :half], S[:, :, half:]
    return whole


def in_halves(S: Integral) -> Integral:
    """Return a copy of ``S``, whose columns are in the order of z and of even length, with columns in halves."""
    return np.concatenate([S[:, :, 0::2], S[:, :, 1::2]], axis=2)


def box_reach(boxes: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
    """Return the box that holds all of ``boxes`` (B, 6) and the voxel that they are about."""
    low, high = boxes[:, 0::2].min(axis=0, initial=0), boxes[:, 1::2].max(axis=0, initial=1)
    return np.stack([low, high], axis=1).reshape(-1).astype(np.int64)


def _rounded_up(height: int, to: int = LANES) -> int:
    """Return the least multiple of ``to`` that holds ``height`` voxels."""
    return -(-height // to) * to


def shape_with_margins(shape: tuple[int, ...], reach: npt.NDArray[np.int64]) -> tuple[int, int, int]:
    """Return the shape of an integral volume in which boxes that ``reach`` so far about ``shape`` voxels lie.

    The voxels begin at -reach[0], -reach[2], -reach[4]. A column is as high as pairs of vectors of voxels ask for.
    """
    x0, x1, y0, y1, z0, z1 = reach.tolist()
    return shape[0] + x1 - x0, shape[1] + y1 - y0, _rounded_up(_rounded_up(shape[2], 2 * LANES) + z1 - z0)


def with_margins(S: Integral, reach: npt.NDArray[np.int64]) -> Integral:
    """Return a copy of ``S`` in halves that goes on over empty cells: boxes about its voxels may ``reach`` so far."""
    low, shape = -reach[0::2], shape_with_margins(tuple(n - 1 for n in S.shape), reach)
    longer: npt.NDArray[Any] = np.pad(
        S, [(a, n - m - a) for a, n, m in zip(low, shape, S.shape, strict=True)], mode="edge"
    )
    longer[: low[0]] = 0
    longer[:, : low[1]] = 0
    longer[:, :, : low[2]] = 0
    return in_halves(longer)
