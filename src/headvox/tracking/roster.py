"""The tracks as a table, a row a track: compiled loops work on it in place."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

NEVER_NS = -(2**62)

ROW = np.dtype(
    [
        ("id", np.int64),
        ("born_ns", np.int64),
        ("seen_ns", np.int64),
        ("hits", np.int64),
        ("life", np.float64),
        ("trust", np.float64),
        ("lost", np.bool_),
        ("absent", np.bool_),
        ("place", np.float64, 3),
        ("velocity", np.float64, 3),
        ("height", np.float64),
        ("sightings", np.int64),
        ("radius", np.float64),
        ("score", np.float64),
        ("strength", np.float64),
        ("last", np.float64, (2, 3)),
        ("last_ns", np.int64, 2),
        ("scatter", np.float64, (3, 3)),
        ("x", np.float64, (2, 6)),
        ("P", np.float64, (2, 6, 6)),
        ("weights", np.float64, 2),
        ("q", np.float64, 4),
        ("rate", np.float64, 3),
        ("C", np.float64, (6, 6)),
        ("rejected", np.int64),
    ],
    align=True,
)
"""All that a tracker knows of a head.

``id``, 0 until confirmed; ``born_ns`` and ``seen_ns``, first and last seen; ``hits``, a bit a frame, the last frame
lowest; ``life``, 1 when seen, dead at 0; ``trust``, grows while it is seen, shrinks while its place is in plain view
without it, dead at 0; ``lost``, dead, but remembered; ``absent``, missed in view, and nobody knows where.

``place`` and ``velocity``, where it was last seen, and how fast; ``height``, its usual height [m], over so many
``sightings``; ``radius`` and ``score`` of the last sighting; ``strength``, how well its sightings score.

``last`` and ``last_ns`` are the last two measured centres, the newest first; ``scatter`` is the covariance by which
they scatter from frame to frame [m²].

``x`` to ``rejected`` are the state of the filters, see :mod:`headvox.tracking.kalman`.
"""

Roster = npt.NDArray[np.void]
"""(N,) rows of :data:`ROW`."""


def blank(count: int) -> Roster:
    """Return ``count`` rows of zeros."""
    roster = np.zeros(count, ROW)
    roster["last_ns"] = NEVER_NS
    return roster
