import naive_voxels
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headvox.integral import (
    box_reach,
    box_sum,
    in_order,
    integral_volume,
    integrate,
    room_for,
    row_for,
    set_corners,
    shape_with_margins,
    with_margins,
)

SHAPES = [(1, 1, 1), (1, 5, 2), (7, 1, 3), (6, 5, 9)]


def random_boxes(rng, shape, count=300):
    """Return boxes (count, 6), many of them over the edges of the grid and some wholly outside."""
    low = np.column_stack([rng.integers(-4, n + 4, count) for n in shape])
    high = low + rng.integers(0, 8, (count, 3))
    return np.stack([low, high], axis=2).reshape(-1, 6).astype(np.int64)


def box_sums(S, boxes):
    """Return the sums over ``boxes`` (B, 6), cut off at the edges of the grid, as far as the numbers of ``S`` go."""
    return np.array([int(box_sum(S, *box)) % 256**S.itemsize for box in boxes])


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint32])
@pytest.mark.parametrize("filled", [0.0, 0.1, 1.0])
def test_equals_the_naive_twin(shape, dtype, filled):
    rng = np.random.default_rng(len(shape) + shape[1])
    cells = np.where(rng.random(shape) < filled, rng.integers(0, 256, shape), 0).astype(dtype)
    S = integral_volume(cells)
    assert S.dtype == np.uint32
    np.testing.assert_array_equal(S, naive_voxels.integral_volume(cells))
    boxes = random_boxes(rng, shape)
    amount = naive_voxels.weights(cells)
    np.testing.assert_array_equal(box_sums(S, boxes), [naive_voxels.box_sum(amount, box) for box in boxes])


def part_of(cells, box, first, shape, dtype, threads=1):
    """Return the integral volume of the cells in ``box``, which ``threads`` threads entered, each some of them."""
    S, counting, row = np.full(shape, 77, dtype), cells.dtype != np.uint8, row_for(shape[2], dtype)
    row[:] = 9  # what an earlier frame left
    grids = np.full((threads, room_for(cells.size)), 200, cells.dtype)
    left, whole = cells.reshape(-1).copy(), (1 << 32) - 1 if counting else 255
    for grid in grids[1:, : cells.size]:
        grid[:] = left & np.random.default_rng(1).integers(0, whole, cells.size)
        left -= grid
    grids[0, : cells.size] = left
    integrate(grids, cells.shape, np.array(box), np.array(first), counting, row, S)
    return in_order(S)


@given(st.integers(0, 2**32 - 1), st.integers(0, 10))
@settings(max_examples=40, deadline=None, derandomize=True)
def test_box_sums_are_exact_though_the_volume_overflows_32_bits(most, seed):
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, most // 8 + 1, (5, 4, 6)).astype(np.uint32)
    boxes = random_boxes(rng, cells.shape, 60)
    boxes[:, 1::2] = np.minimum(boxes[:, 1::2], boxes[:, 0::2] + 2)  # eight cells at most: the sum fits
    np.testing.assert_array_equal(
        box_sums(integral_volume(cells), boxes),
        [naive_voxels.box_sum(cells.astype(np.int64), box) for box in boxes],
    )


def test_box_sums_are_exact_though_the_volume_overflows_16_bits():
    rng = np.random.default_rng(0)
    cells = np.full((40, 30, 20), 255, np.uint8)
    cells[rng.random(cells.shape) < 0.1] = 0
    S = integral_volume(cells, narrow=True)
    assert S.dtype == np.uint16
    amount = naive_voxels.weights(cells)
    assert amount.sum() > 2 * 0xFFFF
    boxes = random_boxes(rng, cells.shape)
    boxes = np.concatenate([boxes, [[0, 20, 0, 20, 0, 20], [20, 60, 10, 60, 0, 60]]])
    wanted = np.array([naive_voxels.box_sum(amount, box) for box in boxes])
    fits = wanted <= 0xFFFF
    assert fits.sum() > 300
    np.testing.assert_array_equal(box_sums(S, boxes[fits]), wanted[fits])


@pytest.mark.parametrize("counting", [False, True])
@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize("height", [5, 32, 41])
def test_a_part_of_the_grid(counting, threads, height):
    """The volume of a box of cells is the volume of a copy of these cells."""
    rng = np.random.default_rng(height)
    cells = rng.integers(0, 256, (9, 8, height)).astype(np.uint32 if counting else np.uint8)
    cells[rng.random(cells.shape) < 0.5] = 0
    for low, high in ((0, height - 1), (3, height - 2), (1, 1)):
        S = part_of(cells, [2, 1, low, 7, 7, high], [2, 1, low], (7, 8, 64), np.uint32, threads)
        wanted = naive_voxels.integral_volume(cells[2:8, 1:8, low : high + 1])
        np.testing.assert_array_equal(S[:, :, : high - low + 2], wanted)
        assert (S[:, :, high - low + 2 :] == wanted[:, :, -1:]).all()


def test_a_million_points_in_one_cell():
    cells = np.zeros((3, 3, 3), np.uint32)
    cells[1, 1, 1] = 1_000_000
    S = integral_volume(cells)
    assert box_sums(
        S, np.array([[-9, 9, -9, 9, -9, 9], [1, 2, 1, 2, 1, 2], [0, 1, 0, 9, 0, 9]])
    ).tolist() == [
        1_000_000,
        1_000_000,
        0,
    ]


@pytest.mark.parametrize("dtype", [np.uint16, np.uint32])
@pytest.mark.parametrize("threads", [1, 2])
def test_a_volume_wider_than_its_cells_goes_on_over_empty_ones(dtype, threads):
    rng = np.random.default_rng(2)
    cells = rng.integers(0, 256, (6, 5, 9)).astype(np.uint8)
    cells[3] = 0
    S = part_of(cells, [1, 1, 2, 4, 3, 7], [-1, -2, -3], (9, 8, 32), dtype, threads)
    wider = np.zeros((8, 7, 31), np.uint8)
    wider[2:6, 3:6, 5:11] = cells[1:5, 1:4, 2:8]
    np.testing.assert_array_equal(S, naive_voxels.integral_volume(wider))


def test_with_margins_every_box_about_every_voxel_lies_in_the_volume():
    rng = np.random.default_rng(3)
    cells = rng.integers(0, 256, (4, 3, 37)).astype(np.uint8)
    boxes = np.array([[-2, 1, 0, 4, -3, 2], [1, 3, -1, 0, 0, 5]], np.int32)
    reach = box_reach(boxes)
    assert reach.tolist() == [-2, 3, -1, 4, -3, 5]
    S = with_margins(integral_volume(cells), reach)
    assert S.shape == shape_with_margins(cells.shape, reach) == (9, 8, 96)
    corners = np.empty((2, 8), np.int64)
    set_corners(S, boxes, corners)
    amount, flat = naive_voxels.weights(cells), S.reshape(-1).astype(np.int64)
    for x, y, z in np.argwhere(cells >= 0).tolist():
        at = ((x + 2) * S.shape[1] + y + 1) * S.shape[2] + (z + 3) // 2
        is_odd = (z + 3) % 2 == 1
        for box, (*columns, z0, z0_if_odd, z1, z1_if_odd) in zip(boxes, corners.tolist(), strict=True):
            low, high = at + z0 + z0_if_odd * is_odd, at + z1 + z1_if_odd * is_odd
            a, b, c, d = (flat[high + column] - flat[low + column] for column in columns)
            wanted = naive_voxels.box_sum(amount, naive_voxels.about((x, y, z), box))
            assert (a - b - (c - d)) % 2**32 == wanted
