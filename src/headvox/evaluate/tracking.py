"""How well identities are kept: CLEAR-MOT and IDF1 by motmetrics, HOTA, and what happens while a head is hidden."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from headvox.data import F64, I64
from headvox.errors import MissingExtra
from headvox.evaluate.match import Match, Rules, match
from headvox.evaluate.metrics import Sample, counted
from headvox.evaluate.truth import NO_ID

ALPHAS = np.arange(1, 20) / 20.0


@dataclass(frozen=True, slots=True)
class Tracks:
    """The heads and the tracks of one frame that count; ``away`` (N, M) metres from head to track."""

    true_ids: I64
    found_ids: I64
    away: F64


@dataclass(frozen=True, slots=True)
class TrackingScores:
    """Figures of identity; the shares are 0..1, ``mota`` may be below 0.

    They are of what has an id. A head that was found without one (a tentative track) is nobody's: whoever has no more
    than that is missed, and a false one is no false track. Recall and false heads, which count all that was found, are
    in :mod:`headvox.evaluate.metrics`.

    ``gaps`` are the times that a head was hidden (labelled as ignored) and had a track before; ``bridged`` are those
    after which it had the same track again; ``coasted`` is the share of the frames in between in which that track
    was stated within the radius of the hidden head.
    """

    mota: float | None
    idf1: float | None
    switches: int | None
    fragmentations: int | None
    hota: float
    detection_accuracy: float
    association_accuracy: float
    gaps: int
    bridged: int
    coasted: float | None


def need_motmetrics() -> None:
    """Raise HeadvoxError where motmetrics is not installed."""
    if importlib.util.find_spec("motmetrics") is None:
        raise MissingExtra(
            "Figures of tracking need motmetrics.", "eval", instead="leave them out: --no-track"
        )


def score_tracks(samples: Sequence[Sample], rules: Rules) -> TrackingScores | None:
    """Return the figures, or None where heads have no ids or nothing that was found has one.

    Raises:
        HeadvoxError: motmetrics is not installed.
    """
    labelled = [sample for sample in samples if sample.true is not None]
    frames = [_tracks(sample, rules) for sample in labelled]
    has_people = any(len(f.true_ids) for f in frames) and all((f.true_ids != NO_ID).all() for f in frames)
    if not has_people or all((s.found.ids == NO_ID).all() for s in labelled):
        return None
    clear = clear_mot(frames, rules.radius_m)
    hota, detection, association = higher_order(frames, 2.0 * rules.radius_m)
    gaps, bridged, coasted = coasting(labelled, rules)
    return TrackingScores(
        clear["mota"], clear["idf1"], clear["num_switches"], clear["num_fragmentations"],
        hota, detection, association, gaps, bridged, coasted,
    )  # fmt: skip


def _tracks(sample: Sample, rules: Rules) -> Tracks:
    """Leave out ignored heads and what is on them, and what was found without an id: it says nothing of who it is."""
    assert sample.true is not None
    true, found, kept = sample.true, sample.found, counted(sample.true, rules)
    named = np.nonzero(found.ids != NO_ID)[0]
    excused = match(found.centres[named], true.centres, kept, rules).excused
    scored = np.delete(named, excused)
    away = np.linalg.norm(true.centres[kept][:, None] - found.centres[scored][None], axis=2)
    return Tracks(true.ids[kept], found.ids[scored], away)


def clear_mot(frames: Sequence[Tracks], radius_m: float) -> dict[str, Any]:
    """Return mota, idf1, num_switches and num_fragmentations, as motmetrics has them.

    Raises:
        HeadvoxError: motmetrics is not installed.
    """
    need_motmetrics()
    import motmetrics

    events = motmetrics.MOTAccumulator(auto_id=True)
    for frame in frames:
        events.update(frame.true_ids, frame.found_ids, np.where(frame.away <= radius_m, frame.away, np.nan))
    names = ["mota", "idf1", "num_switches", "num_fragmentations"]
    row = motmetrics.metrics.create().compute(events, metrics=names, return_dataframe=False)
    return {name: row[name].item() if hasattr(row[name], "item") else row[name] for name in names}


def higher_order(frames: Sequence[Tracks], zero_m: float) -> tuple[float, float, float]:
    """Return HOTA, DetA and AssA, each the mean over the similarity thresholds 0.05, 0.10 ... 0.95.

    Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking", IJCV 2021. Similarity is
    1 - distance / ``zero_m``, not below 0.
    """
    true_all = np.unique(np.concatenate([f.true_ids for f in frames]))
    found_all = np.unique(np.concatenate([f.found_ids for f in frames]))
    if not len(true_all) or not len(found_all):
        return 0.0, 0.0, 0.0
    rows = [np.searchsorted(true_all, f.true_ids) for f in frames]
    columns = [np.searchsorted(found_all, f.found_ids) for f in frames]
    alike = [np.maximum(0.0, 1.0 - f.away / zero_m) for f in frames]
    true_count = np.bincount(np.concatenate(rows), minlength=len(true_all))[:, None]
    found_count = np.bincount(np.concatenate(columns), minlength=len(found_all))[None, :]
    together = np.zeros((len(true_all), len(found_all)))
    for i, j, similar in zip(rows, columns, alike, strict=True):
        union = similar.sum(axis=0)[None, :] + similar.sum(axis=1)[:, None] - similar
        together[np.ix_(i, j)] += np.divide(similar, union, out=np.zeros_like(similar), where=union > 1e-12)
    alignment = together / (true_count + found_count - together)
    matched = np.zeros((len(ALPHAS), len(true_all), len(found_all)))
    for i, j, similar in zip(rows, columns, alike, strict=True):
        a, b = linear_sum_assignment(-alignment[np.ix_(i, j)] * similar)
        good = similar[a, b][None, :] >= ALPHAS[:, None] - 1e-12
        matched[:, i[a], j[b]] += good
    hits = matched.sum(axis=(1, 2))
    detection = hits / (true_count.sum() + found_count.sum() - hits)
    shares = matched / np.maximum(1, true_count + found_count - matched)
    association = (matched * shares).sum(axis=(1, 2)) / np.maximum(1, hits)
    hota = np.sqrt(detection * association)
    return float(hota.mean()), float(detection.mean()), float(association.mean())


def coasting(samples: Sequence[Sample], rules: Rules) -> tuple[int, int, float | None]:
    """Return how often a tracked head was hidden, how often its track outlived that, and the share it was stated."""
    gaps = bridged = hidden = stated = 0
    matches = [_pairs_by_id(sample, rules) for sample in samples]
    people = {int(i) for sample in samples if sample.true is not None for i in sample.true.ids} - {NO_ID}
    for person in people:
        last, waiting = NO_ID, 0
        for sample, tracks in zip(samples, matches, strict=True):
            true = sample.true
            assert true is not None
            at = np.nonzero(true.ids == person)[0]
            if not len(at):
                continue
            if true.ignored[at[0]]:
                if last != NO_ID:
                    waiting += 1
                    own = sample.found.centres[sample.found.ids == last]
                    stated += bool(
                        (np.linalg.norm(own - true.centres[at[0]], axis=1) <= rules.radius_m).any()
                    )
                    hidden += 1
                continue
            now = tracks.get(person, NO_ID)
            if waiting and now != NO_ID:
                gaps, bridged, waiting = gaps + 1, bridged + (now == last), 0
            last = now if now != NO_ID else last
    return gaps, bridged, stated / hidden if hidden else None


def _pairs_by_id(sample: Sample, rules: Rules) -> dict[int, int]:
    assert sample.true is not None
    true, found = sample.true, sample.found
    named = np.nonzero(found.ids != NO_ID)[0]
    paired: Match = match(found.centres[named], true.centres, counted(true, rules), rules)
    return {int(true.ids[j]): int(found.ids[named[i]]) for i, j in paired.pairs if true.ids[j] != NO_ID}
