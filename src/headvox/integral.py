"""Grid -> integral volume, and the sum over any box in eight look-ups.

S[x, y, z] is the sum of the grid over all cells below x, y and z, so the sum over a half-open box is

    S[x1, y1, z1] - S[x0, y1, z1] - S[x1, y0, z1] - S[x1, y1, z0]
                  + S[x0, y0, z1] + S[x0, y1, z0] + S[x1, y0, z0] - S[x0, y0, z0]

(Viola and Jones's summed-area table in 3-D). S is unsigned and wraps around: every box sum that fits the type is
exact all the same, because the wraps cancel. So S can be half the size, and faster, than its largest entry asks for.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.kernels import bare_kernel, kernel, rule
from headvox.simd import LANES, add, beginning, bit_counts, last, load, running_sums, store, sub, widen

Integral = npt.NDArray[np.uint16] | npt.NDArray[np.uint32]


@bare_kernel
def integrate(cells, box, first, counting, y_first, y_last, spare, row, S):  # type: ignore[no-untyped-def]
    """Fill the columns ``y_first`` to ``y_last`` of ``S`` with the integral volume of the cells in ``box``.

    ``box`` is lowest and highest cell (inclusive); what lies outside of it counts as empty. S[0, 0, 0] is at the lower
    corner of the cell ``first``, which may lie before the grid, and S may go on behind it; it is a whole number of
    vectors high. A parts grid is summed by its bits. ``spare`` (LANES cells) and ``row`` (LANES more than S is high)
    are working memory.
    """
    flat, grid = S.reshape(-1), cells.reshape(-1)
    columns, length = S.shape[1], S.shape[2]
    bottom, height = box[2] - first[2] + 1, box[5] - box[2] + 1
    none = load(row, 0)
    none = sub(none, none)
    for z in range(y_first * length, y_last * length, LANES):
        store(flat, z, none)
    for x in range(S.shape[0] - 1):
        for z in range(0, row.shape[0], LANES):
            store(row, z, none)
        occupied = box[0] <= first[0] + x <= box[3]
        for y in range(y_last):
            if occupied and box[1] < first[1] + y <= box[4] + 1:
                column = ((first[0] + x) * cells.shape[1] + first[1] + y - 1) * cells.shape[2] + box[2]
                _add_column(grid, column, height, counting, spare, row, bottom)
            if y >= y_first:
                before = (x * columns + y) * length
                after = before + columns * length
                for z in range(0, length, LANES):
                    store(flat, after + z, add(load(flat, before + z), load(row, z)))


@bare_kernel
def _add_column(grid, at, height, counting, spare, row, bottom):  # type: ignore[no-untyped-def]
    """Add to ``row``, from ``bottom`` on, what is in the column that begins at ``at``, up to each of its cells."""
    total = load(row, 0)
    total = sub(total, total)
    for z in range(0, height, LANES):
        if at + z + LANES <= grid.shape[0]:
            cells = load(grid, at + z)
        else:
            for k in range(min(height - z, LANES)):
                spare[k] = grid[at + z + k]
            cells = load(spare, 0)
        cells = beginning(cells, height - z)
        amounts = cells if counting else bit_counts(cells)
        sums = add(running_sums(widen(amounts, total)), total)
        store(row, bottom + z, add(load(row, bottom + z), sums))
        total = last(sums)
    for z in range(bottom + (height + LANES - 1) // LANES * LANES, row.shape[0] - LANES, LANES):
        store(row, z, add(load(row, z), total))


@rule
def box_sum(S, x0, x1, y0, y1, z0, z1):  # type: ignore[no-untyped-def]
    """Return the sum over the half-open box, cut off at the edges of ``S``."""
    nx, ny, nz = S.shape[0] - 1, S.shape[1] - 1, S.shape[2] - 1
    x0, x1 = min(max(x0, 0), nx), min(max(x1, 0), nx)
    y0, y1 = min(max(y0, 0), ny), min(max(y1, 0), ny)
    z0, z1 = min(max(z0, 0), nz), min(max(z1, 0), nz)
    high = S[x1, y1, z1] - S[x0, y1, z1] - S[x1, y0, z1] + S[x0, y0, z1]
    low = S[x1, y1, z0] - S[x0, y1, z0] - S[x1, y0, z0] + S[x0, y0, z0]
    return high - low


@bare_kernel
def set_corners(S, boxes, corners):  # type: ignore[no-untyped-def]
    """Write where the corners of ``boxes`` (B, 6) lie in the flat S, from the voxel that they are about, to (B, 8).

    A box's sum is ((0 - 1) - (2 - 3)) - ((4 - 5) - (6 - 7)).
    """
    along_x, along_y = S.shape[1] * S.shape[2], S.shape[2]
    for b in range(boxes.shape[0]):
        x0, x1 = boxes[b, 0] * along_x, boxes[b, 1] * along_x
        y0, y1 = boxes[b, 2] * along_y, boxes[b, 3] * along_y
        z0, z1 = boxes[b, 4], boxes[b, 5]
        corners[b, 0], corners[b, 1] = x1 + y1 + z1, x1 + y1 + z0
        corners[b, 2], corners[b, 3] = x0 + y1 + z1, x0 + y1 + z0
        corners[b, 4], corners[b, 5] = x1 + y0 + z1, x1 + y0 + z0
        corners[b, 6], corners[b, 7] = x0 + y0 + z1, x0 + y0 + z0


def integral_volume(cells: npt.NDArray[Any], narrow: bool = False) -> Integral:
    """Return the integral volume (nx+1, ny+1, nz+1) of a parts grid (uint8) or a count grid (uint32).

    It is uint32, or uint16 if ``narrow``, which is for parts grids only.
    """
    nx, ny, nz = cells.shape
    S: npt.NDArray[Any] = np.empty((nx + 1, ny + 1, _rounded_up(nz + 1)), np.uint16 if narrow else np.uint32)
    box = np.array([0, 0, 0, nx - 1, ny - 1, nz - 1], dtype=np.int64)
    memory = np.zeros(LANES, cells.dtype), np.zeros(S.shape[2] + LANES, S.dtype)
    integrate(cells, box, np.zeros(3, np.int64), cells.dtype != np.uint8, 0, ny + 1, *memory, S)
    return np.ascontiguousarray(S[:, :, : nz + 1])


@kernel
def _box_sums(S, boxes, out):  # type: ignore[no-untyped-def]
    mask = np.uint32(0xFFFF) if S.itemsize == 2 else np.uint32(0xFFFFFFFF)
    for i in range(boxes.shape[0]):
        b = boxes[i]
        out[i] = np.uint32(box_sum(S, b[0], b[1], b[2], b[3], b[4], b[5])) & mask


def box_sums(S: Integral, boxes: npt.NDArray[np.int64]) -> npt.NDArray[np.uint32]:
    """Return the sums (B,) over ``boxes`` (B, 6): x0 x1 y0 y1 z0 z1, half-open, cut off at the edges of the grid."""
    out = np.empty(len(boxes), dtype=np.uint32)
    _box_sums(S, np.ascontiguousarray(boxes, dtype=np.int64), out)
    return out


def box_reach(boxes: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
    """Return the box that holds all of ``boxes`` (B, 6) and the voxel that they are about."""
    low, high = boxes[:, 0::2].min(axis=0, initial=0), boxes[:, 1::2].max(axis=0, initial=1)
    return np.stack([low, high], axis=1).reshape(-1).astype(np.int64)


def _rounded_up(height: int) -> int:
    """Return the least whole number of vectors that holds ``height`` voxels."""
    return -(-height // LANES) * LANES


def shape_with_margins(shape: tuple[int, ...], reach: npt.NDArray[np.int64]) -> tuple[int, int, int]:
    """Return the shape of an integral volume in which boxes that ``reach`` so far about ``shape`` voxels lie.

    The voxels begin at -reach[0], -reach[2], -reach[4]. A column is as high as whole vectors of voxels ask for.
    """
    x0, x1, y0, y1, z0, z1 = reach.tolist()
    return shape[0] + x1 - x0, shape[1] + y1 - y0, _rounded_up(_rounded_up(shape[2]) + z1 - z0)


def with_margins(S: Integral, reach: npt.NDArray[np.int64]) -> Integral:
    """Return a copy of ``S`` that goes on over empty cells, so that boxes about its voxels may ``reach`` so far."""
    low, shape = -reach[0::2], shape_with_margins(tuple(n - 1 for n in S.shape), reach)
    longer: npt.NDArray[Any] = np.pad(
        S, [(a, n - m - a) for a, n, m in zip(low, shape, S.shape, strict=True)], mode="edge"
    )
    longer[: low[0]] = 0
    longer[:, : low[1]] = 0
    longer[:, :, : low[2]] = 0
    return longer
