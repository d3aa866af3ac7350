"""Of many candidates the local maxima, and of too many of these the best."""

from __future__ import annotations

import numpy as np
from numba import cuda

from headvox.cuda.lanes import device, kernel
from headvox.vote import DROPPED

CANDIDATES, MAXIMA, PEAKS, JUDGED, KEPT, HEADS = range(6)
"""What the columns of ``counts`` (frames, 6) tell the number of."""


@device
def first_not_below(places, count, place):
    """Return the index of the first of ``count`` rising ``places`` that is at least ``place``."""
    low, high = 0, count
    while low < high:
        middle = (low + high) // 2
        if places[middle] < place:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def mark_maxima(places, counts, scores, reach, column, layer, marked):
    """Set the bit in ``marked`` (frames, words) of each candidate that beats all within ``reach`` voxels.

    Those that were dropped are none; of equal ones the first wins. ``places`` (frames, N) rise; a step in y is
    ``column`` places, one in x ``layer``.
    """
    frame = cuda.blockIdx.y
    mine, score_of = places[frame], scores[frame]
    count = min(counts[frame, CANDIDATES], places.shape[1])
    for i in range(cuda.grid(1), count, cuda.gridsize(1)):
        score, place = score_of[i], mine[i]
        best = score > DROPPED
        for a in range(-reach, reach + 1):
            for b in range(-reach, reach + 1):
                middle = place + a * layer + b * column
                j = first_not_below(mine, count, middle - reach)
                while best and j < count and mine[j] <= middle + reach:
                    if score_of[j] > score or (score_of[j] == score and j < i):
                        best = False
                    j += 1
        if best:
            cuda.atomic.or_(marked, (frame, i >> 5), np.uint32(1) << np.uint32(i & 31))


@kernel
def rank_maxima(maxima, counts, scores, most, ranks):
    """Write how many of the ``maxima`` (frames, N; numbers of candidates) come before each, best score first.

    Of equal scores the first comes first. Where there are no more than ``most``, it does not matter: 0.
    """
    frame = cuda.blockIdx.y
    count = min(counts[frame, MAXIMA], maxima.shape[1])
    for i in range(cuda.grid(1), count, cuda.gridsize(1)):
        rank, score = 0, scores[frame, maxima[frame, i]]
        if count > most:
            for j in range(count):
                other = scores[frame, maxima[frame, j]]
                rank += other > score or (other == score and j < i)
        ranks[frame, i] = rank


@kernel
def list_peaks(maxima, counts, ranks, places, scores, peaks, peak_places, peak_scores):
    """Write the best of the maxima, as many as fit (frames, most), in the order of the volume."""
    frame, most = cuda.blockIdx.y, peaks.shape[1]
    count = min(counts[frame, MAXIMA], maxima.shape[1])
    for i in range(cuda.grid(1), count, cuda.gridsize(1)):
        if i == 0:
            counts[frame, PEAKS] = min(count, most)
        if ranks[frame, i] >= most:
            continue
        at = i
        if count > most:
            at = 0
            for j in range(i):
                at += ranks[frame, j] < most
        candidate = maxima[frame, i]
        peaks[frame, at] = candidate
        peak_places[frame, at] = places[frame, candidate]
        peak_scores[frame, at] = scores[frame, candidate]
