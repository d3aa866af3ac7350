import naive_visibility
import naive_voxels
import numpy as np
import pytest
import scenes

from headvox.data import DepthImage, Intrinsics
from headvox.lattice import Lattice
from headvox.visibility import BEHIND, NO_RETURN, OUT_OF_VIEW, SEEN_EMPTY, SURFACE, count_seen, see_places

REGION = scenes.region(0.6, -0.3, 0.5)
BOXES = np.array(
    [[-1, 2, -1, 2, -1, 2], [0, 1, 0, 1, 0, 1], [-3, -1, 2, 5, 0, 2], [-9, 9, 0, 1, 0, 1]], np.int32
)


def cameras(rng):
    spheres = [(0.0, 0.0, 0.1, 0.1), (0.1, 0.3, 0.0, 0.15)]
    return tuple(
        scenes.image_of_spheres(rng, T, spheres, wall_m=1.5)
        for T in (scenes.looking_along_x(-0.9, 0.0, 0.1), scenes.looking_along_x(-0.7, 0.2, 0.3))
    )


@pytest.mark.parametrize("subdivision", [1, 2])
@pytest.mark.parametrize("count", [1, 2])
def test_equals_the_naive_twin(subdivision, count):
    rng = np.random.default_rng(count)
    images = cameras(rng)[:count]
    lattice = Lattice.over(REGION, 0.05, subdivision)
    cells = np.column_stack([rng.integers(-2, n + 2, 40) for n in lattice.shape]).astype(np.int32)
    seen = count_seen(images, lattice, cells, BOXES)
    wanted = naive_visibility.count_seen(
        images, naive_voxels.lattice_over(REGION, 0.05, subdivision), cells, BOXES
    )
    np.testing.assert_array_equal(seen, wanted)
    assert seen[..., 0].max() > 5
    assert seen[..., 1].max() > 5


def test_turned_cameras_equal_the_naive_twin():
    rng = np.random.default_rng(5)
    camera = Intrinsics(30, 20, 12.0, 12.5, 14.7, 9.1, 0.0005)
    images = tuple(
        DepthImage(f"c{k}", rng.integers(0, 3000, (20, 30)).astype(np.uint16), camera, scenes.pose(rng))
        for k in range(3)
    )
    lattice = Lattice.over(REGION, 0.05, 2)
    cells = np.column_stack([rng.integers(0, n, 60) for n in lattice.shape]).astype(np.int32)
    seen = count_seen(images, lattice, cells, BOXES)
    np.testing.assert_array_equal(
        seen, naive_visibility.count_seen(images, naive_voxels.lattice_over(REGION, 0.05, 2), cells, BOXES)
    )
    assert seen.sum() > 100


def test_depths_about_the_margins_equal_the_naive_twin():
    """Surfaces within a few millimetres of where a layer of cells turns from one state to the next."""
    rng = np.random.default_rng(8)
    T = scenes.looking_along_x(-1.0, 0.02, 0.01)
    lattice = Lattice.over(REGION, 0.05, 1)
    far = 1.0 + lattice.origin[0] + 0.05 * (rng.integers(0, lattice.shape[0], (60, 80)) + 0.5)
    near_margin = (
        far
        + rng.choice([-1.0, 1.0], far.shape) * (0.03 + 0.004 * far**2)
        + rng.uniform(-0.001, 0.001, far.shape)
    )
    image = DepthImage(
        "d",
        np.round(near_margin / 0.0001).astype(np.uint16),
        Intrinsics(80, 60, 60.0, 60.0, 39.6, 29.7, 0.0001),
        T,
    )
    cells = np.argwhere(np.ones(lattice.shape)).astype(np.int32)
    one = np.array([[0, 1, 0, 1, 0, 1]], np.int32)
    wanted = naive_visibility.count_seen((image,), naive_voxels.lattice_over(REGION, 0.05, 1), cells, one)
    np.testing.assert_array_equal(count_seen((image,), lattice, cells, one), wanted)
    assert wanted.sum(axis=(0, 1)).min() > 1000


def test_before_the_surface_is_empty_and_behind_it_hidden():
    """A wall 1 m before a camera at x = -1: what the channels are, in plain geometry."""
    T = scenes.looking_along_x(-1.0, 0.0, 0.0)
    depth = np.full((40, 60), 1000, np.uint16)
    image = DepthImage("wall", depth, Intrinsics(60, 40, 30.0, 30.0, 29.5, 19.5), T)
    lattice = Lattice.over(REGION, 0.05, 1)
    one = np.array([[0, 1, 0, 1, 0, 1]], np.int32)
    cells = np.array([[x, 12, 6] for x in range(lattice.shape[0])], np.int32)
    x = lattice.centres(cells)[:, 0]
    margin = 0.03 + 0.004 * (x + 1.0) ** 2
    seen = count_seen((image,), lattice, cells, one)[:, 0]
    np.testing.assert_array_equal(seen[:, 0], x < -margin)
    np.testing.assert_array_equal(seen[:, 1], x > margin)


def test_no_return_tells_nothing():
    image = DepthImage("none", np.zeros((4, 4), np.uint16), Intrinsics(4, 4, 2.0, 2.0, 1.5, 1.5), np.eye(4))
    lattice = Lattice.over(REGION, 0.05, 1)
    cells = np.array([[12, 12, 12]], np.int32)
    assert count_seen((image,), lattice, cells, BOXES).sum() == 0


def test_behind_the_camera_and_beside_the_image_nothing_is_known():
    T = scenes.looking_along_x(0.0, 0.0, 0.0)
    image = DepthImage("one", np.full((1, 1), 65535, np.uint16), Intrinsics(1, 1, 500.0, 500.0, 0.0, 0.0), T)
    lattice = Lattice.over(REGION, 0.05, 1)
    everything = np.argwhere(np.ones(lattice.shape)).astype(np.int32)
    seen = count_seen((image,), lattice, everything, np.array([[0, 1, 0, 1, 0, 1]], np.int32))[:, 0, 0]
    assert lattice.centres(everything[seen > 0])[:, 0].min(initial=1.0) > 0.1


def test_one_camera_that_sees_it_empty_outvotes_all_that_have_it_hidden():
    camera = Intrinsics(20, 20, 10.0, 10.0, 9.5, 9.5)
    near = DepthImage(
        "near", np.full((20, 20), 300, np.uint16), camera, scenes.looking_along_x(-1.0, 0.0, 0.0)
    )
    far = DepthImage(
        "far", np.full((20, 20), 3000, np.uint16), camera, scenes.looking_along_x(-1.0, 0.0, 0.0)
    )
    lattice = Lattice.over(REGION, 0.05, 1)
    cells = np.array([[12, 12, 6]], np.int32)
    one = BOXES[1:2]
    assert count_seen((near,), lattice, cells, one).tolist() == [[[0, 1]]]
    assert count_seen((far,), lattice, cells, one).tolist() == [[[1, 0]]]
    assert count_seen((near, far), lattice, cells, one).tolist() == [[[1, 0]]]
    assert count_seen((far, near), lattice, cells, one).tolist() == [[[1, 0]]]


def test_no_camera_no_candidate_no_box():
    lattice = Lattice.over(REGION, 0.05, 1)
    none = np.empty((0, 3), np.int32)
    assert count_seen((), lattice, np.array([[1, 1, 1]], np.int32), BOXES).sum() == 0
    assert count_seen((), lattice, none, BOXES).shape == (0, 4, 2)


# ---------------------------------------------------------------------------------------------------- places of heads

SIGHT_M = 4.0


SMALL = Intrinsics(40, 30, 35.0, 36.0, 19.6, 14.3)


def patchy(rng, T, camera=SMALL):
    """An image of patches at depths of their own, some without a return, and some single pixels of any kind."""
    coarse = rng.choice([0, 600, 1500, 2000, 2100, 2800, 5000], (6, 8))
    depth = np.kron(coarse, np.ones((5, 5), int))
    odd = rng.random(depth.shape) < 0.2
    depth[odd] = rng.integers(0, 5000, odd.sum())
    return DepthImage("patchy", depth.astype(np.uint16), camera, T)


def places_about(rng, camera, T, count):
    """Places before, behind and beside a camera: on pixels and their borders, within its image and just out of it."""
    far = rng.choice([-1.0, 0.05, 0.1, 0.8, 1.5, 2.0, 2.3, SIGHT_M, SIGHT_M + 0.2], count)
    u = rng.integers(-6, 2 * camera.width + 6, count) / 2.0
    v = rng.integers(-6, 2 * camera.height + 6, count) / 2.0
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(count)], 1)
    return (far[:, None] * rays) @ T[:3, :3].T + T[:3, 3]


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_places_equal_the_naive_twin(count):
    rng = np.random.default_rng(20 + count)
    T, aside = scenes.pose(rng), np.eye(4)
    aside[0, 3] = 0.4
    images = [patchy(rng, T @ np.linalg.matrix_power(aside, k)) for k in range(count)]
    places = places_about(rng, SMALL, T, 3000)
    seen = see_places(images, places, SIGHT_M)
    np.testing.assert_array_equal(seen, naive_visibility.see_places(images, places, SIGHT_M))
    kinds = (OUT_OF_VIEW, NO_RETURN, BEHIND, SURFACE, SEEN_EMPTY) if count else (OUT_OF_VIEW,)
    assert min((seen == kind).sum() for kind in kinds) >= 8


def test_places_without_a_turn_equal_the_naive_twin_on_the_borders_of_pixels():
    """All numbers are exact in binary here, so a pixel's border and a depth's limit are hit, not only come near to."""
    rng = np.random.default_rng(30)
    image = patchy(rng, np.eye(4), Intrinsics(40, 30, 32.0, 32.0, 19.5, 14.5, 0.0009765625))
    far = rng.choice([0.5, 1.0, 2.0, 4.0], 3000)
    u, v = rng.integers(-4, 84, 3000) / 2.0, rng.integers(-4, 64, 3000) / 2.0
    places = np.stack([(u - 19.5) / 32.0 * far, (v - 14.5) / 32.0 * far, far], 1)
    seen = see_places([image], places, SIGHT_M)
    np.testing.assert_array_equal(seen, naive_visibility.see_places([image], places, SIGHT_M))
    assert min((seen == kind).sum() for kind in range(5)) >= 20


@pytest.mark.parametrize(
    ("depth_m", "kind"), [(0.0, NO_RETURN), (1.0, BEHIND), (1.9, SURFACE), (3.0, SEEN_EMPTY)]
)
def test_what_is_seen_of_a_place_two_metres_away(depth_m, kind):
    depth = np.full((30, 40), round(1000 * depth_m), np.uint16)
    image = DepthImage("wall", depth, SMALL, np.eye(4))
    places = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [5.0, 0.0, 2.0], [0.0, 0.0, 4.5]])
    assert see_places([image], places, SIGHT_M).tolist() == [kind, OUT_OF_VIEW, OUT_OF_VIEW, OUT_OF_VIEW]
