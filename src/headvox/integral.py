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

from headvox.kernels import kernel, rule

PARTS = np.array([value.bit_count() for value in range(256)], dtype=np.uint8)

Integral = npt.NDArray[np.uint16] | npt.NDArray[np.uint32]


@kernel
def integrate(cells, box, counting, S):  # type: ignore[no-untyped-def]
    """Fill ``S`` (bx+1, by+1, bz+1 or longer) with the integral volume of the cells in ``box``.

    ``box`` is lowest and highest cell (inclusive). In z it may begin below the grid, and S may be longer: the cells
    there are taken for empty. A parts grid is summed by its bits.
    """
    x0, y0, z0 = box[0], box[1], box[2]
    nx, ny, length = S.shape[0] - 1, S.shape[1] - 1, S.shape[2]
    first = max(-z0, 0)
    nz = min(min(box[5] + 1, cells.shape[2]) - (z0 + first), length - 1 - first)
    row = np.empty(length, S.dtype)
    S[0] = 0
    for x in range(nx):
        row[:] = 0
        S[x + 1, 0] = 0
        for y in range(ny):
            column = cells[x0 + x, y0 + y, z0 + first : z0 + first + nz]
            if _any(column):
                sums = row[first + 1 : first + 1 + nz]
                total = 0
                if counting:
                    for z in range(nz):
                        total += column[z]
                        sums[z] += total
                else:
                    for z in range(nz):
                        total += PARTS[column[z] & 255]
                        sums[z] += total
                row[first + 1 + nz :] = row[first + nz]
            below = S[x, y + 1]
            out = S[x + 1, y + 1]
            for z in range(length):
                out[z] = below[z] + row[z]


@rule
def _any(column):  # type: ignore[no-untyped-def]
    bits = 0
    for z in range(column.shape[0]):
        bits |= column[z]
    return bits != 0


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


@rule
def set_corners(S, x0, x1, y0, y1, z0, z1, corner):  # type: ignore[no-untyped-def]
    """Write where the corners of a box about an entry of the flat S lie, from that entry, to ``corner`` (8,).

    The box's sum is ((0 - 1) - (2 - 3)) - ((4 - 5) - (6 - 7)).
    """
    along_x, along_y = S.shape[1] * S.shape[2], S.shape[2]
    x0, x1, y0, y1 = x0 * along_x, x1 * along_x, y0 * along_y, y1 * along_y
    corner[0], corner[1] = x1 + y1 + z1, x1 + y1 + z0
    corner[2], corner[3] = x0 + y1 + z1, x0 + y1 + z0
    corner[4], corner[5] = x1 + y0 + z1, x1 + y0 + z0
    corner[6], corner[7] = x0 + y0 + z1, x0 + y0 + z0


def integral_volume(cells: npt.NDArray[Any]) -> npt.NDArray[np.uint32]:
    """Return the integral volume (nx+1, ny+1, nz+1) uint32 of a parts grid (uint8) or a count grid (uint32)."""
    S = np.empty([n + 1 for n in cells.shape], dtype=np.uint32)
    box = np.array([0, 0, 0, *(n - 1 for n in cells.shape)], dtype=np.int64)
    integrate(cells, box, cells.dtype != np.uint8, S)
    return S


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
