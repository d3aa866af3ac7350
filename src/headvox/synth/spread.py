"""Points spread evenly over a surface, and which of its places are hidden in folds."""

from __future__ import annotations

import heapq

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from headvox.data import F64, I32, I64
from headvox.errors import HeadvoxError
from headvox.machine.kernels import kernel

Mask = npt.NDArray[np.bool_]

TRIES_PER_POINT = 5


def spread_points(vertices: F64, faces: I32, count: int, rng: np.random.Generator) -> F64:
    """Return exactly ``count`` points (count, 3) that keep their distance on a surface: Poisson disks.

    Five times as many random points are thinned out: the one with the closest neighbours goes first (Yuksel
    2015, "Sample Elimination for Generating Poisson Disk Sample Sets").
    """
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = 0.5 * np.sqrt((cross * cross).sum(1))
    area = float(areas.sum())
    if not area > 0.0:
        raise HeadvoxError("The surface has no area.", "Give triangles.")
    tries = TRIES_PER_POINT * count
    which = np.minimum(np.searchsorted(np.cumsum(areas), rng.random(tries) * area), len(faces) - 1)
    edge, along = np.sqrt(rng.random(tries))[:, None], rng.random(tries)[:, None]
    a, b, c = corners[which, 0], corners[which, 1], corners[which, 2]
    points = (1.0 - edge) * a + edge * ((1.0 - along) * b + along * c)
    # As far apart as the points of the densest packing on a plane could be.
    widest = 2.0 * np.sqrt(area / (2.0 * np.sqrt(3.0) * count))
    least = widest * 0.65 * (1.0 - (1.0 / TRIES_PER_POINT) ** 1.5)
    pairs = cKDTree(points).query_pairs(widest, output_type="ndarray").astype(np.int64)
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    start = np.searchsorted(pairs[:, 0], np.arange(tries + 1))
    stays: Mask = _thin_out(points, start, np.ascontiguousarray(pairs[:, 1]), count, least, widest)
    spread: F64 = points[stays]
    return spread


@kernel
def _thin_out(points: F64, start: I64, neighbours: I64, count: int, least: float, widest: float) -> Mask:
    """Which points stay. Neighbours of point i are ``neighbours[start[i]:start[i + 1]]``."""
    share = np.empty(len(neighbours))  # of each neighbour in how crowded a point is
    crowd = np.zeros(len(points))
    heap = []
    for i in range(len(points)):
        for k in range(start[i], start[i + 1]):
            x, y, z = points[i] - points[neighbours[k]]
            near = 1.0 - max(np.sqrt(x * x + y * y + z * z), least) / widest
            near *= near
            near *= near
            share[k] = near * near
            crowd[i] += share[k]
        heap.append((-crowd[i], i))
    heapq.heapify(heap)
    stays = np.ones(len(points), np.bool_)
    left = len(points)
    while left > count:
        most, i = heapq.heappop(heap)
        if -most != crowd[i]:  # some neighbour has gone since
            heapq.heappush(heap, (-crowd[i], i))
            continue
        stays[i] = False
        left -= 1
        for k in range(start[i], start[i + 1]):
            crowd[neighbours[k]] -= share[k]
    return stays


def escapes(vertices: F64, faces: I32, points: F64, directions: F64) -> Mask:
    """Return (N, D): whether a ray from each point (N, 3) along each unit direction (D, 3) hits no triangle."""
    free = np.ones((len(points), len(directions)), np.bool_)
    used, corners = np.unique(faces, return_inverse=True)
    vertices, triangles = vertices[used], corners.reshape(-1, 3)
    size = float(np.sqrt(np.ptp(vertices, axis=0) @ np.ptp(vertices, axis=0) / max(len(faces), 1)))
    for k, toward in enumerate(directions):
        side = np.cross(toward, np.eye(3)[np.abs(toward).argmin()])
        side /= np.sqrt((side * side).sum())
        axes = np.column_stack([side, np.cross(toward, side), toward])
        seen, starts = vertices @ axes, points @ axes
        low = np.minimum(seen.min(0), starts.min(0))[:2]
        cells = ((starts[:, :2] - low) / size).astype(np.int64)
        columns = int(max(cells[:, 1].max(), ((seen[:, 1] - low[1]) / size).max())) + 1
        key = cells[:, 0] * columns + cells[:, 1]
        order = np.argsort(key, kind="stable")
        rows = int(max(cells[:, 0].max(), ((seen[:, 0] - low[0]) / size).max())) + 1
        first = np.searchsorted(key[order], np.arange(rows * columns + 1))
        _block(seen, triangles, starts, low, size, columns, first, order, free[:, k])
    return free


@kernel
def _block(
    seen: F64,
    faces: npt.NDArray[np.integer],
    starts: F64,
    low: F64,
    size: float,
    columns: int,
    first: I64,
    order: I64,
    free: Mask,
) -> None:
    """Mark the points that lie below a triangle, in axes whose third is the rays' direction."""
    for f in range(len(faces)):
        ax, ay, az = seen[faces[f, 0]]
        bx, by, bz = seen[faces[f, 1]]
        cx, cy, cz = seen[faces[f, 2]]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        v0, v1 = int((min(ay, by, cy) - low[1]) / size), int((max(ay, by, cy) - low[1]) / size)
        for u in range(int((min(ax, bx, cx) - low[0]) / size), int((max(ax, bx, cx) - low[0]) / size) + 1):
            for j in range(first[u * columns + v0], first[u * columns + v1 + 1]):
                x, y, z = starts[order[j]]
                a = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                b = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                c = 1.0 - a - b
                if a >= 0.0 and b >= 0.0 and c >= 0.0 and z < a * az + b * bz + c * cz:
                    free[order[j]] = False
