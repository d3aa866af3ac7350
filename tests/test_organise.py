"""Clouds of depth cameras become their images again, pixel by pixel, and all other clouds stay what they are."""

import copy
import pickle
from dataclasses import replace
from itertools import pairwise

import naive_organise
import numpy as np
import pytest

from headvox import (
    Cloud,
    DepthImage,
    Detector,
    Frame,
    Heads,
    HeadvoxError,
    Intrinsics,
    Tracker,
    TrackerConfig,
    open_source,
    sample_folder,
)
from headvox.frames import OPTICAL, inverse, transform, unproject
from headvox.machine.simd import LANES
from headvox.machine.threads import Threads
from headvox.organise import Organiser, put_into_pixels
from headvox.pixelgrid import BIAS, grid_of

D435 = Intrinsics(848, 480, 430.25, 429.75, 423.6, 239.1)
SMALL = Intrinsics(160, 90, 81.1, 81.3, 79.2, 44.9)
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def image_of(lens: Intrinsics, seed: int = 0, seen: float = 0.8) -> DepthImage:
    """A slanted wall with holes in it, of which the first and last rows and columns are seen."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: lens.height, : lens.width]
    depth = (900 + 5 * u + 3 * v + rng.integers(0, 20, u.shape)).astype(np.uint16)
    depth[rng.random(u.shape) > seen] = 0
    depth[0, 0] = depth[-1, -1] = 3000
    return DepthImage("camera", depth, lens, np.eye(4))


def cloud_of(image: DepthImage, T_sensor_optical=None, *, is_organised: bool = False) -> Cloud:
    """What a driver makes of a depth image, in an optical or another frame of the sensor."""
    T = np.eye(4) if T_sensor_optical is None else T_sensor_optical
    points = unproject(image.depth, image.intrinsics, T).astype(np.float32)
    if is_organised:
        full = np.full((*image.depth.shape, 3), np.nan, np.float32)
        full[image.depth > 0] = points
        points = full.reshape(-1, 3)
    return Cloud(image.name, points, image.T_world_camera @ inverse(T))


def organised(*clouds: Cloud, threads: int = 1, **others) -> Frame:
    return Organiser(Threads(threads)).organised(Frame(0, clouds=clouds, **others))


def same_image(made: DepthImage, image: DepthImage) -> None:
    """The same readings, at the same pixels but for a shift that the principal point has, too."""
    rows, columns = np.nonzero(made.depth)
    wanted_rows, wanted_columns = np.nonzero(image.depth)
    down, right = rows[0] - wanted_rows[0], columns[0] - wanted_columns[0]
    np.testing.assert_array_equal(rows, wanted_rows + down)
    np.testing.assert_array_equal(columns, wanted_columns + right)
    np.testing.assert_array_equal(made.depth[rows, columns], image.depth[wanted_rows, wanted_columns])
    lens, wanted = made.intrinsics, image.intrinsics
    assert lens.depth_scale == wanted.depth_scale == 0.001
    assert (lens.fx, lens.fy) == pytest.approx((wanted.fx, wanted.fy), abs=0.01)
    assert (lens.cx - right, lens.cy - down) == pytest.approx((wanted.cx, wanted.cy), abs=0.02)
    np.testing.assert_allclose(made.T_world_camera, image.T_world_camera, atol=1e-12)


@pytest.mark.parametrize("is_organised", [False, True])
@pytest.mark.parametrize("T_sensor_optical", [np.eye(4), OPTICAL, OPENGL], ids=["optical", "body", "opengl"])
@pytest.mark.parametrize("lens", [SMALL, D435], ids=["160x90", "848x480"])
def test_a_camera_s_cloud_becomes_its_image(lens, T_sensor_optical, is_organised):
    place = transform_to_a_corner()
    image = replace(image_of(lens), T_world_camera=place)
    frame = organised(cloud_of(image, T_sensor_optical, is_organised=is_organised), threads=2)
    assert frame.clouds == ()
    same_image(frame.depths[0], image)


def transform_to_a_corner():
    T = np.eye(4)
    T[:3, :3] = OPTICAL[:3, :3]
    T[:3, 3] = 1.0, 2.0, 0.5
    return T


@pytest.mark.parametrize("seen", [1.0, 0.5, 0.15])
def test_also_where_most_pixels_have_no_return(seen):
    image = image_of(D435, seed=1, seen=seen)
    same_image(organised(cloud_of(image)).depths[0], image)


def test_the_outermost_pixels_are_found_where_the_sample_has_not_seen_them():
    image = image_of(D435)
    image.depth[:, :100] = image.depth[:, -100:] = 0
    image.depth[131, 0] = image.depth[133, -1] = 2000  # the sample has these rows, or not
    image.depth[237, 0] = image.depth[239, -1] = 2000
    same_image(organised(cloud_of(image)).depths[0], image)


def test_column_by_column_is_as_good_as_row_by_row():
    image = image_of(SMALL)
    turned = DepthImage(
        "camera", np.ascontiguousarray(image.depth.T), Intrinsics(90, 160, 81.3, 81.1, 44.9, 79.2), np.eye(4)
    )
    points = cloud_of(turned).points[:, [1, 0, 2]]  # x and y change places, the order of the points stays
    same_image(organised(Cloud("camera", np.ascontiguousarray(points), np.eye(4))).depths[0], image)


def test_what_is_farther_than_an_image_can_say_is_as_far_as_it_can():
    image = image_of(SMALL)
    points = cloud_of(image).points.copy()
    points[1000] *= 70_000 / (1000 * points[1000, 2])
    made = organised(Cloud("camera", points, np.eye(4))).depths[0]
    assert made.depth[made.depth > 0][1000] == 65535
    assert np.count_nonzero(made.depth == 65535) == 1


def test_a_few_points_between_the_pixels_are_left_out():
    image = image_of(SMALL)
    points = cloud_of(image).points
    strays = points[::200] + points[::200, 2:] * np.float32([0.5 / SMALL.fx, 0.0, 0.0])
    same_image(organised(Cloud("camera", np.concatenate([points, strays]), np.eye(4))).depths[0], image)


def test_infinite_points_are_no_returns():
    image = image_of(SMALL)
    points = cloud_of(image, is_organised=True).points
    same_image(
        organised(Cloud("camera", np.where(np.isnan(points), np.inf, points), np.eye(4))).depths[0], image
    )


def far_off(points):
    """Another frame than the camera's."""
    return transform(transform_to_a_corner(), points.astype(np.float64)).astype(np.float32)


def refused():
    rng = np.random.default_rng(3)
    points = cloud_of(image_of(SMALL)).points
    directions = rng.normal(size=(20_000, 3))
    lidar = 4.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    yield "shuffled", rng.permutation(points)
    yield "moved", far_off(points)
    yield "lidar", lidar
    yield "half of a lidar", np.abs(lidar)
    yield "things behind it, too", np.concatenate([points, -points[:500], points[-1:]])
    yield "two points on one ray", np.concatenate([points, 1.5 * points[700:701]])
    yield "noise along and across the rays", points + rng.normal(scale=0.005, size=points.shape)
    yield "whole millimetres", np.round(0.4 * points, 3)
    yield "few points", points[:400]
    yield "no point", np.full((1000, 3), np.nan)
    yield "zeros", np.zeros((1000, 3))
    yield "one row", points[: np.count_nonzero(points[:, 1] / points[:, 2] < -0.55)]
    yield "a line", np.stack([np.linspace(-1, 1, 5000), np.zeros(5000), np.ones(5000)], axis=1)
    yield "one point, again and again", np.ones((5000, 3))
    yield "infinite", np.full((1000, 3), np.inf)
    yield "huge", 1e30 * lidar
    yield "nearly flat", np.abs(lidar) * [1e19, 1e19, 1e-38]
    yield "nearly in one place", 1e-38 * points
    yield "all in one place", np.full((5000, 3), 1e-38)
    yield "an image that is too wide", wide(points)


def wide(points):
    """One point in a million pixels."""
    few = points.copy()
    few[-1] = 3e5, 0.0, 1.0
    return few


@pytest.mark.parametrize("points", [pytest.param(points, id=name) for name, points in refused()])
def test_other_clouds_stay_what_they_are(points):
    cloud = Cloud("c", np.ascontiguousarray(points, np.float32), np.eye(4))
    frame = Frame(0, clouds=(cloud,))
    made = Organiser(Threads(1)).organised(frame)
    assert made.clouds == (cloud,)
    assert made.depths == ()


def test_a_cloud_in_the_world_stays_what_it_is():
    frame = Frame(0, clouds=(Cloud("c", cloud_of(image_of(SMALL)).points),))
    assert Organiser(Threads(1)).organised(frame) is frame


def test_a_frame_keeps_its_other_readings():
    image, other = image_of(SMALL), replace(image_of(SMALL, seed=5), name="other")
    lidar = Cloud("lidar", np.ones((9, 3), np.float32), np.eye(4))
    made = organised(lidar, cloud_of(image), depths=(other,))
    assert made.clouds == (lidar,)
    assert [one.name for one in made.depths] == ["camera", "other"]
    assert made.depths[1] is other


def test_images_of_other_slots_are_not_overwritten():
    organiser, images = Organiser(Threads(1)), [image_of(SMALL, seed) for seed in range(3)]
    made = [
        organiser.organised(Frame(0, clouds=(cloud_of(image),)), slot) for slot, image in enumerate(images)
    ]
    for frame, image in zip(made, images, strict=True):
        same_image(frame.depths[0], image)


def test_a_camera_is_the_same_in_each_frame_and_whatever_came_before():
    organiser = Organiser(Threads(1))
    clouds = [cloud_of(image_of(D435, seed, 0.9)) for seed in range(4)]
    lenses = [organiser.organised(Frame(0, clouds=(cloud,))).depths[0].intrinsics for cloud in clouds]
    assert len(set(lenses)) == 1
    assert organised(clouds[2]).depths[0].intrinsics == lenses[0]


# ------------------------------------------------------------------------------------------------------------ the loop


def loop(points, P, height, width, parts=1):
    pixels, counts = np.zeros(height * width + 1, np.uint16), np.zeros((parts, 3), np.int64)
    working = np.empty(3 * LANES, np.float32), np.empty(LANES, np.int32), np.empty(LANES, np.int32)
    edges = np.linspace(0, len(points), parts + 1).astype(int)
    for part, (low, high) in enumerate(pairwise(edges)):
        put_into_pixels(points, low, high, P, np.array([height, width]), *working, pixels, counts[part])
    return pixels[:-1].reshape(height, width), counts.sum(axis=0).tolist()


def hard_points():
    rng = np.random.default_rng(7)
    some = rng.uniform((-1, -1, -0.2), (1, 1, 3), (3000, 3))
    border = np.array([[u / 8, v / 8, 1.0] for u in range(-80, 81) for v in (-60, -1, 0, 1, 59, 60)])
    strange = np.array(
        [[np.nan] * 3, [np.inf] * 3, [0, 0, np.inf], [np.nan, 0, 1], [0, 0, 0], [0, 0, -1], [0, 0, 4e-4],
         [0, 0, 6e-4], [0, 0, 65.5349], [0, 0, 65.536], [0, 0, 1e30], [1e30, 0, 1], [-1e30, 0, 1], [0, 0, 1e-40]]
    )  # fmt: skip
    yield "random", some
    yield "borders", border
    yield "strange", strange
    yield "nothing", np.empty((0, 3))
    yield "one", np.array([[0.1, 0.1, 1.0]])
    yield "as many as lanes", some[:LANES]
    yield "one more", some[: LANES + 1]


@pytest.mark.parametrize("parts", [1, 3])
@pytest.mark.parametrize("points", [pytest.param(points, id=name) for name, points in hard_points()])
def test_the_loop_equals_its_naive_twin(points, parts):
    points, P = np.ascontiguousarray(points, np.float32), np.zeros((3, 4), np.float32)
    P[0, 0], P[1, 1], P[2, 2] = 8.0, 8.0, 1.0
    P[:2, 2] = BIAS + 10.0, BIAS + 7.5
    image, counts = loop(points, P, 15, 21, parts)
    wanted, wanted_counts = naive_organise.put_into_pixels(points, P, 15, 21)
    np.testing.assert_array_equal(image, wanted)
    assert counts == wanted_counts


# ------------------------------------------------------------------------------------------------- detector and tracker


def in_their_frames(frame: Frame) -> Frame:
    images = [replace(image, T_world_camera=np.eye(4)) for image in frame.depths]
    clouds = (
        replace(cloud_of(image), T_world_sensor=placed.T_world_camera)
        for image, placed in zip(images, frame.depths, strict=True)
    )
    return Frame(frame.stamp_ns, clouds=tuple(clouds))


def test_a_camera_s_cloud_in_millimetres_is_told():
    points = 1000.0 * cloud_of(image_of(SMALL)).points
    with pytest.raises(HeadvoxError, match=r"camera: half .* Convert them to metres"):
        Detector().detect_frame(Frame(0, clouds=(Cloud("camera", points, np.eye(4)),)))


def test_a_detector_finds_in_clouds_what_it_finds_in_images():
    detector = Detector()
    for frame in list(open_source(sample_folder()))[::6]:
        heads, again = detector.detect_frame(frame), detector.detect_frame(in_their_frames(frame))
        np.testing.assert_array_equal(again.scores, heads.scores)
        np.testing.assert_allclose(again.centres, heads.centres, atol=0.03)
        assert len(heads) >= 3


def test_a_tracker_knows_from_clouds_where_nobody_is():
    """Where the image sees through the place, the head that was there is gone at once."""
    lens = Intrinsics(160, 90, 81.1, 81.3, 79.2, 44.9)
    wall = DepthImage("camera", np.full((90, 160), 4000, np.uint16), lens, transform_to_a_corner())
    cloud = in_their_frames(Frame(0, depths=(wall,))).clouds
    ends = [lifetime(readings) for readings in ({"depths": (wall,)}, {"clouds": cloud})]
    assert ends[0] == ends[1] < TrackerConfig().missed_s


def lifetime(readings) -> float:
    """How long a head lives that stood 2 m before the camera, and then does no more."""
    tracker, centre = Tracker(), np.array([[3.0, 2.0, 0.5]])
    head = Heads(centre, np.full((1, 4), np.nan), np.full(1, 0.1), np.full(1, 6.0))
    for k in range(30):
        tracker.update(head, Frame(k * 33_000_000, **readings))
    for k in range(30, 200):
        if len(tracker.update(Heads(), Frame(k * 33_000_000, **readings))) == 0:
            return (k - 30) * 0.033
    raise AssertionError("it lives for ever")


def test_the_grid_is_that_of_the_camera():
    grid = grid_of(cloud_of(image_of(D435)).points)
    assert grid is not None
    np.testing.assert_array_equal(grid.T_sensor_optical, np.eye(4))
    assert grid.column.f == pytest.approx(430.25, abs=0.01)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda tracker: pickle.loads(pickle.dumps(tracker))])
def test_a_tracker_can_be_copied(copied):
    centre = np.array([[3.0, 2.0, 0.5]])
    head = Heads(centre, np.full((1, 4), np.nan), np.full(1, 0.1), np.full(1, 6.0))
    tracker = Tracker()
    for k in range(10):
        tracker.update(head, Frame(k * 33_000_000))
    again = copied(tracker).update(head, Frame(400_000_000))
    assert again.ids.tolist() == tracker.update(head, Frame(400_000_000)).ids.tolist() == [1]
