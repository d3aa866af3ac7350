"""From what was fitted to the peaks to heads: of those that overlap, the best."""

from __future__ import annotations

import numpy as np

from headvox.data import F64, I64, Heads, unknown
from headvox.masks.compile import SCORE_UNIT
from headvox.pose.fit import Poses
from headvox.refine import HAIR_M
from headvox.suppress import suppress_overlaps

SAME_HEAD_M = 0.18
MOST_POSES = 32
"""Heads of a frame that get a pose, best score first."""
RADIUS_M = 0.1  # of a head to which no sphere was fitted


def best_apart(centres: F64, scores: I64, spheres: F64 | None, haired: bool) -> tuple[I64, F64, F64]:
    """Return which of the peaks at voxels with these ``centres`` (N, 3) are heads of their own, best score first.

    Also returned are where their centres are and their radii, metres, world. ``spheres`` (N, 6) were fitted about the
    voxels (:func:`headvox.refine.fit_spheres`); ``haired`` says that they lie on hair, not on the skull.
    """
    if spheres is None:
        radii: F64 = np.full(len(centres), RADIUS_M)
    else:
        centres, radii = centres + spheres[:, :3], spheres[:, 3]
        if haired:
            centres[:, 2] -= HAIR_M
    kept = suppress_overlaps(centres, scores, SAME_HEAD_M)
    return kept, centres[kept], radii[kept]


def as_heads(centres: F64, radii: F64, scores: I64, least: int, yaws: F64 | None) -> Heads:
    """Return heads with these ``centres`` (N, 3) and ``radii`` (N,), metres, world, best score first.

    ``scores`` (N,) are in steps; heads that score ``least`` are sure. ``yaws`` (N,) are in radians, if known.
    """
    if yaws is None:
        quaternions = unknown(len(centres), 4)
    else:
        half, none = 0.5 * yaws, np.zeros(len(yaws))
        quaternions = np.stack([none, none, np.sin(half), np.cos(half)], axis=1)
    return Heads(centres, quaternions, radii, scores / SCORE_UNIT, sure=scores >= least)


def with_poses(heads: Heads, poses: Poses) -> Heads:
    """Return ``heads``, of which the first were fitted these ``poses``; the others stay as they are."""
    best, fitted = slice(0, len(poses.radii)), np.isfinite(poses.radii)
    centres, radii = heads.centres.copy(), heads.radii.copy()
    quaternions = np.full((len(heads), 4), np.nan)
    centre_covariances = np.full((len(heads), 3, 3), np.nan)
    rotation_covariances = centre_covariances.copy()
    centres[best][fitted], radii[best][fitted] = poses.centres[fitted], poses.radii[fitted]
    quaternions[best] = poses.quaternions
    centre_covariances[best] = poses.centre_covariances
    rotation_covariances[best] = poses.rotation_covariances
    kept = suppress_overlaps(centres, heads.scores, SAME_HEAD_M)  # two starts may have found one head
    return Heads(
        centres[kept],
        quaternions[kept],
        radii[kept],
        heads.scores[kept],
        centre_covariances[kept],
        rotation_covariances[kept],
        heads.sure[kept],
    )
