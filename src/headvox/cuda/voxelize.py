"""Points and depth images -> the grids of a batch of frames, by :mod:`headvox.voxelize`'s rules.

A grid is one row of 32-bit words. In a parts grid bit ``cell * 8 + part`` is that part's, so that a word is four of
the CPU's bytes, in the order of the memory; in a count grid a word is a cell. Bits are set and counts added up by
atomic operations whose order does not show.
"""

from __future__ import annotations

import numpy as np
from numba import cuda

from headvox.cuda.lanes import LANE_WISE, kernel, on_device
from headvox.cuda.readings import (
    CLOUD,
    COLUMN,
    DATA,
    HEADER,
    HEIGHT,
    KIND,
    LIMITS,
    NOTHING,
    ROW,
    SENSOR,
    SENSORS,
    TRANSFORM,
    WIDTH,
)
from headvox.voxelize import along_ray, code_of, inside, moved

_moved = on_device(moved, **LANE_WISE)
_along_ray = on_device(along_ray, **LANE_WISE)
_inside = on_device(inside, **LANE_WISE)
_code_of = on_device(code_of, **LANE_WISE)


@kernel
def clear(cells, passed, marked, counts):
    """Set all four (frames, N each) to 0."""
    frame = cuda.blockIdx.y
    for words in (cells, passed, marked):
        for i in range(cuda.grid(1), words.shape[1], cuda.gridsize(1)):
            words[frame, i] = 0
    for i in range(cuda.grid(1), counts.shape[1], cuda.gridsize(1)):
        counts[frame, i] = 0


@kernel
def mark(whole, real, quads, half, shape, shift, counting, cells):
    """Enter the readings of each frame into its grid ``cells`` (frames, words); z of the launch is the sensor.

    ``whole``, ``real`` and ``half`` are the same buffer as int32, float32 and uint16, and ``quads`` (frames, N, 4) as
    rows of four float32: see :mod:`headvox.cuda.readings`.
    """
    frame, sensor = cuda.blockIdx.y, cuda.blockIdx.z
    at = HEADER + sensor * SENSOR
    if sensor >= whole[frame, SENSORS] or whole[frame, at + KIND] == NOTHING:
        return
    data, width, height = whole[frame, at + DATA], whole[frame, at + WIDTH], whole[frame, at + HEIGHT]
    column, row = whole[frame, at + COLUMN], whole[frame, at + ROW]
    limits = real[frame, LIMITS : LIMITS + 6]
    transform = quads[frame, (at + TRANSFORM) // 4 : (at + TRANSFORM) // 4 + 4]
    for i in range(cuda.grid(1), width * height, cuda.gridsize(1)):
        if whole[frame, at + KIND] == CLOUD:
            first = data + 3 * i
            px, py, pz = real[frame, first], real[frame, first + 1], real[frame, first + 2]
            x = _moved(transform, 0, px, py, pz)
            y = _moved(transform, 1, px, py, pz)
            z = _moved(transform, 2, px, py, pz)
        else:
            raw = half[frame, data + i]
            if raw == 0:
                continue
            far = np.float32(raw)
            v, u = i // width, i % width
            x = _along_ray(transform[0, 3], far, real[frame, column + u], real[frame, row + v])
            y = _along_ray(
                transform[1, 3], far, real[frame, column + width + u], real[frame, row + height + v]
            )
            z = _along_ray(
                transform[2, 3], far, real[frame, column + 2 * width + u], real[frame, row + 2 * height + v]
            )
        if _inside(x, y, z, limits):
            code = _code_of(np.int32(x), np.int32(y), np.int32(z), shape[1], shape[2], shift)
            if counting:
                cuda.atomic.add(cells, (frame, code >> 3), np.uint32(1))
            else:
                cuda.atomic.or_(cells, (frame, code >> 5), np.uint32(1) << np.uint32(code & 31))
