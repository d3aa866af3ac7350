"""Clouds of depth cameras, put back into the pixels that they came from.

Points alone do not tell what their sensor saw to be empty, nor which of them were neighbours. But many a cloud is a
depth image that a driver made points of: then they lie on rays through the pixels of a pinhole camera in the origin of
their frame, one on each. Where they plainly do, the image is made again, and looked at as any other. Where they do
not (lidars, filtered or merged clouds, such as were moved to another frame), the cloud stays what it is.

Nothing is kept from frame to frame but memory: what a cloud comes to depends on its points alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from headvox.data import F32, F64, U16, Cloud, DepthImage, Frame, Intrinsics
from headvox.frames import OPTICAL
from headvox.machine.kernels import bare_kernel, read_only, rule
from headvox.machine.simd import (
    LANES,
    add,
    below,
    fill,
    load_triples,
    mul,
    ratio,
    set_bits,
    store,
    sub,
    times,
    to_float,
    to_int,
    where,
    within,
)
from headvox.machine.threads import Threads
from headvox.slabs import shares_of
from headvox.voxelize import moved

I64 = npt.NDArray[np.int64]

RUNS, RUN = 8, 1024
"""How many points of a cloud its grid is learnt from: so many runs of so many that follow each other."""
LEAST_POINTS = 500
"""Of fewer nothing is learnt."""
LEAST_STEPS, MOST_STEPS, FINEST = 8, 1024, 5e-5
"""How often neighbours have to differ along each axis of the image, how many of these are sorted, and by how much of
the distance they have to differ to count."""
OFF_PIXEL, MOST_OFF = 0.25, 0.01
"""How far from the middle of its pixel a point may be, in pixels, and the share of points that may be farther."""
UNIT_PX = 1 / 256
"""What is learnt is rounded to this, so that it mostly comes to the same in every frame of a camera."""
SPARE_PX = 2
"""How many more columns and rows than the sample has are made room for at first, to each side."""
WIDEST_PX, MOST_PIXELS = 8192, 64
"""Columns or rows, and pixels a point, of the largest image that is made."""
MILLIMETRE, FARTHEST = 0.001, 65535
PER_METRE, NOWHERE_MM = np.float32(1000.0), 1e9
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


class Organiser:
    """Makes depth images of clouds where they were some; keeps one buffer for each."""

    def __init__(self, threads: Threads) -> None:
        self._threads = threads
        self._pixels: dict[tuple[int, int], U16] = {}
        self._working = [
            (np.empty(3 * LANES, np.float32), np.empty(LANES, np.int32), np.empty(LANES, np.int32))
            for _ in range(threads.count)
        ]

    def organised(self, frame: Frame, slot: int = 0) -> Frame:
        """Return ``frame`` with depth images for those of its clouds that were some; itself where there is none.

        The images lie in memory that the next call with the same ``slot`` overwrites.
        """
        if all(cloud.T_world_sensor is None for cloud in frame.clouds):
            return frame
        images = [self._image(cloud, (slot, k)) for k, cloud in enumerate(frame.clouds)]
        clouds = tuple(cloud for cloud, image in zip(frame.clouds, images, strict=True) if image is None)
        made = tuple(image for image in images if image is not None)
        return replace(frame, clouds=clouds, depths=(*made, *frame.depths))

    def _image(self, cloud: Cloud, key: tuple[int, int]) -> DepthImage | None:
        points, T = cloud.points, cloud.T_world_sensor
        grid = None if T is None else grid_of(points)
        if T is None or grid is None or grid.is_too_large(len(points)):
            return None
        depth, (on, between, outside) = self._entered(points, grid, key)
        if outside:  # the sample has not seen the outermost pixels
            grid = widened(grid, points)
            if grid.is_too_large(len(points)):
                return None
            depth, (on, between, outside) = self._entered(points, grid, key)
        if outside or between > MOST_OFF * (on + between) or np.count_nonzero(depth) != on:
            return None  # two points on one ray are no image's
        return DepthImage(cloud.name, depth, grid.lens(), T @ grid.T_sensor_optical)

    def _entered(self, points: F32, grid: Grid, key: tuple[int, int]) -> tuple[U16, tuple[int, int, int]]:
        """Return the image of ``points``, and how many of them lie in a pixel, in none, and out of the image."""
        lens = grid.lens()
        height, width = lens.height, lens.width
        pixels = self._cleared(key, height * width + 1)
        P, size = grid.projection(), np.array([height, width])
        shares = shares_of(len(points), self._threads.count)
        counts = np.zeros((len(shares), 3), np.int64)
        calls = [
            (read_only(points), low, high, P, size, *self._working[part], pixels, counts[part])
            for part, low, high in shares
        ]
        self._threads.run(put_into_pixels, calls)
        on, between, outside = counts.sum(axis=0).tolist()
        return pixels[:-1].reshape(height, width), (on, between, outside)

    def _cleared(self, key: tuple[int, int], size: int) -> U16:
        known = self._pixels.get(key)
        if known is None or len(known) < size:
            known = self._pixels[key] = np.empty(size, np.uint16)
        pixels = known[:size]
        pixels[:] = 0
        return pixels


@bare_kernel
def put_into_pixels(points, low, high, P, size, few, cells, values, pixels, counts):
    """Write to ``pixels`` how far ahead the ``points`` from ``low`` to ``high`` are, in millimetres.

    ``P`` (3, 4) projects them, see :meth:`Grid.projection`; ``size`` (2,) is the image's height and width. ``pixels``
    has one more than it, for what is in none. Counted are points in a pixel, between pixels or behind the camera, and
    out of the image: ``counts`` (3,). ``few`` (3 * LANES,), ``cells`` and ``values`` (LANES,) are memory.
    """
    height, width = np.int32(size[0]), np.int32(size[1])
    first, none = np.int32(BIAS), np.int32(height * width)
    last_column, last_row = np.int32(BIAS + width - 1), np.int32(BIAS + height - 1)
    xyz, end = points.reshape(-1), 3 * high
    on, in_none, outside = 0, 0, 0
    for at in range(3 * low, end, 3 * LANES):
        if at + 3 * LANES <= end:
            x, y, z = load_triples(xyz, at)
        else:
            few[:] = np.nan
            for k in range(end - at):
                few[k] = xyz[at + k]
            x, y, z = load_triples(few, 0)
        ahead = moved(P, 2, x, y, z)
        u, is_column, between_columns = _pixel(ratio(moved(P, 0, x, y, z), ahead))
        v, is_row, between_rows = _pixel(ratio(moved(P, 1, x, y, z), ahead))
        far = mul(ahead, fill(PER_METRE))
        seen = below(fill(np.float32(0.5)), far) & below(far, fill(np.float32(NOWHERE_MM)))
        behind, beyond = below(ahead, fill(np.float32(0.0))), below(fill(np.float32(FARTHEST)), far)
        inside = within(u, first, last_column) & within(v, first, last_row)
        hit = seen & is_column & is_row & inside
        cell = add(times(sub(v, fill(first)), width), sub(u, fill(first)))
        store(cells, 0, where(hit, cell, fill(none)))
        whole = to_int(add(far, fill(np.float32(0.5))))
        store(values, 0, where(beyond, fill(np.int32(FARTHEST)), whole))
        for k in range(np.uint64(LANES)):
            pixels[np.uint64(cells[k])] = np.uint16(values[k])
        lost, between = seen & ~hit, between_columns | between_rows
        on += set_bits(hit)
        in_none += set_bits(behind | (lost & between))
        outside += set_bits(lost & ~between)
    counts[0], counts[1], counts[2] = on, in_none, outside


@rule
def _pixel(place):
    """Return the whole pixels at places along an axis, and two numbers with a bit for each: in it, and between two.

    Where neither is set the place is far out of any image, or none at all.
    """
    some = below(fill(np.float32(0.0)), place) & below(place, fill(np.float32(2 * BIAS)))
    place = where(some, place, fill(np.float32(0.0)))
    pixel = to_int(add(place, fill(np.float32(0.5))))
    off = sub(place, to_float(pixel))
    near = below(off, fill(np.float32(OFF_PIXEL))) & below(fill(np.float32(-OFF_PIXEL)), off)
    return pixel, some & near, some & ~near


def grid_of(points: F32) -> Grid | None:
    """Return the pixels that ``points`` (N, 3) in their sensor's frame lie in; None where they plainly lie in none."""
    sample = _sample(points)
    size = np.abs(sample).sum(axis=0)
    sample = sample[:, (size > 0.0) & (size < np.inf)]
    for T in AXES:
        right, down, ahead = T[:3, :3].T @ sample
        seen = ahead > 0.0
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
