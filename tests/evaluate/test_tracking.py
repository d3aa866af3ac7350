"""Figures of identity: by hand, and HOTA against its authors' own code where that is installed."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from headvox.evaluate.found import FoundHeads
from headvox.evaluate.match import Rules
from headvox.evaluate.metrics import Sample
from headvox.evaluate.tracking import ALPHAS, TrackingScores, Tracks, coasting, higher_order, score_tracks
from headvox.evaluate.truth import NO_ID, TrueHeads

PLACES = {1: 0.0, 2: 1.0}  # where person 1 and person 2 stand, on the x axis


def frame(true: dict[int, bool], tracks: dict[int, float], stamp_ns: int = 0) -> Sample:
    """People by id (True: hidden) at their places, and tracks by id at theirs."""
    heads = [{"id": i, "centre": [PLACES[i], 0, 0], "ignore": hidden} for i, hidden in true.items()]
    centres = np.array([[x, 0.0, 0.0] for x in tracks.values()]).reshape(-1, 3)
    n = len(tracks)
    found = FoundHeads(centres, np.full((n, 4), np.nan), np.zeros(n), np.array(list(tracks), np.int64))
    return Sample(stamp_ns, found, TrueHeads.of(stamp_ns, heads), np.empty((0, 3)))


BOTH = {1: False, 2: False}


def tracked(*samples: Sample) -> TrackingScores:
    scores = score_tracks(samples, Rules())
    assert scores is not None
    return scores


def test_perfect_tracks() -> None:
    s = tracked(*(frame(BOTH, {7: 0.0, 8: 1.0}) for _ in range(4)))
    assert (s.mota, s.idf1, s.switches, s.fragmentations) == (1.0, 1.0, 0, 0)
    assert (s.hota, s.detection_accuracy, s.association_accuracy) == pytest.approx((1.0, 1.0, 1.0))
    assert (s.gaps, s.bridged, s.coasted) == (0, 0, None)


def test_two_people_swap_their_tracks() -> None:
    # Four frames, two people: 8 heads, all found. After frame 2 the tracks are swapped: 2 switches, MOTA 1 - 2/8.
    # The best way to give each person one track (any way) explains 2 + 2 of the 8: IDF1 = 2*4 / (8 + 8).
    # DetA is 1. Each pair (person, track) was together in 2 frames, apart in 2 + 2: AssA = 2 / 6; HOTA its root.
    before, after = frame(BOTH, {7: 0.0, 8: 1.0}), frame(BOTH, {8: 0.0, 7: 1.0})
    s = tracked(before, before, after, after)
    assert (s.mota, s.idf1, s.switches) == (0.75, 0.5, 2)
    assert (s.detection_accuracy, s.association_accuracy) == pytest.approx((1.0, 1 / 3))
    assert s.hota == pytest.approx(math.sqrt(1 / 3))


def test_a_miss_and_a_false_track() -> None:
    # 8 heads; person 2 has no track in frame 2, and there is one at 5 m in frame 3: MOTA = 1 - (1 + 1) / 8.
    # Explained: 7 of 8 heads by 7 of 8 found: IDF1 7/8. Person 2 is lost and found again: one break.
    good = frame(BOTH, {7: 0.0, 8: 1.0})
    s = tracked(good, frame(BOTH, {7: 0.0}), frame(BOTH, {7: 0.0, 8: 1.0, 9: 5.0}), good)
    assert (s.mota, s.idf1, s.switches, s.fragmentations) == (0.75, 0.875, 0, 1)
    # DetA = 7 / (8 + 8 - 7). Person 1: 4 pairs with share 4/4; person 2: 3 pairs with share 3/4.
    assert s.detection_accuracy == pytest.approx(7 / 9)
    assert s.association_accuracy == pytest.approx((4 * 1 + 3 * 0.75) / 7)


def test_hota_asks_for_more_and_more_likeness() -> None:
    # A track 6 cm beside its head: likeness 1 - 6/30 = 0.8, enough for the thresholds 0.05 ... 0.8: 16 of 19.
    s = tracked(frame({1: False}, {7: 0.06}))
    assert s.detection_accuracy == pytest.approx(16 / 19)
    assert s.hota == pytest.approx(16 / 19)


def test_detections_without_a_track_say_nothing_of_identity() -> None:
    # Person 1 is found in three frames, with track 7 in the first only: two misses of three, one of 3 + 1 explained.
    s = tracked(frame({1: False}, {7: 0.0}), *(frame({1: False}, {NO_ID: 0.0}) for _ in range(2)))
    assert (s.switches, s.mota) == (0, pytest.approx(1 / 3))
    assert s.idf1 == pytest.approx(2 * 1 / (3 + 1))


def test_a_detection_without_a_track_takes_no_head_from_a_track_and_is_no_false_track() -> None:
    seen, gone = frame({1: False}, {7: 0.05, NO_ID: 0.0}), frame({1: True}, {})
    s = tracked(seen, gone, seen)
    assert (s.mota, s.idf1) == (1.0, 1.0)
    assert (s.gaps, s.bridged) == (1, 1)


def test_without_ids_there_are_no_figures() -> None:
    assert score_tracks([frame(BOTH, {NO_ID: 0.0})], Rules()) is None
    anyone = frame({1: False}, {7: 0.0})
    nobody_told = TrueHeads.of(0, [{"centre": [0, 0, 0]}])
    assert score_tracks([Sample(0, anyone.found, nobody_told, anyone.sensors)], Rules()) is None
    assert score_tracks([frame({}, {7: 0.0})], Rules()) is None


def test_hidden_heads_are_neither_lost_nor_false() -> None:
    # Person 1 is hidden in frames 2 and 3; its track goes on in frame 2 only. Neither costs anything.
    seen, gone = frame({1: False}, {7: 0.0}), frame({1: True}, {})
    s = tracked(seen, frame({1: True}, {7: 0.05}), gone, seen)
    assert (s.mota, s.idf1, s.switches) == (1.0, 1.0, 0)
    # One gap, after which the track is the same; it was stated in one of the two hidden frames.
    assert (s.gaps, s.bridged, s.coasted) == (1, 1, 0.5)


def test_a_track_that_does_not_outlive_a_gap() -> None:
    # Hidden twice: after the first gap track 8 is there instead of 7, after the second 8 still.
    seen, gone, other = frame({1: False}, {7: 0.0}), frame({1: True}, {7: 0.3}), frame({1: False}, {8: 0.0})
    assert coasting([seen, gone, other, gone, other], Rules()) == (2, 1, 0.0)
    # Hidden before anything was tracked, and to the end: no gap that anything could outlive.
    assert coasting([gone, seen, gone], Rules()) == (0, 0, 0.0)


def random_tracks(seed: int) -> list[Tracks]:
    """People who walk about, with tracks that are off, lost, false and swapped."""
    rng = np.random.default_rng(seed)
    frames = []
    for k in range(25):
        true = np.sort(rng.choice(5, rng.integers(0, 6), replace=False))
        places = np.stack([true + 0.1 * k, np.zeros(len(true)), np.zeros(len(true))], axis=1)
        kept = rng.random(len(true)) < 0.85
        ids = np.where(rng.random(kept.sum()) < 0.9, true[kept] + 100, true[kept] + 200 + k // 5 * 10)
        found = np.concatenate(
            [places[kept] + rng.normal(0, 0.05, (kept.sum(), 3)), rng.uniform(0, 5, (1, 3))]
        )
        ids = np.append(ids, 900 + k % 3)
        frames.append(Tracks(true, ids, np.linalg.norm(places[:, None] - found[None], axis=2)))
    return frames


def naive_hota(frames: list[Tracks], zero_m: float) -> tuple[float, float, float]:
    """HOTA from the words of the paper: sets of true positives, and for each how its two tracks go together."""

    def likeness(f: Tracks, i: int, j: int) -> float:
        return max(0.0, 1.0 - f.away[i, j] / zero_m)

    together: Counter[tuple[int, int]] = Counter()
    true_count: Counter[int] = Counter()
    found_count: Counter[int] = Counter()
    for f in frames:
        true_count.update(f.true_ids.tolist())
        found_count.update(f.found_ids.tolist())
        for i, a in enumerate(f.true_ids.tolist()):
            for j, b in enumerate(f.found_ids.tolist()):
                rivals = sum(likeness(f, i, k) for k in range(len(f.found_ids)))
                rivals += sum(likeness(f, k, j) for k in range(len(f.true_ids))) - likeness(f, i, j)
                together[a, b] += likeness(f, i, j) / rivals if rivals > 0 else 0.0
    sums = np.zeros(3)
    for alpha in ALPHAS:
        positives: list[tuple[int, int]] = []
        for f in frames:
            worth = np.zeros(f.away.shape)
            for i, a in enumerate(f.true_ids.tolist()):
                for j, b in enumerate(f.found_ids.tolist()):
                    both = together[a, b]
                    worth[i, j] = both / (true_count[a] + found_count[b] - both) * likeness(f, i, j)
            for i, j in zip(*linear_sum_assignment(worth, maximize=True), strict=True):
                if likeness(f, i, j) >= alpha - 1e-12:
                    positives.append((int(f.true_ids[i]), int(f.found_ids[j])))
        everything = sum(true_count.values()) + sum(found_count.values()) - len(positives)
        shares = []
        for a, b in positives:
            tpa = positives.count((a, b))
            shares.append(tpa / (true_count[a] + found_count[b] - tpa))
        detection, association = len(positives) / everything, float(np.mean(shares)) if shares else 0.0
        sums += [math.sqrt(detection * association), detection, association]
    hota, detection, association = sums / len(ALPHAS)
    return hota, detection, association


@pytest.mark.parametrize("seed", range(3))
def test_hota_is_what_the_paper_says(seed: int) -> None:
    frames = random_tracks(seed)
    assert higher_order(frames, 0.3) == pytest.approx(naive_hota(frames, 0.3), abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_hota_is_that_of_its_authors(seed: int) -> None:
    metrics = pytest.importorskip(
        "trackeval.metrics", reason="needs headvox[against]: trackeval", exc_type=ImportError
    )
    frames = random_tracks(seed)
    true = np.unique(np.concatenate([f.true_ids for f in frames]))
    found = np.unique(np.concatenate([f.found_ids for f in frames]))
    data = {
        "num_gt_ids": len(true),
        "num_tracker_ids": len(found),
        "num_gt_dets": sum(len(f.true_ids) for f in frames),
        "num_tracker_dets": sum(len(f.found_ids) for f in frames),
        "gt_ids": [np.searchsorted(true, f.true_ids) for f in frames],
        "tracker_ids": [np.searchsorted(found, f.found_ids) for f in frames],
        "similarity_scores": [np.maximum(0.0, 1.0 - f.away / 0.3) for f in frames],
    }
    theirs = metrics.HOTA().eval_sequence(data)
    assert len(theirs["HOTA"]) == len(ALPHAS)
    expected = [float(np.mean(theirs[name])) for name in ("HOTA", "DetA", "AssA")]
    assert higher_order(frames, 0.3) == pytest.approx(expected, abs=1e-12)
    assert 0.2 < expected[0] < 0.9
