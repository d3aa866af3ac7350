import math

import naive_voxels
import numpy as np
import pytest
import scenes
from hypothesis import given, settings
from hypothesis import strategies as st

from headvox.data import Cloud, DepthImage, Intrinsics
from headvox.errors import HeadvoxError
from headvox.fuse import Region
from headvox.lattice import Lattice
from headvox.machine.threads import new_blocks
from headvox.voxelize import (
    ROWS,
    Marking,
    Rays,
    mark_depth,
    mark_points,
    new_box,
    part_transform,
    voxelize_depth,
    voxelize_points,
)


def same_grids(thing, region, voxel=0.05, subdivision=2):
    """Assert that both kinds of grid equal their twins; return the count grid."""
    lattice = Lattice.over(region, voxel, subdivision)
    grid = naive_voxels.Grid(naive_voxels.lattice_over(region, voxel, subdivision))
    if isinstance(thing, Cloud):
        grid.enter_cloud(thing)
        parts, counts = voxelize_points(thing, lattice), voxelize_points(thing, lattice, count=True)
    else:
        grid.enter_depth(thing)
        parts, counts = voxelize_depth(thing, lattice), voxelize_depth(thing, lattice, count=True)
    assert parts.dtype == np.uint8
    assert counts.dtype == np.uint32
    np.testing.assert_array_equal(parts, grid.bits)
    np.testing.assert_array_equal(counts, grid.counts)
    return counts


finite = st.floats(-20.0, 20.0, allow_nan=False)


@given(
    centre=st.tuples(finite, finite, finite),
    radius=st.floats(
        0.05, 5.0
    ),  # with 1 cm voxels, a wider region of this height has more parts than can be numbered
    low=st.floats(-3.0, 3.0),
    height=st.floats(0.01, 4.0),
    voxel=st.sampled_from([0.01, 0.02, 0.025, 0.04, 0.05, 0.1, 0.2]),
    subdivision=st.sampled_from([1, 2]),
)
@settings(max_examples=200, deadline=None, derandomize=True)
def test_lattice_equals_the_naive_twin_and_covers_its_region(centre, radius, low, height, voxel, subdivision):
    region = Region(centre, radius, low, low + height)
    lattice, twin = (
        Lattice.over(region, voxel, subdivision),
        naive_voxels.lattice_over(region, voxel, subdivision),
    )
    assert lattice.origin == twin.origin
    assert lattice.shape == twin.shape
    assert lattice.part_m == twin.part
    np.testing.assert_allclose(lattice.limits(), twin.limits, rtol=1e-5, atol=1e-3)
    for k, (lowest, highest) in enumerate(
        [
            (centre[0] - radius, centre[0] + radius),
            (centre[1] - radius, centre[1] + radius),
            (low, low + height),
        ]
    ):
        assert lattice.origin[k] <= lowest + 1e-9
        assert lattice.origin[k] + lattice.shape[k] * voxel > highest + 1e-4
        assert abs(lattice.origin[k] / voxel - round(lattice.origin[k] / voxel)) < 1e-9


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("voxel", "subdivision"), [(0.05, 2), (0.05, 1), (0.025, 1), (0.04, 2)])
def test_points_equal_the_naive_twin(seed, voxel, subdivision):
    rng = np.random.default_rng(seed)
    region = scenes.region(centre=tuple(rng.uniform(-0.3, 0.3, 3)))
    for cloud in scenes.clouds(rng):
        assert same_grids(cloud, region, voxel, subdivision).sum() > 50


coordinate = st.one_of(
    st.floats(-1.0, 1.0, width=32),
    st.integers(-40, 40).map(lambda k: float(np.float32(k * 0.025))),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e30, -1e30, 0.6, -0.6, 0.0, -0.0]),
)


@given(st.lists(st.tuples(coordinate, coordinate, coordinate), max_size=20), st.integers(0, 3))
@settings(max_examples=100, deadline=None, derandomize=True)
def test_any_points_equal_the_naive_twin(points, seed):
    cloud = np.array(points, np.float32).reshape(-1, 3)
    T = scenes.pose(np.random.default_rng(seed)) if seed else None
    same_grids(Cloud("any", cloud, T), scenes.region())


def test_empty_cloud_and_one_point():
    assert same_grids(Cloud("none", np.empty((0, 3), np.float32)), scenes.region()).sum() == 0
    counts = same_grids(Cloud("one", np.array([[0.01, 0.01, 0.01]], np.float32)), scenes.region())
    assert np.argwhere(counts).tolist() == [[12, 12, 6]]


def test_a_point_on_a_border_belongs_to_the_upper_cell():
    region = Region((0.0, 0.0, 0.0), 1.0, -1.0, 1.0)
    lattice = Lattice.over(region, 0.0625, 2)
    points = np.array([[0.0, 0.0, 0.0], [0.0625, -0.0625, 0.03125]], np.float32)
    cells = voxelize_points(Cloud("a", points), lattice)
    assert np.argwhere(cells).tolist() == [[16, 16, 16], [17, 15, 16]]
    assert cells[16, 16, 16] == 1
    assert cells[17, 15, 16] == 2
    same_grids(Cloud("a", points), region, 0.0625)


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (100.3, -50.7, 0.1), (-4321.0, 1234.5, 0.0)])
def test_range_limit_is_a_ball_and_half_open(centre):
    """No point that rounding lets in may fall outside of the grid, wherever its centre lies."""
    rng = np.random.default_rng(5)
    n = rng.normal(size=(3000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    n[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    region = Region(centre, 0.6, -0.7, 0.7)
    T = np.eye(4)
    T[:3, 3] = centre
    lattice = Lattice.over(region, 0.05, 2)
    at_limit = (0.6 * n * rng.choice([1.0, 1.0 - 1e-7, 1.0 + 1e-7], (3000, 1))).astype(np.float32)
    counts = voxelize_points(Cloud("limit", at_limit, T), lattice, count=True)
    assert 0 < counts.sum() < 3000
    assert counts[0, 0].sum() == counts[-1, -1].sum() == 0
    inner = voxelize_points(Cloud("inner", (0.999 * at_limit).astype(np.float32), T), lattice, count=True)
    outer = voxelize_points(Cloud("outer", (1.001 * at_limit).astype(np.float32), T), lattice, count=True)
    assert inner.sum() == (3000 if abs(centre[0]) < 1000 else inner.sum())
    assert outer.sum() == (0 if abs(centre[0]) < 1000 else outer.sum())


@pytest.mark.parametrize("far", [1e5, 6.4e6, 1e7])
def test_a_centre_in_earth_coordinates_stays_within_the_grid(far):
    """In float32 a centre so far out is off by more than a voxel: the grid must not be left all the same."""
    region = Region((far + 0.3, -far - 0.2, 0.0), 0.6, -0.5, 0.5)
    lattice = Lattice.over(region, 0.05, 2)
    limits = lattice.limits()
    for k in range(2):
        assert limits[k] - np.sqrt(limits[3]) > -1e-3
        assert limits[k] + np.sqrt(limits[3]) < 2 * lattice.shape[k]
    assert limits[5] < 2 * lattice.shape[2]


@pytest.mark.parametrize("voxel", [0.025, 0.05])
def test_moving_the_centre_by_whole_voxels_keeps_the_cells(voxel):
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.3, 0.3, (500, 3)).astype(np.float32)
    T = np.eye(4)
    first = Lattice.over(scenes.region(), voxel, 2)
    reference = voxelize_points(Cloud("a", points, T), first)
    at = np.argwhere(reference)
    for steps in (1, -3, 7):
        region = scenes.region(centre=(steps * voxel, -steps * voxel, 0.0))
        moved = Lattice.over(region, voxel, 2)
        shift = np.round((np.array(first.origin) - np.array(moved.origin)) / voxel).astype(int)
        np.testing.assert_allclose(np.array(first.origin) - np.array(moved.origin), shift * voxel, atol=1e-9)
        assert moved.shape == first.shape
        cells = voxelize_points(Cloud("a", points, T), moved)
        there = at + shift
        inside = ((there >= 0) & (there < moved.shape)).all(axis=1)
        near = np.linalg.norm(first.centres(at) - np.array(region.centre), axis=1) < 0.5
        assert (inside & near).sum() > 100
        # A point may lie so near to a border that the move rounds it over: allow for a few parts, no more.
        same = cells[tuple(there[inside & near].T)] == reference[tuple(at[inside & near].T)]
        assert same.mean() > 0.99
        np.testing.assert_allclose(moved.centres(there), first.centres(at), atol=1e-9)


@pytest.mark.parametrize(("voxel", "radius"), [(0.005, 50.0), (0.02, 50.0), (0.01, 6.0)])
def test_more_voxels_than_can_be_numbered_are_refused(voxel, radius):
    """The last has cells enough, but parts whose numbers do not fit 32 bits."""
    with pytest.raises(HeadvoxError, match=r"voxels of 0\.0"):
        Lattice.over(Region((0.0, 0.0, 0.0), radius, -1.0, 3.0), voxel, 2)


def test_a_million_points_in_one_cell():
    points = np.tile(np.array([[0.01, 0.02, 0.03]], np.float32), (1_000_000, 1))
    lattice = Lattice.over(scenes.region(), 0.05, 2)
    counts = voxelize_points(Cloud("many", points), lattice, count=True)
    assert counts.max() == counts.sum() == 1_000_000
    parts = voxelize_points(Cloud("many", points), lattice)
    assert np.count_nonzero(parts) == 1


def test_the_order_of_the_points_does_not_matter():
    rng = np.random.default_rng(2)
    points = scenes.messy_cloud(rng, 5000)
    lattice = Lattice.over(scenes.region(), 0.05, 2)
    for count in (False, True):
        one = voxelize_points(Cloud("a", points), lattice, count)
        other = voxelize_points(Cloud("a", rng.permutation(points)), lattice, count)
        np.testing.assert_array_equal(one, other)


# ------------------------------------------------------------------------------------------------------ depth images


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("voxel", "subdivision"), [(0.05, 2), (0.05, 1), (0.025, 1)])
def test_depth_equals_the_naive_twin(seed, voxel, subdivision):
    rng = np.random.default_rng(seed)
    T = scenes.pose(rng)
    camera = Intrinsics(37, 23, 30.0, 31.5, 17.3, 12.9, float(rng.choice([0.001, 0.0001, 0.00025])))
    depth = rng.integers(0, 1.2 / camera.depth_scale, (23, 37)).clip(0, 65535).astype(np.uint16)
    depth[rng.random(depth.shape) < 0.2] = 0
    depth[rng.random(depth.shape) < 0.1] = 65535
    assert same_grids(DepthImage("d", depth, camera, T), scenes.region(), voxel, subdivision).sum() > 50


@pytest.mark.parametrize(
    ("value", "scale", "points"), [(0, 0.001, 0), (500, 0.001, 1), (65535, 0.001, 0), (65535, 1e-5, 1)]
)
def test_one_pixel(value, scale, points):
    image = DepthImage(
        "d", np.full((1, 1), value, np.uint16), Intrinsics(1, 1, 1.0, 1.0, 0.0, 0.0, scale), np.eye(4)
    )
    assert same_grids(image, Region((0.0, 0.0, 0.0), 0.8, -0.1, 0.8)).sum() == points


@pytest.mark.parametrize("seed", range(3))
def test_pixels_on_the_borders_of_cells_equal_the_naive_twin(seed):
    """Coordinates that are whole numbers but for the last bit: the sums must be taken as documented."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    T[:3, 3] = rng.integers(-3, 4, 3) * 0.025
    camera = Intrinsics(33, 25, 3.0, 3.0, 16.0, 12.0, 0.025 / 15)
    depth = (rng.integers(0, 20, (25, 33)) * 15).astype(np.uint16)
    for subdivision in (1, 2):
        counts = same_grids(
            DepthImage("d", depth, camera, T), scenes.region(0.9, -0.9, 0.9), 0.05, subdivision
        )
        assert counts.sum() > 100


@pytest.mark.parametrize("seed", range(3))
def test_turned_points_on_the_borders_of_cells_equal_the_naive_twin(seed):
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = [[0.6, -0.48, 0.64], [0.8, 0.36, -0.48], [0.0, 0.8, 0.6]]
    points = (rng.integers(-8, 9, (600, 3)) * 0.125).astype(np.float32)
    assert same_grids(Cloud("c", points, T), scenes.region(0.9, -0.9, 0.9)).sum() > 50


def test_the_range_limit_itself_is_out():
    """All of these distances are exact in float32."""
    region = Region((0.0, 0.0, 0.0), 1.0, -2.0, 2.0)
    on_limit = np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0.0, -1.0, 0.0]], np.float32)
    assert same_grids(Cloud("on", on_limit), region, 0.0625).sum() == 0
    assert same_grids(Cloud("in", on_limit * np.float32(1 - 2**-20)), region, 0.0625).sum() == 5
    camera = Intrinsics(1, 1, 1.0, 1.0, 0.0, 0.0, 1 / 1024)
    for value, count in ((1023, 1), (1024, 0), (1025, 0)):
        image = DepthImage("d", np.full((1, 1), value, np.uint16), camera, np.eye(4))
        assert same_grids(image, region, 0.0625).sum() == count


@pytest.mark.parametrize("height", [-0.5, 0.25])
def test_height_limits_are_half_open(height):
    region = Region((0.0, 0.0, 0.0), 1.0, -0.5, 0.25)
    points = np.array([[0, 0, height]], np.float32)
    assert same_grids(Cloud("z", points), region, 0.0625).sum() == (height < 0)


def test_a_pixel_without_return_is_no_point_at_the_camera():
    image = DepthImage("d", np.zeros((4, 5), np.uint16), Intrinsics(5, 4, 3.0, 3.0, 2.0, 2.0), np.eye(4))
    assert same_grids(image, scenes.region()).sum() == 0


def test_depth_and_its_cloud_fill_the_same_voxels():
    """The two paths round differently in the last bit, so only voxels on a border may differ."""
    rng = np.random.default_rng(3)
    T = scenes.looking_along_x(-0.9, 0.0, 0.1)
    image = scenes.image_of_spheres(rng, T, [(0.0, 0.0, 0.1, 0.1)], wall_m=1.2)
    lattice = Lattice.over(scenes.region(), 0.05, 2)
    c = image.intrinsics
    v, u = np.nonzero(image.depth)
    z = image.depth[v, u] * c.depth_scale
    points = np.column_stack([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z]).astype(np.float32)
    by_depth = voxelize_depth(image, lattice, count=True).astype(int)
    by_cloud = voxelize_points(Cloud("c", points, T), lattice, count=True).astype(int)
    assert by_depth.sum() > 300
    assert np.abs(by_depth - by_cloud).sum() <= 0.01 * by_depth.sum()


# ------------------------------------------------------------------------------------------------- shares of a frame


@pytest.mark.parametrize("counting", [False, True])
def test_shares_are_together_the_whole_and_tell_the_occupied_box(counting):
    rng = np.random.default_rng(4)
    lattice = Lattice.over(scenes.region(), 0.05, 2)
    cloud = Cloud("c", scenes.messy_cloud(rng, 1000), scenes.pose(rng))
    image = scenes.image_of_spheres(
        rng, scenes.looking_along_x(-0.9, 0.0, 0.1), [(0.0, 0.0, 0.1, 0.1)], wall_m=1.2
    )
    rays, width = Rays.of(image, lattice), image.depth.shape[1]
    size = math.prod(lattice.shape)
    box, grids = new_box(), [np.zeros(size, np.uint32 if counting else np.uint8) for _ in range(2)]
    marking = Marking.of(width)
    common = (lattice.limits(), lattice.bits, lattice.shape, 1, counting)
    first, rest = new_blocks(2)
    rest[0] = 1  # the first block of rows was taken by the other
    assert image.depth.shape[0] > ROWS
    for cells, points, depth, blocks in (
        (grids[0], cloud.points[:617], image.depth[:ROWS], first),
        (grids[1], cloud.points[617:], image.depth, rest),
    ):
        T = part_transform(cloud, lattice)
        mark_points(points, new_blocks(1)[0], T, *common, *marking.for_points(), box, cells)
        pixels = (depth, blocks, rays.column, rays.row, rays.t)
        mark_depth(*pixels, *common, *marking.for_depth(width), box, cells)
    together = grids[0] + grids[1] if counting else grids[0] | grids[1]
    cloud_cells, image_cells = (
        voxelize_points(cloud, lattice, counting),
        voxelize_depth(image, lattice, counting),
    )
    wanted = cloud_cells + image_cells if counting else cloud_cells | image_cells
    assert (cloud_cells > 0).sum() > 50 < (image_cells > 0).sum()
    np.testing.assert_array_equal(together.reshape(lattice.shape), wanted)
    at = np.argwhere(wanted)
    assert box.tolist() == [*at.min(axis=0), *at.max(axis=0)]


def test_nothing_in_range_leaves_the_box_empty():
    lattice, box = Lattice.over(scenes.region(), 0.05, 2), new_box()
    points, cells = np.full((5, 3), 99.0, np.float32), np.zeros(math.prod(lattice.shape), np.uint8)
    T = part_transform(Cloud("c", points), lattice)
    mark_points(
        points,
        new_blocks(1)[0],
        T,
        lattice.limits(),
        lattice.bits,
        lattice.shape,
        1,
        False,
        *Marking.of(32).for_points(),
        box,
        cells,
    )
    assert box.tolist() == new_box().tolist()
    assert not cells.any()
