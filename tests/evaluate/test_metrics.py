"""Every figure on a case that is worked out by hand in the comments."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from headvox.evaluate.found import FoundHeads
from headvox.evaluate.match import Rules
from headvox.evaluate.metrics import (
    Group,
    Sample,
    average_precision,
    precision_recall,
    scatter,
    turn_errors_deg,
)
from headvox.evaluate.scores import Scores, score
from headvox.evaluate.truth import NO_ID, TrueHeads

LEVEL = [0.0, 0.0, 0.0, 1.0]


def found_heads(
    centres: list[list[float]],
    scores: list[float] | None = None,
    quaternions: list[list[float]] | None = None,
    latency_ms: float = math.nan,
    ids: list[int] | None = None,
) -> FoundHeads:
    n = len(centres)
    return FoundHeads(
        np.array(centres, float).reshape(-1, 3),
        np.full((n, 4), np.nan) if quaternions is None else np.array(quaternions),
        np.zeros(n) if scores is None else np.array(scores),
        np.full(n, NO_ID) if ids is None else np.array(ids),
        latency_ms,
    )


def sample(found: FoundHeads, *heads: dict[str, object], stamp_ns: int = 0) -> Sample:
    return Sample(stamp_ns, found, TrueHeads.of(stamp_ns, heads), np.zeros((1, 3)), found)


def scored(*samples: Sample, count_truncated: bool = False) -> Scores:
    return score("a", "b", samples, Rules(count_truncated=count_truncated))


def test_heads_that_are_found_missed_false_or_neither() -> None:
    # Frame 1: heads at x = 0 and 1, an ignored one at 5, a truncated one at 7; found 0.02, 0.10, 5.1, 7.0, 9.0.
    #   0.02 is the head at 0; 0.10 is false, and a duplicate; 5.1 and 7.0 count neither way; 9.0 is false; 1 is missed.
    # Frame 2: nobody is there, 3.0 is found: false.
    # Frame 3 has no labels. So 2 frames, 2 heads, 1 found, 3 false: recall 1/2, precision 1/4, 3/2 false a frame.
    first = sample(
        found_heads([[0.02, 0, 0], [0.10, 0, 0], [5.1, 0, 0], [7.0, 0, 0], [9.0, 0, 0]]),
        {"centre": [0, 0, 0]}, {"centre": [1, 0, 0]},
        {"centre": [5, 0, 0], "ignore": True}, {"centre": [7, 0, 0], "truncated": True},
    )  # fmt: skip
    unlabelled = Sample(2, found_heads([[4.0, 0, 0]]), None, np.zeros((1, 3)))
    s = scored(first, sample(found_heads([[3.0, 0, 0]])), unlabelled)
    assert (s.frames, s.heads, s.found, s.false, s.duplicates) == (2, 2, 1, 3, 1)
    assert (s.recall, s.precision, s.false_per_frame) == (0.5, 0.25, 1.5)
    assert (s.truncated, s.truncated_found) == (1, 1)


def test_truncated_heads_count_when_asked_for() -> None:
    one = sample(found_heads([]), {"centre": [0, 0, 0]}, {"centre": [7, 0, 0], "truncated": True})
    assert scored(one).heads == 1
    assert scored(one, count_truncated=True).heads == 2


def test_centre_errors() -> None:
    # Errors (3, 0, 0), (0, 4, 0) and (0, 0, -12) cm: lengths 3, 4, 12; mean 19/3, median 4; the 90th percentile lies
    # 0.8 of the way from 4 to 12: 10.4; the mean vector is (1, 4/3, -4).
    # About it: (2, -4/3, 4), (-1, 8/3, 4), (-1, -4/3, -8), squares 196/9, 217/9, 601/9; their mean 1014/27, root 6.13.
    places = [[0.03, 0, 0], [0, 0.04, 0], [0, 0, -0.12]]
    s = scored(*(sample(found_heads([place]), {"centre": [0, 0, 0]}) for place in places))
    assert s.centre_mean_m == pytest.approx(0.19 / 3)
    assert s.centre_median_m == pytest.approx(0.04)
    assert s.centre_p90_m == pytest.approx(0.104)
    assert s.centre_bias_m == pytest.approx((0.01, 0.04 / 3, -0.04))
    assert s.centre_scatter_m == pytest.approx(0.01 * math.sqrt(1014 / 27))
    assert scatter(np.empty((0, 3))) is None


def test_turns_are_in_the_axes_of_the_true_head() -> None:
    # The true head looks along y (yaw 90). Found: 10 degrees more to its left, then one that looks 20 degrees down
    # (a positive turn about its y axis), then one whose crown leans 30 degrees to its right (about its x axis).
    true = Rotation.from_euler("z", 90, degrees=True)
    turns = [Rotation.from_euler(*turn, degrees=True) for turn in (("z", 10), ("y", 20), ("x", 30))]
    found = [true * turn for turn in turns]
    errors = turn_errors_deg(np.array([q.as_quat() for q in found]), np.tile(true.as_quat(), (3, 1)))
    assert errors == pytest.approx(np.array([[10, 0, 0, 10], [0, 20, 0, 20], [0, 0, 30, 30]]), abs=1e-9)


def test_turns_agree_with_the_angles_they_are_made_of() -> None:
    rng = np.random.default_rng(5)
    true = Rotation.random(50, random_state=rng)
    angles = rng.uniform((-179, -89, -179), (179, 89, 179), (50, 3))
    turns = turn_errors_deg(
        (true * Rotation.from_euler("ZYX", angles, degrees=True)).as_quat(), true.as_quat()
    )
    assert turns[:, :3] == pytest.approx(angles, abs=1e-6)


def test_orientation_errors_and_flips() -> None:
    # Yaws -10, +20 and 170 degrees off; one head without a stated, and one without a true orientation.
    # 170 is a flip and counted apart; of the others the mean is 15, the median 15, the 90th percentile 19.
    def turned(yaw: float) -> list[float]:
        return Rotation.from_euler("z", yaw, degrees=True).as_quat().tolist()

    nan = [math.nan] * 4
    found = found_heads(
        [[k, 0, 0] for k in range(5)], None, [turned(-10), turned(20), turned(170), nan, LEVEL]
    )
    heads = [{"centre": [k, 0, 0], "quaternion": None if k == 4 else LEVEL} for k in range(5)]
    s = scored(sample(found, *heads))
    assert (s.found, s.oriented, s.flips) == (5, 3, 1)
    assert (s.yaw_mean_deg, s.pitch_mean_deg, s.roll_mean_deg) == pytest.approx((15, 0, 0))
    assert (s.turn_mean_deg, s.turn_median_deg, s.turn_p90_deg) == pytest.approx((15, 15, 19))


def test_latency() -> None:
    # Of 1, 2, 3, 4 ms the median is 2.5, the 95th percentile 0.85 of the way from 3 to 4, the 99th 0.97 of it;
    # each is 1 ms from the next. (With so few frames the first ones count, too.)
    s = scored(*(sample(found_heads([], latency_ms=ms)) for ms in (1, 2, 3, 4)))
    assert (s.latency_p50_ms, s.latency_p95_ms, s.latency_p99_ms) == pytest.approx((2.5, 3.85, 3.97))
    assert s.latency_jitter_ms == pytest.approx(1.0)


def test_the_first_calls_are_not_timed() -> None:
    assert (
        scored(*(sample(found_heads([], latency_ms=9 if k < 3 else 1)) for k in range(20))).latency_p99_ms
        == 1
    )


def test_groups() -> None:
    # The sensor is at the origin. Heads at 1.5, 2.5 and 2.9 m, seen by 90 %, 50 % and 20 %, by two, one and one
    # camera; the second is missed, the others are 1 and 3 cm off.
    heads = [
        {"centre": [1.5, 0, 0], "visible": {"l": 0.9, "r": 0.3}, "posture": "standing"},
        {"centre": [2.5, 0, 0], "visible": {"l": 0.5, "r": 0.1}, "posture": "lying"},
        {"centre": [0, 2.9, 0], "visible": {"l": 0.0, "r": 0.2}},
    ]
    groups = scored(sample(found_heads([[1.51, 0, 0], [0, 2.93, 0]]), *heads)).groups
    near, far = pytest.approx(0.01), pytest.approx(0.03)
    assert groups == {
        "distance [m]": [Group("1 to 2", 1, 1, near, None), Group("2 to 3", 2, 1, far, None)],
        "visible": [
            Group("15% to 40%", 1, 1, far, None),
            Group("40% to 60%", 1, 0, None, None),
            Group("80% and more", 1, 1, near, None),
        ],
        "views": [Group("1", 2, 1, far, None), Group("2", 1, 1, near, None)],
        "posture": [Group("lying", 1, 0, None, None), Group("standing", 1, 1, near, None)],
    }


def test_precision_over_recall() -> None:
    # Two heads, in two frames. Scores: frame 1 a head 5, nobody 4; frame 2 a head 3, nobody 1.
    # From 5 on: 1 of 2, none false. From 3 on: 2 of 2, one false (in two frames), precision 2/3.
    # The area: 0.5 of recall at precision 1, 0.5 at 2/3.
    first = sample(found_heads([[0, 0, 0], [3, 0, 0]], [5, 4]), {"centre": [0, 0, 0]})
    second = sample(found_heads([[0, 0, 0], [3, 0, 0]], [3, 1]), {"centre": [0, 0, 0]})
    curve = precision_recall([first, second], Rules())
    assert curve == [(5.0, 0.5, 1.0, 0.0), (3.0, 1.0, pytest.approx(2 / 3), 0.5)]
    assert average_precision(curve) == pytest.approx(0.5 + 0.5 * 2 / 3)
    assert average_precision([]) is None


def test_precision_that_recovers_counts_from_its_best() -> None:
    # At recall 0.5 precision is 1/2, at 1.0 it is 2/3: whoever is content with 0.5 can have 2/3, too.
    assert average_precision([(2, 0.5, 0.5, 1), (1, 1.0, 2 / 3, 1)]) == pytest.approx(2 / 3)


def test_nobody_there_and_nothing_found() -> None:
    s = scored(sample(found_heads([])))
    assert (s.heads, s.found, s.false, s.false_per_frame) == (0, 0, 0, 0)
    assert s.recall is s.precision is s.centre_mean_m is s.centre_bias_m is s.latency_p50_ms is None
    assert s.groups == {}
