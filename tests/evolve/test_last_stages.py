"""What is fitted after the search: the last stage and the last look, on spoilt views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from easy_search import easy_view, samples_of

from headvox.evolve import again, samples, search, views
from headvox.evolve import relief as last_look
from headvox.masks.cascade import MEASURES, cuts
from headvox.masks.read import load_cascade


def doubtful_peaks(view: views.View, cascade) -> again.Peaks | None:
    """The peaks of an easy view, of which those of every third are said to be no heads: else all of them are."""
    peaks = again.spoilt_peaks(view, cascade)
    if peaks is None or view.number % 3:
        return peaks
    return replace(peaks, samples=replace(peaks.samples, label=0 * peaks.samples.label))


def doubtful_looks(view: views.View, cascade) -> last_look.Looks | None:
    """As :func:`doubtful_peaks`."""
    looks = last_look.spoilt_looks(view, cascade)
    return looks if looks is None or view.number % 3 else replace(looks, label=0 * looks.label)


def test_heads_that_the_border_cuts_are_heads_to_the_last_stage_and_dummies_neither():
    far_apart = np.array([[0.0, 0, 1.5], [1, 0, 1.5], [2, 0, 1.5], [3, 0, 1.5]])
    clear, visible = np.array([True, False, False, False]), np.array([0.9, 0.6, 0.9, 0.1])
    posture = np.array([0, 0, len(views.POSTURES), 0])  # whole, cut, a dummy, hardly seen
    view = easy_view(None, 0, 1)
    view = replace(view, heads=views.Heads(far_apart, visible, clear, posture))
    found = (far_apart[None] + np.array([0.0, 0.2, 0.5])[:, None, None] * [1, 0, 0]).reshape(-1, 3)
    label, bag = again.label_places(view, found)
    assert label.tolist() == [1, 1, -1, -1] + [-1] * 4 + [0] * 4
    assert bag.tolist() == [100, 101] + [-1] * 10


@pytest.fixture
def on_easy_views(monkeypatch):
    monkeypatch.setattr(search, "keep_view", easy_view)
    monkeypatch.setattr(search, "spoilt_peaks", doubtful_peaks)
    monkeypatch.setattr(search, "spoilt_looks", doubtful_looks)
    monkeypatch.setattr(again, "LEAST_ROWS", 5)
    monkeypatch.setattr(last_look, "LEAST_ROWS", 5)
    monkeypatch.setattr(samples, "RANGE_M", 2.8)


@pytest.mark.usefixtures("on_easy_views")
def test_the_last_stage_is_single_cuts_over_what_was_asked_before(evolved):
    folder, found, _ = evolved
    said: list[str] = []
    more = search._with_second_opinion(search.Settings(folder, 200, "easy"), found, said.append)
    assert said[-1].startswith("asked again: ")
    once, twice = (load_cascade(str(folder / name)) for name in ("once.toml", "twice.toml"))
    assert twice.groups == once.groups
    assert twice.judge[:-1] == once.judge
    last = twice.judge[-1]
    assert last.name == more.judge[-1].plan.name == again.PLAN.name
    assert 0 < len(last.trees) <= again.PLAN.trees
    cuts = [tree for tree in last.trees if isinstance(tree, tuple)]  # the others are constants
    assert cuts
    assert all(isinstance(leaf, float) for cut in cuts for leaf in cut[2:])


def test_the_last_stage_needs_heads_and_others():
    made, score = samples_of([1.0, 2.0], [1, 1], [16, 32])
    assert again.fit_again(again.Peaks(made, score), ["cube5"], seed=0) is None


@pytest.mark.usefixtures("on_easy_views")
def test_the_last_look_is_fitted_to_spoilt_views_and_written(evolved):
    folder, found, _ = evolved
    found = replace(found, relief=None, verification=None)
    said: list[str] = []
    more = search._with_last_look(search.Settings(folder, 200, "easy"), found, said.append)
    assert said[-1].startswith("looked again: ")
    blunt, sharp = (load_cascade(str(folder / name)) for name in ("blunt.toml", "sharp.toml"))
    assert blunt.relief is None
    assert sharp.judge == blunt.judge
    kept = [stage.keep for stage in (*found.search, *found.judge)]
    patient = [stage.keep for stage in (*more.search, *more.judge)]
    waits = [stage > search.HASTY for stage in range(1, len(kept) + 1)]
    assert patient == pytest.approx(np.array(kept) - np.where(waits, search.PATIENCE, 0.0))
    assert any(waits)
    assert sharp.relief is not None
    assert sharp.relief.first == last_look.FIRST
    assert 0.0 <= sharp.relief.reach < last_look.MOST
    assert sharp.relief == more.relief
    assert 0 < len(sharp.relief.spots) <= last_look.MOST_SPOTS
    assert len(sharp.relief.trees) == last_look.TREES
    asked = {name for tree in sharp.relief.trees for name, _ in cuts(tree)}
    assert asked & set(MEASURES)
    assert {name.rpartition(".")[0] for name in asked - set(MEASURES)} == {
        spot.name for spot in sharp.relief.spots
    }


def test_nothing_to_tell_apart_gives_no_last_look():
    features = 2 * len(last_look.SPOTS) + len(MEASURES)
    same = last_look.Looks(
        np.zeros((9, features), np.int16), np.ones(9, np.int8), np.zeros(9), np.zeros(9, bool)
    )
    assert last_look.fit_relief(same, 0) is None
    different = replace(same, label=np.arange(9, dtype=np.int8) % 2)
    assert last_look.fit_relief(different, 0) is None  # of what is seen alike


class Steps:
    """A model whose first trees say what the first column holds, in tenths, and all of them what the second does."""

    def predict(self, features, num_iteration, raw_score):
        assert raw_score
        return features[:, 0 if num_iteration == last_look.FIRST else 1] / 10.0


def test_the_reach_is_what_nearly_every_head_lacks_after_the_first_trees():
    relief = np.zeros((4, 3), np.int16)
    relief[:, 1:] = [[-5, 10], [-12, 10], [-40, -20], [-99, 49]]  # the third is no head in the end either
    heads = last_look.Looks(relief, np.ones(4, np.int8), np.array([0.0, 0.5, 0.0, 0.0]), np.ones(4, bool))
    columns = np.array([1, 2])
    assert last_look._reach(Steps(), columns, heads.of(np.arange(4) < 3)) == pytest.approx(0.7, abs=0.011)
    assert last_look._reach(Steps(), columns, heads) == pytest.approx(
        last_look.MOST, abs=0.02
    )  # no tree says more
    assert last_look._reach(Steps(), columns, heads.of(np.zeros(4, bool))) == np.inf
