"""What is asked about a voxel of a view, and what it counts as."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import naive_voxels
import numpy as np

from headvox.evolve import bank, samples, views
from headvox.masks.compile import compile_cascade
from headvox.masks.read import load_cascade


def test_features_are_the_sorted_sums_of_the_naive_twin():
    rng = np.random.default_rng(0)
    cells = (rng.random((24, 24, 24)) < 0.2) * rng.integers(0, 256, (24, 24, 24))
    amount = naive_voxels.weights(cells.astype(np.uint8))
    S = naive_voxels.integral_volume(amount)
    where = np.array([[12, 12, 12], [3, 20, 8], [0, 0, 0], [23, 23, 23]], np.int32)
    found = bank.OCCUPIED.features(bank.sums_about(S, where, bank.OCCUPIED.boxes))
    for row, cell in zip(found, where, strict=True):
        wanted = []
        for group in bank.OCCUPIED.groups:
            sums = sorted(
                naive_voxels.box_sum(
                    amount, naive_voxels.about(cell, naive_voxels.voxel_box(box, bank.VOXEL_M))
                )
                for box in group.boxes
            )
            wanted += [sums[0], sums[2], sums[-3], sums[-1]] if len(sums) > 1 else []
            wanted.append(sum(sums))
        assert row.tolist() == wanted


def test_every_fourth_voxel_is_one_of_four_lattices_that_leave_no_place_far():
    cells = np.array(list(product(range(6), repeat=3)), np.int32)
    which = samples.coset_of(cells)
    assert np.bincount(which).tolist() == [len(cells) // 4] * 4
    rng = np.random.default_rng(1)
    places = rng.uniform(2, 3, (500, 3))
    for lattice in range(4):
        away = np.linalg.norm(places[:, None] - (cells[which == lattice] + 0.5), axis=2).min(axis=1)
        assert away.max() * bank.VOXEL_M <= samples.SEARCH_NEAR_M
    assert away.max() * bank.VOXEL_M > 0.9 * samples.SEARCH_NEAR_M


def test_heads_give_bags_and_what_is_near_them_is_neither(real_view):
    gate = compile_cascade(load_cascade("default")).gate
    found = samples.search_samples(real_view, replace(gate, spacing=1), None)
    assert found is not None
    wanted = np.flatnonzero(samples.to_find(real_view))
    assert set(np.unique(found.bag[found.label == 1] // 16)) <= {900 + k for k in wanted}
    assert set(np.unique(found.label)) <= {0, 1}
    assert (found.bag[found.label == 0] == -1).all()
    assert (found.label == 0).sum() <= samples.HARD


def test_views_of_every_kind_are_kept_aside():
    numbers = np.arange(2000)
    kinds = {views.KINDS[n % len(views.KINDS)] for n in numbers[samples.is_aside(numbers)]}
    assert kinds == set(views.KINDS)
    assert samples.is_aside(numbers).sum() == 200
