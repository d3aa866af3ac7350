"""What the pose fit may take from a score: fitted to the heads that the detector tells in spoilt views, and the others.

Three numbers by logistic regression, beside a score that stays as it is: what misfit and radius say is much the same
for every sensor and range, and trees over more of what the fit tells found no more on views kept aside. They are fitted
on views of their own: where the last look has learnt, its scores know the answer, and the fit seems to add little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from headvox.assemble import MOST_POSES
from headvox.data import F64
from headvox.evolve import samples
from headvox.evolve.again import label_places
from headvox.evolve.check import heads_in
from headvox.evolve.spoil import spoil
from headvox.evolve.views import View
from headvox.machine.threads import Threads
from headvox.masks.cascade import Verification
from headvox.pose.fit import FitMemory, fit_poses

LEAST_SCORE = -3.5  # of the heads to which poses are fitted
# Heads that the border cuts, or of which a camera sees little, fit badly, too; then the fit states more than this.
SURE_M = 0.03
MOST = 2.0  # how far the score may fall


@dataclass(frozen=True)
class Fits:
    """Fits that are sure of the centre, one a row: whether it is a head, its score, and what the fit tells."""

    label: npt.NDArray[np.int8]
    score: F64
    misfit: F64
    radius: F64

    @classmethod
    def join(cls, parts: Sequence[Fits]) -> Fits:
        """Put those of several views one after the other."""
        return cls(*(np.concatenate([getattr(part, entry.name) for part in parts]) for entry in fields(cls)))


def spoilt_fits(view: View, cascade: Path) -> Fits | None:
    """Return what is fitted in ``view``, spoilt, or None: there is nothing, no camera, or it is for others."""
    if not samples.is_for_verification(np.array([view.number]))[0]:
        return None
    if not view.frame.depths or view.frame.clouds:
        return None
    return fits_in(spoil(view, np.random.default_rng([view.number, 11])), cascade)


def fits_in(view: View, cascade: Path) -> Fits | None:
    """Return what is fitted to what is certainly a head or none."""
    heads = heads_in(view, cascade, LEAST_SCORE)
    if heads is None:
        return None
    centres = heads.centres[:MOST_POSES]
    poses = fit_poses(view.frame, centres, FitMemory.new(1, MOST_POSES), Threads(1))
    label, _ = label_places(view, centres)
    sigmas = np.sqrt(np.trace(poses.centre_covariances, axis1=1, axis2=2))
    rows = np.flatnonzero((label >= 0) & (sigmas < SURE_M))
    return (
        Fits(label[rows], heads.scores[rows], poses.misfits[rows], poses.radii[rows]) if len(rows) else None
    )


def fit_verification(fits: Fits) -> Verification | None:
    """Return what misfit and radius cost, or None: there is nothing to tell apart, or heads fit no better."""
    heads = fits.label == 1
    if heads.all() or not heads.any():
        return None
    radius_m = round(float(np.median(fits.radius[heads])), 3)
    told = np.column_stack([np.ones(len(heads)), fits.misfit, np.abs(fits.radius - radius_m)])
    scale = told.std(axis=0)
    scale[0] = 1.0
    told, sign = told / np.maximum(scale, 1e-9), np.where(heads, 1.0, -1.0)

    def loss(weights: F64) -> tuple[float, F64]:
        wrong = -sign * (fits.score + told @ weights)
        return float(np.logaddexp(0.0, wrong).sum()), -told.T @ (sign / (1.0 + np.exp(-wrong)))

    free, misfit, radius = minimize(loss, np.zeros(3), jac=True, method="L-BFGS-B").x / np.maximum(
        scale, 1e-9
    )
    if not (misfit < 0.0 and radius < 0.0 and free > 0.0):
        return None
    return Verification(
        MOST, SURE_M, round(float(free), 2), round(-float(misfit), 2), round(-float(radius)), radius_m
    )
