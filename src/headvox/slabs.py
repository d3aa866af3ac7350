"""The integral volume in slabs, each of which one thread fills and searches by itself.

A slab holds the slices that the boxes about some of the voxels reach, so slabs overlap; they lie one after the other
in one array. Each begins its sums anew at its own lower corner: the sum over a box within it is the same, and no thread
waits for what another one adds up.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from headvox.data import I64
from headvox.machine.kernels import rule


class Slab(NamedTuple):
    """What one thread fills and searches."""

    first: int
    end: int
    """The slices of its voxels, counted from the first one that is searched."""
    slices: slice
    """Where its slices lie among those of all slabs."""
    shift: I64
    """From the volume's corner to its own, (3,)."""


class Slabs(NamedTuple):
    """A volume that is cut into slabs."""

    each: tuple[Slab, ...]
    seams: I64
    """The slice of the volume that the voxels of each slab but the first begin with."""
    overlap: int
    """How many slices more a slab has than voxels."""

    @property
    def slices(self) -> int:
        """How many slices all slabs have together."""
        return int(self.each[-1].slices.stop)


@lru_cache(maxsize=256)
def cut(slices: int, low: int, high: int, threads: int) -> Slabs:
    """Return slabs for so many ``slices`` of voxels, about which boxes reach from ``low`` (below 0) to ``high``.

    There are as many slabs as ``threads``, if they are not thinner than what they overlap.
    """
    overlap = high - low
    shares = shares_of(slices, min(threads, max(slices // overlap, 1)))
    each = tuple(
        Slab(
            first, end, slice(first + k * overlap, end + (k + 1) * overlap), np.array([first, 0, 0], np.int64)
        )
        for k, first, end in shares
    )
    return Slabs(each, np.array([slab.first - low for slab in each[1:]], np.int64), overlap)


ONE_SLAB = np.empty(0, np.int64), 0
"""The seams and the overlap of a volume that is not cut."""


@rule
def slice_of(x, seams, overlap):
    """Return where a voxel's slice ``x`` of the volume lies in its slabs."""
    at = np.int64(x)
    for seam in range(seams.shape[0]):
        at += overlap * (x >= seams[seam])
    return at


def shares_of(count: int, parts: int) -> list[tuple[int, int, int]]:
    """Return part, first and end of the ``count`` things that each of ``parts`` threads does, if it does any."""
    parts = min(parts, count)
    return [(part, -(-count * part // parts), -(-count * (part + 1) // parts)) for part in range(parts)]
