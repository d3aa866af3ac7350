import naive_voxels
import numpy as np
import pytest
import scenes

from headvox.data import Cloud
from headvox.fuse import Region, fuse


@pytest.mark.parametrize("seed", range(4))
def test_equals_the_naive_twin(seed):
    rng = np.random.default_rng(seed)
    clouds = scenes.clouds(rng)
    region = scenes.region(centre=tuple(rng.uniform(-0.2, 0.2, 3)))
    fused = fuse(clouds, region)
    assert len(fused) > 100
    assert fused.tobytes() == naive_voxels.fuse(clouds, region).tobytes()


def test_nothing_in_gives_nothing_out():
    assert fuse([], scenes.region()).shape == (0, 3)
    assert fuse([Cloud("none", np.empty((0, 3), np.float32))], scenes.region()).shape == (0, 3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e30, -1e30])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_drops_what_is_no_point(bad, axis):
    points = np.zeros((3, 3), np.float32)
    points[1, axis] = bad
    T = scenes.pose(np.random.default_rng(0), 0.1)
    assert len(fuse([Cloud("a", points)], scenes.region())) == 2
    assert len(fuse([Cloud("a", points, T)], scenes.region())) == 2


def test_limits_are_half_open():
    region = Region((0.0, 0.0, 0.0), 1.0, -0.25, 0.5)
    below_one = np.nextafter(np.float32(1), np.float32(0))
    points = np.array([[1, 0, 0], [below_one, 0, 0], [0, 0, -0.25], [0, 0, 0.5], [0, 0, -0.26]], np.float32)
    assert fuse([Cloud("a", points)], region).tolist() == [[below_one, 0, 0], [0, 0, -0.25]]


def test_keeps_the_order_of_sensors_and_points():
    a = np.array([[0.3, 0, 0], [0.1, 0, 0]], np.float32)
    b = np.array([[0.2, 0, 0]], np.float32)
    T = np.eye(4)
    T[0, 3] = 0.25
    fused = fuse([Cloud("a", a), Cloud("b", b, T)], scenes.region())
    np.testing.assert_array_equal(fused[:, 0], np.array([0.3, 0.1, 0.45], np.float32))
