"""Are these points metres near where they should be? If not: too large by a factor, or too far away?"""

from __future__ import annotations

import numpy as np

from headvox.data import F64
from headvox.errors import HeadvoxError

FARTHEST_MEDIAN_M = 100.0  # no indoor sensor sees its typical point from farther away
FAR = 3.0  # times its own size is a cloud away that is elsewhere: a sensor stands in, or beside, what it sees
MILLIMETRES = 1000.0, 30_000.0  # the size of a room in them: as centimetres or inches that would be a hall


def wrong_scale(
    points: F64, name: str, origin: tuple[float, float, float] | None = None
) -> HeadvoxError | None:
    """Say that a cloud is too large, or far away; None where half of its points are within 100 m.

    Args:
        points: (N, 3) finite numbers that should be metres, N > 0.
        name: what the cloud is called in the error.
        origin: what they should be near, metres; by default the origin of their frame.
    """
    where = "the origin" if origin is None else f"({', '.join(f'{value:.2f}' for value in origin)})"
    distance = _middle_length(points - (origin or (0.0, 0.0, 0.0)))
    if distance <= FARTHEST_MEDIAN_M:
        return None
    size = _middle_length(points - np.median(points, axis=0))
    if distance > FAR * size:
        return HeadvoxError(
            f"{name}: half of the points are {distance:.4g} m or more from {where}, though they lie together: "
            f"expected less than {FARTHEST_MEDIAN_M:g} m.",
            "Move the cloud near the origin; metres are expected.",
        )
    what = (
        f"{name}: half of the points are {distance:.4g} or more from {where} and {size:.4g} from their middle"
    )
    if MILLIMETRES[0] <= size <= MILLIMETRES[1]:
        return HeadvoxError(
            f"{what}, expected metres: these look like millimetres.", "Multiply them by 0.001."
        )
    return HeadvoxError(f"{what}: metres are expected.", "Convert them to metres.")


def _middle_length(offsets: F64) -> float:
    return float(np.median(np.linalg.norm(offsets, axis=1)))
