"""What the detector really does with a cascade, on the views that nothing was fitted to."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from headvox.config import DetectorConfig
from headvox.data import F64, Cloud, Frame, Heads
from headvox.errors import HeadvoxError
from headvox.evaluate.match import Rules, match
from headvox.evolve.samples import RANGE_M, to_find
from headvox.evolve.views import View
from headvox.frames import unproject
from headvox.pipeline import Detector

LEAST_SCORE = -8.0
MISSED = -np.inf


@dataclass(frozen=True)
class Outcome:
    """Scores: ``heads`` (N,) of every head to find, -inf if it was missed; ``false`` (M,) of false heads."""

    heads: F64
    false: F64
    frames: int

    def threshold(self, false_a_frame: float) -> float:
        """Return the lowest score that leaves at most so many false heads a frame, rounded up to a hundredth."""
        allowed = int(false_a_frame * self.frames)
        worst = np.sort(self.false)[::-1]
        least = worst[allowed] if len(worst) > allowed else LEAST_SCORE
        return float(np.floor(least * 100.0 + 1.0) / 100.0)

    def recall(self, least: float) -> float:
        """Return the share of the heads that score at least so much."""
        return float((self.heads >= least).mean()) if len(self.heads) else 0.0


def check(cascade: Path, views: Iterable[View], as_clouds: bool = False) -> Outcome:
    """Run a detector with the ``cascade`` over ``views``; see :func:`look_at`."""
    return look_at(views, detector_for(str(cascade)), as_clouds)


def detector_for(cascade: str, voxel_m: float | None = None) -> Detector:
    """Return a detector that tells all heads, however little they score."""
    config = DetectorConfig(
        cascade=cascade, max_range_m=RANGE_M, min_score=LEAST_SCORE, refine="sphere", voxel_m=voxel_m
    )
    return Detector(config)


def heads_in(view: View, cascade: Path, least: float) -> Heads | None:
    """Return the heads of ``view`` that score ``least``, with spheres fitted, or None: nothing is in range."""
    try:
        return _detector(cascade, cascade.stat().st_mtime_ns, least).detect_frame(view.frame)
    except HeadvoxError:
        return None


@lru_cache(maxsize=1)
def _detector(cascade: Path, written_ns: int, least: float) -> Detector:
    settings = DetectorConfig(cascade=str(cascade), max_range_m=RANGE_M, min_score=least, refine="sphere")
    return Detector(settings, backend="cpu")


def look_at(views: Iterable[View], detector: Detector, as_clouds: bool = False) -> Outcome:
    """Run ``detector`` over ``views``; ``as_clouds`` makes points of the depth images, so nothing is known empty."""
    heads: list[F64] = []
    false: list[F64] = []
    frames = 0
    for view in views:
        scores = scores_in(view, detector, points_of(view.frame) if as_clouds else None)
        if scores is None:
            continue
        frames += 1
        heads.append(scores[0])
        false.append(scores[1])
    return Outcome(np.concatenate([*heads, np.empty(0)]), np.concatenate([*false, np.empty(0)]), frames)


def scores_in(view: View, detector: Detector, frame: Frame | None = None) -> tuple[F64, F64] | None:
    """Return the scores of the heads to find in ``view``, -inf of a missed one, and of false heads.

    ``frame`` is looked at in place of the view's own. The scores are (N,), in the order of the heads, and (M,); None:
    nothing is in range.
    """
    try:
        found = detector.detect_frame(frame or view.frame)
    except HeadvoxError:
        return None
    counted = to_find(view)
    pairing = match(found.centres, view.heads.centres, counted, Rules(clear_m=0.25))
    scores = np.full(int(counted.sum()), MISSED)
    real = np.flatnonzero(counted)
    scores[np.searchsorted(real, pairing.pairs[:, 1])] = found.scores[pairing.pairs[:, 0]]
    return scores, found.scores[pairing.false]


def points_of(frame: Frame, in_world: bool = True) -> Frame:
    """Return ``frame`` with points in place of its depth images, in the world's frame or in their cameras'."""
    clouds = []
    for image in frame.depths:
        T = image.T_world_camera if in_world else np.eye(4)
        points = unproject(image.depth, image.intrinsics, T).astype(np.float32)
        clouds.append(Cloud(image.name, points, None if in_world else image.T_world_camera))
    return replace(frame, depths=(), clouds=(*frame.clouds, *clouds))
