import numpy as np
import pytest
from scipy.spatial import cKDTree

from headvox.errors import HeadvoxError
from headvox.synth.spread import escapes, spread_points

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def spread(count=400, seed=0, vertices=SQUARE, faces=HALVES):
    return spread_points(vertices, faces, count, np.random.default_rng(seed))


def test_neighbours_keep_nearly_the_distance_of_the_densest_packing():
    points = spread()
    assert points.shape == (400, 3)
    assert (points[:, 2] == 0.0).all()
    assert (points >= 0.0).all()
    assert (points <= 1.0).all()
    widest = 2.0 * np.sqrt(1.0 / (2.0 * np.sqrt(3.0) * 400))
    nearest = cKDTree(points).query(points, k=2)[0][:, 1]
    assert nearest.min() > 0.65 * widest
    assert np.median(nearest) > 0.72 * widest
    grid = np.stack(np.meshgrid(*[np.linspace(0.05, 0.95, 50)] * 2), -1).reshape(-1, 2)
    hole = cKDTree(points[:, :2]).query(grid)[0]
    assert hole.max() < 1.1 * widest  # no gap that would take another point


@pytest.mark.parametrize("count", [1, 2, 3, 57])
def test_the_count_is_exact(count):
    assert spread(count).shape == (count, 3)


def test_the_same_seed_gives_the_same_points_and_another_others():
    np.testing.assert_array_equal(spread(100), spread(100))
    assert not np.array_equal(spread(100), spread(100, seed=1))


def test_triangles_get_points_by_their_area():
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]], dtype=np.int32)
    small = np.array([[5.0, 0.0, 0.0], [5.5, 0.0, 0.0], [5.0, 1.0, 0.0]])
    points = spread(500, vertices=np.concatenate([SQUARE, small]), faces=faces)
    assert (points[:, 0] > 4.0).sum() == pytest.approx(100, abs=15)


def test_no_surface_is_told():
    with pytest.raises(HeadvoxError, match="no area"):
        spread(vertices=np.zeros((4, 3)))


def hits(vertices, faces, start, toward):
    """Moeller and Trumbore, one ray."""
    for a, b, c in vertices[faces]:
        p = np.cross(toward, c - a)
        det = (b - a) @ p
        if abs(det) < 1e-15:
            continue
        u = (start - a) @ p / det
        q = np.cross(start - a, b - a)
        v, t = toward @ q / det, (c - a) @ q / det
        if u >= 0.0 and v >= 0.0 and u + v <= 1.0 and t > 0.0:
            return True
    return False


def test_rays_escape_where_the_naive_ray_caster_hits_nothing():
    rng = np.random.default_rng(3)
    vertices = rng.uniform(-1.0, 1.0, (60, 3))
    faces = rng.permutation(60).reshape(20, 3).astype(np.int32)
    points = rng.uniform(-1.2, 1.2, (40, 3))
    directions = rng.normal(size=(12, 3))
    directions = np.concatenate([directions, np.eye(3), -np.eye(3)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    free = escapes(vertices, faces, points, directions)
    wanted = [[not hits(vertices, faces, point, toward) for toward in directions] for point in points]
    np.testing.assert_array_equal(free, wanted)
    assert 0.1 < free.mean() < 0.95
