"""What goes to the device and comes back.

Uploaded is everything that the sensors saw in a frame, and where they stand, in one row of a buffer.

A row is read as int32, float32, float64 and uint16 at once; offsets are numbers of items of the type that lies there.
4x4 matrices begin at whole quads of words, and expected heads at whole octets of float64.

    header    how many sensors, of which peaks the cameras are asked, the parity of cell 0, 0, 0, the least score
              that is worth a look in two words, the limits of the region, the least score of a head in two words, where
              the expected heads are and how many, whether heads have hair, and the lattice's origin
    sensors   a record each: what it is, where its readings and rays begin, its size, whether it is where its readings
              say, its transform or place in the grid, its camera's table, its place in the world, and its lens
    expected  of each head its centre, its quaternion, and its reach
    readings  points as they are; rays (columns, rows) and pixels of a depth image
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from headvox.check import origins_of
from headvox.data import F64, I32, I64, DepthImage, Expected, Frame
from headvox.lattice import Lattice
from headvox.pose.fit import Poses
from headvox.pose.nearby import lens_of
from headvox.visibility import camera_table
from headvox.voxelize import Rays, part_transform

SENSORS, SEES, ODD, THRESHOLD, LIMITS, LEAST, EXPECTED, EXPECTED_AT, HAIRED = 0, 1, 2, 5, 8, 14, 16, 17, 18
ORIGIN = 10  # in float64
HEADER = 32
KIND, DATA, WIDTH, HEIGHT, COLUMN, ROW, KNOWS, TRANSFORM, TABLE, PLACE, LENS = (
    0,
    1,
    2,
    3,
    4,
    5,
    6,
    8,
    24,
    40,
    64,
)
SENSOR = 76
OCTET = 16  # words of an expected head
NOTHING, CLOUD, DEPTH = 0, 1, 2
OF_NONE, OF_ALL, OF_SEEN = 0, 1, 2  # the cameras are asked of these peaks


@dataclass(frozen=True, slots=True)
class Asked:
    """A frame, where it is searched, whether the cameras are asked, and what may be a head: see :mod:`headvox.keep`."""

    frame: Frame
    lattice: Lattice
    sees: bool
    least: int
    slack: int = 0
    expected: Expected | None = None


@dataclass(frozen=True, slots=True)
class Found:
    """The heads of a frame (N of them, best score first), and whether anything was in range.

    ``cells`` (N, 3) of the lattice, ``scores`` (N,) in steps and ``yaws`` (N,) are integer, and the same as the CPU's.
    ``centres`` (N, 3) and ``radii`` (N,) are those of the spheres, ``poses`` of the first heads, if they were fitted.
    """

    occupied: bool
    candidates: int
    cells: I32
    scores: I64
    yaws: I64
    centres: F64
    radii: F64
    poses: Poses | None


def words_of(asked: Asked) -> int:
    """Return how many 32-bit words a row for a frame has."""
    frame, expected = asked.frame, OCTET * (1 + (0 if asked.expected is None else len(asked.expected)))
    points = sum(cloud.points.size for cloud in frame.clouds)
    images = 0
    for image in frame.depths:
        height, width = image.depth.shape
        images += 3 * (width + height) + (width * height + 1) // 2
    return HEADER + SENSOR * (len(frame.clouds) + len(frame.depths)) + expected + points + images


def pack(asked: Asked, rays_of: Callable[[DepthImage, Lattice], Rays], row: I32) -> None:
    """Write everything about a frame to ``row``, which is long enough: see :func:`words_of`.

    Images come before clouds, as in :func:`headvox.pose.nearby.sensors_of`.
    """
    frame, lattice = asked.frame, asked.lattice
    real, wide, half = row.view(np.float32), row.view(np.float64), row.view(np.uint16)
    row[SENSORS] = len(frame.clouds) + len(frame.depths)
    row[SEES] = OF_NONE if not asked.sees else OF_SEEN if frame.clouds else OF_ALL
    row[ODD : ODD + 3] = lattice.odd
    row[THRESHOLD : THRESHOLD + 2] = np.array([asked.least - asked.slack], np.int64).view(np.int32)
    row[LEAST : LEAST + 2] = np.array([asked.least], np.int64).view(np.int32)
    real[LIMITS : LIMITS + 6] = lattice.limits()
    row[HAIRED] = len(origins_of(frame)) > 0
    wide[ORIGIN : ORIGIN + 3] = lattice.origin
    at = HEADER
    data = _put_expected(asked.expected, HEADER + SENSOR * int(row[SENSORS]), row)

    def put(values: npt.NDArray[np.float32]) -> int:
        """Write float32 numbers behind all others; return where they begin."""
        nonlocal data
        begin, data = data, data + values.size
        real[begin:data] = values.reshape(-1)
        return begin

    for image in frame.depths:
        height, width = image.depth.shape
        rays = rays_of(image, lattice)
        row[at + COLUMN], row[at + ROW] = put(rays.column[:, :width]), put(rays.row)
        row[at + KIND : at + HEIGHT + 1] = DEPTH, 2 * data, width, height
        half[2 * data : 2 * data + image.depth.size] = image.depth.reshape(-1)
        data += (image.depth.size + 1) // 2
        row[at + KNOWS] = True
        wide[(at + PLACE) // 2 : (at + PLACE) // 2 + 12] = image.T_world_camera[:3].reshape(-1)
        wide[(at + LENS) // 2 : (at + LENS) // 2 + 5] = lens_of(image)
        real[at + TRANSFORM : at + TRANSFORM + 16] = 0.0
        real[at + TRANSFORM + 3 : at + TRANSFORM + 12 : 4] = rays.t
        real[at + TABLE : at + TABLE + 16] = camera_table(image, lattice).reshape(-1)
        at += SENSOR
    for cloud in frame.clouds:
        placed = cloud.T_world_sensor
        row[at + KIND : at + HEIGHT + 1] = CLOUD, put(cloud.points), len(cloud.points), 1
        row[at + KNOWS] = placed is not None
        wide[(at + PLACE) // 2 : (at + PLACE) // 2 + 12] = (np.eye(4) if placed is None else placed)[
            :3
        ].reshape(-1)
        real[at + TRANSFORM : at + TRANSFORM + 16] = part_transform(cloud, lattice).reshape(-1)
        at += SENSOR


def _put_expected(expected: Expected | None, begin: int, row: I32) -> int:
    """Write the expected heads to ``row``, from the first whole octet on; return where they end."""
    first, count = -(-begin // OCTET), 0 if expected is None else len(expected)
    row[EXPECTED], row[EXPECTED_AT] = count, first
    if expected is not None and count:
        octets = row[: row.size // OCTET * OCTET].view(np.float64).reshape(-1, 8)[first : first + count]
        octets[:, :3], octets[:, 3:7], octets[:, 7] = (
            expected.centres,
            expected.quaternions,
            expected.reaches_m,
        )
    return (first + count) * OCTET
