"""The last look at peaks, pixel by pixel: the relief about a head's centre, as the camera that sees it best has it.

Voxels are 5 cm wide, and their rings know nothing of where the camera stands. Here *spots* lie on a plane that faces
the camera, so far to the right and to the left of the centre and so far above it; of each the relief says how much
farther than the centre the surface is. Small trees over these numbers, and over where the candidate is and how large
(:data:`headvox.masks.cascade.MEASURES`), change the score a little: by no more than the cascade allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from headvox.data import F64, I16, I64, DepthImage, Expected
from headvox.keep import keep
from headvox.machine.kernels import bare_kernel, kernel, read_only
from headvox.machine.simd import LANES
from headvox.machine.threads import Threads
from headvox.masks.cascade import MEASURES, SIDES
from headvox.masks.compile import CompiledRelief
from headvox.masks.forest import sum_of_leaves
from headvox.visibility import NEAREST_M, read_pixels, world_to_pixels
from headvox.vote import order

FARTHEST = 600  # mm: farther from the centre, either way, is as far
UNKNOWN = 601  # no return, or out of view
NINE, STEP_M = 9, 0.01  # 3x3 places, as far from each other, whose median is a spot's
ON_HEAD = 200  # mm: surface that may be the head's or the neck's
LARGEST = 32_000  # mm: what a measure is at most, either way
STEEP = 1e-3  # sine of the angle between a ray and the vertical, from which on nothing is right or left


@bare_kernel
def set_places(spots, places):
    """Write the nine places about each spot to ``places`` (2, 9 W): metres to the right of the centre and above it.

    There are nine rows of W; lane 2 k of each is for spot k of ``spots`` (K, 2), the next lane for the one on the left.
    """
    lanes = places.shape[1] // NINE
    for i in range(3):
        for j in range(3):
            for lane in range(2 * spots.shape[0]):
                k, at = lane // 2, (3 * i + j) * lanes + lane
                side = -spots[k, 0] if lane & 1 else spots[k, 0]
                places[0, at], places[1, at] = side + STEP_M * (i - 1), spots[k, 1] + STEP_M * (j - 1)


@bare_kernel
def find_pixels(middle, right, up, places, width, height, pixels, far):
    """Write the number of the pixel that sees each of ``places`` (2, P), -1 if none does, and how ``far`` it is (m).

    ``middle``, ``right`` and ``up`` (3,) are what the camera makes of the centre and of a metre either way.
    """
    # By itself, so that the compiler makes vectors of it: quotients are slow.
    for p in range(np.uint64(places.shape[1])):
        s, t = places[0, p], places[1, p]
        z = middle[2] + s * right[2] + t * up[2]
        column = np.floor((middle[0] + s * right[0] + t * up[0]) / z + 0.5)
        row = np.floor((middle[1] + s * right[1] + t * up[1]) / z + 0.5)
        seen = (z > NEAREST_M) & (column >= 0.0) & (row >= 0.0) & (column < width) & (row < height)
        pixels[p] = np.int32(row * width + column) if seen else np.int32(-1)
        far[p] = z


@bare_kernel
def compare(raw, scale, far, beyond):
    """Write how much farther than a place the surface is, along the camera's axis, in mm; UNKNOWN without a return."""
    for p in range(np.uint64(raw.shape[0])):
        mm = np.floor(1000.0 * (raw[p] * scale - far[p]) + 0.5)
        beyond[p] = np.int16(min(max(mm, -FARTHEST), FARTHEST)) if raw[p] != 0 else UNKNOWN


@bare_kernel
def take_medians(beyond, medians):
    """Write the lower median of what is known in each lane of nine rows of ``beyond``; UNKNOWN of none.

    The rows are brought in order.
    """
    lanes = medians.shape[0]
    for turn in range(NINE):  # neighbours change places until no lane needs it: what is not known comes last
        for row in range(turn & 1, NINE - 1, 2):
            for lane in range(row * lanes, (row + 1) * lanes, LANES):
                order(beyond, lane, lane + lanes)
    for lane in range(lanes):
        known = 0
        for row in range(NINE):
            known += beyond[row * lanes + lane] != UNKNOWN
        medians[lane] = beyond[max(known - 1, 0) // 2 * lanes + lane]


@bare_kernel
def in_mm(metres):
    """Return ``metres`` in millimetres, as far as a measure goes."""
    return np.int16(min(max(np.floor(1000.0 * metres + 0.5), -LARGEST), LARGEST))


@kernel
def set_sizes(centres, radii, relief):
    """Write the last two measures to ``relief`` (N, 2 K + 4), mm: how high a candidate is, and the sphere's radius."""
    for i in range(centres.shape[0]):
        relief[i, -2], relief[i, -1] = in_mm(centres[i, 2]), in_mm(radii[i])


@kernel
def look_closely(depth, scale, camera, origin, centres, begin, step, spots, best, relief):
    """Write what one camera measured about ``centres`` (N, 3), world, to ``relief`` (N, 2 K + 4), mm.

    That is every ``step``-th of them from ``begin`` on. Of the measures it writes the first two. It does so where the
    camera sees more of a head than any before it: ``best`` (N,) says how much that was. ``camera`` is (3, 4): rows
    that give u·Z, v·Z and Z of a world point; ``origin`` (3,) is where it stands.
    """
    count = spots.shape[0]
    lanes = -(-2 * count // LANES) * LANES
    places, far, pixels = (
        np.zeros((2, NINE * lanes)),
        np.empty(NINE * lanes),
        np.empty(NINE * lanes, np.int32),
    )
    raw, beyond = np.empty(NINE * lanes, np.uint16), np.empty(NINE * lanes, np.int16)
    medians = np.empty(lanes, np.int16)
    middle, right, up = np.empty(3), np.empty(3), np.empty(3)
    set_places(spots, places)
    for i in range(begin, centres.shape[0], step):
        x, y, z = centres[i, 0], centres[i, 1], centres[i, 2]
        dx, dy, dz = x - origin[0], y - origin[1], z - origin[2]
        flat = np.sqrt(dx * dx + dy * dy)
        away = np.sqrt(flat * flat + dz * dz)
        if away < NEAREST_M or not 2 * count / away > best[i]:
            continue  # or another camera sees more of it than this one can
        rx, ry = 1.0, 0.0
        if flat > STEEP * away:
            rx, ry = dy / flat, -dx / flat
        ux, uy, uz = ry * dz / away, -rx * dz / away, (rx * dy - ry * dx) / away  # right x ray
        for k in range(3):
            middle[k] = camera[k, 0] * x + camera[k, 1] * y + camera[k, 2] * z + camera[k, 3]
            right[k] = camera[k, 0] * rx + camera[k, 1] * ry
            up[k] = camera[k, 0] * ux + camera[k, 1] * uy + camera[k, 2] * uz
        find_pixels(middle, right, up, places, depth.shape[1], depth.shape[0], pixels, far)
        read_pixels(depth.reshape(-1), pixels, raw)
        compare(raw, scale, far, beyond)
        take_medians(beyond, medians)
        on = 0
        for lane in range(2 * count):
            on += abs(medians[lane]) <= ON_HEAD
        if not on / away > best[i]:
            continue
        best[i] = on / away
        for k in range(count):
            one, other = medians[2 * k], medians[2 * k + 1]
            one, other = other if one == UNKNOWN else one, one if other == UNKNOWN else other
            # What is not known on either side is neither free space nor in front.
            one, other = one if one != UNKNOWN else 0, other if other != UNKNOWN else 0
            relief[i, 2 * k], relief[i, 2 * k + 1] = min(one, other), max(one, other)
        relief[i, 2 * count], relief[i, 2 * count + 1] = in_mm(away), in_mm(dz / away)


@kernel
def add_trees(relief, best, begin, step, forest, first, reach, most, lacking, gains):
    """Write what the trees of ``forest`` say of rows of ``relief`` (N, 2 K + 4) to ``gains`` (N,), within ``most``.

    Where the ``first`` trees leave more than ``reach`` of what is ``lacking`` (N,) to be a head, no others are asked.
    Of what no camera saw (``best`` (N,) is 0) they say nothing.
    """
    nodes, leaves, roots, deepest = forest
    at, measured = np.empty_like(roots), np.empty(relief.shape[1], np.int64)
    for i in range(begin, relief.shape[0], step):
        gains[i] = 0
        if not best[i] > 0.0:
            continue
        for k in range(relief.shape[1]):
            measured[k] = relief[i, k]  # so that the compiler makes vectors of looking it up
        total = sum_of_leaves(measured, nodes, leaves, roots[:first], deepest, at[:first])
        if min(max(total, -most), most) + reach >= lacking[i]:
            total += sum_of_leaves(measured, nodes, leaves, roots[first:], deepest, at[first:])
        gains[i] = min(max(total, -most), most)


def relief_about(images: Sequence[DepthImage], centres: F64, radii: F64, spots: F64) -> tuple[I16, F64]:
    """Return the relief (N, 2 K + 4), mm, of candidates, and how well a camera saw each (N,); 0: none did.

    ``centres`` (N, 3), world, and ``radii`` (N,) are theirs, ``spots`` (K, 2) the places to look at, all metres.
    """
    centres, relief, best = _not_seen(centres, radii, spots)
    for camera in _cameras_of(images):
        look_closely(*camera, centres, 0, 1, spots, best, relief)
    return relief, best


def gains_of(
    images: Sequence[DepthImage], centres: F64, radii: F64, lacking: I64, relief: CompiledRelief, threads: Threads
) -> I64:  # fmt: skip
    """Return by how much the scores of candidates change, in steps: 0 where no camera sees them.

    ``centres`` (N, 3), world, and ``radii`` (N,) are in metres; ``lacking`` (N,) is how much each scores too little to
    be a head, in steps. Of one that still lacks too much after the first trees, what these say is all.
    """
    cameras, gains = _cameras_of(images), np.empty(len(centres), np.int64)
    centres, measured, best = _not_seen(centres, radii, relief.spots)

    def ask(begin: int, step: int) -> None:
        for camera in cameras:
            look_closely(*camera, centres, begin, step, relief.spots, best, measured)
        limits = (relief.first, relief.reach, relief.most)
        add_trees(measured, best, begin, step, relief.forest, *limits, lacking, gains)

    # Dealt out like cards: those that score best come first, and are asked most.
    parts = min(threads.count, len(centres))
    threads.run(ask, [(part, parts) for part in range(parts)])
    return gains


def _not_seen(centres: F64, radii: F64, spots: F64) -> tuple[F64, I16, F64]:
    """Return ``centres`` as the loops read them, and what is known of candidates before a camera is asked."""
    centres = np.ascontiguousarray(centres)
    relief = np.zeros((len(centres), len(SIDES) * len(spots) + len(MEASURES)), np.int16)
    set_sizes(centres, np.ascontiguousarray(radii), relief)
    return centres, relief, np.zeros(len(centres))


def _cameras_of(images: Sequence[DepthImage]) -> list[tuple[Any, ...]]:
    """Return what :func:`look_closely` has to know of each camera."""
    return [
        (read_only(image.depth), image.intrinsics.depth_scale, *world_to_pixels(image)) for image in images
    ]


def look_again(
    centres: F64, radii: F64, scores: I64, images: Sequence[DepthImage], relief: CompiledRelief, least: int,
    slack: int, expected: Expected | None, voxel_m: float, threads: Threads,
) -> tuple[I64, I64]:  # fmt: skip
    """Return which peaks are heads after the last look, best first, and what they score then.

    ``centres`` (N, 3), world, and ``radii`` (N,) are of the spheres that fit them, in metres. For the numbers in steps
    see :func:`headvox.keep.keep`.
    """
    scores = scores + gains_of(images, centres, radii, least - slack - scores, relief, threads)
    kept = np.flatnonzero(keep(centres, scores, least, slack, expected, voxel_m))
    kept = kept[np.argsort(-scores[kept], kind="stable")]
    return kept, scores[kept]
