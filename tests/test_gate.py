from dataclasses import replace
from itertools import product

import naive_search
import naive_voxels
import numpy as np
import pytest
import scenes

from headvox.gate import SLICES, gate_columns, gate_tables, list_passed, pass_gate, shape_of_passed
from headvox.integral import box_reach, integral_volume, set_corners, with_margins
from headvox.masks.cascade import Box, Cascade, Condition, Group
from headvox.masks.compile import compile_cascade
from headvox.masks.read import load_cascade, parse_cascade, shipped_cascades

HEAD = """
format = "headvox-cascade"
version = 1
name = "gate"
summary = "a gate for one test"
voxel_m = 0.05
subdivision = {subdivision}
occupancy = "{occupancy}"
min_score = 0.0
[[group]]
name = "g"
boxes = [{{ centre = [0, 0, 0], size = [0.05, 0.05, 0.05] }}]
[[stage]]
name = "s"
trees = [["g.sum", 0.0, 0.0, 1.0]]
"""


def cascade_with(gate: str, subdivision: int = 2, occupancy: str = "parts"):
    """Return a cascade with ``gate`` alone, even one that no file may have."""
    first = (
        '[[gate]]\nname = "asked for"\nboxes = [{ centre = [0, 0, 0], size = [0.1, 0.1, 0.1] }]\nmin = 1.0\n'
    )
    cascade = parse_cascade(HEAD.format(subdivision=subdivision, occupancy=occupancy) + first + gate, "test")
    return replace(cascade, conditions=cascade.conditions[1:])


def same_survivors(cells, cascade, voxel=None):
    """Assert that the survivors equal those of the twin, in order; return them."""
    compiled = compile_cascade(cascade, voxel)
    wanted = naive_search.gate(naive_voxels.weights(cells), cascade, voxel or cascade.voxel_m)
    survivors = pass_gate(integral_volume(cells), compiled.gate)
    assert survivors.dtype == np.int32
    np.testing.assert_array_equal(survivors, wanted)
    if not cascade.counting and compiled.largest_sum <= 0xFFFF:
        np.testing.assert_array_equal(pass_gate(integral_volume(cells, narrow=True), compiled.gate), wanted)
    return survivors


def random_cells(rng, shape, filled, counting=False):
    cells = np.where(rng.random(shape) < filled, rng.integers(1, 6 if counting else 256, shape), 0)
    return cells.astype(np.uint32 if counting else np.uint8)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("filled", [0.02, 0.1, 0.4])
@pytest.mark.parametrize("text", [scenes.STAGES, scenes.VOTES])
def test_equals_the_naive_twin(seed, filled, text):
    cascade = parse_cascade(text, "test")
    cells = random_cells(np.random.default_rng(seed), (13, 11, 9), filled, cascade.counting)
    same_survivors(cells, cascade)


def test_lets_some_pass_and_stops_most():
    cells = random_cells(np.random.default_rng(3), (13, 11, 9), 0.1)
    cells[4:8] = 0
    assert 100 < len(same_survivors(cells, parse_cascade(scenes.STAGES, "test"))) < 0.9 * cells.size


@pytest.mark.parametrize("name", shipped_cascades())
@pytest.mark.parametrize("filled", [0.05, 0.3])
def test_shipped_cascades_equal_the_naive_twin(name, filled):
    cascade = load_cascade(name)
    rng = np.random.default_rng(4)
    cells = random_cells(rng, (14, 12, 16), filled, cascade.counting)
    if cascade.subdivision == 1 and not cascade.counting:
        cells = np.minimum(cells, 1)
    cells[rng.random(cells.shape[:2]) < 0.5] = 0
    same_survivors(cells, cascade)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 20), (2, 9, 1), (20, 1, 3)])
def test_boxes_reach_over_every_edge(shape):
    rng = np.random.default_rng(5)
    for filled in (0.0, 0.5, 1.0):
        same_survivors(random_cells(rng, shape, filled), parse_cascade(scenes.STAGES, "test"))


@pytest.mark.parametrize("rank", range(1, 9))
def test_every_rank(rank):
    ring = "ring = { radius = 0.12, height = 0.02, size = [0.1, 0.15, 0.05] }"
    gate = f'[[gate]]\nname = "r"\n{ring}\nrank = {rank}\nmin = 0.1\nmax = 0.3\n'
    cells = random_cells(np.random.default_rng(rank), (9, 10, 8), 0.3)
    same_survivors(cells, cascade_with(gate))


def test_ranks_of_boxes_of_different_sizes_share_the_mean_volume():
    boxes = "[{centre=[0,0,0],size=[0.1,0.05,0.05]}, {centre=[0.1,0,0],size=[0.05,0.05,0.05]}]"
    for low in (0.3, 0.34, 0.67):
        gate = f'[[gate]]\nname = "r"\nboxes = {boxes}\nrank = 2\nmin = {low}\n'
        same_survivors(random_cells(np.random.default_rng(0), (6, 6, 6), 0.6), cascade_with(gate, 1))


@pytest.mark.parametrize(
    "limits", ["min = 0.0\nmax = 0.0", "min = 1.0", "min = 0.5\nmax = 0.25", "max = inf", "min = 1e9"]
)
def test_limits_at_their_ends(limits):
    gate = (
        f'[[gate]]\nname = "r"\nboxes = [{{ centre = [0.05, 0, 0], size = [0.1, 0.05, 0.05] }}]\n{limits}\n'
    )
    for filled in (0.0, 0.3, 1.0):
        cells = random_cells(np.random.default_rng(0), (5, 6, 7), filled)
        cells[cells > 0] = 255 if filled == 1.0 else cells[cells > 0]
        same_survivors(cells, cascade_with(gate))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("occupancy", ["parts", "count"])
def test_signed_boxes_equal_the_naive_twin(seed, occupancy):
    """Layers that should be full against layers that should be empty, and limits below zero."""
    rng = np.random.default_rng(seed)
    boxes = []
    for weight in rng.permutation([1, -1, -2, 3, 1])[: rng.integers(2, 6)]:
        centre, size = rng.uniform(-0.2, 0.2, 3).round(3), rng.uniform(0.05, 0.3, 3).round(3)
        boxes.append(f"{{ centre = {centre.tolist()}, size = {size.tolist()}, weight = {weight} }}")
    boxes.append("{ centre = [0, 0, 0], size = [0.1, 0.1, 0.1] }")
    low, high = np.sort(rng.uniform(-0.3, 0.5, 2)).round(3)
    gate = f'[[gate]]\nname = "signed"\nboxes = [{", ".join(boxes)}]\nmin = {low}\nmax = {high}\n'
    gate += f'[[gate]]\nname = "one side"\nboxes = [{", ".join(boxes[:-1])}, {boxes[-1]}]\nmax = {high}\n'
    cascade = cascade_with(gate, 2 if occupancy == "parts" else 1, occupancy)
    for filled in (0.0, 0.2, 0.9):
        cells = random_cells(rng, (10, 9, 11), filled, cascade.counting)
        same_survivors(cells, cascade)


def test_signed_boxes_in_a_volume_that_wraps_around():
    """The whole volume overflows 16 bits many times over, no box does."""
    rng = np.random.default_rng(0)
    gate = """
[[gate]]
name = "signed"
boxes = [
  { centre = [0, 0, 0], size = [0.3, 0.3, 0.3], weight = 2 },
  { centre = [0, 0, 0.2], size = [0.3, 0.3, 0.1], weight = -3 },
]
min = 0.1
max = 0.6
"""
    cells = random_cells(rng, (32, 30, 22), 0.9) | np.uint8(0xF1)
    cells[:, :, 9:13] = 0
    assert naive_voxels.weights(cells).sum() > 0xFFFF
    assert len(same_survivors(cells, cascade_with(gate))) > 100


def test_no_condition_lets_everything_pass():
    cells = np.zeros((3, 4, 5), np.uint8)
    assert len(same_survivors(cells, cascade_with(""))) == 60


def test_a_sum_of_boxes_that_16_bits_cannot_hold():
    """The type of the volume must fit the sums of a condition's boxes, not only each box."""
    box = "{ centre = [0, 0, 0], size = [1.0, 1.0, 0.9] }"
    gate = f'[[gate]]\nname = "r"\nboxes = [{", ".join([box] * 3)}]\nmin = 0.9\n'
    cascade = cascade_with(gate)
    cells = np.full((24, 24, 22), 255, np.uint8)
    assert compile_cascade(cascade).largest_sum >= 3 * 20 * 20 * 18 * 8
    assert len(same_survivors(cells, cascade)) > 0


def test_a_column_that_16_bits_cannot_hold():
    """A full column about a small box must not wrap around to "too few"."""
    gate = '[[gate]]\nname = "r"\nboxes = [{ centre = [0, 0, 0], size = [0.8, 0.8, 0.1] }]\nmin = 0.9\n'
    cells = np.full((20, 20, 40), 255, np.uint8)
    layers = 0xFFFF // (16 * 16 * 8) + 1
    cells[:, :, layers:] = 0
    assert len(same_survivors(cells, cascade_with(gate))) > 0


def test_a_million_points_in_one_cell():
    cells = np.zeros((5, 5, 5), np.uint32)
    cells[2, 2, 2] = 1_000_000
    gate = (
        '[[gate]]\nname = "r"\nboxes = [{ centre = [0, 0, 0], size = [0.15, 0.15, 0.15] }]\nmin = 37037.03\n'
    )
    assert len(same_survivors(cells, cascade_with(gate, 1, "count"))) == 27


@pytest.mark.parametrize("spacing", [2, 4])
def test_some_voxels_equal_the_naive_twin_and_the_lattices_together_are_the_whole(spacing):
    rng = np.random.default_rng(7)
    cells = (rng.random((9, 8, 11)) < 0.15).astype(np.uint8) * rng.integers(0, 256, (9, 8, 11)).astype(
        np.uint8
    )
    condition = Condition(Group("some", (Box((0, 0, 0.02), (0.06, 0.06, 0.06)),)), 0, 0.01, 1.0)
    some = Cascade("c", "c", 0.02, 2, False, (condition,), None, (), (), 0.0, 0.0, (), spacing=spacing)
    S, gate = integral_volume(cells), compile_cascade(some).gate
    whole = pass_gate(S, compile_cascade(replace(some, spacing=1)).gate)
    together = []
    for odd in product((0, 1), repeat=3):
        found = pass_gate(S, gate, odd)
        np.testing.assert_array_equal(found, naive_search.gate(naive_voxels.weights(cells), some, 0.02, odd))
        assert 0 < len(found) < len(whole)
        together += map(tuple, found.tolist())
    assert sorted(together) == sorted([*map(tuple, whole.tolist())] * (8 // spacing))


@pytest.mark.parametrize("spacing", [1, 2, 4])
@pytest.mark.parametrize("shape", [(9, 8, 11), (11, 4, 33), (3, 5, 65)])
def test_shares_of_a_part_of_the_volume_are_together_that_part(spacing, shape):
    rng = np.random.default_rng(8)
    cells = random_cells(rng, shape, 0.15)
    condition = Condition(Group("some", (Box((0, 0, 0.02), (0.06, 0.06, 0.06)),)), 0, 0.01, 1.0)
    cascade = Cascade("c", "c", 0.02, 2, False, (condition,), None, (), (), 0.0, 0.0, (), spacing=spacing)
    gate = compile_cascade(cascade).gate
    margin = -box_reach(gate.boxes)[0::2]
    S = with_margins(integral_volume(cells), box_reach(gate.boxes))
    corners = np.empty((len(gate.boxes), 8), np.int64)
    set_corners(S, gate.boxes, corners)
    for odd in ((0, 0, 0), (1, 0, 1), (0, 1, 1)):
        low = rng.integers(0, np.array(shape) // 2)
        high = rng.integers(low + 1, shape, endpoint=True)
        whole = naive_search.gate(naive_voxels.weights(cells), cascade, 0.02, odd)
        wanted = whole[((whole >= low) & (whole < high)).all(axis=1)]
        region = np.stack([low, high], axis=1).reshape(-1) + margin.repeat(2)
        for parts in (1, 2, 3):
            passed = np.full(shape_of_passed(region), 0xFFFFFFFF, np.uint32)  # what an earlier frame left
            for part in range(parts):
                first, end = len(passed) * np.array([part, part + 1]) // parts
                rows, tables = passed[first:end], gate_tables(gate, S.dtype)
                common = (S[first:], region, first, *tables, spacing, odd + margin, corners)
                gate_columns(*common, np.zeros(1, np.int64), rows)
                rest = np.full_like(rows, 7)
                gate_columns(*common, np.ones(1, np.int64), rest)  # another thread took the first block
                assert (rest[:SLICES] == 7).all()
                np.testing.assert_array_equal(rest[SLICES:], rows[SLICES:])
            survivors = np.empty((cells.size, 3), np.int32)
            count = list_passed(passed, region, survivors)
            np.testing.assert_array_equal(survivors[:count] - margin, wanted)
            few = np.empty((count // 2, 3), np.int32)
            assert list_passed(passed, region, few) == count
            np.testing.assert_array_equal(few, survivors[: len(few)])
