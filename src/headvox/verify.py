"""Verification: what the pose fit says of a head joins its score, and may only lower it.

The template lies badly on what is no head, or has to grow or shrink to lie on it. Where the fit is sure of the centre,
each unit of misfit and each metre that the radius is off cost a part of the score; what fits as heads do loses nothing.
"""

from __future__ import annotations

import numpy as np

from headvox.data import I64, Expected, Heads
from headvox.keep import is_expected, keep
from headvox.masks.cascade import Verification
from headvox.masks.compile import SCORE_UNIT
from headvox.pose.fit import Poses


def losses_of(poses: Poses, rule: Verification) -> I64:
    """Return by how much the scores of what was fitted fall (N,), in steps: 0 where the fit is not sure, or none."""
    sigmas = np.sqrt(np.trace(poses.centre_covariances, axis1=1, axis2=2))
    loss = rule.misfit * poses.misfits + rule.radius * np.abs(poses.radii - rule.radius_m) - rule.free
    steps = np.rint(SCORE_UNIT * np.clip(loss, 0.0, rule.most))
    return np.where(sigmas < rule.sure_m, steps, 0.0).astype(np.int64)


def verify(
    heads: Heads, poses: Poses, rule: Verification, least: int, slack: int, expected: Expected | None, voxel_m: float
) -> tuple[Heads, Poses]:  # fmt: skip
    """Return those of ``heads`` whose score is still enough, in their order, with their poses.

    Where one is expected, the fit has no say: what was seen of it before counts for more than how it lies now.
    ``poses`` are of the first of ``heads``. For the other numbers, in steps, see :func:`headvox.keep.keep`.
    """
    scores = np.rint(heads.scores * SCORE_UNIT).astype(np.int64)
    losses = losses_of(poses, rule)
    if expected is not None and len(expected):
        losses[is_expected(heads.centres[: len(losses)], expected, voxel_m)] = 0
    scores[: len(losses)] -= losses
    kept = np.flatnonzero(keep(heads.centres, scores, least, slack, expected, voxel_m))
    everyone = len(kept) == len(heads) == len(poses.radii)  # as in most frames: then nothing has to be copied
    rows = slice(None) if everyone else kept
    centres = heads.centres[rows]
    told = Heads(
        centres, heads.quaternions[rows], heads.radii[rows], scores[rows] / SCORE_UNIT, sure=scores[rows] >= least
    )  # fmt: skip
    return told, poses if everyone else poses.of(kept, centres)
