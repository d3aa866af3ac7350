"""Clouds of depth cameras, put back into the pixels that they came from.

Points alone do not tell what their sensor saw to be empty, nor which of them were neighbours. But many a cloud is a
depth image that a driver made points of: then they lie on rays through the pixels of a pinhole camera in the origin of
their frame, one on each. Where they plainly do, the image is made again, and looked at as any other. Where they do
not (lidars, filtered or merged clouds, such as were moved to another frame), the cloud stays what it is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from headvox.data import F32, U16, Cloud, DepthImage, Frame
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
from headvox.pixelgrid import BIAS, LEAST_POINTS, MOST_OFF, OFF_PIXEL, Grid, grid_of, widened
from headvox.slabs import shares_of
from headvox.voxelize import moved

FARTHEST = 65535
PER_METRE, NOWHERE_MM = np.float32(1000.0), 1e9


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
        """Return ``frame`` with depth images for those of its clouds that were some; itself where no sensor is placed.

        The images lie in memory that the next call with the same ``slot`` overwrites.
        """
        if all(cloud.T_world_sensor is None for cloud in frame.clouds):
            return frame
        images = [self._image(cloud, (slot, k)) for k, cloud in enumerate(frame.clouds)]
        clouds = tuple(cloud for cloud, image in zip(frame.clouds, images, strict=True) if image is None)
        made = tuple(image for image in images if image is not None)
        return replace(frame, clouds=clouds, depths=(*made, *frame.depths))

    def _image(self, cloud: Cloud, key: tuple[int, int]) -> DepthImage | None:
        points, T = np.asarray(cloud.points, dtype=np.float32), cloud.T_world_sensor
        grid = None if T is None else grid_of(points)
        if T is None or grid is None or grid.is_too_large(len(points)):
            return None
        depth, (on, between, outside) = self._entered(points, grid, key)
        if outside:  # the sample has not seen the outermost pixels
            grid = widened(grid, points)
            if grid.is_too_large(len(points)):
                return None
            depth, (on, between, outside) = self._entered(points, grid, key)
        if outside or on < LEAST_POINTS or between > MOST_OFF * (on + between):
            return None
        if np.count_nonzero(depth) != on:
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
