"""The search on a GPU, or in Numba's simulator of one: test_cuda.py runs this file in a process of its own.

Every kernel equals the CPU's loops, which equal the slow twins (naive*.py), bit for bit.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
from gpu_arrays import (
    REGION,
    STAGES,
    VOTES,
    cloud_of,
    counts_with,
    on,
    places_of,
    random_parts,
    to_device,
    volume_of,
    words_for,
    zeros,
)
from numba import cuda
from votes import score_by_votes

from headvox import Cloud, DepthImage, Frame, Intrinsics
from headvox.cuda import (
    compact,
    gate,
    integral,
    judge,
    readings,
    search,
    suppress,
    vote,
    voxelize,
)
from headvox.gate import gate_tables, pass_gate
from headvox.integral import integral_volume
from headvox.lattice import Lattice
from headvox.masks.compile import compile_cascade
from headvox.masks.read import load_cascade, parse_cascade
from headvox.suppress import suppress as suppress_on_cpu
from headvox.visibility import EMPTY, HIDDEN, cells_of, count_seen, not_seen
from headvox.vote import DROPPED, score_by_stages, seen_boxes
from headvox.voxelize import Rays, voxelize_depth, voxelize_points

# The simulator computes as NumPy's scalars do, which tell of what the hardware does silently.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore:Grid size")


# ------------------------------------------------------------------------------------------------------------- voxels


def grids_on_device(frames, lattice, counting):
    """Return the grid of each frame, as the CPU has it."""
    asked = [readings.Asked(frame, lattice, False, 0) for frame in frames]
    words = words_for(asked)
    rows = np.zeros((len(frames), words), np.int32)
    for one, row in zip(asked, rows, strict=True):
        readings.pack(one, lambda image, lattice: Rays.of(image, lattice), row)
    count = math.prod(lattice.shape)
    cells = zeros(len(frames), count if counting else -(-count // 4))
    whole = cuda.to_device(rows)
    real, half = whole.view(np.float32), whole.view(np.uint16)
    sensors = max(len(frame.clouds) + len(frame.depths) for frame in frames)
    voxelize.mark[on(len(frames), sensors)](
        whole, real, real.reshape(len(frames), words // 4, 4), half, lattice.shape, lattice.subdivision - 1, counting,
        cells,
    )  # fmt: skip
    grids = cells.copy_to_host()
    return [(grid if counting else grid.view(np.uint8)[:count]).reshape(lattice.shape) for grid in grids]


def grid_on_cpu(frame, lattice, counting):
    parts = [voxelize_points(cloud, lattice, counting) for cloud in frame.clouds]
    parts += [voxelize_depth(image, lattice, counting) for image in frame.depths]
    return np.add.reduce(parts) if counting else np.bitwise_or.reduce(parts)


def hard_frames(rng):
    lattice = Lattice.over(REGION, 0.05, 2)
    edges = np.array([(k - 8) * 0.025 for k in range(16)], np.float32)
    limit = np.nextafter(np.float32(0.3), np.float32([0, 1]))
    return {
        "one point": cloud_of([0.01, 0.02, 0.03]),
        "no number": cloud_of([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf]]),
        "on borders": cloud_of(np.stack(np.meshgrid(edges[::3], edges[::3], edges[::5]), -1)),
        "on the limits": cloud_of(
            [[v, 0, 0] for v in limit] + [[0, -v, 0] for v in limit] + [[0, 0, -0.2], [0, 0, 0.2]]
        ),
        "below zero": cloud_of(rng.uniform(-0.3, 0.0, (60, 3))),
        "all in a cell": cloud_of(rng.uniform(0.001, 0.049, (80, 3))),
        "messy": Frame(0, clouds=(*scenes.clouds(rng)[:2],)),
        "far away": cloud_of([[3e38, 3e38, 3e38], [-1e30, 0, 0], [0.1, 0.1, 0.1]]),
        "at the corner": cloud_of(np.array(lattice.origin)),
    }  # fmt: skip


@pytest.mark.parametrize(("subdivision", "counting"), [(2, False), (1, False), (1, True)])
def test_points_fill_the_same_cells(subdivision, counting):
    frames = list(hard_frames(np.random.default_rng(0)).values())
    lattice = Lattice.over(REGION, 0.05, subdivision)
    filled = 0
    for frame, grid in zip(frames, grids_on_device(frames, lattice, counting), strict=True):
        wanted = grid_on_cpu(frame, lattice, counting)
        np.testing.assert_array_equal(grid, wanted)
        filled += np.count_nonzero(wanted)
    assert filled > 150


@pytest.mark.parametrize("counting", [False, True])
def test_depth_images_and_clouds_fill_the_same_cells(counting):
    rng = np.random.default_rng(1)
    camera = Intrinsics(21, 15, 12.0, 12.5, 9.7, 7.1, 0.0005)
    T = scenes.pose(rng)
    images = [
        DepthImage("c", rng.integers(0, 1200, (15, 21)).astype(np.uint16), camera, pose)
        for pose in (T, scenes.looking_along_x(-0.4, 0.0, 0.0))
    ]
    images[0].depth[3:5] = 0
    images[0].depth[6] = 65535
    frames = [
        Frame(0, depths=tuple(images)),
        Frame(0, depths=(images[1],)),
        Frame(0, clouds=(Cloud("w", scenes.messy_cloud(rng, 60, 0.3), T),), depths=(images[0],)),
    ]
    lattice = Lattice.over(REGION, 0.05, 1 if counting else 2)
    for frame, grid in zip(frames, grids_on_device(frames, lattice, counting), strict=True):
        wanted = grid_on_cpu(frame, lattice, counting)
        np.testing.assert_array_equal(grid, wanted)
        assert np.count_nonzero(wanted) > 20


# ---------------------------------------------------------------------------------------------------- sums and gate


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 3, 7), (4, 6, 2)])
@pytest.mark.parametrize("counting", [False, True])
def test_integral_volumes_are_equal(shape, counting):
    rng = np.random.default_rng(2)
    grids = [random_parts(rng, shape, share) for share in (0.5, 0.0, 1.0)]
    if counting:
        grids = [rng.integers(0, 1000, shape).astype(np.uint32) for _ in grids]
    size = math.prod(shape)
    words = np.zeros((3, size if counting else -(-size // 4)), np.uint32)
    for row, grid in zip(words, grids, strict=True):
        row.view(grid.dtype)[:size] = grid.reshape(-1)
    S = zeros(3, *(n + 1 for n in shape))
    integral.sum_along_z[on(3)](cuda.to_device(words), counting, S)
    integral.sum_along[on(3)](S)
    integral.sum_along[on(3)](S.reshape(3, 1, shape[0] + 1, (shape[1] + 1) * (shape[2] + 1)))
    for got, grid in zip(S.copy_to_host(), grids, strict=True):
        np.testing.assert_array_equal(got, integral_volume(grid))


@pytest.mark.parametrize("spacing", ["all", "every other", "every fourth"])
@pytest.mark.parametrize("odd", [(0, 0, 0), (1, 0, 1)])
def test_the_same_voxels_pass_the_gate(spacing, odd):
    text = scenes.STAGES.replace("min_score =", f'candidates = "{spacing}"\nmin_score =', 1)
    compiled = compile_cascade(parse_cascade(text, "test"))
    shape = (8, 7, 6)
    cells = random_parts(np.random.default_rng(3), shape, 0.06)
    passed = gated(cells, compiled.gate, odd)
    wanted = pass_gate(integral_volume(cells), compiled.gate, odd)
    np.testing.assert_array_equal(np.sort(passed), places_of(wanted, shape)[0])
    assert 0 < len(wanted) < cells.size / 2


def gated(cells, compiled, odd=(0, 0, 0)):
    """Return the places that pass on the device."""
    whole = np.zeros((1, readings.HEADER), np.int32)
    whole[0, readings.ODD : readings.ODD + 3] = odd
    weights, spans, rank, limits = gate_tables(compiled, np.dtype(np.uint32))
    tables = to_device(compiled.boxes, weights, spans, rank, limits)
    passed = zeros(1, -(-math.prod(n + 2 for n in cells.shape) // 32))
    gate.gate[on()](volume_of(cells), cuda.to_device(whole), *tables, compiled.spacing, passed)
    return np.flatnonzero(np.unpackbits(passed.copy_to_host().view(np.uint8), bitorder="little"))


def test_the_gate_of_counts_and_of_an_empty_grid():
    compiled = compile_cascade(VOTES).gate
    rng = np.random.default_rng(4)
    cells = rng.integers(0, 9, (7, 6, 5)).astype(np.uint32)
    wanted = pass_gate(integral_volume(cells), compiled)
    np.testing.assert_array_equal(gated(cells, compiled), places_of(wanted, cells.shape)[0])
    assert len(wanted) > 0
    assert len(gated(np.zeros((3, 3, 3), np.uint32), compiled)) == 0


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 1.0])
def test_lists_are_in_order_and_whole(share):
    rng = np.random.default_rng(5)
    for words, room, shares in ((1, 40, 7), (23, 800, 7), (23, 9, 5), (64, 2100, 64)):
        bits = np.packbits(rng.random((2, 32 * words)) < share, axis=1, bitorder="little").view(np.uint32)
        device, counts, listed = (
            cuda.to_device(bits),
            zeros(2, shares, dtype=np.int32),
            zeros(2, room, dtype=np.int32),
        )
        total = counts_with(0, 0, frames=2)
        compact.count_bits[on(2)](device, counts)
        compact.add_up[(1, 2), search.ONE_BLOCK_THREADS](counts, total, suppress.MAXIMA)
        compact.list_bits[on(2)](device, counts, listed)
        for row, found, number in zip(bits, listed.copy_to_host(), total.copy_to_host(), strict=True):
            wanted = np.flatnonzero(np.unpackbits(row.view(np.uint8), bitorder="little"))
            assert number[suppress.MAXIMA] == len(wanted)
            np.testing.assert_array_equal(found[: len(wanted)], wanted[:room])


# -------------------------------------------------------------------------------------------------------------- votes


def some_cells(rng, shape, count):
    """Return cells (N, 3), many at the edges, where boxes reach beyond."""
    cells = np.argwhere(np.ones(shape))
    corner = cells[(cells == 0).all(axis=1)]
    return np.unique(np.concatenate([corner, rng.choice(cells, count)]), axis=0).astype(np.int32)


def scores_on_device(cells, places, stages, seen, steps=((0, 0, 0),), asked=None):
    """Return the scores of all stages, or of those that see nothing, of the voxels ``steps`` from each place.

    Of those that are not ``asked``, seven is left.
    """
    shape, several = cells.shape, len(places[0]) * len(steps)
    along = np.array([(shape[1] + 2) * (shape[2] + 2), shape[2] + 2, 1])
    sizes = vote.Sizes.of(stages)
    table = tuple(to_device(*vote.stages_table(stages)))
    whole = np.zeros((1, readings.HEADER), np.int32)
    whole[0, readings.SEES] = seen is not None
    looked = np.zeros((1, 1, 1, 2), np.int32) if seen is None else seen[None]
    asked = np.full(several, True) if asked is None else asked
    scores = cuda.to_device(np.full((1, several), 7))
    vote.vote_stages[(2, 1), search.THREADS](
        volume_of(cells), *to_device(whole, places, (np.array(steps) @ along).astype(np.int32)),
        counts_with(0, len(places[0])), 0, table, *to_device(looked, asked[None]), seen is not None,
        stages.occupied_stages if seen is None else len(stages.stage_keep),
        zeros(2, sizes.boxes, dtype=np.int64), zeros(2, sizes.features, dtype=np.int64), scores,
    )  # fmt: skip
    return scores.copy_to_host()[0]


@pytest.mark.parametrize("seeing", [False, True])
def test_stages_score_alike(seeing):
    rng = np.random.default_rng(6)
    grid = random_parts(rng, (9, 8, 7))
    grid[2:5] = 0
    cells = some_cells(rng, grid.shape, 40)
    compiled = compile_cascade(STAGES)
    stages = compiled.judge if seeing else compiled.stages
    seen = None
    if seeing:
        seen = rng.integers(0, 12, (len(cells), len(seen_boxes(stages)[0]), 2)).astype(np.int32)
    wanted = score_by_stages(integral_volume(grid), cells, stages, seen)
    got = scores_on_device(grid, places_of(cells, grid.shape), stages, seen)
    np.testing.assert_array_equal(got, wanted)
    assert DROPPED in wanted
    assert len(set(wanted.tolist())) > 2


def test_the_shipped_stages_score_alike():
    compiled = compile_cascade(load_cascade("default"))
    rng = np.random.default_rng(7)
    grid = random_parts(rng, (9, 9, 9), 0.3)
    cells = some_cells(rng, grid.shape, 5)
    for stages in (compiled.stages, compiled.judge):
        stages = replace(stages, stage_keep=np.full_like(stages.stage_keep, -(1 << 39)))
        wanted = score_by_stages(integral_volume(grid), cells, stages)
        got = scores_on_device(grid, places_of(cells, grid.shape), stages, None)
        np.testing.assert_array_equal(got, wanted)
        assert len(set(wanted.tolist())) > 3


def test_the_voxels_about_a_peak_score_alike():
    rng = np.random.default_rng(8)
    grid = random_parts(rng, (7, 7, 7), 0.1)
    cells = np.array([[3, 3, 3], [0, 6, 2]], np.int32)
    steps = np.array([[0, 0, 0], [-1, 0, 0], [1, 1, 1]], np.int32)
    stages = compile_cascade(STAGES).stages
    got = scores_on_device(grid, places_of(cells, grid.shape), stages, None, steps)
    about = (cells[:, None] + steps).reshape(-1, 3)
    wide = np.pad(grid, 1)
    wanted = score_by_stages(integral_volume(wide), about + 1, stages)
    np.testing.assert_array_equal(got, wanted)


@pytest.mark.parametrize("least", [0, 1, 2])
def test_votes_score_alike(least):
    rng = np.random.default_rng(9)
    grid = (rng.integers(0, 30, (8, 7, 6)) * (rng.random((8, 7, 6)) < 0.2)).astype(np.uint32)
    cells = some_cells(rng, grid.shape, 25)
    votes = replace(compile_cascade(VOTES).votes, min_votes=least)
    scores, yaws = zeros(1, len(cells), dtype=np.int64), zeros(1, len(cells), dtype=np.int32)
    vote.vote_masks[on()](
        volume_of(grid), *to_device(places_of(cells, grid.shape)), counts_with(0, len(cells)), 0,
        tuple(to_device(*vote.votes_table(votes))), votes.masks, votes.asymmetry_cost, votes.min_votes, scores, yaws,
    )  # fmt: skip
    wanted = score_by_votes(integral_volume(grid), cells, votes)
    np.testing.assert_array_equal(scores.copy_to_host()[0], wanted[0])
    np.testing.assert_array_equal(yaws.copy_to_host()[0], wanted[1])
    assert len(set(wanted[0].tolist())) > 3


# -------------------------------------------------------------------------------------------------------------- peaks


@pytest.mark.parametrize("reach", [1, 2])
@pytest.mark.parametrize(
    ("values", "share", "most"), [(3, 0.3, 64), (1000, 0.4, 5), (1, 1.0, 64), (9, 0.0, 3)]
)
def test_the_same_peaks(reach, values, share, most):
    rng = np.random.default_rng(10)
    shape = (5, 4, 6)
    cells = np.argwhere(rng.random(shape) < share).astype(np.int32)
    scores = rng.integers(-values, values, len(cells))
    scores[rng.random(len(cells)) < 0.1] = DROPPED
    room = max(len(cells), 1)
    places, on_device = (
        places_of(np.resize(cells, (room, 3)), shape),
        np.resize(scores, (1, room)).astype(np.int64),
    )
    counts = counts_with(suppress.CANDIDATES, len(cells))
    marked, maxima = zeros(1, -(-room // 32)), zeros(1, room, dtype=np.int32)
    peaks, peak_places = zeros(1, most, dtype=np.int32), zeros(1, most, dtype=np.int32)
    peak_scores, shares = zeros(1, most, dtype=np.int64), zeros(1, 3, dtype=np.int32)
    places, device_scores = to_device(places, on_device)
    column, layer = shape[2] + 2, (shape[1] + 2) * (shape[2] + 2)
    suppress.mark_maxima[on()](places, counts, device_scores, reach, column, layer, marked)
    compact.count_bits[on()](marked, shares)
    compact.add_up[(1, 1), search.ONE_BLOCK_THREADS](shares, counts, suppress.MAXIMA)
    compact.list_bits[on()](marked, shares, maxima)
    ranks = zeros(1, room, dtype=np.int32)
    suppress.rank_maxima[on()](maxima, counts, device_scores, most, ranks)
    suppress.list_peaks[on()](maxima, counts, ranks, places, device_scores, peaks, peak_places, peak_scores)
    wanted = suppress_on_cpu(cells, scores, DROPPED + 1, shape, reach)
    if len(wanted) > most:
        wanted = np.sort(wanted[np.argsort(-scores[wanted], kind="stable")[:most]])
    assert counts.copy_to_host()[0, suppress.PEAKS] == len(wanted)
    np.testing.assert_array_equal(peaks.copy_to_host()[0, : len(wanted)], wanted)
    np.testing.assert_array_equal(peak_scores.copy_to_host()[0, : len(wanted)], scores[wanted])
    np.testing.assert_array_equal(
        peak_places.copy_to_host()[0, : len(wanted)], places_of(cells[wanted], shape)[0]
    )


def test_of_peaks_that_meet_the_first_stays():
    """Three peaks: the first two move to one voxel, the third was dropped; the fourth stays where it is."""
    about = np.full((1, 12), DROPPED)
    about[0, [2, 4, 9, 10]] = 5, 6, 3, 3
    places = np.array([[100, 102, 150, 190]], np.int32)
    counts = counts_with(suppress.PEAKS, 4)
    out = [zeros(1, 4, dtype=dtype) for dtype in (np.int32, np.int32, np.int32, np.int64)]
    judge.keep_best[(1, 1), search.ONE_BLOCK_THREADS](
        counts,
        *to_device(np.array([0, -1, 1], np.int32), about, np.array([[3, 5, 7, 9]], np.int32), places),
        *out,
    )
    assert counts.copy_to_host()[0, suppress.JUDGED] == 2
    _, judged, judged_places, scores = (a.copy_to_host()[0, :2].tolist() for a in out)
    assert (judged, judged_places, scores) == ([3, 9], [101, 190], [5, 3])


def test_the_cameras_saw_the_same():
    rng = np.random.default_rng(11)
    camera = Intrinsics(30, 20, 12.0, 12.5, 14.7, 9.1, 0.0005)
    images = tuple(
        DepthImage(f"c{k}", rng.integers(0, 3000, (20, 30)).astype(np.uint16), camera, scenes.pose(rng))
        for k in (0, 1)
    )
    lattice = Lattice.over(REGION, 0.05, 2)
    cells = np.column_stack([rng.integers(0, n, 12) for n in lattice.shape]).astype(np.int32)
    boxes = np.array([[-1, 2, -1, 2, -1, 2], [-3, -1, 2, 5, 0, 2], [-9, 9, 0, 1, 0, 1]], np.int32)
    offsets, start = cells_of(boxes)
    frame = Frame(0, depths=images)
    asked = readings.Asked(frame, lattice, True, 0)
    whole = np.zeros((1, words_for([asked])), np.int32)
    readings.pack(asked, lambda i, lattice: Rays.of(i, lattice), whole[0])
    whole = cuda.to_device(whole)
    quads = whole.view(np.float32).reshape(1, whole.shape[1] // 4, 4)
    counts = counts_with(suppress.JUDGED, len(cells))
    S = volume_of(np.zeros(lattice.shape, np.uint8))
    states, seen = zeros(1, 12, len(offsets), dtype=np.uint8), zeros(1, 12, 3, 2, dtype=np.int32)
    places, offsets, start = to_device(places_of(cells, lattice.shape), offsets, start)
    judge.look_about[on()](S, whole, quads, whole.view(np.uint16), counts, places, offsets, states)
    judge.count_states[on()](whole, counts, states, start, seen)
    wanted = count_seen(images, lattice, cells, boxes)
    np.testing.assert_array_equal(seen.copy_to_host()[0], wanted)
    assert wanted[..., 0].sum() > 20
    assert wanted[..., 1].sum() > 20


@pytest.mark.parametrize("sees", [readings.OF_ALL, readings.OF_SEEN])
def test_the_cameras_are_asked_of_the_same_peaks(sees):
    rng = np.random.default_rng(13)
    states = rng.choice(3, (1, 9, 48), p=[0.6, 0.35, 0.05]).astype(np.uint8)
    states[0, 0], states[0, 1, :3], states[0, 1, 3:] = HIDDEN, EMPTY, HIDDEN
    whole = np.zeros((1, readings.HEADER), np.int32)
    whole[0, readings.SEES] = sees
    asked, scores = zeros(1, 9, dtype=np.bool_), cuda.to_device(np.arange(9)[None])
    counts = counts_with(suppress.JUDGED, 9)
    judge.ask_of[on()](*to_device(whole), counts, *to_device(states), -100, asked, scores)
    unseen = not_seen(states[0]) & (sees == readings.OF_SEEN)
    np.testing.assert_array_equal(asked.copy_to_host()[0], ~unseen)
    np.testing.assert_array_equal(scores.copy_to_host()[0], np.arange(9) - 100 * unseen)
    assert not_seen(states[0])[:2].tolist() == [True, False]  # three of 48 are just enough


def test_of_what_is_not_asked_nothing_changes():
    rng = np.random.default_rng(14)
    grid = random_parts(rng, (9, 8, 7))
    cells, stages = some_cells(rng, grid.shape, 12), compile_cascade(STAGES).judge
    asked = np.arange(len(cells)) % 3 > 0
    seen = rng.integers(0, 12, (len(cells), len(seen_boxes(stages)[0]), 2)).astype(np.int32)
    wanted = np.where(asked, score_by_stages(integral_volume(grid), cells, stages, seen), 7)
    got = scores_on_device(grid, places_of(cells, grid.shape), stages, seen, asked=asked)
    np.testing.assert_array_equal(got, wanted)
