"""The pixels of a depth camera, learnt from a cloud that its driver made of an image.

A cloud's points lie on rays through the pixels of a pinhole camera in the origin of their frame where their slopes are
evenly spaced along two axes. Nothing is kept from cloud to cloud: what one comes to depends on its points alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from headvox.data import F32, F64, Intrinsics
from headvox.frames import OPTICAL

RUNS, RUN = 8, 1024
"""How many points of a cloud its grid is learnt from: so many runs of so many that follow each other."""
LEAST_POINTS = 500
"""Of fewer nothing is learnt."""
LEAST_STEPS, MOST_STEPS, FINEST = 8, 1024, 5e-5
"""How often neighbours have to differ along each axis of the image, how many of these are sorted, and by how much of
the distance they have to differ to count."""
STEEPEST = 20.0
"""Slope of the rays that may be a camera's: 87 degrees off its axis."""
OFF_PIXEL, MOST_OFF = 0.25, 0.01
"""How far from the middle of its pixel a point may be, in pixels, and the share of points that may be farther."""
UNIT_PX = 1 / 256
"""What is learnt is rounded to this, so that it mostly comes to the same in every frame of a camera."""
SPARE_PX = 2
"""How many more columns and rows than the sample has are made room for at first, to each side."""
WIDEST_PX, MOST_PIXELS = 8192, 64
"""Columns or rows, and pixels a point, of the largest image that is made."""
MILLIMETRE = 0.001
BIAS = WIDEST_PX
"""What is added to columns and rows, so that those before the first one are above 0, too."""

AXES: tuple[F64, ...] = (np.eye(4), OPTICAL, np.diag([1.0, -1.0, -1.0, 1.0]))
"""T_sensor_optical of a sensor's frame: optical itself; x forward and z up (REP 103); y up and z backward (OpenGL)."""


class Line(NamedTuple):
    """Pixels along one axis of an image: a ray's slope is in pixel ``f * slope + c``; which of them were seen."""

    f: float
    c: float
    first: int
    last: int


class Grid(NamedTuple):
    """The pixels of a cloud."""

    T_sensor_optical: F64
    column: Line
    row: Line

    def lens(self) -> Intrinsics:
        """Return the camera whose image these pixels are."""
        (fx, cx, left, right), (fy, cy, top, bottom) = self.column, self.row
        return Intrinsics(right - left + 1, bottom - top + 1, fx, fy, cx - left, cy - top, MILLIMETRE)

    def projection(self) -> F32:
        """Return (3, 4): rows that give u * z, v * z and z (m) of a point, u and v in pixels from ``-BIAS``."""
        lens, R = self.lens(), self.T_sensor_optical[:3, :3].T
        P = np.zeros((3, 4))
        P[:, :3] = (
            lens.fx * R[0] + (lens.cx + BIAS) * R[2],
            lens.fy * R[1] + (lens.cy + BIAS) * R[2],
            R[2],
        )
        return P.astype(np.float32)

    def is_too_large(self, points: int) -> bool:
        """Return whether this is plainly no image of so many points."""
        lens = self.lens()
        return max(lens.width, lens.height) > WIDEST_PX or lens.width * lens.height > MOST_PIXELS * points


def grid_of(points: F32) -> Grid | None:
    """Return the pixels that ``points`` (N, 3) in their sensor's frame lie in; None where they plainly lie in none."""
    sample = _sample(points)
    size = np.abs(sample).sum(axis=0)
    sample = sample[:, (size > 0.0) & (size < np.inf)]
    for T in AXES:
        right, down, ahead = T[:3, :3].T @ sample
        seen = np.maximum(np.abs(right), np.abs(down)) < STEEPEST * ahead
        count = np.count_nonzero(seen)
        if count < max(LEAST_POINTS, (1.0 - MOST_OFF) * sample.shape[1]):
            continue  # a camera looks ahead
        if count < sample.shape[1]:
            right, down, ahead = right[seen], down[seen], ahead[seen]
        column, row = _line(right / ahead), _line(down / ahead)
        if column is not None and row is not None:
            return Grid(T, column, row)
    return None


def _sample(points: F32) -> F64:
    """Return up to ``RUNS`` runs of points that follow each other, evenly through the cloud: (3, M) float64."""
    if len(points) > RUNS * RUN:
        starts = np.linspace(0, len(points) - RUN, RUNS).astype(np.int64)
        points = np.concatenate([points[start : start + RUN] for start in starts])
    return np.ascontiguousarray(points.T, np.float64)


def _line(slopes: F64) -> Line | None:
    """Return the pixels whose rays have these ``slopes`` (M,); None if they are not evenly spaced."""
    steps = np.abs(np.diff(slopes))
    steps = steps[steps > FINEST]
    if len(steps) < LEAST_STEPS:
        return None
    few = steps[:MOST_STEPS]
    least = np.partition(few, len(few) // 10)[len(few) // 10]  # a tenth may be smaller: noise
    pitch = steps[np.abs(steps - least) < 0.25 * least].mean()
    mean = slopes.mean()
    away, f = slopes - mean, 1.0 / pitch
    c = -f * away[len(away) // 2]  # any point is in the middle of its pixel
    for _ in range(2):
        pixels = np.rint(f * away + c)
        f, c = float(away @ pixels / (away @ away)), float(pixels.mean())
    f, c = (round(value / UNIT_PX) * UNIT_PX for value in (f, c - f * mean))
    places = f * slopes + c
    pixels = np.rint(places)
    on = np.abs(places - pixels) <= OFF_PIXEL
    if not f > 0.0 or on.mean() < 1.0 - MOST_OFF:
        return None
    return Line(f, c, int(pixels[on].min()) - SPARE_PX, int(pixels[on].max()) + SPARE_PX)


def widened(grid: Grid, points: F32) -> Grid:
    """Return ``grid`` with all pixels that any of ``points`` lies in."""
    known = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    right, down, ahead = (known @ grid.T_sensor_optical[:3, :3]).T
    seen = ahead > 0.0
    column = _spanning(grid.column, right[seen] / ahead[seen])
    return grid._replace(column=column, row=_spanning(grid.row, down[seen] / ahead[seen]))


def _spanning(line: Line, slopes: F64) -> Line:
    pixels = np.clip(np.rint(line.f * slopes + line.c), -WIDEST_PX, WIDEST_PX)
    return line._replace(first=int(pixels.min()) - 1, last=int(pixels.max()) + 1)
