"""Stages of boosted trees: those of the search and those that judge what it found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from easy_search import SMALL_SEARCH, easy_view, samples_of

from headvox.evolve import boost, samples, search
from headvox.evolve.check import check
from headvox.evolve.write import Found, cascade_text, write_cascade
from headvox.gate import pass_gate
from headvox.masks.compile import compile_cascade
from headvox.masks.read import load_cascade, parse_cascade
from headvox.vote import DROPPED, score_by_stages


def test_a_head_scores_as_its_best_voxel_does():
    made, score = samples_of([1.0, 3.0, 2.0, 9.0], [1, 1, 1, 0], [16, 16, 32, -1])
    bags, best = samples.of_bags(made, score, np.ones(4, bool))
    assert (bags.tolist(), best.tolist()) == ([16, 32], [3.0, 2.0])
    assert boost.quantile_of_heads(made, score, np.ones(4, bool), 0.0) == 2.0


def test_pruning_raises_a_stage_to_what_accepted_heads_need():
    made, score = samples_of([1.0, 5.0, 4.0], [1, 1, 1], [16, 32, 48])
    stage = boost.Fitted(SMALL_SEARCH[0], 0.5, None, [], score)
    boost.prune([stage], made, np.array([False, True, True]), 0.0)
    assert stage.keep == 4.0


def test_a_search_finds_easy_heads_and_tells_how_it_goes(evolved):
    folder, found, said = evolved
    path = folder / "easy.toml"
    write_cascade(path, "easy", found)
    unseen = [easy_view(None, 77, number) for number in range(30)]
    outcome = check(path, unseen)
    assert len(outcome.heads) > 20
    assert outcome.recall(outcome.threshold(0.1)) > 0.8
    assert any("heads kept aside" in line for line in said)
    assert any(line.startswith("glimpse") for line in said)
    assert load_cascade(str(path)).tuned_on[0].startswith("boosting: synthetic views 0-199 of seed 0")


def test_the_same_samples_and_seed_give_the_same_file(evolved, monkeypatch):
    monkeypatch.setattr(samples, "RANGE_M", 2.8)
    _, found, _ = evolved
    gate = search._compile_gate(found.gate)
    parts = [samples.search_samples(easy_view(None, 0, number), gate, None) for number in range(12)]
    joined = samples.join(part for part in parts if part is not None)
    texts = set()
    for seed in (0, 0, 1):
        fitted = boost.boost(joined, SMALL_SEARCH, seed, lambda text: None)
        texts.add(cascade_text("easy", Found(found.gate, fitted)))
    assert len(texts) == 2


def test_the_file_scores_as_the_models_do(evolved):
    """What the detector reads is what was fitted, up to the rounding of each leaf."""
    _, found, _ = evolved
    stages = [replace(stage, keep=-1e3) for stage in found.search]
    compiled = compile_cascade(
        parse_cascade(cascade_text("easy", replace(found, search=stages, judge=())), "easy")
    )
    grid = samples.Grid.of(easy_view(None, 5, 1).frame)
    cells = pass_gate(grid.S, replace(compiled.gate, spacing=1))[:300]
    features = grid.occupied(cells)
    wanted = np.zeros(len(cells))
    for stage in stages:
        columns = [boost.NAMES.index(name) for name in stage.names]
        wanted += stage.model.predict(features[:, columns].astype(np.float32), raw_score=True)
    scores = score_by_stages(grid.S, cells, compiled.stages)
    trees = sum(stage.plan.trees for stage in stages)
    assert len(np.unique(scores)) > 5
    assert (scores > DROPPED).all()
    np.testing.assert_allclose(scores / 1024.0, wanted, atol=trees * 0.0011)
