"""Grids -> integral volumes: running sums along z, then y, then x.

The volumes are 32 bits wide and cover the whole lattice, so that nothing of them depends on what a frame holds.
"""

from __future__ import annotations

import numpy as np
from numba import cuda

from headvox.cuda.lanes import device, kernel


@device
def amount_in(cells, cell, counting):
    """Return what a cell of a grid, a row of words, adds to a sum."""
    if counting:
        return np.int64(cells[cell])
    return np.int64(cuda.popc(np.uint32((cells[cell >> 2] >> np.uint32(8 * (cell & 3))) & np.uint32(0xFF))))


@kernel
def sum_along_z(cells, counting, S):
    """Write to each column of ``S`` (frames, nx + 1, ny + 1, nz + 1) the sums up its own column of cells."""
    frame = cuda.blockIdx.y
    columns, length = S.shape[2], S.shape[3]
    for i in range(cuda.grid(1), S.shape[1] * columns, cuda.gridsize(1)):
        x, y = i // columns, i % columns
        S[frame, x, y, 0] = 0
        total = np.int64(0)
        first = ((x - 1) * (columns - 1) + y - 1) * (length - 1)
        for z in range(1, length):
            if x > 0 and y > 0:
                total += amount_in(cells[frame], first + z - 1, counting)
            S[frame, x, y, z] = total


@kernel
def sum_along(S):
    """Add to each entry of ``S`` (frames, A, N, B) all before it along the third axis."""
    frame, length = cuda.blockIdx.y, S.shape[3]
    for i in range(cuda.grid(1), S.shape[1] * length, cuda.gridsize(1)):
        a, b = i // length, i % length
        total = np.int64(0)
        for n in range(S.shape[2]):
            total += S[frame, a, n, b]
            S[frame, a, n, b] = total
