import naive_sphere
import numpy as np
import pytest
import scenes

from headvox.data import Cloud
from headvox.lattice import Lattice
from headvox.refine import MOST_PARTS, ROWS, fit_spheres
from headvox.voxelize import voxelize_points


def fitted(cells, peaks, voxel=0.05, subdivision=2, counting=False):
    spheres = np.empty((len(peaks), 6))
    room = np.empty((ROWS, MOST_PARTS))
    halves = cells.reshape(1, -1) & np.where(np.arange(cells.size) % 3, 0x5A, 0xA5)[None].astype(cells.dtype)
    grids = np.concatenate([halves, cells.reshape(1, -1) - halves])  # as two threads enter them
    fit_spheres(grids, cells.shape, np.array(peaks, np.int32), voxel, subdivision, counting, room, spheres)
    return spheres


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("voxel", "subdivision", "counting"), [(0.05, 2, False), (0.05, 1, False), (0.025, 1, True)]
)
def test_equals_the_naive_twin(seed, voxel, subdivision, counting):
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-0.05, 0.05, 3)
    lattice = Lattice.over(scenes.region(), voxel, subdivision)
    cells = voxelize_points(Cloud("b", scenes.bust(rng, centre)), lattice, counting)
    middle = np.floor((centre - np.array(lattice.origin)) / voxel).astype(int)
    peaks = [
        middle,
        middle + np.array((1, 0, 0)),
        middle - np.array((0, 1, 1)),
        [0, 0, 0],
        np.array(lattice.shape) - 1,
    ]
    wanted = naive_sphere.fit_spheres(cells, peaks, voxel, subdivision)
    spheres = fitted(cells, peaks, voxel, subdivision, counting)
    np.testing.assert_allclose(spheres, wanted, rtol=1e-9, atol=1e-9)
    assert spheres[0, 5] > 20


def test_finds_the_centre_of_a_sphere():
    rng = np.random.default_rng(0)
    for _ in range(10):
        centre = rng.uniform(-0.05, 0.05, 3)
        lattice = Lattice.over(scenes.region(), 0.05, 2)
        cells = voxelize_points(Cloud("s", scenes.shell(rng, centre, 0.095, 3000)), lattice)
        peak = np.floor((centre - np.array(lattice.origin)) / 0.05).astype(np.int32)
        sphere = fitted(cells, [peak])[0]
        assert np.linalg.norm(lattice.centres(peak[None])[0] + sphere[:3] - centre) < 0.005
        assert abs(sphere[3] - 0.095) < 0.005
        assert sphere[4] < 0.012


def test_nothing_near_leaves_the_centre_and_the_usual_radius():
    sphere = fitted(np.zeros((9, 9, 9), np.uint8), [[4, 4, 4]])
    np.testing.assert_allclose(sphere, [[0, 0, 0, 0.093, 0, 0]], atol=1e-12)


def test_one_part_and_a_part_at_the_very_centre():
    cells = np.zeros((9, 9, 9), np.uint8)
    cells[6, 4, 4] = 1
    np.testing.assert_allclose(
        fitted(cells, [[4, 4, 4]]), naive_sphere.fit_spheres(cells, [[4, 4, 4]], 0.05, 2), atol=1e-9
    )
    lone = np.zeros((9, 9, 9), np.uint32)
    lone[4, 4, 4] = 5
    assert np.isfinite(fitted(lone, [[4, 4, 4]], 0.05, 1, True)).all()


def test_a_full_grid_does_not_overrun_the_memory_for_its_points():
    sphere = fitted(np.full((80, 80, 80), 255, np.uint8), [[40, 40, 40]], 0.01, 2)
    assert sphere[0, 5] == MOST_PARTS
    assert np.isfinite(sphere).all()


def test_no_peak():
    assert fitted(np.zeros((3, 3, 3), np.uint8), np.empty((0, 3))).shape == (0, 6)
