"""The search for cascades, on views that are made in a moment: heads are spheres on necks, the rest is boxes."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import product

import naive_voxels
import numpy as np
import pytest

from headvox.cli import main
from headvox.data import Cloud, DepthImage, Frame, Intrinsics
from headvox.errors import HeadvoxError
from headvox.evolve import again, bank, boost, gates, samples, search, views
from headvox.evolve import relief as last_look
from headvox.evolve.check import Outcome, check
from headvox.evolve.spoil import spoil
from headvox.evolve.write import Found, cascade_text, write_cascade
from headvox.frames import inverse, transform
from headvox.gate import pass_gate
from headvox.masks.cascade import cuts
from headvox.masks.compile import compile_cascade
from headvox.masks.read import load_cascade, parse_cascade
from headvox.synth.scene import TrueHead
from headvox.vote import DROPPED, score_by_stages

SMALL_SEARCH = (
    boost.Plan("glimpse", "single", 3, 4, 0.5, 0.01),
    boost.Plan("shape", "occupied", 3, 6, 0.3, 0.01),
)
SMALL_JUDGE = (
    boost.Plan("closer", "single", 3, 4, 0.5, 0.01),
    boost.Plan("detail", "occupied", 4, 8, 0.3, 0.01, costly=False),
    boost.Plan("sight", "seen", 2, 3, 0.3, 0.0, costly=False),
)


def easy_view(folder, seed: int, number: int) -> views.View:
    """A sphere on a cylinder, now and then two, and a box or three."""
    rng = np.random.default_rng([seed, number])
    parts, centres = [], []
    for k in range(int(rng.integers(0, 3))):
        centre = np.array([1.2 * k - 0.6, 0.0, 1.5]) + rng.uniform(-0.3, 0.3, 3)
        ball = rng.normal(size=(1500, 3))
        parts.append(centre + 0.1 * ball / np.linalg.norm(ball, axis=1, keepdims=True))
        angle, height = rng.uniform(0, 6.28, 2000), rng.uniform(-0.9, -0.18, 2000)
        parts.append(centre + np.column_stack([0.2 * np.cos(angle), 0.2 * np.sin(angle), height]))
        centres.append(centre)
    for _ in range(3):
        box = rng.uniform(-0.5, 0.5, (1500, 3))
        box[np.arange(1500), rng.integers(0, 3, 1500)] = rng.choice([-0.5, 0.5], 1500)
        parts.append(rng.uniform([-2, -2, 0], [2, 2, 1.5]) + box * rng.uniform(0.1, 1.0, 3))
    points = np.concatenate(parts).astype(np.float32)
    count = len(centres)
    heads = views.Heads(
        np.array(centres).reshape(-1, 3), np.ones(count), np.ones(count, bool), np.zeros(count, np.int64)
    )
    frame = Frame(0, depths=(seen(points),)) if number % 2 else Frame(0, clouds=(Cloud("made", points),))
    return views.View(number, frame, heads)


def seen(points: np.ndarray) -> DepthImage:
    """Points as a camera 2 m away sees them, the nearest in each pixel."""
    lens = Intrinsics(160, 120, 80.0, 80.0, 79.5, 59.5)
    T = np.array([[0.0, 0, 1, -2.0], [-1, 0, 0, 0], [0, -1, 0, 1.2], [0, 0, 0, 1]])
    x, y, z = transform(inverse(T), points.astype(np.float64)).T
    ahead = z > 0.2
    x, y, z = x[ahead], y[ahead], z[ahead]
    u = np.clip(np.round(lens.fx * x / z + lens.cx), 0, 159).astype(int)
    v = np.clip(np.round(lens.fy * y / z + lens.cy), 0, 119).astype(int)
    depth = np.full((120, 160), 65535, np.uint16)
    np.minimum.at(depth, (v, u), np.round(1000.0 * z).astype(np.uint16))
    return DepthImage("camera", np.where(depth == 65535, 0, depth).astype(np.uint16), lens, T)


@pytest.fixture(scope="module")
def real_view() -> views.View:
    return views.make_view(3, 9)


# ------------------------------------------------------------------------------------------------------------- views


def test_a_view_is_kept_on_disk_and_is_the_same_when_it_is_made_again(tmp_path, real_view):
    assert real_view.kind == "crowd"
    for _ in range(2):
        view = views.keep_view(tmp_path, 3, 9)
        assert view.number == 9
        for name in ("centres", "visible", "clear", "posture"):
            np.testing.assert_array_equal(getattr(view.heads, name), getattr(real_view.heads, name))
        assert len(view.frame.depths) == len(real_view.frame.depths) > 0
        for mine, made in zip(view.frame.depths, real_view.frame.depths, strict=True):
            np.testing.assert_array_equal(mine.depth, made.depth)
            np.testing.assert_array_equal(mine.T_world_camera, made.T_world_camera)
            assert mine.intrinsics == made.intrinsics
    assert [path.name for path in tmp_path.iterdir()] == ["000009.npz"]


def test_every_kind_of_view_can_be_made():
    first = {kind: views.KINDS.index(kind) for kind in views.KINDS}
    made = {kind: views.make_view(1, number) for kind, number in first.items()}
    assert not made["nobody"].heads.clear.any()  # a dummy may stand there
    assert made["bodies"].frame.clouds[0].T_world_sensor is None
    assert made["bodies"].heads.clear.all()
    shell, centre = made["shell"].frame.clouds[0].points, made["shell"].heads.centres[0]
    assert len(shell) == views.SHELL_POINTS
    assert np.abs((shell.min(axis=0) + shell.max(axis=0)) / 2 - centre).max() < 0.05
    assert made["ordinary"].frame.depths


# ----------------------------------------------------------------------------------------------------------- features


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


# --------------------------------------------------------------------------------------------------------------- gate


def made_up_sums() -> samples.GateSums:
    """Heads about one place in the space of the gate's sums, everything else all over it."""
    rng = np.random.default_rng(2)
    count = len(bank.GATE.groups)
    heads = rng.normal(60, 10, (2000, count)).round().astype(np.int32)
    others = rng.integers(2, 300, (4000, count)).astype(np.int32)
    return samples.GateSums(
        np.concatenate([heads, others]), np.concatenate([np.arange(2000) // 2, np.full(4000, -1)])
    )


def test_the_gate_keeps_the_heads_and_little_else(monkeypatch):
    monkeypatch.setattr(gates, "GENERATIONS", 60)
    sums = made_up_sums()
    limits = gates.find_limits(sums, 0.01, seed=0)
    heads, others = gates.report(limits, sums)
    assert heads >= 0.985
    assert others < 0.05
    assert (limits == gates.find_limits(sums, 0.01, seed=0)).all()


def test_conditions_pass_just_what_the_limits_pass():
    sums = made_up_sums()
    limits = np.array([[10, 200]] * len(bank.GATE.groups))
    gate = search._compile_gate(gates.as_conditions(limits, sums))
    assert len(gate.low) == len(bank.GATE.groups)
    order = [bank.GATE.groups.index(c.group) for c in gates.as_conditions(limits, sums)]
    assert order[0] == 0  # the crown bounds where a candidate can be
    assert gate.low.tolist()[0] == 10
    others = sums.sums[sums.bag < 0]
    passed = ((others[:, order] >= gate.low) & (others[:, order] <= gate.high)).all(axis=1)
    assert passed.sum() == ((others >= 10) & (others <= 200)).all(axis=1).sum()


# ----------------------------------------------------------------------------------------------------------- boosting


def samples_of(score, label, bag) -> tuple[samples.Samples, np.ndarray]:
    count = len(score)
    empty = np.zeros((count, 0), np.int16)
    made = samples.Samples(
        empty, empty, np.array(label, np.int8), np.array(bag), np.zeros(count, np.int64), np.ones(count, bool)
    )
    return made, np.array(score, float)


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


@pytest.fixture(scope="module")
def evolved(tmp_path_factory):
    """A whole search on easy views."""
    folder = tmp_path_factory.mktemp("evolve")
    patch = pytest.MonkeyPatch()
    patch.setattr(search, "keep_view", easy_view)
    patch.setattr(gates, "GENERATIONS", 40)
    patch.setattr(boost, "SEARCH", SMALL_SEARCH)
    patch.setattr(boost, "JUDGE", SMALL_JUDGE)
    said: list[str] = []
    patch.setattr(samples, "RANGE_M", 2.8)
    try:
        found = search.evolve(search.Settings(folder, 200, "easy", rounds=2), said.append)
    finally:
        patch.undo()
    return folder, found, said


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


# ------------------------------------------------------------------------------------------------------ the last stage


def test_a_spoilt_view_is_the_same_view_from_a_worse_sensor(real_view):
    lost = []
    for seed in range(12):
        spoilt = spoil(real_view, np.random.default_rng(seed))
        same = spoil(real_view, np.random.default_rng(seed))
        lost.append(0)
        for was, now, again_ in zip(
            real_view.frame.depths, spoilt.frame.depths, same.frame.depths, strict=True
        ):
            np.testing.assert_array_equal(now.depth, again_.depth)
            kept = now.depth > 0
            np.testing.assert_array_equal(now.depth[kept], was.depth[kept])
            lost[-1] += int((was.depth > 0).sum() - kept.sum())
            np.testing.assert_allclose(
                transform(inverse(now.T_world_camera), spoilt.heads.centres),
                transform(inverse(was.T_world_camera), real_view.heads.centres),
                atol=1e-9,
            )
            np.testing.assert_allclose(now.T_world_camera[2, :3], was.T_world_camera[2, :3], atol=1e-9)
    assert min(lost) == 0 < max(lost)


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


def test_the_last_stage_is_single_cuts_over_what_was_asked_before(evolved, monkeypatch):
    folder, found, _ = evolved
    monkeypatch.setattr(search, "keep_view", easy_view)
    monkeypatch.setattr(search, "spoilt_peaks", doubtful_peaks)
    monkeypatch.setattr(again, "LEAST_ROWS", 5)
    monkeypatch.setattr(samples, "RANGE_M", 2.8)
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


def test_the_last_stage_needs_heads_and_others():
    made, score = samples_of([1.0, 2.0], [1, 1], [16, 32])
    assert again.fit_again(again.Peaks(made, score), ["cube5"], seed=0) is None


# ---------------------------------------------------------------------------------------------------------- the border


def test_thresholds_leave_no_more_false_heads_than_allowed():
    outcome = Outcome(np.array([3.0, 1.0, -np.inf]), np.array([0.5, 2.004, 2.0]), 100)
    assert outcome.threshold(0.02) == 0.51
    assert outcome.threshold(0.0) == 2.01
    assert (outcome.false >= outcome.threshold(0.0)).sum() == 0
    assert outcome.recall(1.0) == pytest.approx(2 / 3)
    assert Outcome(np.empty(0), np.empty(0), 10).threshold(0.02) < -7


def test_a_folder_of_another_seed_is_not_mixed(tmp_path):
    (tmp_path / "search.json").write_text(json.dumps({"format": "headvox-search", "version": 1, "seed": 4}))
    with pytest.raises(HeadvoxError, match="another seed"):
        search.evolve(search.Settings(tmp_path, 200, seed=5), print)


def test_bad_commands_end_before_any_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["masks", "evolve", "--views", "20"]) == 1
    assert "--views: expected at least 200" in capsys.readouterr().err
    (tmp_path / "evolved.toml").write_text("mine")
    assert main(["masks", "evolve"]) == 1
    assert "exists already" in capsys.readouterr().err
    assert (tmp_path / "evolved.toml").read_text() == "mine"
    assert main(["masks", "evolve", "--seed", "-1"]) == 2


def test_a_camera_whose_image_is_cut_off_before_a_head_does_not_see_it() -> None:
    camera = Intrinsics(4, 4, 4.0, 4.0, 1.5, 1.5, 0.001)
    images = [
        DepthImage(name, np.full((4, 4), 3000, np.uint16), camera, np.eye(4)) for name in ("near", "far")
    ]
    seen_by, upright = {"near": 0.9, "far": 0.5}, np.array([0.0, 0.0, 0.0, 1.0])
    truth = [
        TrueHead(k, np.array([0.0, 0.0, z]), upright, "standing", seen_by, False, False)
        for k, z in enumerate((2.0, 3.0, 4.5))
    ]
    heads = views._heads_of(truth, images, {"near": 2.5, "far": 4.0})
    assert heads.visible.tolist() == [0.9, 0.5, 0.0]
    assert heads.clear.tolist() == [True, True, False]


def test_the_last_look_is_fitted_to_spoilt_views_and_written(evolved, monkeypatch):
    folder, found, _ = evolved
    monkeypatch.setattr(search, "keep_view", easy_view)
    monkeypatch.setattr(search, "spoilt_looks", doubtful_looks)
    monkeypatch.setattr(last_look, "LEAST_ROWS", 5)
    monkeypatch.setattr(samples, "RANGE_M", 2.8)
    said: list[str] = []
    more = search._with_last_look(search.Settings(folder, 200, "easy"), found, said.append)
    assert said[-1].startswith("looked again: ")
    blunt, sharp = (load_cascade(str(folder / name)) for name in ("blunt.toml", "sharp.toml"))
    assert blunt.relief is None
    assert sharp.judge == blunt.judge
    assert sharp.relief is not None
    assert sharp.relief == more.relief
    assert 0 < len(sharp.relief.spots) <= last_look.MOST_SPOTS
    assert len(sharp.relief.trees) == last_look.TREES
    asked = {name.rpartition(".")[0] for tree in sharp.relief.trees for name, _ in cuts(tree)}
    assert asked == {spot.name for spot in sharp.relief.spots}


def test_nothing_to_tell_apart_gives_no_last_look():
    same = last_look.Looks(
        np.zeros((9, 2 * len(last_look.SPOTS)), np.int16), np.ones(9, np.int8), np.zeros(9)
    )
    assert last_look.fit_relief(same, 0) is None
    different = replace(same, label=np.arange(9, dtype=np.int8) % 2)
    assert last_look.fit_relief(different, 0) is None  # of what is seen alike
