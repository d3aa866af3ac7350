"""Surfaces as points: triangles sampled evenly, the same way every time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import numpy.typing as npt

from headvox.data import F32, F64, I64
from headvox.errors import HeadvoxError

SPACING_M = 0.008  # two to three points across a 2 cm cell
MAX_POINTS = 50_000_000
_CHUNK = 500_000  # points made at once: holds what lies in memory meanwhile under 100 MB


def triangulate(polygons: Iterable[npt.NDArray[np.integer]]) -> I64:
    """Split polygons into fans around their first corner.

    Args:
        polygons: arrays (K, n) of vertex indices, one array for each number of corners n; n < 3 gives
            nothing.

    Returns:
        (F, 3) int64 vertex indices. A concave polygon is covered, and a little beside it.
    """
    fans = [np.empty((0, 3), dtype=np.int64)]
    for corners in polygons:
        count, n = corners.shape
        if n < 3:
            continue
        fan = np.empty((count, n - 2, 3), dtype=np.int64)
        fan[:, :, 0] = corners[:, :1]
        fan[:, :, 1] = corners[:, 1:-1]
        fan[:, :, 2] = corners[:, 2:]
        fans.append(fan.reshape(-1, 3))
    return np.concatenate(fans)


def sample_surface(
    vertices: npt.ArrayLike, faces: npt.ArrayLike, spacing_m: float = SPACING_M, name: str = "mesh"
) -> F32:
    """Return the vertices and points that lie evenly on the triangles.

    A triangle is cut into columns that stand on its longest edge, at most ``spacing_m`` apart, and a column
    has points at most ``spacing_m`` apart. So a needle costs its length and not its length squared, no place
    on a triangle is farther than ``spacing_m`` from a point, and triangles so small that their corners do
    that already get none. There are no random numbers.

    Args:
        vertices: (V, 3), metres.
        faces: (F, 3) integers, indices of vertices. A face with a vertex that is not finite gives no points.
        spacing_m: the largest distance between neighbours, metres.
        name: what the surface is called in an error.

    Returns:
        (V + M, 3) float32, metres, C-contiguous, in the frame of the vertices; the vertices come first.

    Raises:
        HeadvoxError: an index without a vertex, or an area that needs more than 50 million points.
    """
    corners = np.asarray(vertices, dtype=np.float32).reshape(-1, 3)
    triangles = np.asarray(faces, dtype=np.int64).reshape(-1, 3)
    _check_spacing(spacing_m, name)
    _check_indices(triangles, len(corners), name)
    shapes = _longest_edge_first(corners[triangles].astype(np.float64))
    shapes = shapes[np.isfinite(shapes).all(axis=(1, 2))]
    bounds = _upper_bounds(shapes, spacing_m)
    _refuse_too_many(bounds.sum(), spacing_m, name)

    points = np.empty((len(corners) + int(bounds.sum()), 3), dtype=np.float32)
    points[: len(corners)] = corners
    filled = len(corners)
    for owner, share, shares in _portions(bounds):
        samples = _sample(shapes[owner], share, shares, spacing_m)
        points[filled : filled + len(samples)] = samples
        filled += len(samples)
    points.resize((filled, 3), refcheck=False)  # in place: a slice would keep the unused rest alive
    return points


def _check_spacing(spacing_m: float, name: str) -> None:
    if not spacing_m > 0.0:
        raise HeadvoxError(f"{name}: the spacing is {spacing_m} m, expected more than 0.", "Try 0.008.")


def _check_indices(triangles: I64, vertex_count: int, name: str) -> None:
    if triangles.size == 0:
        return
    low, high = int(triangles.min()), int(triangles.max())
    if low < 0 or high >= vertex_count:
        raise HeadvoxError(
            f"{name}: a face names vertex {low if low < 0 else high}, expected 0 to {vertex_count - 1}.",
            "The file is damaged, or its indices count from 1.",
        )


def _refuse_too_many(points: float, spacing_m: float, name: str) -> None:
    if not points <= MAX_POINTS:
        raise HeadvoxError(
            f"{name}: the surface needs {points:.1e} points {spacing_m * 1000:g} mm apart, "
            f"expected at most {MAX_POINTS:.0e}.",
            "Is it in millimetres? Scale it to metres.",
        )


def _longest_edge_first(shapes: F64) -> F64:
    """Turn each triangle of (F, 3, 3) so that its longest edge runs from corner 0 to corner 1."""
    edges = np.linalg.norm(np.roll(shapes, -1, axis=1) - shapes, axis=2)
    turn = (edges.argmax(axis=1)[:, None] + np.arange(3)) % 3
    return np.take_along_axis(shapes, turn[:, :, None], axis=1)


def _upper_bounds(shapes: F64, spacing_m: float) -> F64:
    """At most this many points will be made on each triangle."""
    base, side = shapes[:, 1] - shapes[:, 0], shapes[:, 2] - shapes[:, 0]
    length = np.linalg.norm(base, axis=1) / spacing_m
    highest = np.linalg.norm(np.cross(base, side), axis=1) / spacing_m**2 / np.maximum(length, 1.0)
    bounds: F64 = np.where(length > 1.0, np.ceil(length) * (0.5 * highest + 1.0), 0.0)
    return bounds


def _portions(bounds: F64) -> Iterator[tuple[I64, I64, I64]]:
    """Divide the work: yield triangles with which share of how many of their columns is to be made."""
    shares = np.maximum(np.ceil(bounds / _CHUNK), 1.0).astype(np.int64)  # only a huge triangle has several
    owner = np.repeat(np.arange(len(bounds)), shares)
    share = _count_within(shares)
    chunk = (np.cumsum((bounds / shares)[owner]) // _CHUNK).astype(np.int64)
    for part in np.split(np.arange(len(owner)), np.flatnonzero(np.diff(chunk)) + 1):
        yield owner[part], share[part], shares[owner[part]]


def _sample(shapes: F64, share: I64, shares: I64, spacing_m: float) -> F64:
    """Return the points on a share of the columns of each triangle, (M, 3).

    ``shapes`` is (F, 3, 3), the longest edge first; ``share`` and ``shares`` are (F,).
    """
    start, base, side = shapes[:, 0], shapes[:, 1] - shapes[:, 0], shapes[:, 2] - shapes[:, 0]
    length = np.linalg.norm(base, axis=1)
    gaps = np.maximum(np.ceil(length / spacing_m), 1.0).astype(np.int64)  # the corners stand at both ends
    first, last = (1 + k * (gaps - 1) // shares for k in (share, share + 1))

    triangle = np.repeat(np.arange(len(shapes)), last - first)
    along = (first[triangle] + _count_within(last - first)) / gaps[triangle]
    with np.errstate(divide="ignore", invalid="ignore"):
        peak = np.clip(np.einsum("ij,ij->i", side, base) / length**2, 0.0, 1.0)
        rise = np.minimum(along / peak[triangle], (1.0 - along) / (1.0 - peak[triangle]))
    up = side - peak[:, None] * base
    height = rise * np.linalg.norm(up, axis=1)[triangle]
    point_counts = np.maximum(np.ceil(height / spacing_m), 1.0).astype(np.int64)

    column = np.repeat(np.arange(len(triangle)), point_counts)
    up_share = (_count_within(point_counts) + 0.5) / point_counts[column] * rise[column]
    triangle = triangle[column]
    samples: F64 = start[triangle] + along[column, None] * base[triangle] + up_share[:, None] * up[triangle]
    return samples


def _count_within(counts: I64) -> I64:
    """Return 0 1 .. c-1 for each c of the counts, one after the other."""
    ends = np.cumsum(counts)
    total = int(ends[-1]) if len(ends) else 0
    return np.arange(total) - np.repeat(ends - counts, counts)
