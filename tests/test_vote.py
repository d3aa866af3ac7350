from dataclasses import replace

import naive_search
import naive_visibility
import naive_voxels
import numpy as np
import pytest
import scenes
from test_gate import random_cells
from votes import score_by_votes

from headvox.integral import integral_volume
from headvox.machine.simd import LANES
from headvox.masks.cascade import Stage
from headvox.masks.compile import compile_cascade
from headvox.masks.read import load_cascade, parse_cascade, shipped_cascades
from headvox.vote import DROPPED, score_by_stages, seen_boxes, statistics_of

SMALL = parse_cascade(scenes.STAGES, "small")
SMALL_VOTES = parse_cascade(scenes.VOTES, "small votes")


class MadeUp:
    """States of cells that no camera saw: a third empty, a third hidden."""

    def of(self, cell):
        return ("empty", "hidden", None)[(5 * cell[0] + 3 * cell[1] + cell[2] ** 2) % 3]


def some_cells(rng, shape, count):
    return np.column_stack([rng.integers(0, n, count) for n in shape]).astype(np.int32)


def volumes(cells, compiled):
    """Return the integral volume in every type that is wide enough."""
    narrow = cells.dtype == np.uint8 and compiled.largest_sum <= 0xFFFF
    return [integral_volume(cells, narrow=kind) for kind in ((False, True) if narrow else (False,))]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("voxel", [0.05, 0.04])
def test_votes_equal_the_naive_twin(seed, voxel):
    rng = np.random.default_rng(seed)
    grid = random_cells(rng, (13, 11, 9), 0.2, counting=True)
    cells = some_cells(rng, grid.shape, 80)
    compiled = compile_cascade(SMALL_VOTES, voxel)
    scores, yaws = score_by_votes(integral_volume(grid), cells, compiled.votes)
    wanted = [
        naive_search.score_by_votes(naive_voxels.weights(grid), cell, SMALL_VOTES.votes, voxel)
        for cell in cells
    ]
    assert scores.tolist() == [score for score, _ in wanted]
    assert yaws.tolist() == [yaw for _, yaw in wanted]
    assert len(set(yaws.tolist())) > 1


def test_too_few_votes_drop_a_candidate():
    votes = replace(SMALL_VOTES.votes, min_votes=2)
    cascade = replace(SMALL_VOTES, votes=votes)
    rng = np.random.default_rng(1)
    grid = random_cells(rng, (9, 9, 9), 0.1, counting=True)
    cells = some_cells(rng, grid.shape, 60)
    scores, _ = score_by_votes(integral_volume(grid), cells, compile_cascade(cascade).votes)
    wanted = [naive_search.score_by_votes(naive_voxels.weights(grid), cell, votes, 0.05)[0] for cell in cells]
    assert scores.tolist() == wanted
    assert 0 < (scores == DROPPED).sum() < 60


def test_votes_of_an_empty_volume_and_of_no_candidate():
    S = integral_volume(np.zeros((4, 4, 4), np.uint32))
    compiled = compile_cascade(replace(SMALL_VOTES, votes=replace(SMALL_VOTES.votes, min_votes=0)))
    assert score_by_votes(S, np.zeros((1, 3), np.int32), compiled.votes)[0].tolist() == [0]
    assert len(score_by_votes(S, np.zeros((0, 3), np.int32), compiled.votes)[0]) == 0


def test_mirrored_pairs_count_for_the_type_of_the_volume():
    pairs = max(
        naive_voxels.volume(naive_voxels.voxel_box(box, 0.05))
        for pair in SMALL_VOTES.votes.mirrored
        for box in pair
    )
    assert pairs == 12**3
    assert compile_cascade(SMALL_VOTES).largest_sum >= pairs


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("voxel", [0.05, 0.04])
@pytest.mark.parametrize("seeing", [False, True])
def test_stages_equal_the_naive_twin(seed, voxel, seeing):
    rng = np.random.default_rng(seed)
    grid = random_cells(rng, (13, 11, 9), 0.15)
    grid[3:6] = 0
    cells = some_cells(rng, grid.shape, 80)
    compiled = compile_cascade(SMALL, voxel)
    stages = compiled.judge if seeing else compiled.stages
    states = MadeUp() if seeing else None
    seen = None
    if seeing:
        boxes, _ = seen_boxes(stages)
        seen = np.array(
            [[naive_visibility.count_in(states, naive_voxels.about(c, b)) for b in boxes] for c in cells],
            np.int32,
        )
    amount = naive_voxels.weights(grid)
    wanted = [naive_search.score_by_stages(amount, cell, SMALL, voxel, states, seeing) for cell in cells]
    for S in volumes(grid, compiled):
        assert score_by_stages(S, cells, stages, seen).tolist() == wanted
    assert len(set(wanted)) > 2
    assert DROPPED in wanted


def random_tree(rng, features, depth):
    if depth == 0 or rng.random() < 0.2:
        return float(rng.normal())
    return (
        str(rng.choice(features)),
        float(rng.uniform(0, 0.4)),
        random_tree(rng, features, depth - 1),
        random_tree(rng, features, depth - 1),
    )


@pytest.mark.parametrize("seed", range(4))
def test_random_trees_equal_the_naive_twin(seed):
    rng = np.random.default_rng(seed)
    features = [f"near.{s}" for s in ("min", "low", "high", "max", "sum")] + [
        "core.sum",
        "unused.low",
        "free.max",
    ]
    stages = tuple(
        Stage(
            f"s{k}", float(rng.normal(-2.0)), tuple(random_tree(rng, features[: 6 + k], 5) for _ in range(6))
        )
        for k in range(3)
    )
    cascade = replace(SMALL, stages=stages)
    grid = random_cells(rng, (9, 9, 9), 0.3)
    cells = some_cells(rng, grid.shape, 40)
    compiled = compile_cascade(cascade)
    states = MadeUp()
    boxes, _ = seen_boxes(compiled.stages)
    seen = np.array(
        [[naive_visibility.count_in(states, naive_voxels.about(c, b)) for b in boxes] for c in cells],
        np.int32,
    )
    seen = seen.reshape(len(cells), -1, 2)
    S = integral_volume(grid)
    for known, states_known in ((seen, states), (None, None)):
        wanted = [
            naive_search.score_by_stages(naive_voxels.weights(grid), cell, cascade, 0.05, states_known)
            for cell in cells
        ]
        assert score_by_stages(S, cells, compiled.stages, known).tolist() == wanted


@pytest.mark.parametrize("count", [1, 3, 4, 5, 6, 7, 8, 33, 64])
@pytest.mark.parametrize("dtype", [np.int32, np.int64])
def test_statistics_are_those_of_the_sorted_sums(count, dtype):
    sums = np.random.default_rng(count).integers(0, 20, (64, LANES)).astype(dtype)
    features = np.full((7, LANES), -1, dtype)
    wanted = np.sort(sums[:count], axis=0)
    statistics_of(sums.reshape(-1), count, count > 1, features.reshape(-1), LANES)
    np.testing.assert_array_equal(features[5], wanted.sum(axis=0))
    if count > 1:
        np.testing.assert_array_equal(features[1:5], wanted[[0, 2, count - 3, count - 1]])
    assert (features[[0, 6]] == -1).all()


@pytest.mark.parametrize("keep", [0.4999, 0.5, 0.5001, -0.0001, 0.0])
def test_a_candidate_is_dropped_below_keep_and_not_at_it(keep):
    cascade = replace(SMALL, stages=(Stage("only", keep, (("core.sum", 0.5, 0.5, 0.0),)),))
    grid = np.zeros((4, 4, 4), np.uint8)
    cells = np.array([[1, 1, 1]], np.int32)
    score = score_by_stages(integral_volume(grid), cells, compile_cascade(cascade).stages)
    assert score.tolist() == [512 if keep <= 0.5 else DROPPED]
    grid[:] = 255
    cells[:] = 2
    score = score_by_stages(integral_volume(grid), cells, compile_cascade(cascade).stages)
    assert score.tolist() == [0 if keep <= 0.0 else DROPPED]
    assert score[0] == naive_search.score_by_stages(naive_voxels.weights(grid), cells[0], cascade, 0.05)


@pytest.mark.parametrize("name", shipped_cascades())
def test_shipped_cascades_equal_the_naive_twin(name):
    cascade = load_cascade(name)
    compiled = compile_cascade(cascade)
    rng = np.random.default_rng(7)
    grid = random_cells(rng, (15, 15, 15), 0.2, cascade.counting)
    cells = some_cells(rng, grid.shape, 12)
    amount = naive_voxels.weights(grid)
    for S in volumes(grid, compiled):
        if cascade.votes is not None:
            scores, yaws = score_by_votes(S, cells, compiled.votes)
            wanted = [
                naive_search.score_by_votes(amount, cell, cascade.votes, cascade.voxel_m) for cell in cells
            ]
            assert list(zip(scores.tolist(), yaws.tolist(), strict=True)) == wanted
        else:
            kept = replace(cascade, stages=tuple(replace(stage, keep=-1e6) for stage in cascade.stages))
            for version in (cascade, kept):  # the second so that the last stage is reached
                wanted = [
                    naive_search.score_by_stages(amount, cell, version, cascade.voxel_m) for cell in cells
                ]
                assert score_by_stages(S, cells, compile_cascade(version).stages).tolist() == wanted


def test_every_candidate_scores_alone_as_among_others():
    """No working memory is carried from candidate to candidate."""
    rng = np.random.default_rng(2)
    grid = random_cells(rng, (9, 9, 9), 0.2)
    cells = some_cells(rng, grid.shape, 30)
    stages = compile_cascade(SMALL).stages
    S = integral_volume(grid)
    together = score_by_stages(S, cells, stages)
    assert together.tolist() == [int(score_by_stages(S, cell[None], stages)[0]) for cell in cells]
