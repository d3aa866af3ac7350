"""The last look at peaks, pixel by pixel: the relief about a head's centre, as the camera that sees it best has it.

Voxels are 5 cm wide, and their rings know nothing of where the camera stands. Here *spots* lie on a plane that faces
the camera, so far to the right and to the left of the centre and so far above it; of each the relief says how much
farther than the centre the surface is. Small trees over these numbers change the score a little: by no more than the
cascade allows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from headvox.data import F64, DepthImage, Expected, Heads
from headvox.keep import keep
from headvox.machine.kernels import kernel, read_only, rule
from headvox.masks.compile import SCORE_UNIT, CompiledRelief
from headvox.visibility import NEAREST_M, world_to_pixels

I16 = npt.NDArray[np.int16]
I64 = npt.NDArray[np.int64]

FARTHEST = 600  # mm: farther from the centre, either way, is as far
UNKNOWN = 601  # no return, or out of view
STEP_M = 0.01  # of the 3x3 places whose median is a spot's
ON_HEAD = 200  # mm: surface that may be the head's or the neck's
STEEP = 1e-3  # sine of the angle between a ray and the vertical, from which on nothing is right or left


@rule
def median(values, count):  # type: ignore[no-untyped-def]
    """Return the lower median of the first ``count`` of ``values``, which it sorts; UNKNOWN of none."""
    for i in range(1, count):
        value, k = values[i], i
        while k > 0 and values[k - 1] > value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value
    return values[(count - 1) // 2] if count > 0 else UNKNOWN


@rule
def relief_at(depth, scale, u, v, far):  # type: ignore[no-untyped-def]
    """Return how much farther than a place the surface is, along the camera's axis, in mm.

    The place is at column ``u`` / ``far`` and row ``v`` / ``far``, ``far`` metres away.
    """
    if not far > NEAREST_M:
        return UNKNOWN
    column, row = int(np.floor(u / far + 0.5)), int(np.floor(v / far + 0.5))
    if column < 0 or row < 0 or column >= depth.shape[1] or row >= depth.shape[0] or depth[row, column] == 0:
        return UNKNOWN
    beyond = np.floor(1000.0 * (depth[row, column] * scale - far) + 0.5)
    return int(min(max(beyond, -FARTHEST), FARTHEST))


@rule
def spot_at(depth, scale, middle, right, up, a, b, around):  # type: ignore[no-untyped-def]
    """Return the median of the 3x3 places about the spot ``a`` metres to the ``right`` and ``b`` metres ``up``.

    ``middle``, ``right`` and ``up`` (3,) are what the camera makes of the centre and of a metre either way.
    """
    there = 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            s, t = a + STEP_M * i, b + STEP_M * j
            value = relief_at(
                depth,
                scale,
                middle[0] + s * right[0] + t * up[0],
                middle[1] + s * right[1] + t * up[1],
                middle[2] + s * right[2] + t * up[2],
            )
            if value != UNKNOWN:
                around[there] = value
                there += 1
    return median(around, there)


@kernel
def look_closely(depth, scale, camera, origin, centres, spots, best, relief):  # type: ignore[no-untyped-def]
    """Write what one camera measured about each of ``centres`` (N, 3), world, to ``relief`` (N, 2 K), mm.

    It does so where the camera sees more of a head than any before it: ``best`` (N,) says how much that was. ``camera``
    is (3, 4): rows that give u·Z, v·Z and Z of a world point; ``origin`` (3,) is where it stands.
    """
    count = spots.shape[0]
    around, mine = np.empty(9, np.int64), np.empty(2 * count, np.int64)
    middle, right, up = np.empty(3), np.empty(3), np.empty(3)
    for i in range(centres.shape[0]):
        x, y, z = centres[i, 0], centres[i, 1], centres[i, 2]
        dx, dy, dz = x - origin[0], y - origin[1], z - origin[2]
        flat = np.sqrt(dx * dx + dy * dy)
        away = np.sqrt(flat * flat + dz * dz)
        if away < NEAREST_M:
            continue
        rx, ry = 1.0, 0.0
        if flat > STEEP * away:
            rx, ry = dy / flat, -dx / flat
        ux, uy, uz = ry * dz / away, -rx * dz / away, (rx * dy - ry * dx) / away  # right x ray
        for k in range(3):
            middle[k] = camera[k, 0] * x + camera[k, 1] * y + camera[k, 2] * z + camera[k, 3]
            right[k] = camera[k, 0] * rx + camera[k, 1] * ry
            up[k] = camera[k, 0] * ux + camera[k, 1] * uy + camera[k, 2] * uz
        on = 0
        for k in range(count):
            if not (on + 2 * (count - k)) / away > best[i]:
                break  # another camera sees more of it than this one can
            one = spot_at(depth, scale, middle, right, up, spots[k, 0], spots[k, 1], around)
            other = spot_at(depth, scale, middle, right, up, -spots[k, 0], spots[k, 1], around)
            on += (abs(one) <= ON_HEAD) + (abs(other) <= ON_HEAD)
            one, other = other if one == UNKNOWN else one, one if other == UNKNOWN else other
            # What is not known on either side is neither free space nor in front.
            one, other = one if one != UNKNOWN else 0, other if other != UNKNOWN else 0
            mine[2 * k], mine[2 * k + 1] = min(one, other), max(one, other)
        if on / away > best[i]:
            best[i] = on / away
            for k in range(2 * count):
                relief[i, k] = mine[k]


@kernel
def add_trees(relief, best, nodes, roots, depths, most, gains):  # type: ignore[no-untyped-def]
    """Write what the trees say of each row of ``relief`` (N, 2 K) to ``gains`` (N,), at most ``most`` either way.

    Of what no camera saw (``best`` (N,) is 0) they say nothing.
    """
    for i in range(relief.shape[0]):
        total = np.int64(0)
        if best[i] > 0.0:
            for t in range(roots.shape[0]):
                at = roots[t]
                for _ in range(depths[t]):
                    at = nodes[at + 2 + (relief[i, nodes[at]] > nodes[at + 1])]
                total += nodes[at + 1]
        gains[i] = min(max(total, -most), most)


def relief_about(images: Sequence[DepthImage], centres: F64, spots: F64) -> tuple[I16, F64]:
    """Return the relief (N, 2 K) about ``centres`` (N, 3), mm, and how well a camera saw each (N,); 0: none did."""
    best, relief = np.zeros(len(centres)), np.zeros((len(centres), 2 * len(spots)), np.int16)
    for image in images:
        camera, origin = world_to_pixels(image)
        scale = image.intrinsics.depth_scale
        look_closely(read_only(image.depth), scale, camera, origin, centres, spots, best, relief)
    return relief, best


def gains_of(images: Sequence[DepthImage], centres: F64, relief: CompiledRelief) -> I64:
    """Return by how much the scores of what is at ``centres`` (N, 3), world, change, in steps: 0 where none sees it."""
    seen, best = relief_about(images, np.ascontiguousarray(centres), relief.spots)
    gains = np.zeros(len(centres), np.int64)
    add_trees(seen, best, relief.nodes, relief.root, relief.depth, relief.most, gains)
    return gains


def look_again(
    heads: Heads, images: Sequence[DepthImage], relief: CompiledRelief, least: int, slack: int,
    expected: Expected | None, voxel_m: float,
) -> tuple[Heads, I64]:  # fmt: skip
    """Return those of ``heads``, best first, whose score is enough after the last look, and which of them they are.

    ``heads`` have no pose yet. For the other numbers, in steps, see :func:`headvox.keep.keep`.
    """
    gains = gains_of(images, heads.centres, relief)
    scores = np.rint(heads.scores * SCORE_UNIT).astype(np.int64) + gains
    kept = np.flatnonzero(keep(heads.centres, scores, least, slack, expected, voxel_m))
    kept = kept[np.argsort(-scores[kept], kind="stable")]
    told = Heads(
        heads.centres[kept], heads.quaternions[kept], heads.radii[kept], scores[kept] / SCORE_UNIT,
        sure=scores[kept] >= least,
    )  # fmt: skip
    return told, kept
