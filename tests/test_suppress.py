import naive_search
import numpy as np
import pytest

from headvox.suppress import best_of_each, suppress, suppress_overlaps


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("values", [1, 3, 1000])
@pytest.mark.parametrize("reach", [1, 2])
def test_equals_the_naive_twin(seed, values, reach):
    rng = np.random.default_rng(seed)
    shape = (7, 6, 8)
    cells = np.argwhere(rng.random(shape) < rng.choice([0.05, 0.3, 1.0])).astype(np.int32)
    scores = rng.integers(-values, values, len(cells))
    for least in (-(2**40) + 1, 0):
        peaks = suppress(cells, scores, least, shape, reach)
        np.testing.assert_array_equal(peaks, naive_search.suppress(cells, scores, least, reach))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("values", [1, 3, 1000])
def test_the_best_of_each_group_equals_the_naive_twin(seed, values):
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, 3, (7 * 20, 3)).astype(np.int32)
    scores = rng.integers(-values, values, len(cells))
    for least in (-values, 0, values + 1):
        best = np.empty(20, np.int64)
        wanted = naive_search.best_of_each(cells, scores, 7, least)
        assert best[: best_of_each(cells, scores, 7, least, best)].tolist() == wanted
        assert len(wanted) < 20


def test_no_candidate_and_one_candidate():
    assert suppress(np.empty((0, 3), np.int32), np.empty(0, np.int64), 0, (3, 3, 3)).tolist() == []
    cell = np.array([[0, 2, 1]], np.int32)
    assert suppress(cell, np.array([5]), 5, (1, 3, 2)).tolist() == [0]
    assert suppress(cell, np.array([5]), 6, (1, 3, 2)).tolist() == []


def test_the_first_of_a_plateau_wins_once():
    cells = np.argwhere(np.ones((2, 2, 2))).astype(np.int32)
    assert suppress(cells, np.full(8, 9), 0, (2, 2, 2)).tolist() == [0]


def test_a_neighbour_across_a_corner_counts_and_two_steps_away_does_not():
    cells = np.array([[0, 0, 0], [1, 1, 1], [3, 1, 1]], np.int32)
    assert suppress(cells, np.array([1, 2, 3]), 0, (4, 4, 4)).tolist() == [1, 2]


@pytest.mark.parametrize("seed", range(6))
def test_overlaps_equal_the_naive_twin(seed):
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-0.5, 0.5, (40, 3))
    scores = rng.integers(0, 5, 40)
    kept = suppress_overlaps(centres, scores, 0.3)
    np.testing.assert_array_equal(kept, naive_search.suppress_overlaps(centres, scores, 0.3))
    assert 1 < len(kept) < 40


def test_overlaps_keep_the_better_and_all_that_are_apart():
    centres = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.3, 0, 0]])
    assert suppress_overlaps(centres, np.array([1, 2, 0]), 0.19).tolist() == [1, 2]
    assert suppress_overlaps(centres, np.array([1, 1, 1]), 0.1).tolist() == [0, 1, 2]
    assert suppress_overlaps(np.empty((0, 3)), np.empty(0), 0.2).tolist() == []
