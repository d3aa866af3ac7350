"""Rigid transforms ``T_a_b``: 4x4 float64 matrices that map coordinates in b to coordinates in a."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from headvox.data import F64, U16, Intrinsics
from headvox.errors import HeadvoxError

RIGID_TOLERANCE = 1e-3  # extrinsics typed by hand have four digits
OPTICAL: F64 = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""T_body_optical: from x right, y down, z forward to x forward, y left, z up."""


def as_rigid(matrix: npt.ArrayLike, name: str) -> F64:
    """Return ``matrix`` as (4, 4) float64, or say why it is no rigid transform.

    Raises:
        HeadvoxError: wrong shape, not finite, a last row other than 0 0 0 1, or a rotation part that is not a
            rotation (scaled, sheared, mirrored or singular).
    """
    try:
        T = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        raise HeadvoxError(
            f"{name}: expected a 4x4 matrix of numbers.", "Give four rows of four numbers."
        ) from None
    if T.shape != (4, 4):
        raise HeadvoxError(
            f"{name}: expected a 4x4 matrix, got shape {T.shape}.", "Give four rows of four numbers."
        )
    if not np.isfinite(T).all():
        raise HeadvoxError(
            f"{name}: the matrix has NaN or infinite entries.", "An unknown transform is not usable."
        )
    if np.abs(T[3] - (0.0, 0.0, 0.0, 1.0)).max() > RIGID_TOLERANCE:
        raise HeadvoxError(f"{name}: the last row is {T[3].tolist()}, expected 0 0 0 1.", "Is it transposed?")
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > RIGID_TOLERANCE or np.linalg.det(R) < 0.0:
        raise HeadvoxError(
            f"{name}: the rotation part is not a rotation (determinant {np.linalg.det(R):.3g}).",
            "Expected an invertible, unscaled, right-handed rotation.",
        )
    return T


def inverse(T_a_b: F64) -> F64:
    """Return T_b_a of a rigid T_a_b."""
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = T_a_b[:3, :3].T
    T_b_a[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return T_b_a


def transform(T_a_b: F64, points_b: F64) -> F64:
    """Map (N, 3) points in b to a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def unproject(depth: U16, intrinsics: Intrinsics, T_world_camera: F64) -> F64:
    """World points (N, 3) of the pixels that have a return, in image order."""
    v, u = np.nonzero(depth)
    z = depth[v, u] * intrinsics.depth_scale
    points = np.stack(
        [(u - intrinsics.cx) / intrinsics.fx * z, (v - intrinsics.cy) / intrinsics.fy * z, z], -1
    )
    return transform(T_world_camera, points)
