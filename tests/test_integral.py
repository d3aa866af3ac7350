import naive
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headvox.integral import PARTS, box_sums, integral_volume, integrate

SHAPES = [(1, 1, 1), (1, 5, 2), (7, 1, 3), (6, 5, 9)]


def random_boxes(rng, shape, count=300):
    """Return boxes (count, 6), many of them over the edges of the grid and some wholly outside."""
    low = np.column_stack([rng.integers(-4, n + 4, count) for n in shape])
    high = low + rng.integers(0, 8, (count, 3))
    return np.stack([low, high], axis=2).reshape(-1, 6).astype(np.int64)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint32])
@pytest.mark.parametrize("filled", [0.0, 0.1, 1.0])
def test_equals_the_naive_twin(shape, dtype, filled):
    rng = np.random.default_rng(len(shape) + shape[1])
    cells = np.where(rng.random(shape) < filled, rng.integers(0, 256, shape), 0).astype(dtype)
    S = integral_volume(cells)
    assert S.dtype == np.uint32
    np.testing.assert_array_equal(S, naive.integral_volume(cells))
    boxes = random_boxes(rng, shape)
    amount = naive.weights(cells)
    np.testing.assert_array_equal(box_sums(S, boxes), [naive.box_sum(amount, box) for box in boxes])


def test_parts_are_the_number_of_bits():
    assert PARTS.tolist() == [bin(value).count("1") for value in range(256)]


@given(st.integers(0, 2**32 - 1), st.integers(0, 10))
@settings(max_examples=40, deadline=None, derandomize=True)
def test_box_sums_are_exact_though_the_volume_overflows_32_bits(most, seed):
    rng = np.random.default_rng(seed)
    cells = rng.integers(0, most // 8 + 1, (5, 4, 6)).astype(np.uint32)
    boxes = random_boxes(rng, cells.shape, 60)
    boxes[:, 1::2] = np.minimum(boxes[:, 1::2], boxes[:, 0::2] + 2)  # eight cells at most: the sum fits
    np.testing.assert_array_equal(
        box_sums(integral_volume(cells), boxes), [naive.box_sum(cells.astype(np.int64), box) for box in boxes]
    )


def test_box_sums_are_exact_though_the_volume_overflows_16_bits():
    rng = np.random.default_rng(0)
    cells = np.full((40, 30, 20), 255, np.uint8)
    cells[rng.random(cells.shape) < 0.1] = 0
    S = np.empty([n + 1 for n in cells.shape], np.uint16)
    integrate(cells, np.array([0, 0, 0, 39, 29, 19]), False, S)
    amount = naive.weights(cells)
    assert amount.sum() > 2 * 0xFFFF
    boxes = random_boxes(rng, cells.shape)
    boxes = np.concatenate([boxes, [[0, 20, 0, 20, 0, 20], [20, 60, 10, 60, 0, 60]]])
    wanted = np.array([naive.box_sum(amount, box) for box in boxes])
    fits = wanted <= 0xFFFF
    assert fits.sum() > 300
    np.testing.assert_array_equal(box_sums(S, boxes[fits]), wanted[fits])


@pytest.mark.parametrize("counting", [False, True])
def test_a_part_of_the_grid(counting):
    """The volume of a box of cells is the volume of a copy of these cells."""
    rng = np.random.default_rng(1)
    cells = rng.integers(0, 256, (9, 8, 7)).astype(np.uint32 if counting else np.uint8)
    cells[rng.random(cells.shape) < 0.5] = 0
    box = np.array([2, 1, 3, 7, 7, 5])
    S = np.full((7, 8, 4), 77, np.uint32)
    integrate(cells, box, counting, S)
    np.testing.assert_array_equal(S, naive.integral_volume(cells[2:8, 1:8, 3:6]))


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
def test_a_volume_longer_than_its_cells_goes_on_over_empty_ones(dtype):
    rng = np.random.default_rng(2)
    cells = rng.integers(0, 256, (6, 5, 9)).astype(np.uint8)
    cells[3] = 0
    S = np.full((5, 5, 16), 77, dtype)
    integrate(cells, np.array([1, 1, 2, 4, 4, 7]), False, S)
    padded = np.zeros((4, 4, 15), np.uint8)
    padded[:, :, :6] = cells[1:5, 1:5, 2:8]
    np.testing.assert_array_equal(S, naive.integral_volume(padded))
