"""Which found head is which true head."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from headvox.data import F64, I64

TOO_FAR = 1e6


@dataclass(frozen=True, slots=True)
class Rules:
    """What counts as found and what as false; distances in metres.

    A head is found when a detection within ``radius_m`` of its centre is assigned to it. What is left over is false,
    unless it is within ``radius_m`` of a head that is not counted, or nearer than ``clear_m`` to any true head.
    """

    radius_m: float = 0.15
    clear_m: float = 0.0
    count_truncated: bool = False


@dataclass(frozen=True, slots=True)
class Match:
    """Indices of found and of true heads of one frame.

    ``pairs`` (K, 2): (found, true); ``distances`` (K,) metres; ``missed`` true heads; ``false`` found heads that are
    none; ``excused`` found heads that count neither way.
    """

    pairs: I64
    distances: F64
    missed: I64
    false: I64
    excused: I64


def match(found: F64, true: F64, counted: npt.NDArray[np.bool_], rules: Rules) -> Match:
    """Pair ``found`` (N, 3) with ``true`` (M, 3) centres, of which those ``counted`` (M,) have to be found.

    As many pairs as possible, and of those with as many the one with the least sum of distances (the Hungarian
    method).
    """
    away = np.linalg.norm(found[:, None, :] - true[None, :, :], axis=2)
    real = np.nonzero(counted)[0]
    pairs, distances = assign(away[:, real], rules.radius_m)
    pairs[:, 1] = real[pairs[:, 1]]
    left = np.setdiff1d(np.arange(len(found)), pairs[:, 0])
    missed = np.setdiff1d(real, pairs[:, 1])
    near_uncounted = away[np.ix_(left, np.nonzero(~counted)[0])].min(axis=1, initial=np.inf) <= rules.radius_m
    is_excused = near_uncounted | (away[left].min(axis=1, initial=np.inf) < rules.clear_m)
    return Match(pairs, distances, missed, left[~is_excused], left[is_excused])


def assign(away: F64, radius_m: float) -> tuple[I64, F64]:
    """Return the pairs (K, 2) of rows and columns of ``away`` (N, M) within ``radius_m``, and their distances."""
    within = away <= radius_m
    rows, columns = linear_sum_assignment(np.where(within, away, TOO_FAR))
    good = within[rows, columns]
    pairs = np.stack([rows[good], columns[good]], axis=1).astype(np.int64)
    return pairs, away[rows[good], columns[good]]
