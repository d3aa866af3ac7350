"""What runs on a GPU, or in Numba's simulator of one: test_cuda.py runs this file in a process of its own.

Every kernel equals the CPU's loops, which equal the slow twins (naive.py), and so do whole frames, bit for bit.
"""

import math
import sys
import threading
from dataclasses import replace
from types import SimpleNamespace

import numba
import numpy as np
import pytest
import scenes
from numba import cuda
from test_pipeline import NARROW, SMALL, camera_frame, expecting, two_busts

from headvox import Cloud, DepthImage, Detector, Frame, HeadvoxError, Intrinsics, align, assemble, settle
from headvox import nearby as nearby_on_cpu
from headvox import pose as pose_on_cpu
from headvox.cli import main
from headvox.compile_masks import compile_cascade
from headvox.config import DetectorConfig
from headvox.cuda import (
    compact,
    gate,
    graph,
    integral,
    judge,
    nearby,
    pose,
    readings,
    refine,
    search,
    suppress,
    vote,
    voxelize,
)
from headvox.cuda import fits as fits_module
from headvox.cuda.device import BATCH, check_device, is_simulated
from headvox.cuda.fits import Fits
from headvox.data import Expected
from headvox.fuse import Region
from headvox.gate import gate_tables, pass_gate
from headvox.integral import integral_volume
from headvox.nearby import gather_points, sensors_of
from headvox.pose import Poses
from headvox.read_masks import load_cascade, parse_cascade
from headvox.refine import COUNT, HAIR_M, MOST_PARTS, RADIUS, ROWS, fit_spheres
from headvox.suppress import suppress as suppress_on_cpu
from headvox.suppress import suppress_overlaps
from headvox.threads import Threads
from headvox.visibility import cells_of, count_seen
from headvox.vote import DROPPED, score_by_stages, score_by_votes, seen_boxes
from headvox.voxelize import Lattice, Rays, voxelize_depth, voxelize_points

# The simulator computes as NumPy's scalars do, which tell of what the hardware does silently.
pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning", "ignore:Grid size")
sys.setswitchinterval(2e-5)  # the simulator's threads wait for each other busily


def shared_array(self, shape, dtype, alignment=None):
    """Stand for the simulator's shared.array, which gives two threads that ask at once an array each."""
    asking = sys._getframe(1)
    place = asking.f_code.co_filename, asking.f_lineno
    with SHARING:
        if place not in self._allocations:
            self._allocations[place] = np.empty(shape, dtype)
        return self._allocations[place]


SHARING = threading.Lock()
if is_simulated():
    from numba.cuda.simulator.kernelapi import FakeCUDAShared

    FakeCUDAShared.array = shared_array

METRES, RADIANS = 1e-6, 1e-6
"""How far what is fitted may be from the CPU's: sums have another order, and functions other last bits."""
STAGES = parse_cascade(scenes.STAGES, "test")
VOTES = parse_cascade(scenes.VOTES, "test")
REGION = scenes.region(0.3, -0.2, 0.2)


def on(frames=1, sensors=1):
    """Return a launch of a few blocks."""
    return (2, frames, sensors), search.THREADS


def to_device(*arrays):
    return [cuda.to_device(np.ascontiguousarray(array)) for array in arrays]


def words_for(asked):
    """Return how long a row is that has room for each of these."""
    return -(-max(readings.words_of(one) for one in asked) // readings.OCTET) * readings.OCTET


def zeros(*shape, dtype=np.uint32):
    return cuda.to_device(np.zeros(shape, dtype))


def volume_of(cells):
    """Return the integral volume of a grid on the device, as a batch of one."""
    return cuda.to_device(integral_volume(cells)[None])


def random_parts(rng, shape, share=0.15):
    return (rng.integers(0, 256, shape) * (rng.random(shape) < share)).astype(np.uint8)


def places_of(cells, shape):
    """Return the places of cells: see headvox.cuda.gate."""
    x, y, z = (np.asarray(cells).reshape(-1, 3) + 1).T
    return ((x * (shape[1] + 2) + y) * (shape[2] + 2) + z).astype(np.int32)[None]


def counts_with(which, count, frames=1):
    counts = np.zeros((frames, suppress.HEADS + 1), np.int32)
    counts[:, which] = count
    return cuda.to_device(counts)


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


def cloud_of(points):
    return Frame(0, clouds=(Cloud("cloud", np.array(points, np.float32).reshape(-1, 3)),))


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


def scores_on_device(cells, places, stages, seen, steps=((0, 0, 0),)):
    """Return the scores of all stages, or of those that see nothing, of the voxels ``steps`` from each place."""
    shape, several = cells.shape, len(places[0]) * len(steps)
    along = np.array([(shape[1] + 2) * (shape[2] + 2), shape[2] + 2, 1])
    sizes = vote.Sizes.of(stages)
    table = tuple(to_device(*vote.stages_table(stages)))
    whole = np.zeros((1, readings.HEADER), np.int32)
    whole[0, readings.SEES] = seen is not None
    looked = np.zeros((1, 1, 1, 2), np.int32) if seen is None else seen[None]
    scores = cuda.to_device(np.full((1, several), 7))
    vote.vote_stages[(2, 1), search.THREADS](
        volume_of(cells), *to_device(whole, places, (np.array(steps) @ along).astype(np.int32)),
        counts_with(0, len(places[0])), 0, table, *to_device(looked), seen is not None,
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


# ------------------------------------------------------------------------------------------------------------- fits


@pytest.mark.parametrize("counting", [False, True])
def test_the_same_spheres(counting):
    """Also of peaks at the edges and of one in empty space, with and without hair."""
    rng = np.random.default_rng(13)
    shape = (9, 8, 9)
    grid = random_parts(rng, shape, 0.3)
    if counting:
        grid = rng.integers(0, 3, shape).astype(np.uint32)
    grid[:3] = 0
    cells = np.array([[4, 4, 4], [0, 0, 0], [8, 7, 2], [5, 0, 8]], np.int32)
    fits = Fits(1, len(cells), "sphere", 0.06, 1 if counting else 2, counting)
    lattice = Lattice((1.2, -0.6, 0.3), 0.06, shape, fits.subdivision, REGION)
    wanted = np.empty((len(cells), 6))
    fit_spheres(grid, cells, 0.06, fits.subdivision, counting, np.empty((ROWS, MOST_PARTS)), wanted)
    assert wanted[:, COUNT].min() == 0
    assert wanted[:, COUNT].max() > 40
    for haired in (False, True):
        frame = Frame(0, clouds=(Cloud("c", np.zeros((1, 3), np.float32), np.eye(4) if haired else None),))
        uploaded = upload(readings.Asked(frame, lattice, False, 0))
        fits.kept.copy_to_device(np.arange(len(cells), dtype=np.int32)[::-1].copy()[None])
        refine.fit_spheres[(2, 1), fits_module.SPHERE_THREADS](
            volume_of(np.zeros(shape, np.uint8)), uploaded.whole, uploaded.wide, *to_device(grid.reshape(1, -1)),
            counts_with(suppress.KEPT, len(cells)), *to_device(places_of(cells, shape)), fits.kept, fits.reach, 0.06,
            fits.subdivision, counting, True, fits.spheres,
        )  # fmt: skip
        got = fits.spheres.copy_to_host()[0, ::-1]
        centres = lattice.centres(cells) + wanted[:, :3]
        np.testing.assert_allclose(got[:, :3], centres - [0, 0, HAIR_M * haired], atol=METRES)
        np.testing.assert_allclose(got[:, RADIUS], wanted[:, RADIUS], atol=METRES)


@pytest.mark.parametrize("count", [0, 1, 12])
def test_the_same_of_heads_that_overlap(count):
    rng = np.random.default_rng(count)
    centres, scores = rng.uniform(0, 0.4, (count, 3)), rng.integers(0, 4, count)
    room = max(count, 1)
    fits = Fits(1, room, "none", 0.05, 2, False)
    kept = rng.permutation(count).astype(np.int32)
    fits.kept.copy_to_device(np.resize(kept, (1, room)).astype(np.int32))
    spheres, of_peaks = np.zeros((1, room, 4)), np.zeros((1, room), np.int64)
    spheres[0, :count, :3], of_peaks[0, kept] = centres, scores
    counts = counts_with(suppress.KEPT, count)
    refine.suppress_overlaps[(1, 1), 2](
        counts,
        *to_device(of_peaks),
        fits.kept,
        *to_device(spheres),
        assemble.SAME_HEAD_M,
        fits.order,
        fits.heads,
    )
    wanted = suppress_overlaps(centres, scores, assemble.SAME_HEAD_M)
    assert fits.heads.copy_to_host()[0, : len(wanted)].tolist() == wanted.tolist()
    assert counts.copy_to_host()[0, suppress.HEADS] == len(wanted)
    assert count < 12 or len(wanted) < count


@pytest.mark.skipif(not is_simulated(), reason="calls a device function")
@pytest.mark.parametrize("room", [2, 3, 7, 8])
def test_a_full_list_is_thinned_as_on_the_cpu(room):
    for there in (0, 1, room - 1, room, room + 1, 3 * room, 41, 64):
        points = np.zeros((there, 3), np.float32)
        points[:, 0] = np.arange(there) / 1000
        samples, rays = np.empty((room, 8)), np.empty((room, 6))
        n, _ = gather_points(points, np.eye(4)[:3], False, 1.0, 0, 0, room, room, samples, rays)
        wanted = np.round(samples[:n, 0] * 1000).astype(int).tolist()
        places = {nearby.place_of(k + 1, there, room): k for k in range(there)}
        places.pop(-1, None)
        assert [places[k] for k in range(len(places))] == wanted
        assert nearby.length_of(there, room) == n


def upload(asked):
    """Return what a search has of a frame that is uploaded."""
    words = words_for([asked])
    rows = np.zeros((1, words), np.int32)
    readings.pack(asked, lambda image, lattice: Rays.of(image, lattice), rows[0])
    whole = cuda.to_device(rows)
    wide, real = whole.view(np.float64), whole.view(np.float32)
    return SimpleNamespace(
        whole=whole, wide=wide, real=real, half=whole.view(np.uint16), stream=0,
        octets=wide.reshape(1, words // readings.OCTET, 8),
    )  # fmt: skip


def fitted_on_device(frame, centres, expected=None):
    """Return the poses near ``centres``, and what they were fitted with."""
    lattice = Lattice.over(REGION, 0.05, 2)
    uploaded = upload(readings.Asked(frame, lattice, False, 0, expected=expected))
    uploaded.counts = counts_with(suppress.HEADS, len(centres))
    fits = Fits(1, len(centres) + 1, "pose", 0.05, 2, False)
    spheres, heads = np.zeros((1, len(centres) + 1, 4)), np.zeros((1, len(centres) + 1), np.int32)
    spheres[0, 1:, :3], heads[0, : len(centres)] = centres, np.arange(1, len(centres) + 1)
    fits.spheres.copy_to_device(spheres)
    fits.heads.copy_to_device(heads)
    fits.launch_poses(uploaded, 1)
    poses = Poses(*(array.copy_to_host()[: len(centres)] for array in fits.poses))
    return poses, fits


def head_and_wall(rng, count=34, behind=12):
    """Return points on a head at 1 m along x, on its side that faces the origin, and on a wall behind it."""
    bust = scenes.bust(rng, (0.0, 0.0, 0.0), 40 * count)
    skull = bust[(bust[:, 0] < -0.01) & (np.linalg.norm(bust, axis=1) < 0.2)]
    wall = np.column_stack([np.full(behind, 1.0), rng.uniform(-0.35, 0.35, (behind, 2))])
    points = np.concatenate([rng.choice(skull, count, replace=False), wall])
    points[:, 0] += 1.0
    return rng.permutation(points).astype(np.float32)


def scenes_to_gather():
    rng = np.random.default_rng(14)
    T = np.eye(4)
    T[:3, 3] = 0.1, -0.2, 0.05
    points = head_and_wall(rng)
    images = camera_frame(1, 2).depths
    large = np.concatenate([points, np.full((4003, 3), np.nan, np.float32)])
    return {
        "a cloud": Frame(0, clouds=(Cloud("c", points, T),)),
        "points in the world": Frame(0, clouds=(Cloud("c", points + np.float32(T[:3, 3])),)),
        "images": Frame(0, depths=images),
        "all": Frame(0, clouds=(Cloud("c", points, T), Cloud("d", points)), depths=images[:1]),
        "a large cloud": Frame(0, clouds=(Cloud("c", np.resize(large, ((1 << 17) + 5, 3)), T),)),
        "nothing near": Frame(0, clouds=(Cloud("c", points + np.float32(9), T),)),
    }


@pytest.mark.parametrize("kind", scenes_to_gather())
@pytest.mark.parametrize("few", [False, True])
def test_the_same_is_gathered(kind, few):
    """Also where there is not room for all."""
    if few and not is_simulated():
        pytest.skip("the number is compiled in")
    room = 30 if few else nearby.MOST_SAMPLES
    frame = scenes_to_gather()[kind]
    centre = np.array([1.1, -0.2, 0.05]) if kind != "images" else np.zeros(3)
    samples, rays = np.zeros((room, 8)), np.zeros((room, 6))
    n, m = nearby_on_cpu.gather(sensors_of(frame), centre, samples, rays)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fits_module, "MOST_SAMPLES", room)
        patch.setattr(nearby, "MOST_SAMPLES", room)
        patch.setattr(pose, "fit_starts", Nothing())
        patch.setattr(pose, "settle_heads", Nothing())
        _, fits = fitted_on_device(frame, centre[None])
    near = fits.near.copy_to_host()[0, 0]
    assert near[:2].tolist() == [n, m]
    np.testing.assert_allclose(fits.samples.copy_to_host()[0, :n], samples[:n], atol=1e-12)
    np.testing.assert_allclose(fits.rays.copy_to_host()[0, :m], rays[:m], atol=1e-12)
    assert (n > 20 or few) if kind != "nothing near" else n == 0
    points, used = np.zeros((align.FINE_SAMPLES, 8)), min(n, align.FINE_SAMPLES)
    assert choose_on_cpu(samples, n, points, align.FINE_SAMPLES) == used
    np.testing.assert_allclose(fits.points.copy_to_host()[0, :used], points[:used], atol=1e-12)
    assert near[nearby.ROUND] == settle.is_round(samples, n)


class Nothing:
    """Stands for a kernel that is not to run."""

    def __getitem__(self, launch):
        return lambda *_: None


@numba.njit
def choose_on_cpu(source, there, target, most):
    return align.choose(source, there, target, most)


@cuda.jit
def factor_and_solve(A, size, x, told):
    thread, threads = cuda.threadIdx.x, cuda.blockDim.x
    pose.factor(A, size, thread, threads)
    if thread == 0:
        told[0] = pose.solve_back(A, size, x)


@pytest.mark.parametrize("size", [align.PARAMETERS, 10])
def test_the_same_step_is_taken(size):
    rng = np.random.default_rng(size)
    B = rng.normal(size=(size, 40))
    A = np.zeros((pose.SYSTEM, pose.SYSTEM))
    A[:size, :size] = np.triu(B @ B.T)
    A[:size, align.RESIDUAL] = rng.normal(size=size)
    x, wanted = np.zeros(align.PARAMETERS), np.zeros(align.PARAMETERS)
    on_device, x, told = to_device(A, x, np.zeros(1))
    factor_and_solve[1, 3](on_device, size, x, told)
    system = A[: align.PARAMETERS].copy()
    half_log_det = align.solve(system, wanted, size)
    np.testing.assert_allclose(x.copy_to_host(), wanted, rtol=1e-9)
    np.testing.assert_allclose(told.copy_to_host()[0], half_log_det, rtol=1e-12)
    np.testing.assert_allclose(
        np.tril(on_device.copy_to_host()[:size, :size], -1), np.tril(system[:size, :size], -1), rtol=1e-9
    )


def cases_to_fit():
    rng = np.random.default_rng(15)
    T = np.eye(4)
    points = head_and_wall(rng)
    seen = Frame(0, clouds=(Cloud("c", points, T),))
    shell = rng.normal(size=(30, 3))
    shell *= 0.1 / np.linalg.norm(shell, axis=1)[:, None]
    front = np.array([1.0, 0.0, 0.0])
    right = Expected(front[None], np.array([[0.0, 0.0, 1.0, 0.05]]), np.array([0.3]))
    wrong = Expected(front[None], np.array([[0.7, 0.7, 0.0, 0.1]]), np.array([0.3]))
    return {
        "from everywhere": (seen, [front], None),
        "as expected": (seen, [front], right),
        "not as expected": (seen, [np.array([1.0, 0.08, 0.0])], wrong),
        "a shell": (Frame(0, clouds=(Cloud("c", (shell + front).astype(np.float32)),)), [front], None),
        "too few points": (Frame(0, clouds=(Cloud("c", points[:18], T),)), [front, front + 9], None),
    }


UPRIGHT, ANYHOW = pose_on_cpu.upright_turns(), pose_on_cpu.all_turns()


@pytest.fixture
def few_turns(monkeypatch):
    """Let both start from few turns: the simulator takes seconds for what a CPU does in a millisecond."""
    for module in (pose_on_cpu, fits_module):
        monkeypatch.setattr(module, "upright_turns", lambda: UPRIGHT[::5].copy())
        monkeypatch.setattr(module, "all_turns", lambda: ANYHOW[::20].copy())


@pytest.mark.parametrize("case", cases_to_fit())
def test_the_same_poses(case, few_turns):
    frame, centres, expected = cases_to_fit()[case]
    centres = np.array(centres)
    wanted = pose_on_cpu.fit_poses(frame, centres, [align.Scratch.new()], Threads(1), expected)
    got, _ = fitted_on_device(frame, centres, expected)
    assert np.isfinite(wanted.radii).tolist() == [case != "too few points"] * len(centres)
    for name, one, other in zip(Poses._fields, got, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=METRES, err_msg=name)


# ------------------------------------------------------------------------------------------------------- whole frames


@pytest.fixture(scope="module")
def cascades(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cascades")
    fourth = scenes.STAGES.replace("min_score =", 'candidates = "every fourth"\nmin_score =', 1)
    for name, text in (("stages", scenes.STAGES), ("fourth", fourth), ("votes", scenes.VOTES)):
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    return folder


def detectors(cascades, cascade="stages", **settings):
    """Return the same detector on the CPU and on the GPU."""
    path = str(cascades / f"{cascade}.toml") if cascade in ("stages", "fourth", "votes") else cascade
    config = DetectorConfig(cascade=path, **{**SMALL, **NARROW, **settings})
    return Detector(config, backend="cpu"), Detector(config, backend="cuda")


def same(one, other):
    """The same heads, with the same scores; what was fitted to them is within the stated tolerance."""
    assert len(one) == len(other)
    assert one.scores.tolist() == other.scores.tolist()
    assert one.sure.tolist() == other.sure.tolist()
    for name, tolerance in (
        ("centres", METRES),
        ("radii", METRES),
        ("quaternions", RADIANS),
        ("centre_covariances", METRES**2),
        ("rotation_covariances", RADIANS),
    ):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-4, atol=tolerance)


def frames_of_all_kinds():
    cloud = scenes.bust(np.random.default_rng(0), (-0.2, -0.2, 0.1), 100)
    camera = camera_frame(1)
    return {
        "two cameras": ("stages", camera_frame(2, 2), {"min_score": -2.0}),
        "a camera and a cloud": ("stages", replace(camera, clouds=(Cloud("c", cloud),)), {}),
        "every fourth voxel": ("fourth", Frame(0, clouds=(Cloud("c", two_busts()),)), {"min_score": -1.0}),
        "votes": ("votes", Frame(0, clouds=(Cloud("c", two_busts()),)), {"min_score": 0.0, "voxel_m": 0.06}),
    }


@pytest.mark.parametrize("kind", frames_of_all_kinds())
def test_whole_frames_are_equal(cascades, kind):
    cascade, frame, settings = frames_of_all_kinds()[kind]
    cpu, gpu = detectors(cascades, cascade, **settings)
    heads = cpu.detect_frame(frame)
    same(gpu.detect_frame(frame), heads)
    assert gpu.candidates == cpu.candidates > 0
    assert gpu.on_device
    assert set(gpu.stage_ms) == {"device", "host"}
    assert len(heads) > 0


def test_whole_frames_have_the_same_poses(cascades, few_turns):
    """One head that is expected to look another way; and what it scores is too little, but for that."""
    T = np.eye(4)
    T[:3, 3] = -1.0, 0.0, 0.05
    points = scenes.bust(np.random.default_rng(0), (-0.2, -0.2, 0.1), 70) - T[:3, 3].astype(np.float32)
    frame = Frame(0, clouds=(Cloud("c", points, T),))
    near = {"centre": (0.0, 0.0, 0.0)}
    everyone = detectors(cascades, min_score=-1e3, refine="none", **near)[0].detect_frame(frame)
    best = {"min_score": float(everyone.scores[0]) + 0.1, "score_slack": 0.11}
    cpu, gpu = detectors(cascades, **best, refine="pose", **near)
    expected = Expected(everyone.centres[:1], np.array([[0.0, 0.7, 0.7, 0.1]]), np.array([0.2]))
    heads = cpu.detect_frame(frame, expected)
    same(gpu.detect_frame(frame, expected), heads)
    assert len(heads) == 1
    assert not heads.sure[0]
    assert np.isfinite(heads.centre_covariances).all()
    assert len(cpu.detect_frame(frame)) == 0


def test_the_default_cascade_finds_the_same_head(cascades):
    rng = np.random.default_rng(12)
    frame = Frame(0, clouds=(Cloud("c", scenes.bust(rng, (0.0, 0.0, 0.05), 250)),))
    cpu, gpu = detectors(cascades, "default", min_score=-1e3, max_range_m=0.3)
    heads = cpu.detect_frame(frame)
    same(gpu.detect_frame(frame), heads)
    assert len(heads) > 0


def test_a_batch_is_equal_and_takes_nothing_from_another_frame(cascades):
    """Frames with more and fewer sensors side by side; then one alone, in the memory that they left."""
    cloud = Frame(0, clouds=(Cloud("c", scenes.bust(np.random.default_rng(0), (0.1, 0.1, 0.1), 60)),))
    frames = [camera_frame(1), cloud]
    cpu, gpu = detectors(cascades, max_range_m=0.3, min_score=-2.0)
    wanted = cpu.detect_batch(frames)
    assert len(frames) < BATCH
    for got, one in zip(gpu.detect_batch(frames), wanted, strict=True):
        same(got, one)
    same(gpu.detect_frame(cloud), wanted[1])
    assert all(len(heads) for heads in wanted)


def test_an_expected_head_may_score_less(cascades):
    frame = camera_frame(0, 1)
    everyone = detectors(cascades, min_score=-2.0)[0].detect_frame(frame)
    settings = {"min_score": float(everyone.scores[0]) + 0.5, "score_slack": 0.6}
    cpu, gpu = detectors(cascades, **settings)
    expected = expecting(everyone.centres[0])
    heads = cpu.detect_frame(frame, expected)
    same(gpu.detect_frame(frame, expected), heads)
    assert len(heads) > 0
    assert not heads.sure.any()


def test_more_candidates_than_there_is_room_for(cascades, monkeypatch):
    monkeypatch.setattr(search, "FIRST_CANDIDATES", 32)
    cpu, gpu = detectors(cascades, max_range_m=0.3)
    same(gpu.detect_frame(camera_frame(1)), cpu.detect_frame(camera_frame(1)))
    assert gpu.candidates == cpu.candidates > 32


def test_nobody_in_range_is_told_as_on_the_cpu(cascades):
    cpu, gpu = detectors(cascades, max_range_m=0.2, min_height_m=-0.1, max_height_m=0.1)
    far = cloud_of([[5.0, 5.0, 5.0]])
    with pytest.raises(HeadvoxError) as on_gpu:
        gpu.detect_frame(far)
    with pytest.raises(HeadvoxError) as on_cpu:
        cpu.detect_frame(far)
    assert str(on_gpu.value) == str(on_cpu.value)
    near = cloud_of([[0.0, 0.0, 0.0]])
    assert len(gpu.detect_frame(near)) == len(cpu.detect_frame(near)) == 0  # as if nothing had happened


def test_nothing_is_allocated_once_all_is_there(cascades, monkeypatch):
    _, gpu = detectors(cascades, max_range_m=0.2, min_height_m=-0.1, max_height_m=0.1)
    frame = cloud_of(np.random.default_rng(0).uniform(-0.1, 0.1, (30, 3)))
    gpu.detect_frame(frame)
    for name in ("device_array", "pinned_array", "to_device"):
        monkeypatch.setattr(cuda, name, lambda *_, **__: pytest.fail("allocated"))
    gpu.detect_frame(frame)


def test_the_bench_measures_everything(cascades, capsys):
    """Only that it comes to its end: in the simulator its times are made up."""
    from headvox.cuda import bench

    near = {"max_range_m": 0.15, "centre": (0.1, -0.15, 0.1), "min_height_m": 0.0, "max_height_m": 0.2}
    region = Region(near["centre"], near["max_range_m"], near["min_height_m"], near["max_height_m"])
    cpu, _ = detectors(cascades, **near)
    with pytest.MonkeyPatch.context() as patch:
        if is_simulated():
            patch.setattr(bench, "LAUNCHES", 1)
            patch.setattr(bench, "COPY_WORDS", 64)
            patch.setattr(bench, "BATCH_FRAMES", 1)
            patch.setattr(cuda.get_current_device().__class__, "name", "simulator", raising=False)
        result = bench.measure(replace(cpu.config, refine="sphere"), camera_frame(1).depths, 1, print)
    assert result["same_candidates_and_peaks_as_cpu"]
    assert result["farthest_from_cpu_m"] <= METRES
    assert result["one_graph"] == (not is_simulated())
    masks, memory, ms = result["mask_evaluations"], result["memory"], result["ms"]
    lattice = Lattice.over(region, STAGES.voxel_m, STAGES.subdivision)
    conditions = len(compile_cascade(STAGES).gate.rank)
    assert masks["count"] == math.prod(lattice.shape) * conditions
    assert masks["a_second"] == pytest.approx(masks["count"] / masks["ms"] * 1e3)
    assert masks["times_the_paper"] == pytest.approx(masks["a_second"] / 9.5e7)
    assert memory["least_bytes"] > 4 * 2 * math.prod(n + 1 for n in lattice.shape)  # sums, written and read
    assert memory["floor_ms"] == pytest.approx(1e3 * memory["least_bytes"] / memory["copy_bytes_a_second"])
    kernels = ms["kernels, without refinement"]["p50"]
    assert memory["floor_over_kernels"] == pytest.approx(memory["floor_ms"] / kernels, rel=0.1)
    assert result["batch"]["frames_a_second"] > 0
    assert {"kernels", "upload", "download", "end to end, without refinement"} <= set(ms)
    assert {name for name, of in result["ms"].items() if of["p50"] > 0} >= {
        "end to end",
        "end to end, on the CPU",
    }
    told = bench.report(result)
    for row in ("mask evaluations", "times the paper's", "floor / kernels", "frames a second", "one by one"):
        assert row in told or (row == "one by one" and result["one_graph"])


@pytest.mark.skipif(not is_simulated(), reason="there is a GPU")
def test_the_bench_refuses_the_simulator(capsys):
    assert main(["bench", "--backend", "cuda"]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert "NUMBA_ENABLE_CUDASIM is set" in said.err


class CudaAPIError(Exception):
    __module__ = "numba.cuda.cudadrv.driver"


def test_a_lost_gpu_is_told_once_and_the_cpu_goes_on(cascades, monkeypatch):
    cpu, _ = detectors(cascades)
    said = []
    gpu = Detector(cpu.config, backend="cuda", note=said.append)
    frame = camera_frame(1)
    wanted = cpu.detect_frame(frame)

    def fail(*_):
        raise CudaAPIError("[719] the device fell off the bus")

    monkeypatch.setattr(search.Search, "launch", fail)
    for _ in range(2):
        same(gpu.detect_frame(frame), wanted)
    same(gpu.detect_batch([frame])[0], wanted)
    assert not gpu.on_device
    assert len(said) == 1
    assert "[719] the device fell off the bus" in said[0]


def test_a_gpu_with_too_little_memory_is_told_once(cascades, monkeypatch):
    cpu, _ = detectors(cascades)
    said = []
    gpu = Detector(cpu.config, backend="cuda", note=said.append)
    frame = camera_frame(1)

    def full(*_):
        raise CudaAPIError("[2] Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY")

    monkeypatch.setattr(cuda, "device_array", full)
    for heads in gpu.detect_batch(9 * [frame]):  # more than go at once
        assert heads.centres.tobytes() == cpu.detect_frame(frame).centres.tobytes()
    assert len(said) == 1
    assert "CUDA_ERROR_OUT_OF_MEMORY" in said[0]
    assert "max_range_m" in said[0]
    assert "\n" not in said[0]


def test_a_graph_is_what_was_started_before(cascades, monkeypatch):
    """Of the first frame all is started one by one; then as one, until a buffer is another."""
    cpu, gpu = detectors(cascades, max_range_m=0.2, min_height_m=-0.1, max_height_m=0.1)
    started = []

    def capture(stream, enqueue):
        search = enqueue.func.__self__
        assert stream is search.stream
        return lambda: (started.append("graph"), enqueue())

    monkeypatch.setattr(search, "FIRST_CANDIDATES", 4096)
    all_of = search.Search.all_of
    monkeypatch.setattr(search, "capture", capture)
    monkeypatch.setattr(search.Search, "all_of", lambda self, *of: (started.append("all"), all_of(self, *of)))
    few, more = (np.random.default_rng(0).uniform(-0.1, 0.1, (n, 3)) for n in (20, 60))
    for points in (few, few, few, more, more):
        same(gpu.detect_frame(cloud_of(points)), cpu.detect_frame(cloud_of(points)))
    assert started == ["all", "graph", "all", "graph", "all", "all", "graph", "all"]


def test_without_graphs_all_is_started_one_by_one(cascades, monkeypatch):
    cpu, gpu = detectors(cascades, max_range_m=0.2, min_height_m=-0.1, max_height_m=0.1)
    monkeypatch.setattr(search, "capture", lambda *_: None)
    frame = cloud_of(np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3)))
    for _ in range(3):
        same(gpu.detect_frame(frame), cpu.detect_frame(frame))
    assert not gpu.device.device.for_frames(1).is_graph


class FakeStream:
    """Stands for cuda.core's stream and its graph builder; it may fail."""

    fails, log = False, []

    @classmethod
    def from_handle(cls, handle):
        cls.log.append(("stream", handle))
        return cls()

    def create_graph_builder(self):
        return self

    def begin_building(self):
        self.log.append("begin")

    def end_building(self):
        self.log.append("end")

    def complete(self):
        if self.fails:
            raise CudaAPIError("graphs are not supported")
        return SimpleNamespace(launch=lambda stream: self.log.append(("launch", stream is self)))


@pytest.mark.parametrize("fails", [False, True])
def test_a_graph_is_captured_as_cuda_core_asks_for_it(monkeypatch, fails):
    monkeypatch.setattr(graph, "SIMULATED", False)
    monkeypatch.setitem(sys.modules, "cuda.core", SimpleNamespace(Stream=FakeStream))
    monkeypatch.setattr(FakeStream, "fails", fails)
    monkeypatch.setattr(FakeStream, "log", [])
    launch = graph.capture(7, lambda: FakeStream.log.append("enqueue"))
    assert FakeStream.log == [("stream", 7), "begin", "enqueue", "end"]
    assert (launch is None) == fails
    if launch is not None:
        launch()
        assert FakeStream.log[4:] == [("launch", True)]


def test_a_fault_of_ours_is_no_lost_gpu(cascades, monkeypatch):
    _, gpu = detectors(cascades)
    monkeypatch.setattr(search.Search, "launch", lambda *_: {}["missing"])
    with pytest.raises(KeyError):
        gpu.detect_frame(camera_frame(1))


def test_without_a_note_it_is_a_warning(cascades, monkeypatch):
    cpu, gpu = detectors(cascades)
    monkeypatch.setattr(search.Search, "launch", lambda *_: (_ for _ in ()).throw(CudaAPIError("gone")))
    with pytest.warns(RuntimeWarning, match="the GPU failed .gone."):
        same(gpu.detect_frame(camera_frame(1)), cpu.detect_frame(camera_frame(1)))


def test_auto_takes_a_gpu_but_no_simulated_one():
    check_device()
    assert Detector(backend="auto").on_device == (not is_simulated())


def test_a_gpu_that_counts_wrongly_is_not_used(monkeypatch):
    monkeypatch.setattr(compact, "count_bits", SimpleNamespace(__getitem__=None))
    with pytest.raises(HeadvoxError, match="cannot run on this GPU"):
        check_device()


def test_the_tests_end_all_their_threads():
    assert threading.active_count() < 20
