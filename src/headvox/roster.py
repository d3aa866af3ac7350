"""The tracks as a structure of arrays, a row a track: compiled loops work on them in place."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from headvox.data import F64, I64

NEVER_NS = -(2**62)


class Roster(NamedTuple):
    """All that a tracker knows of N heads. Columns are contiguous, as the loops are compiled for.

    ``ids`` (N,), 0 until confirmed; ``born_ns`` and ``seen_ns`` (N,), first and last seen; ``hits`` (N,), a bit a
    frame, the last frame lowest; ``life`` (N,), 1 when seen, dead at 0; ``trust`` (N,), grows while it is seen, shrinks
    while its place is in plain view without it, dead at 0; ``lost`` (N,), dead, but remembered.

    ``places`` and ``velocities`` (N, 3), where it was last seen, and how fast; ``heights`` (N,), its usual height [m],
    over so many ``sightings`` (N,); ``radii`` and ``scores`` (N,) of the last sighting.

    ``last`` (N, 2, 3) and ``last_ns`` (N, 2) are the last two measured centres, the newest first; ``scatter`` (N, 3, 3)
    is the covariance by which they scatter from frame to frame [m²].

    ``x`` to ``rejected`` are the state of the filters, see :mod:`headvox.kalman`.
    """

    ids: I64
    born_ns: I64
    seen_ns: I64
    hits: I64
    life: F64
    trust: F64
    lost: npt.NDArray[np.bool_]
    places: F64
    velocities: F64
    heights: F64
    sightings: I64
    radii: F64
    scores: F64
    last: F64
    last_ns: I64
    scatter: F64
    x: F64
    P: F64
    weights: F64
    quaternions: F64
    rates: F64
    C: F64
    rejected: I64

    @classmethod
    def blank(cls, count: int) -> Roster:
        """Return ``count`` rows of zeros."""

        def whole() -> I64:
            return np.zeros(count, np.int64)

        def real(*shape: int) -> F64:
            return np.zeros((count, *shape))

        return cls(
            whole(), whole(), whole(), whole(), real(), real(), np.zeros(count, np.bool_),
            real(3), real(3), real(), whole(), real(), real(),
            real(2, 3), np.full((count, 2), NEVER_NS), real(3, 3),
            real(2, 6), real(2, 6, 6), real(2), real(4), real(3), real(6, 6), whole(),
        )  # fmt: skip

    @property
    def size(self) -> int:
        """How many rows there are."""
        return len(self.ids)

    def rows(self, which: npt.NDArray[Any]) -> Roster:
        """Return a copy of the rows with these numbers, or that are true."""
        numbers = np.flatnonzero(which) if which.dtype == np.bool_ else which
        return Roster._make([column.take(numbers, axis=0) for column in self])  # faster than column[numbers]

    def and_also(self, others: Roster) -> Roster:
        """Return these rows, and after them the others."""
        return Roster(*(np.concatenate(pair) for pair in zip(self, others, strict=True)))
