"""Trees in numbers of 64 bits say what the trees say."""

import numpy as np
import pytest

from headvox.masks.forest import GREATEST, plant, sum_of_leaves

MEASURES = 65_535


def leaf_of(tree, measured):
    while isinstance(tree, tuple):
        name, cut, at_most, above = tree
        tree = at_most if measured[int(name)] <= cut else above
    return round(1024 * tree)


def random_tree(rng, depth, cuts):
    if depth == 0 or rng.random() < 0.2:
        return float(rng.integers(-3000, 3000)) / 1024
    name = str(rng.choice([0, 1, 7, MEASURES - 1]))
    return (
        name,
        int(rng.choice(cuts)),
        random_tree(rng, depth - 1, cuts),
        random_tree(rng, depth - 1, cuts),
    )


@pytest.mark.parametrize("depth", [0, 1, 3, 9])
def test_equals_the_trees_at_every_cut_and_beyond_what_16_bits_hold(depth):
    rng = np.random.default_rng(depth)
    cuts = [-1_000_000, -32_769, -32_768, -32_000, -1, 0, 1, 601, 31_999, 32_000, 32_767, 32_768, 1_000_000]
    trees = [random_tree(rng, depth, cuts) for _ in range(70)]
    forest = plant(trees, lambda name, cut: (int(name), int(cut)), lambda leaf: round(1024 * leaf))
    assert forest.deepest <= depth
    said = set()
    for _ in range(40):
        measured = np.zeros(MEASURES, np.int64)
        measured[[0, 1, 7, -1]] = rng.choice([-32_000, -31_999, -1, 0, 1, 2, 600, 601, 31_999, 32_000], 4)
        wanted = sum(leaf_of(tree, measured) for tree in trees)
        assert sum_of_leaves(measured, *forest, np.empty_like(forest.roots)) == wanted
        said.add(wanted)
    assert depth == 0 or len(said) > 10
    assert measured.max() < GREATEST


def test_no_trees_say_nothing():
    forest = plant([], lambda name, cut: (0, 0), round)
    assert sum_of_leaves(np.zeros(1, np.int64), *forest, np.empty_like(forest.roots)) == 0
