"""What the sensors saw to be empty, and what is hidden from them: the two channels beside "occupied".

A voxel is *known-empty* when a camera measured a surface well behind it, and *hidden* when every camera that looks that
way measured one well in front of it. A pixel without a return tells nothing: unknown is never taken for free. The
channels are looked up in the depth images cell by cell, and only about the few candidates that are left, so they
need no volume of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from headvox.data import F32, F64, I32, DepthImage, Intrinsics
from headvox.frames import inverse
from headvox.lattice import Lattice
from headvox.machine.kernels import bare_kernel, kernel, product, read_only, rule

HIDDEN, EMPTY = 1, 2
LEAST_EMPTY = 16  # a camera that sees a place saw one in so many of the cells about it to be empty
NEAREST_M = 0.1  # a cell closer to the camera than this projects to nowhere useful

# What may be seen of the place where a head should be; of several cameras the highest counts.
OUT_OF_VIEW, NO_RETURN, BEHIND, SURFACE, SEEN_EMPTY = range(5)
HEAD_M = 0.07  # how far from its centre a head is sampled: well inside of its outline
IN_FRONT_M = 0.25  # the head's own face is some 10 cm nearer than its centre
BEYOND_M = 0.15


@rule
def project(camera, row, x, y, z):
    """Return what ``row`` of a camera's table gives for a place."""
    first = product(camera[row, 0], x) + product(camera[row, 1], y)
    return first + product(camera[row, 2], z) + camera[row, 3]


@rule
def floored(value):
    """Return the whole number at or below ``value``."""
    return int(np.floor(value))  # math.floor goes by way of float64


@rule
def pixel_of(camera, x, y, z):
    """Return column and row that see the centre of the cell x, y, z, and how far away it is (m): -1 if too near.

    ``camera`` is (4, 4) float32: rows that give u·Z, v·Z and Z (m) of a cell, and a row with the depth scale, the
    constant and the quadratic part of the margin. The margin is 3 cm + 0.4 cm per m², twice a sensor's noise.
    """
    far = project(camera, 2, x, y, z)
    if not far > np.float32(NEAREST_M):
        return -1, -1, far
    half = np.float32(0.5)
    column = floored(project(camera, 0, x, y, z) / far + half)
    row = floored(project(camera, 1, x, y, z) / far + half)
    return column, row, far


@rule
def state_at(raw, camera, far):
    """Return EMPTY, HIDDEN or 0 for a cell so ``far`` away whose pixel measured ``raw``."""
    measured = np.float32(raw) * camera[3, 0]
    margin = camera[3, 1] + product(camera[3, 2] * far, far)
    # Numbers, not branches: what a pixel measured is nothing that a processor could guess.
    is_empty, is_hidden = measured > far + margin, measured < far - margin
    return (EMPTY * is_empty + HIDDEN * is_hidden) * (raw != 0)


@kernel
def look_about(depth, camera, cells, offsets, states):
    """Merge what one camera saw of the cells about each candidate into ``states`` (candidates, M).

    ``offsets`` (3, M) lead from a candidate to its cells.
    """
    count = offsets.shape[1]
    pixels, far, raw = np.empty(count, np.int32), np.empty(count, np.float32), np.empty(count, np.uint16)
    for i in range(cells.shape[0]):
        _find_pixels(camera, depth.shape[1], depth.shape[0], cells[i], offsets, pixels, far)
        read_pixels(depth.reshape(-1), pixels, raw)
        _merge(raw, camera, far, states[i])


@bare_kernel
def _find_pixels(camera, width, height, cell, offsets, pixels, far):
    """Write the number of the pixel that sees each of the cells about ``cell``, -1 if none, and how far it is (m)."""
    # By itself, as the other steps, so that the compiler makes vectors of it.
    for k in range(np.uint64(offsets.shape[1])):
        x, y, z = cell[0] + offsets[0, k], cell[1] + offsets[1, k], cell[2] + offsets[2, k]
        column, row, far[k] = pixel_of(camera, np.float32(x), np.float32(y), np.float32(z))
        seen = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        pixels[k] = np.int32(row * width + column) if seen else np.int32(-1)


@bare_kernel
def read_pixels(flat, pixels, raw):
    """Write what ``pixels`` of a flat image measured to ``raw``; 0 for a negative number, which is no pixel."""
    for k in range(np.uint64(pixels.shape[0])):
        raw[k] = flat[np.uint64(pixels[k])] if pixels[k] >= 0 else np.uint16(0)


@bare_kernel
def _merge(raw, camera, far, states):
    for k in range(np.uint64(raw.shape[0])):
        states[k] = max(states[k], np.uint8(state_at(raw[k], camera, far[k])))


@kernel
def count_states(states, start, seen):
    """Count the EMPTY and the HIDDEN cells of each box: ``seen`` (candidates, boxes, 2)."""
    for i in range(states.shape[0]):
        for b in range(seen.shape[1]):
            empty = 0
            hidden = 0
            for k in range(start[b], start[b + 1]):
                empty += states[i, k] == EMPTY
                hidden += states[i, k] == HIDDEN
            seen[i, b, 0] = empty
            seen[i, b, 1] = hidden


def not_seen(states: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
    """Return which candidates no camera sees (N,): hardly a cell about them was seen to be empty.

    ``states`` (N, M) are those of :func:`look_about`. Only a cloud can have put something there.
    """
    unseen: npt.NDArray[np.bool_] = LEAST_EMPTY * np.count_nonzero(states == EMPTY, axis=1) < states.shape[1]
    return unseen


@kernel
def look_at_places(depth, camera, fx, fy, scale, places, sight_m, states):
    """Raise ``states`` (N,) to what one camera saw of each of ``places`` (N, 3), a head's size about each.

    ``camera`` is (3, 4) float64: rows that give u·Z, v·Z and Z of a world point. Nine pixels of a grid about the place
    are asked. It is SEEN_EMPTY when at least five of them measured well beyond it and fewer than two something about
    it; BEHIND when most that measured anything measured well in front of it; NO_RETURN when fewer than five did.
    """
    for n in range(places.shape[0]):
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        far = camera[2, 0] * x + camera[2, 1] * y + camera[2, 2] * z + camera[2, 3]
        if not NEAREST_M < far <= sight_m:
            continue
        u = (camera[0, 0] * x + camera[0, 1] * y + camera[0, 2] * z + camera[0, 3]) / far
        v = (camera[1, 0] * x + camera[1, 1] * y + camera[1, 2] * z + camera[1, 3]) / far
        inside = front = beyond = about = 0
        for i in range(-1, 2):
            for j in range(-1, 2):
                column = int(np.floor(u + i * HEAD_M * fx / far + 0.5))
                row = int(np.floor(v + j * HEAD_M * fy / far + 0.5))
                if column < 0 or row < 0 or column >= depth.shape[1] or row >= depth.shape[0]:
                    continue
                inside += 1
                measured = depth[row, column] * scale
                if measured == 0.0:
                    continue
                if measured > far + BEYOND_M:
                    beyond += 1
                elif measured >= far - IN_FRONT_M:
                    about += 1
                else:
                    front += 1
        if inside < 5:
            state = OUT_OF_VIEW
        elif beyond >= 5 and about < 2:
            state = SEEN_EMPTY
        elif front + beyond + about < 5:
            state = NO_RETURN
        elif 2 * front > front + beyond + about:
            state = BEHIND
        else:
            state = SURFACE
        states[n] = max(states[n], state)


def see_places(images: Sequence[DepthImage], places: F64, sight_m: float) -> npt.NDArray[np.int64]:
    """Return what the cameras saw of each of ``places`` (N, 3), in world coordinates: OUT_OF_VIEW to SEEN_EMPTY.

    A camera sees ``sight_m`` far along its axis. A place that any camera saw to be empty is empty; one that is hidden
    from all that look that way is BEHIND.
    """
    places, states = np.ascontiguousarray(places), np.full(len(places), OUT_OF_VIEW, np.int64)
    for image in images:
        lens, (camera, _) = image.intrinsics, world_to_pixels(image)
        depth = read_only(image.depth)
        look_at_places(depth, camera, lens.fx, lens.fy, lens.depth_scale, places, sight_m, states)
    return states


def projection(camera: Intrinsics) -> F64:
    """Return the (3, 3) matrix that maps a point of the camera's frame to u·Z, v·Z and Z."""
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


def world_to_pixels(image: DepthImage) -> tuple[F64, F64]:
    """Return the (3, 4) rows that give u·Z, v·Z and Z of a world point, and where the camera stands (3,): read only."""
    return _world_to_pixels(image.intrinsics, np.asarray(image.T_world_camera, np.float64).tobytes())


@lru_cache(maxsize=64)  # cameras mostly stand still
def _world_to_pixels(lens: Intrinsics, place: bytes) -> tuple[F64, F64]:
    T = np.frombuffer(place).reshape(4, 4)
    camera, origin = projection(lens) @ inverse(T)[:3], T[:3, 3].copy()
    camera.flags.writeable = origin.flags.writeable = False
    return camera, origin


def camera_table(image: DepthImage, lattice: Lattice) -> F32:
    """Return ``image``'s camera as :func:`look_about` reads it."""
    K = projection(image.intrinsics)
    T = inverse(image.T_world_camera)
    first = np.array(lattice.origin) + 0.5 * lattice.voxel_m  # the centre of cell 0, 0, 0
    table = np.zeros((4, 4))
    table[:3, :3] = K @ T[:3, :3] * lattice.voxel_m
    table[:3, 3] = K @ (T[:3, :3] @ first + T[:3, 3])
    table[3, :3] = image.intrinsics.depth_scale, 0.03, 0.004
    return table.astype(np.float32)


def cells_of(boxes: I32) -> tuple[I32, I32]:
    """Return the cells (M, 3) of ``boxes`` (B, 6), one box after the other, and where each box begins (B + 1,)."""
    cells: list[tuple[int, int, int]] = []
    start = [0]
    for x0, x1, y0, y1, z0, z1 in boxes.tolist():
        cells += [(x, y, z) for x in range(x0, x1) for y in range(y0, y1) for z in range(z0, z1)]
        start.append(len(cells))
    return np.array(cells, np.int32).reshape(-1, 3), np.array(start, np.int32)


def as_columns(offsets: I32) -> I32:
    """Return ``offsets`` (M, 3) as :func:`look_about` reads them: (3, M)."""
    return np.ascontiguousarray(offsets.T)


def count_seen(images: tuple[DepthImage, ...], lattice: Lattice, cells: I32, boxes: I32) -> I32:
    """Return how many cells of each box about each candidate are known-empty and hidden.

    ``cells`` (N, 3) are the candidates, in cells of ``lattice``; ``boxes`` (B, 6) half-open offsets. The result is
    (N, B, 2) int32. A cell is known-empty when any camera saw it empty, else hidden when any camera has it hidden.
    """
    offsets, start = cells_of(boxes)
    states = np.zeros((len(cells), len(offsets)), np.uint8)
    for image in images:
        look_about(read_only(image.depth), camera_table(image, lattice), cells, as_columns(offsets), states)
    seen = np.empty((len(cells), len(boxes), 2), np.int32)
    count_states(states, start, seen)
    return seen
