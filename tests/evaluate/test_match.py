"""Pairs of found and true heads, on cases that can be checked by eye."""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
import pytest

from headvox.evaluate.match import Match, Rules, assign, match


def on_line(*x: float) -> np.ndarray:
    """Points on the x axis."""
    return np.array([[value, 0.0, 0.0] for value in x]).reshape(-1, 3)


def matched(found: np.ndarray, true: np.ndarray, counted: list[bool] | None = None, **rules: Any) -> Match:
    kept = np.ones(len(true), bool) if counted is None else np.array(counted, bool)
    return match(found, true, kept, Rules(**rules))


def test_each_head_takes_one_detection_and_the_rest_is_false() -> None:
    #      found 0.02  0.10   5.0        true 0.0   1.0
    #      0.02 and 0.10 are both within 0.15 of 0.0: the nearer one has it; nobody is at 1.0.
    m = matched(on_line(0.02, 0.10, 5.0), on_line(0.0, 1.0))
    assert m.pairs.tolist() == [[0, 0]]
    assert m.distances == pytest.approx([0.02])
    assert m.missed.tolist() == [1]
    assert m.false.tolist() == [1, 2]
    assert m.excused.tolist() == []


def test_as_many_pairs_as_possible_come_before_the_nearest() -> None:
    # true 0.00 and 0.14; found 0.04 (reaches both) and -0.10 (reaches 0.00 alone).
    # Nearest first would pair 0.04 with 0.00 and leave the other two alone.
    m = matched(on_line(0.04, -0.10), on_line(0.0, 0.14))
    assert sorted(m.pairs.tolist()) == [[0, 1], [1, 0]]
    assert len(m.missed) == len(m.false) == 0


def test_the_radius_itself_is_within() -> None:
    assert len(matched(on_line(0.25), on_line(0.0), radius_m=0.25).pairs) == 1
    assert len(matched(on_line(0.2501), on_line(0.0), radius_m=0.25).pairs) == 0


def test_a_detection_on_a_head_that_does_not_count_is_excused() -> None:
    # true 0.0 counts, 3.0 does not; found 3.1 is on the latter, so is a second one at 2.95; 6.0 is on nobody.
    m = matched(on_line(0.01, 3.1, 2.95, 6.0), on_line(0.0, 3.0), [True, False])
    assert m.pairs.tolist() == [[0, 0]]
    assert m.missed.tolist() == []
    assert m.excused.tolist() == [1, 2]
    assert m.false.tolist() == [3]


def test_a_head_that_counts_comes_before_one_that_does_not() -> None:
    # 0.08 is nearer to the ignored head at 0.10, and the only one that could be the head at 0.0.
    assert matched(on_line(0.08), on_line(0.0, 0.10), [True, False]).pairs.tolist() == [[0, 0]]


def test_a_margin_about_true_heads_can_be_cleared() -> None:
    # The rule "false is what is 20 cm or more from any head": 0.18 is neither, 0.20 is false.
    m = matched(on_line(0.0, 0.18, 0.20), on_line(0.0), radius_m=0.1, clear_m=0.2)
    assert m.excused.tolist() == [1]
    assert m.false.tolist() == [2]


@pytest.mark.parametrize(("found", "true"), [(0, 0), (0, 2), (2, 0)])
def test_nothing_found_or_nobody_there(found: int, true: int) -> None:
    m = matched(on_line(*range(found)), on_line(*range(true)))
    assert len(m.pairs) == len(m.distances) == 0
    assert m.missed.tolist() == list(range(true))
    assert m.false.tolist() == list(range(found))


def test_it_is_the_best_of_all_ways_to_pair() -> None:
    rng = np.random.default_rng(3)
    for _ in range(60):
        n, m = rng.integers(1, 6, 2)
        away = rng.uniform(0.0, 0.3, (n, m))
        ways = []
        for order in permutations(range(max(n, m)), int(n)):
            good = [(i, j) for i, j in enumerate(order) if j < m and away[i, j] <= 0.15]
            ways.append((-len(good), sum(away[pair] for pair in good)))
        pairs, distances = assign(away, 0.15)
        assert (-len(pairs), distances.sum()) == pytest.approx(min(ways))
