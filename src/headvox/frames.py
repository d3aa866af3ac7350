"""Rigid transforms ``T_a_b``: 4x4 float64 matrices that map coordinates in b to coordinates in a."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from headvox.data import F64, U16, Intrinsics
from headvox.errors import HeadvoxError

RIGID_TOLERANCE = 1e-3  # extrinsics typed by hand have four digits
STILL_M = 0.01  # what stands still may jitter so far,
STILL = 0.01  # and each entry of its rotation by so much: about half a degree
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
        given = np.asanyarray(matrix)
        if given.dtype.kind == "c" or isinstance(given, np.ma.MaskedArray):
            raise TypeError  # NumPy would leave out what is imaginary, and take what is masked
        T = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise HeadvoxError(
            f"{name}: expected a 4x4 matrix of real numbers.", "Give four rows of four numbers."
        ) from None
    if T.shape != (4, 4):
        raise HeadvoxError(
            f"{name}: expected a 4x4 matrix, got shape {T.shape}.", "Give four rows of four numbers."
        )
    fault = _fault_of(T.tobytes())
    if fault is not None:
        what, hint = fault
        raise HeadvoxError(f"{name}: {what}", hint)
    return T


def is_moving(places: Iterable[F64]) -> bool:
    """Return whether a sensor with these ``places`` (4, 4), one a frame, moves by more than poses jitter."""
    T = np.array(list(places), np.float64).reshape(-1, 4, 4)
    off = np.abs(T - T[:1])
    return bool((off[:, :3, 3] > STILL_M).any() or (off[:, :3, :3] > STILL).any())


@lru_cache(maxsize=64)
def _fault_of(matrix: bytes) -> tuple[str, str] | None:
    """Return what is wrong with a 4x4 matrix, and what to do. Each frame asks of the same sensors: it is kept."""
    T = np.frombuffer(matrix).reshape(4, 4)
    # Plain numbers: a sensor that moves is asked about in each frame, and a call of NumPy takes longer than all of it.
    *rows, last = T.tolist()
    if not all(map(math.isfinite, [*rows[0], *rows[1], *rows[2], *last])):
        return "the matrix has NaN or infinite entries.", "An unknown transform is not usable."
    if max(abs(last[0]), abs(last[1]), abs(last[2]), abs(last[3] - 1.0)) > RIGID_TOLERANCE:
        return f"the last row is {last}, expected 0 0 0 1.", "Is it transposed?"
    if not _is_rotation(*rows):
        return (
            f"the rotation part is not a rotation (determinant {np.linalg.det(T[:3, :3]):.3g}).",
            "Expected an invertible, unscaled, right-handed rotation.",
        )
    return None


def _is_rotation(a: list[float], b: list[float], c: list[float]) -> bool:
    """Return whether the first three numbers of the rows are a rotation: unit length, right angles, right-handed."""
    (a0, a1, a2, _), (b0, b1, b2, _), (c0, c1, c2, _) = a, b, c
    off = (
        a0 * a0 + a1 * a1 + a2 * a2 - 1.0, b0 * b0 + b1 * b1 + b2 * b2 - 1.0, c0 * c0 + c1 * c1 + c2 * c2 - 1.0,
        a0 * b0 + a1 * b1 + a2 * b2, a0 * c0 + a1 * c1 + a2 * c2, b0 * c0 + b1 * c1 + b2 * c2,
    )  # fmt: skip
    determinant = a0 * (b1 * c2 - b2 * c1) - a1 * (b0 * c2 - b2 * c0) + a2 * (b0 * c1 - b1 * c0)
    return max(map(abs, off)) <= RIGID_TOLERANCE and determinant > 0.0


def placed(translation: npt.ArrayLike, quaternion: npt.ArrayLike) -> F64:
    """Return T_a_b of where b is in a: metres, and x, y, z, w of any length but 0."""
    q = np.asarray(quaternion, dtype=np.float64)
    x, y, z, w = (q / np.linalg.norm(q)).tolist()
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = translation
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
