import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from headvox.errors import HeadvoxError
from headvox.mesh import SPACING_M, sample_surface, triangulate

TRIANGLE = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.2, 0.1]])


def dense(triangle, count=4000, seed=0):
    """Points all over a triangle, corners and edges too."""
    weights = np.random.default_rng(seed).dirichlet((0.7, 0.7, 0.7), count)
    return weights @ triangle


def farthest(places, points):
    return max(np.linalg.norm(points - place, axis=1).min() for place in places)


def test_vertices_come_first_and_samples_lie_on_the_triangle():
    points = sample_surface(TRIANGLE, [[0, 1, 2]])
    assert points.dtype == np.float32
    assert points.flags.c_contiguous
    np.testing.assert_array_equal(points[:3], TRIANGLE.astype(np.float32))
    u, v = np.linalg.lstsq((TRIANGLE[1:] - TRIANGLE[0]).T, (points - TRIANGLE[0]).T, rcond=None)[0]
    assert u.min() > -1e-5
    assert v.min() > -1e-5
    assert (u + v).max() < 1 + 1e-5
    flat = TRIANGLE[0] + u[:, None] * (TRIANGLE[1] - TRIANGLE[0]) + v[:, None] * (TRIANGLE[2] - TRIANGLE[0])
    np.testing.assert_allclose(points, flat, atol=1e-6)


def test_the_density_is_that_of_the_spacing():
    area = 0.5 * np.linalg.norm(np.cross(TRIANGLE[1], TRIANGLE[2]))
    count = len(sample_surface(TRIANGLE, [[0, 1, 2]], 0.002)) - 3
    assert count == pytest.approx(area / 0.002**2, rel=0.05)


def test_the_same_bytes_every_time():
    first = sample_surface(TRIANGLE, [[0, 1, 2]])
    np.random.default_rng().random(5)
    assert sample_surface(TRIANGLE, [[0, 1, 2]]).tobytes() == first.tobytes()


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.sampled_from([0.004, 0.02, 0.1]), st.sampled_from([1.0, 0.1, 0.001, 0.0])
)
def test_no_place_on_a_triangle_is_farther_than_the_spacing(seed, size, flatness):
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    triangle = rng.normal(size=(3, 3)) * size * np.array([1.0, 1.0, flatness]) @ turn
    points = sample_surface(triangle, [[0, 1, 2]]).astype(np.float64)
    assert farthest(dense(triangle, 300, seed), points) < SPACING_M


def test_every_cell_that_a_triangle_really_crosses_has_a_point():
    rng = np.random.default_rng(5)
    for _ in range(8):
        triangle = rng.uniform(-0.3, 0.3, (3, 3))
        count = 100_000
        cells, hits = np.unique(
            np.floor(dense_even(triangle, count, rng) / 0.02).astype(int), axis=0, return_counts=True
        )
        area = 0.5 * np.linalg.norm(np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0]))
        crossed = cells[hits / count * area > 0.5 * 0.02**2]  # half as much as a face of it lies inside
        have = {tuple(c) for c in np.floor(sample_surface(triangle, [[0, 1, 2]]) / 0.02).astype(int)}
        assert len(crossed) > 20
        assert not [cell for cell in map(tuple, crossed) if cell not in have]


def dense_even(triangle, count, rng):
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return triangle[0] + u[:, None] * (triangle[1] - triangle[0]) + v[:, None] * (triangle[2] - triangle[0])


def test_a_needle_costs_its_length():
    points = sample_surface([[0, 0, 0], [10, 0, 0], [5, 1e-5, 0]], [[0, 1, 2]])
    assert 10 / SPACING_M < len(points) < 1.01 * 10 / SPACING_M


def test_small_and_degenerate_triangles_need_no_more_than_their_corners():
    corners = np.array([[0, 0, 0], [0.004, 0, 0], [0, 0.004, 0], [np.nan, 0, 0]])
    assert len(sample_surface(corners, [[0, 1, 2], [0, 0, 0], [0, 1, 3]])) == 4


def test_a_huge_triangle_is_made_in_shares_without_gaps(monkeypatch):
    triangle = np.array([[0, 0, 0], [1.0, 0, 0], [0.2, 0.5, 0]])
    at_once = sample_surface(triangle, [[0, 1, 2]])
    monkeypatch.setattr("headvox.mesh._CHUNK", 100)
    np.testing.assert_array_equal(sample_surface(triangle, [[0, 1, 2]]), at_once)
    np.testing.assert_array_equal(sample_surface(triangle, [[0, 1, 2]] * 3)[3:], np.tile(at_once[3:], (3, 1)))


def test_memory_is_bounded_by_the_points_that_come_out():
    tracemalloc.start()
    points = sample_surface([[0, 0, 0], [30, 0, 0], [0, 30, 0], [20_000, 0, 1e-3]], [[0, 1, 2], [0, 1, 3]])
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(points) > 9_000_000
    assert most < points.nbytes + 150_000_000


def test_a_surface_in_millimetres_is_refused_in_one_line():
    with pytest.raises(HeadvoxError, match=r"body: the surface needs .* points .* at most 5e\+07") as error:
        sample_surface(TRIANGLE * 1000, [[0, 1, 2]], name="body")
    assert "millimetres" in error.value.do
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("bad", [-1, 3])
def test_an_index_without_a_vertex_is_refused(bad):
    with pytest.raises(HeadvoxError, match=f"vertex {bad}, expected 0 to 2"):
        sample_surface(TRIANGLE, [[0, 1, bad]])


def test_a_spacing_of_nothing_is_refused():
    with pytest.raises(HeadvoxError, match="expected more than 0"):
        sample_surface(TRIANGLE, [[0, 1, 2]], 0.0)


def test_polygons_become_fans():
    triangles = triangulate([np.array([[0, 1, 2]]), np.array([[3, 4, 5, 6, 7]]), np.array([[8, 9]])])
    assert triangles.tolist() == [[0, 1, 2], [3, 4, 5], [3, 5, 6], [3, 6, 7]]
    assert triangulate([]).shape == (0, 3)
