"""What goes to the device and comes back.

Uploaded is everything that the sensors saw in a frame, and where they stand, in one row of a buffer.

A row is read as int32, float32 and uint16 at once; offsets are numbers of items of the type that lies there, and 4x4
matrices begin at whole quads of words.

    header    how many sensors, whether the cameras are asked what they saw, the parity of cell 0, 0, 0, the threshold
              in two words, and the limits of the region
    sensors   a record each: what it is, where its readings and rays begin, its size, its transform or place, and its
              camera's table
    readings  points as they are; rays (columns, rows) and pixels of a depth image
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.data import DepthImage, Frame
from headvox.visibility import camera_table
from headvox.voxelize import Lattice, Rays, part_transform

SENSORS, SEES, ODD, THRESHOLD, LIMITS = 0, 1, 2, 5, 8
HEADER = 16
KIND, DATA, WIDTH, HEIGHT, COLUMN, ROW, TRANSFORM, TABLE = 0, 1, 2, 3, 4, 5, 8, 24
SENSOR = 40
NOTHING, CLOUD, DEPTH = 0, 1, 2

I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Asked:
    """A frame, where it is searched, and the least score (in steps) that is worth a look at the surface."""

    frame: Frame
    lattice: Lattice
    sees: bool
    threshold: int


@dataclass(frozen=True, slots=True)
class Found:
    """What the search found in a frame: all integer, and the same as the CPU's.

    ``cells`` (N, 3) of the lattice, ``scores`` (N,) in steps and ``yaws`` (N,) are of the peaks that were judged, in
    the order of the volume. ``patches`` (P, side, side, side) are the cells of the grid about those that score enough,
    and ``patch_of`` (N,) tells which is whose, or -1.
    """

    occupied: bool
    candidates: int
    cells: I32
    scores: I64
    yaws: I32
    patches: npt.NDArray[Any]
    patch_of: I64


def words_of(frame: Frame) -> int:
    """Return how many 32-bit words a row for ``frame`` has."""
    points = sum(cloud.points.size for cloud in frame.clouds)
    images = 0
    for image in frame.depths:
        height, width = image.depth.shape
        images += 3 * (width + height) + (width * height + 1) // 2
    return HEADER + SENSOR * (len(frame.clouds) + len(frame.depths)) + points + images


def pack(asked: Asked, rays_of: Callable[[DepthImage, Lattice], Rays], row: I32) -> None:
    """Write everything about a frame to ``row``, which is long enough: see :func:`words_of`."""
    frame, lattice = asked.frame, asked.lattice
    real, half = row.view(np.float32), row.view(np.uint16)
    row[SENSORS] = len(frame.clouds) + len(frame.depths)
    row[SEES] = asked.sees
    row[ODD : ODD + 3] = lattice.odd
    row[THRESHOLD : THRESHOLD + 2] = np.array([asked.threshold], np.int64).view(np.int32)
    real[LIMITS : LIMITS + 6] = lattice.limits()
    at, data = HEADER, HEADER + SENSOR * int(row[SENSORS])

    def put(values: npt.NDArray[np.float32]) -> int:
        """Write float32 numbers behind all others; return where they begin."""
        nonlocal data
        begin, data = data, data + values.size
        real[begin:data] = values.reshape(-1)
        return begin

    for cloud in frame.clouds:
        row[at + KIND : at + HEIGHT + 1] = CLOUD, put(cloud.points), len(cloud.points), 1
        real[at + TRANSFORM : at + TRANSFORM + 16] = part_transform(cloud, lattice).reshape(-1)
        at += SENSOR
    for image in frame.depths:
        height, width = image.depth.shape
        rays = rays_of(image, lattice)
        row[at + COLUMN], row[at + ROW] = put(rays.column[:, :width]), put(rays.row)
        row[at + KIND : at + HEIGHT + 1] = DEPTH, 2 * data, width, height
        half[2 * data : 2 * data + image.depth.size] = image.depth.reshape(-1)
        data += (image.depth.size + 1) // 2
        real[at + TRANSFORM : at + TRANSFORM + 16] = 0.0
        real[at + TRANSFORM + 3 : at + TRANSFORM + 12 : 4] = rays.t
        real[at + TABLE : at + TABLE + 16] = camera_table(image, lattice).reshape(-1)
        at += SENSOR
