"""The judge's last stage: a second opinion on the very peaks that the detector leaves.

The stages before it learn from chosen voxels of clean views. This one learns from peaks, in views that are turned,
moved against the grid and spoilt (:mod:`headvox.evolve.spoil`), and heads that the image's border cuts count as heads.
It is of single cuts alone, over the groups that the cascade has: it can only weigh again what was asked before, which
costs no look-up, and holds on other sensors, too; deeper trees did better on synthetic views and worse on real ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.config import DetectorConfig
from headvox.data import F64, I32, I64, Expected, Frame
from headvox.errors import HeadvoxError
from headvox.evolve import boost, samples
from headvox.evolve.samples import Grid, Samples, join, to_find
from headvox.evolve.spoil import spoil
from headvox.evolve.views import LEAST_VISIBLE, View
from headvox.keep import Judged
from headvox.masks.compile import SCORE_UNIT
from headvox.memory import Memory
from headvox.pipeline import Detector
from headvox.synth.scene import POSTURES

TURNS = 2  # how often each view is taken
LEAST_SCORE = -6.0
NEAR_M, APART_M = 0.15, 0.25
PLAN = boost.Plan("again", "seen", 0, 60, 0.10, 0.0)
LEAVES, LEAST_ROWS, SHARE_OF_FEATURES = 2, 100, 0.3


@dataclass(frozen=True)
class Peaks:
    """Peaks of a detector, one a row: what can be asked about them, and ``score`` (N,), what it said of them."""

    samples: Samples
    score: F64

    @classmethod
    def join(cls, parts: Sequence[Peaks]) -> Peaks:
        """Put those of several views one after the other."""
        return cls(join(part.samples for part in parts), np.concatenate([part.score for part in parts]))


class Watched(Detector):
    """A detector that tells of the last frame's peaks, all of them: cells of the lattice, and scores."""

    told: tuple[I32, F64]

    def _judge(
        self, frame: Frame, S: npt.NDArray[Any], survivors: I32, scores: I64, peaks: I64, memory: Memory,
        expected: Expected | None,
    ) -> Judged:  # fmt: skip
        judged = super()._judge(frame, S, survivors, scores, peaks, memory, expected)
        self.told = judged.cells + memory.first.astype(np.int32), judged.scores / SCORE_UNIT
        return judged


@lru_cache(maxsize=1)
def _watched(cascade: Path, written_ns: int) -> Watched:
    settings = DetectorConfig(
        cascade=str(cascade), max_range_m=samples.RANGE_M, min_score=LEAST_SCORE, refine="none"
    )
    return Watched(settings, backend="cpu")


def spoilt_peaks(view: View, cascade: Path) -> Peaks | None:
    """Return the peaks of ``view``, spoilt :data:`TURNS` times, or None: there are none, or there is no camera."""
    if not view.frame.depths or view.frame.clouds:
        return None
    parts = [peaks_of(spoil(view, np.random.default_rng([view.number, 4, k])), cascade) for k in range(TURNS)]
    some = [part for part in parts if part is not None]
    return Peaks.join(some) if some else None


def peaks_of(view: View, cascade: Path) -> Peaks | None:
    """Return the peaks that are certainly a head or none; several may be of one head."""
    detector = _watched(cascade, cascade.stat().st_mtime_ns)
    try:
        detector.detect_frame(view.frame)
    except HeadvoxError:  # nothing in range
        return None
    grid = Grid.of(view.frame)
    cells, scores = detector.told
    label, bag = label_places(view, grid.lattice.centres(cells))
    known = label >= 0
    if not known.any():
        return None
    cells, count = cells[known], int(known.sum())
    asked = Samples(
        grid.occupied(cells), grid.seen(cells), label[known], bag[known], np.full(count, view.number),
        np.ones(count, bool),
    )  # fmt: skip
    return Peaks(asked, scores[known])


def label_places(view: View, centres: F64) -> tuple[npt.NDArray[np.int8], I64]:
    """Return 1 (a head), 0 (none) or -1 (neither) for each place, and which head it is near."""
    heads = view.heads
    cut = (heads.visible >= LEAST_VISIBLE) & (heads.posture < len(POSTURES)) & ~heads.clear
    away = np.linalg.norm(centres[:, None] - heads.centres, axis=2)
    label = np.where(away.min(axis=1, initial=np.inf) > APART_M, 0, -1).astype(np.int8)
    label[away[:, to_find(view) | cut].min(axis=1, initial=np.inf) < NEAR_M] = 1
    bag = np.full(len(centres), -1, np.int64)
    if len(heads.centres):
        bag[label == 1] = 100 * view.number + away[label == 1].argmin(axis=1)
    return label, bag


def fit_again(peaks: Peaks, groups: Sequence[str], seed: int) -> boost.Fitted | None:
    """Return the stage, fitted to ``peaks`` over ``groups`` of the banks, or None: there is nothing to tell apart.

    Views kept aside are not learnt from.
    """
    if len(np.unique(peaks.samples.label[~peaks.samples.aside])) < 2:
        return None
    columns = np.flatnonzero(np.isin(boost.GROUP_OF, groups))
    every = np.ones(len(peaks.score), bool)
    model, score = boost.fit(
        peaks.samples, columns, every, peaks.score, PLAN.trees, PLAN.rate, SHARE_OF_FEATURES, seed,
        {"num_leaves": LEAVES, "min_data_in_leaf": LEAST_ROWS}, head_weight=1.0,
    )  # fmt: skip
    return boost.Fitted(PLAN, -1e3, model, [boost.NAMES[c] for c in columns], score)
