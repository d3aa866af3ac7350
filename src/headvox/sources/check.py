"""Is a point cloud one that heads can be found in?"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.data import F32, F64
from headvox.errors import HeadvoxError
from headvox.scale import wrong_scale

Column = npt.NDArray[Any]

_SAMPLE = 10_000  # points that are looked at: every frame passes here


def as_points(x: Column, y: Column, z: Column) -> F32:
    """Return three columns (N,) of real numbers, metres, as a point array.

    Returns:
        (N, 3) float32, C-contiguous, metres in the frame of the columns; a point with a coordinate that is
        not finite is NaN in all of them.
    """
    points = np.empty((len(x), 3), dtype=np.float32)
    # What float32 cannot hold becomes infinite and then NaN; a signalling NaN is a NaN like any other.
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, column in enumerate((x, y, z)):
            points[:, axis] = column
    finite = np.isfinite(points[:, 0]) & np.isfinite(points[:, 1]) & np.isfinite(points[:, 2])
    if not finite.all():
        points[~finite] = np.nan
    return points


def check_cloud(points: F32, name: str) -> None:
    """Refuse a cloud that has no points, or whose points are plainly not metres near the origin.

    Args:
        points: (N, 3) floats, NaN where invalid, in the sensor's or the world frame.
        name: what the cloud is called in the error.

    Raises:
        HeadvoxError: wrong shape or dtype, no point, no finite point, or a median distance from the origin
            above 100 m.
    """
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind != "f":
        raise HeadvoxError(
            f"{name}: expected points as (N, 3) float32, got shape {points.shape} of {points.dtype}.",
            "Give x, y, z in metres.",
        )
    if len(points) == 0:
        raise HeadvoxError(f"{name}: the cloud is empty, expected points.", "Check how it was recorded.")
    seen = _finite_rows(points[:: -(-len(points) // _SAMPLE)])
    if len(seen) == 0:
        seen = _finite_rows(points)
    if len(seen) == 0:
        raise HeadvoxError(
            f"{name}: all {len(points)} points are NaN or infinite, expected some finite ones.",
            "Check how it was recorded.",
        )
    error = wrong_scale(seen, name)
    if error is not None:
        raise error


def _finite_rows(points: F32) -> F64:
    rows: F64 = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    return rows
