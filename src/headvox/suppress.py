"""Non-maximum suppression: of many candidates about one head, the best."""

from __future__ import annotations

from itertools import product

import numpy as np
import numpy.typing as npt

from headvox.data import F64, I32, I64
from headvox.machine.kernels import kernel

PEAK_REACH = {1: 1, 2: 1, 4: 2}
"""How far the neighbours of a voxel are when every voxel, every other, every fourth is a candidate."""

MOST_PEAKS = 256
"""Peaks of a frame that are looked at closer: a frame of noise must not take forever."""
NEIGHBOURS = np.array(list(product((-1, 0, 1), repeat=3)), np.int32)
STEPS = np.abs(NEIGHBOURS).sum(axis=1)
AROUND = {1: NEIGHBOURS[STEPS == 0], 2: NEIGHBOURS[STEPS <= 1], 4: NEIGHBOURS}
"""A peak and the voxels about it that were not candidates, when every voxel, every other, every fourth is one."""


@kernel
def local_maxima(cells, scores, least, reach, index, peaks):
    """Write the indices of the local maxima to ``peaks``; return how many there are.

    A maximum scores more than all within ``reach`` voxels along each axis. ``index`` is a volume of zeros over all
    voxels, and is left so.
    """
    nx, ny, nz = index.shape
    for i in range(cells.shape[0]):
        if scores[i] >= least:
            index[cells[i, 0], cells[i, 1], cells[i, 2]] = i + 1
    found = 0
    for i in range(cells.shape[0]):
        score = scores[i]
        if score < least:
            continue
        best = True
        x, y, z = cells[i, 0], cells[i, 1], cells[i, 2]
        for a in range(max(x - reach, 0), min(x + reach + 1, nx)):
            for b in range(max(y - reach, 0), min(y + reach + 1, ny)):
                for c in range(max(z - reach, 0), min(z + reach + 1, nz)):
                    j = index[a, b, c] - 1
                    # Of equal neighbours the first in the order of the volume is the maximum.
                    if j >= 0 and j != i and (scores[j] > score or (scores[j] == score and j < i)):
                        best = False
        if best:
            peaks[found] = i
            found += 1
    for i in range(cells.shape[0]):
        if scores[i] >= least:
            index[cells[i, 0], cells[i, 1], cells[i, 2]] = 0
    return found


@kernel
def best_of_each(cells, scores, group, least, best):
    """Write the index of the best of every ``group`` cells to ``best``; return how many there are.

    Of equals it is the first. Left out are those that score less than ``least`` and cells that were best before:
    groups may meet at one.
    """
    found = 0
    for first in range(0, cells.shape[0], group):
        i = first
        for k in range(first + 1, first + group):
            if scores[k] > scores[i]:
                i = k
        is_new = scores[i] >= least
        for k in range(found):
            j = best[k]
            if cells[i, 0] == cells[j, 0] and cells[i, 1] == cells[j, 1] and cells[i, 2] == cells[j, 2]:
                is_new = False
        if is_new:
            best[found] = i
            found += 1
    return found


def suppress(cells: I32, scores: I64, least: int, shape: tuple[int, ...], reach: int = 1) -> I64:
    """Return the indices of the candidates that score at least ``least`` and more than all within ``reach`` voxels.

    ``cells`` (N, 3) are distinct voxels of a volume of ``shape``, in the order of x, y, z. Of equal neighbours the
    first one wins.
    """
    peaks = np.empty(len(cells), np.int64)
    found = local_maxima(cells, scores, least, reach, np.zeros(shape, np.int32), peaks)
    return peaks[:found]


@kernel
def _keep_apart(centres, scores, distance2, order, kept):
    for i in range(order.shape[0]):  # best first: they are few
        k = i
        while k > 0 and scores[order[k - 1]] < scores[i]:
            order[k] = order[k - 1]
            k -= 1
        order[k] = i
    count = 0
    for i in order:
        apart = True
        for k in range(count):
            j = kept[k]
            dx, dy, dz = (
                centres[i, 0] - centres[j, 0],
                centres[i, 1] - centres[j, 1],
                centres[i, 2] - centres[j, 2],
            )
            apart &= dx * dx + dy * dy + dz * dz >= distance2
        if apart:
            kept[count] = i
            count += 1
    return count


def suppress_overlaps(centres: F64, scores: npt.NDArray[np.generic], distance_m: float) -> I64:
    """Return the indices to keep, best score first, so that no two centres (N, 3) are closer than ``distance_m``."""
    order, kept = np.empty((2, len(scores)), np.int64)
    centres, scores = np.ascontiguousarray(centres), scores.astype(np.float64)
    return kept[: _keep_apart(centres, scores, distance_m * distance_m, order, kept)]
