"""Which of the judged peaks are heads: those that reach the cascade's threshold, or nearly so where one is expected."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from headvox.config import DetectorConfig
from headvox.data import F64, I64, Expected, Frame
from headvox.masks.cascade import Cascade
from headvox.masks.compile import SCORE_UNIT, CompiledRelief


class Judged(NamedTuple):
    """What the judge lets through: N voxels that are heads, or may yet turn out to be some."""

    cells: npt.NDArray[np.int32]
    """(N, 3), of the integral volume"""
    centres: F64
    """(N, 3) metres, world"""
    scores: I64
    """(N,) in steps"""
    peaks: I64
    """(N,) which of the candidates each was found at"""
    least: int
    """What a head has to score, in steps."""


def asks_cameras(frame: Frame, sees: bool) -> bool:
    """Return whether a cascade that ``sees`` can ask cameras: clouds do not tell what was seen to be empty."""
    return sees and len(frame.depths) > 0


def shift_of_unseen(cascade: Cascade) -> int:
    """Return what is added to the score of a peak that no camera sees, in steps: one threshold holds for all."""
    return math.ceil(cascade.min_score * SCORE_UNIT) - math.ceil(cascade.min_score_occupied * SCORE_UNIT)


def least_score(config: DetectorConfig, cascade: Cascade, blind: bool) -> int:
    """Return the least score of a head, in steps; ``blind`` says that the cascade could not ask the cameras."""
    least = config.min_score
    if least is None:
        least = cascade.min_score_occupied if blind else cascade.min_score
    return math.ceil(least * SCORE_UNIT)


def least_before(least: int, relief: CompiledRelief | None, sees: bool) -> int:
    """Return the least score of what the last look might make a head of; ``sees`` says whether there is one."""
    return least - relief.most if relief is not None and sees else least


def slack_of(config: DetectorConfig, expected: Expected | None) -> int:
    """Return how much less a head may score where one is ``expected``, in steps; 0 where none is."""
    return 0 if expected is None or len(expected) == 0 else math.floor(config.score_slack * SCORE_UNIT)


def keep(
    centres: F64, scores: I64, least: int, slack: int, expected: Expected | None, voxel_m: float
) -> npt.NDArray[np.bool_]:
    """Return which of the peaks at ``centres`` (N, 3) metres, world, are heads: (N,).

    ``scores`` (N,) and the other two are in steps.
    """
    kept: npt.NDArray[np.bool_] = scores >= least
    if expected is not None and len(expected):
        kept |= (scores >= least - slack) & is_expected(centres, expected, voxel_m)
    return kept


def is_expected(centres: F64, expected: Expected, voxel_m: float) -> npt.NDArray[np.bool_]:
    """Return whether each of ``centres`` is within reach of any place where a head is expected."""
    away = np.linalg.norm(centres[:, None] - expected.centres, axis=2)
    within: npt.NDArray[np.bool_] = (away <= expected.reaches_m + voxel_m).any(axis=1)
    return within
