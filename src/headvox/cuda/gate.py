"""Stage 1 on the device: a thread a voxel, and a bit for each that passes.

Voxels are numbered in the order of x, y, z, in a lattice that is one voxel wider on every side than the grid, so that
the neighbours of a candidate have a number too: that number is a candidate's *place*.
"""

from __future__ import annotations

import numpy as np
from numba import cuda

from headvox.cuda.lanes import LANE_WISE, device, kernel, on_device, sum_about_voxel
from headvox.cuda.readings import ODD
from headvox.gate import holds


@device
def _sum_at(S, at, boxes, b):
    return sum_about_voxel(S, at[0], at[1], at[2], boxes[b])


_holds = on_device(holds, **LANE_WISE, box_sums_at=_sum_at)


@device
def is_candidate(x, y, z, spacing):
    """Return whether a gate of this spacing looks at the voxel x, y, z, counted from the world's origin."""
    if spacing == 2:
        return (x + y + z) & 1 == 0
    return spacing == 1 or (x & 1 == y & 1 and y & 1 == z & 1)


@device
def cell_of(place, S):
    """Return x, y, z of a place; ``S`` is the integral volume (nx + 1, ny + 1, nz + 1)."""
    columns, length = S.shape[1] + 1, S.shape[2] + 1
    column = place // length
    return column // columns - 1, column % columns - 1, place % length - 1


@kernel
def gate(S, whole, boxes, weights, spans, rank, limits, spacing, passed):
    """Set the bit in ``passed`` (frames, words), which is cleared, of each place that passes all conditions."""
    frame = cuda.blockIdx.y
    volume = S[frame]
    nx, ny, nz = volume.shape[0] - 1, volume.shape[1] - 1, volume.shape[2] - 1
    odd_x, odd_y, odd_z = whole[frame, ODD], whole[frame, ODD + 1], whole[frame, ODD + 2]
    for i in range(cuda.grid(1), nx * ny * nz, cuda.gridsize(1)):
        x, y, z = i // (ny * nz), i // nz % ny, i % nz
        if not is_candidate(x + odd_x, y + odd_y, z + odd_z, spacing):
            continue
        passes = True
        for condition in range(rank.shape[0]):
            if not _holds(volume, (x, y, z), boxes, weights, spans, rank, limits, condition):
                passes = False
                break
        if passes:
            place = ((x + 1) * (ny + 2) + y + 1) * (nz + 2) + z + 1
            cuda.atomic.or_(passed, (frame, place >> 5), np.uint32(1) << np.uint32(place & 31))
