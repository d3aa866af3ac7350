"""Figures of many frames: recall, errors, false heads, latency, and the same by distance, visibility and so on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from headvox.data import F64
from headvox.evaluate.found import FoundHeads
from headvox.evaluate.match import Match, Rules, match
from headvox.evaluate.truth import LABELS, Bools, TrueHeads

FLIP_DEG = 90.0
DISTANCES_M = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
SHARES = (0.15, 0.4, 0.6, 0.8)
MOST_THRESHOLDS = 60


@dataclass(frozen=True, slots=True)
class Sample:
    """One frame of an evaluation; ``true`` is None where the frame has no labels.

    ``sensors`` (S, 3) is where the sensors stand, in the world, as far as is known. ``swept`` are the heads that a
    detector without threshold finds, for the precision-recall curve.
    """

    stamp_ns: int
    found: FoundHeads
    true: TrueHeads | None
    sensors: F64
    swept: FoundHeads | None = None


@dataclass(frozen=True, slots=True)
class Group:
    """The heads of one kind: ``found`` of ``heads``, and the mean errors of those found."""

    label: str
    heads: int
    found: int
    centre_mean_m: float | None
    turn_mean_deg: float | None


@dataclass(frozen=True, slots=True)
class Rows:
    """All heads that have to be found, of all frames, as a structure of arrays of N rows.

    ``errors`` (N, 3) metres, found minus true centre, NaN where missed. ``turns_deg`` (N, 4) yaw, pitch and roll of
    the turn from the true to the found head in the true head's axes, and its whole angle; NaN where either is not
    known. ``distances`` metres to the nearest sensor, NaN where no sensor's place is known.
    """

    frames: npt.NDArray[np.int64]
    errors: F64
    turns_deg: F64
    distances: F64
    visible: F64
    views: F64
    labels: dict[str, npt.NDArray[np.str_]]

    @property
    def found(self) -> Bools:
        """Which were found (N,)."""
        return np.isfinite(self.errors[:, 0])


def counted(true: TrueHeads, rules: Rules) -> Bools:
    """Return which heads (N,) have to be found."""
    return ~true.ignored if rules.count_truncated else ~(true.ignored | true.truncated)


def match_frames(samples: Sequence[Sample], rules: Rules) -> list[Match | None]:
    """Return the match of every frame with labels."""
    return [
        None if s.true is None else match(s.found.centres, s.true.centres, counted(s.true, rules), rules)
        for s in samples
    ]


def gather(samples: Sequence[Sample], matches: Sequence[Match | None], rules: Rules) -> Rows:
    """Put the heads that have to be found, of all frames, into one table; at least one frame has labels."""
    parts = [
        _rows(k, s, m, rules) for k, (s, m) in enumerate(zip(samples, matches, strict=True)) if m is not None
    ]
    return Rows(
        frames=np.concatenate([part.frames for part in parts]),
        errors=np.concatenate([part.errors for part in parts]),
        turns_deg=np.concatenate([part.turns_deg for part in parts]),
        distances=np.concatenate([part.distances for part in parts]),
        visible=np.concatenate([part.visible for part in parts]),
        views=np.concatenate([part.views for part in parts]),
        labels={name: np.concatenate([part.labels[name] for part in parts]) for name in LABELS},
    )


def _rows(number: int, sample: Sample, pairing: Match, rules: Rules) -> Rows:
    assert sample.true is not None
    true, kept = sample.true, counted(sample.true, rules)
    errors, turns = np.full((len(true), 3), np.nan), np.full((len(true), 4), np.nan)
    i, j = pairing.pairs.T
    errors[j] = sample.found.centres[i] - true.centres[j]
    turns[j] = turn_errors_deg(sample.found.quaternions[i], true.quaternions[j])
    away = np.linalg.norm(true.centres[:, None] - sample.sensors[None], axis=2).min(axis=1, initial=np.inf)
    away[np.isinf(away)] = np.nan
    return Rows(
        frames=np.full(int(kept.sum()), number),
        errors=errors[kept],
        turns_deg=turns[kept],
        distances=away[kept],
        visible=true.visible[kept],
        views=true.views[kept],
        labels={name: np.array(words, dtype=str)[kept] for name, words in true.labels.items()},
    )


def turn_errors_deg(found: F64, true: F64) -> F64:
    """Return (N, 4): yaw, pitch, roll and whole angle of the turns from ``true`` to ``found`` quaternions (N, 4).

    Degrees; R_found = R_true R_z(yaw) R_y(pitch) R_x(roll); NaN where either quaternion is.
    """
    turns = np.full((len(found), 4), np.nan)
    known = np.isfinite(found).all(axis=1) & np.isfinite(true).all(axis=1)
    if known.any():
        turn = Rotation.from_quat(true[known]).inv() * Rotation.from_quat(found[known])
        matrix = turn.as_matrix()  # as_euler would warn where pitch is 90 degrees
        turns[known, 0] = np.degrees(np.arctan2(matrix[:, 1, 0], matrix[:, 0, 0]))
        turns[known, 1] = np.degrees(np.arcsin(np.clip(-matrix[:, 2, 0], -1.0, 1.0)))
        turns[known, 2] = np.degrees(np.arctan2(matrix[:, 2, 1], matrix[:, 2, 2]))
        turns[known, 3] = np.degrees(turn.magnitude())
    return turns


def group_rows(rows: Rows) -> dict[str, list[Group]]:
    """Return the heads by distance, visible share, number of views, and by what else is told of them."""
    groups = {
        "distance [m]": _in_bins(rows, rows.distances, DISTANCES_M, "{:g}"),
        "visible": _in_bins(rows, rows.visible, SHARES, "{:.0%}"),
        "views": [
            _group(rows, rows.views == count, f"{count:g}")
            for count in np.unique(rows.views[rows.views >= 0])
        ],
    }
    for name, words in rows.labels.items():
        groups[name] = [_group(rows, words == word, str(word)) for word in np.unique(words) if word]
    return {name: several for name, several in groups.items() if several}


def _in_bins(rows: Rows, values: F64, edges: Sequence[float], form: str) -> list[Group]:
    groups = []
    for low, high in zip(edges, (*edges[1:], math.inf), strict=True):
        label = (
            f"{form.format(low)} to {form.format(high)}"
            if high < math.inf
            else f"{form.format(low)} and more"
        )
        groups.append(_group(rows, (values >= low) & (values < high), label))
    return [group for group in groups if group.heads]


def _group(rows: Rows, which: Bools, label: str) -> Group:
    turns = rows.turns_deg[which, 3]
    return Group(
        label,
        int(which.sum()),
        int(rows.found[which].sum()),
        mean(np.linalg.norm(rows.errors[which & rows.found], axis=1)),
        mean(turns[turns <= FLIP_DEG]),
    )


def precision_recall(samples: Sequence[Sample], rules: Rules) -> list[tuple[float, float, float, float]]:
    """Return (threshold, recall, precision, false heads a frame) over the score threshold, highest first.

    The thresholds are scores of detections on heads: only there recall can change. Each is matched anew.
    """
    swept = [
        (s.swept.scores, match(s.swept.centres, s.true.centres, counted(s.true, rules), rules), s)
        for s in samples
        if s.swept is not None and s.true is not None
    ]
    on_heads = np.concatenate([np.empty(0), *(scores[m.pairs[:, 0]] for scores, m, _ in swept)])
    heads = sum(len(m.pairs) + len(m.missed) for _, m, _ in swept)
    if not heads:
        return []
    steps = np.unique(on_heads[np.isfinite(on_heads)])[::-1]
    steps = steps[np.unique(np.linspace(0, len(steps) - 1, min(len(steps), MOST_THRESHOLDS)).astype(int))]
    curve = []
    for least in steps:
        found = false = 0
        for _, _, s in swept:
            assert s.swept is not None
            assert s.true is not None
            centres = s.swept.centres[s.swept.scores >= least]
            m = match(centres, s.true.centres, counted(s.true, rules), rules)
            found, false = found + len(m.pairs), false + len(m.false)
        curve.append((float(least), found / heads, found / max(found + false, 1), false / len(swept)))
    return curve


def average_precision(curve: Sequence[tuple[float, float, float, float]]) -> float | None:
    """Return the area under precision over recall, each precision being the best of that recall or a higher one."""
    if not curve:
        return None
    recall = np.array([0.0, *(point[1] for point in curve)])
    precision = np.array([point[2] for point in curve])
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float((np.diff(np.maximum.accumulate(recall)) * best).sum())


def mean(values: F64) -> float | None:
    """Return the mean, or None of nothing."""
    return float(values.mean()) if len(values) else None


def percentile(values: F64, q: float) -> float | None:
    """Return the q-th percentile, or None of nothing."""
    return float(np.percentile(values, q)) if len(values) else None


def scatter(vectors: F64) -> float | None:
    """Return the root mean square distance of ``vectors`` (N, 3) from their mean, or None of nothing."""
    return (
        float(np.sqrt(((vectors - vectors.mean(axis=0)) ** 2).sum(axis=1).mean())) if len(vectors) else None
    )


def successive_change(values: F64) -> float | None:
    """Return the mean absolute change from one value to the next, or None of fewer than two."""
    return float(np.abs(np.diff(values)).mean()) if len(values) > 1 else None
