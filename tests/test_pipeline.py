from dataclasses import replace

import naive
import numpy as np
import pytest
import scenes

from headvox import Cloud, DepthImage, Detector, Frame, Heads, HeadvoxError, Intrinsics
from headvox.config import DetectorConfig
from headvox.data import BadFrame, Expected
from headvox.fuse import Region
from headvox.masks.read import load_cascade, parse_cascade

SMALL = {
    "max_range_m": 0.7,
    "min_height_m": -0.5,
    "max_height_m": 0.5,
    "centre": (0.0, 0.0, 0.0),
    "refine": "sphere",
}


@pytest.fixture(scope="module")
def cascades(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cascades")
    (folder / "stages.toml").write_text(scenes.STAGES, encoding="utf-8")
    fourth = scenes.STAGES.replace("min_score =", 'candidates = "every fourth"\nmin_score =', 1)
    (folder / "fourth.toml").write_text(fourth, encoding="utf-8")
    (folder / "votes.toml").write_text(scenes.VOTES, encoding="utf-8")
    names = ("stages", "fourth", "votes")
    return {name: str(folder / f"{name}.toml") for name in names}


@pytest.fixture
def make(cascades):
    """Return a function that makes a detector, and end its threads afterwards."""
    made = []

    def make(cascade="stages", **settings):
        made.append(Detector(DetectorConfig(cascade=cascades.get(cascade, cascade), **{**SMALL, **settings})))
        return made[-1]

    yield make
    for detector in made:
        detector.close()


def everything(heads: Heads) -> tuple[bytes, ...]:
    return tuple(a.tobytes() for a in (heads.centres, heads.quaternions, heads.radii, heads.scores))


def two_busts(seed=0):
    rng = np.random.default_rng(seed)
    return np.concatenate(
        [scenes.bust(rng, (-0.25, -0.2, 0.1), 400), scenes.bust(rng, (0.25, 0.25, 0.15), 400)]
    )


def camera_frame(seed=0, count=1):
    rng = np.random.default_rng(seed)
    spheres = [(0.1, -0.15, 0.1, 0.1), (0.1, -0.15, -0.2, 0.17), (0.3, 0.25, 0.15, 0.1)]
    places = [scenes.looking_along_x(-0.9, 0.0, 0.1), scenes.looking_along_x(-0.8, 0.3, 0.2)]
    images = [
        scenes.image_of_spheres(rng, T, spheres, 1.7, name=f"c{k}") for k, T in enumerate(places[:count])
    ]
    return Frame(0, depths=tuple(images))


# ------------------------------------------------------------------------------------------------------ the whole flow


def same_heads(heads: Heads, wanted: naive.Found):
    assert heads.scores.tolist() == wanted.scores
    np.testing.assert_allclose(heads.centres, wanted.centres, atol=1e-9)
    np.testing.assert_allclose(heads.radii, wanted.radii, atol=1e-9)


NARROW = {"max_range_m": 0.45, "min_height_m": -0.25, "max_height_m": 0.35}
REGION = Region((0.0, 0.0, 0.0), 0.45, -0.25, 0.35)


@pytest.mark.parametrize("cascade", ["stages", "fourth", "votes"])
def test_clouds_equal_the_naive_twin(make, cascades, cascade):
    rng = np.random.default_rng(1)
    T = scenes.pose(rng)
    cloud = np.concatenate(
        [scenes.bust(rng, (0.1, 0.1, 0.15), 150), scenes.bust(rng, (-0.2, -0.2, 0.1), 150)]
    )
    in_sensor = ((cloud - T[:3, 3]) @ T[:3, :3]).astype(np.float32)
    world, turned = np.ascontiguousarray(cloud[::2]), np.ascontiguousarray(in_sensor[1::2])
    frame = Frame(0, clouds=(Cloud("world", world), Cloud("turned", turned, T)))
    least = 0.0 if cascade == "votes" else -1.0
    detector = make(cascade, min_score=least, **NARROW)
    wanted = naive.detect(frame, load_cascade(cascades[cascade]), REGION, least)
    same_heads(detector.detect_frame(frame), wanted)
    assert detector.candidates == wanted.candidates
    assert len(wanted.scores) > 1


@pytest.mark.parametrize("count", [1, 2])
def test_depth_images_equal_the_naive_twin(make, cascades, count):
    """Through all stages, those that ask what the cameras saw too."""
    frame = camera_frame(count, count)
    for least in (None, -2.0)[count - 1 :]:
        wanted = naive.detect(frame, load_cascade(cascades["stages"]), REGION, least)
        detector = make(min_score=least, **NARROW)
        same_heads(detector.detect_frame(frame), wanted)
        assert detector.candidates == wanted.candidates
    assert len(wanted.scores) > 1


def test_clouds_and_depth_images_in_one_frame(make, cascades):
    cloud = scenes.bust(np.random.default_rng(0), (-0.2, -0.2, 0.1), 100)
    frame = replace(camera_frame(1), clouds=(Cloud("c", cloud),))
    wanted = naive.detect(frame, load_cascade(cascades["stages"]), REGION)
    same_heads(make(**NARROW).detect_frame(frame), wanted)
    assert len(wanted.scores) > 0


def test_without_refinement_a_head_is_at_its_voxel(make):
    heads = make(refine="none", min_score=-1.0).detect(two_busts())
    assert len(heads) > 1
    steps = heads.centres / 0.05 - 0.5
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)


def expecting(*centres, reach=0.2) -> Expected:
    return Expected(
        np.array(centres).reshape(-1, 3), np.full((len(centres), 4), np.nan), np.full(len(centres), reach)
    )


@pytest.mark.parametrize("frame", [Frame(0, clouds=(Cloud("c", two_busts()),)), camera_frame(0, 2)])
def test_where_a_head_is_expected_a_weaker_one_lives_but_not_a_much_weaker_one(make, frame):
    everyone = make(min_score=-2.0).detect_frame(frame)
    best = everyone.centres[0]
    above = float(everyone.scores[0]) + 0.5
    detector = make(min_score=above, score_slack=0.6)
    assert len(detector.detect_frame(frame)) == 0
    heads = detector.detect_frame(frame, expecting(best))
    assert (heads.scores[0], heads.sure[0]) == (everyone.scores[0], False)
    np.testing.assert_array_equal(heads.centres[0], best)
    assert (np.linalg.norm(heads.centres - best, axis=1) < 0.4).all()
    assert len(detector.detect_frame(frame, expecting(best + np.array((0, 0, 1.5))))) == 0
    assert len(detector.detect_frame(frame, expecting())) == 0
    assert len(make(min_score=above, score_slack=0.4).detect_frame(frame, expecting(best))) == 0


def test_expecting_a_head_takes_nothing_from_the_others(make):
    """What is found without expecting anything is found with it, surely and bit for bit."""
    frame = camera_frame(1, 2)
    detector = make(min_score=-1.0)
    bare = detector.detect_frame(frame)
    expected = detector.detect_frame(frame, expecting((0.1, -0.15, 0.1), (0.9, 0.9, 0.0), reach=0.1))
    assert len(bare) > 0
    assert bare.sure.all()
    sure = expected.sure
    assert everything(bare) == tuple(
        a[sure].tobytes() for a in (expected.centres, expected.quaternions, expected.radii, expected.scores)
    )


def test_heads_come_best_first_and_apart(make):
    heads = make(min_score=-2.0).detect(two_busts())
    assert len(heads) > 1
    assert (np.diff(heads.scores) <= 0).all()
    for i in range(len(heads)):
        others = np.delete(heads.centres, i, axis=0)
        assert np.linalg.norm(others - heads.centres[i], axis=1).min() >= 0.18
    assert [head.score for head in heads] == heads.scores.tolist()
    assert np.isnan(heads.quaternions).all()


def test_votes_give_a_yaw(make):
    heads = make("votes", min_score=0.0).detect(two_busts())
    assert len(heads) > 0
    np.testing.assert_allclose(np.linalg.norm(heads.quaternions, axis=1), 1.0)
    yaws = 2 * np.degrees(np.arctan2(heads.quaternions[:, 2], heads.quaternions[:, 3]))
    assert set(np.round(yaws)) <= {0.0, 45.0, 90.0, 120.0}


def test_min_score_drops_the_worse(make):
    everyone = make(min_score=-2.0).detect(two_busts())
    least = float(np.sort(everyone.scores)[len(everyone) // 2])
    some = make(min_score=least).detect(two_busts())
    assert some.scores.tolist() == [s for s in everyone.scores.tolist() if s >= least]


# ------------------------------------------------------------------------------------------------------- determinism


@pytest.mark.parametrize("cascade", ["stages", "votes", "default"])
def test_threads_second_runs_and_other_frames_change_nothing(make, cascade):
    """Bytes are equal; a big frame before, a small one, a bad one and another kind leave nothing behind."""
    rng = np.random.default_rng(3)
    cloud = two_busts()
    settings = {"min_score": -2.0 if cascade == "stages" else 0.0}
    wanted = everything(make(cascade, **settings).detect(cloud))
    for threads in (1, 2, 3):
        detector = make(cascade, threads=threads, **settings)
        assert everything(detector.detect(cloud)) == wanted
        assert everything(detector.detect(cloud)) == wanted
        detector.detect(rng.uniform(-1, 1, (20_000, 3)).astype(np.float32))
        assert everything(detector.detect(cloud)) == wanted
        detector.detect(cloud[:1])
        with pytest.raises(HeadvoxError):
            detector.detect(np.full((3, 3), np.nan, np.float32))
        with pytest.raises(HeadvoxError):
            detector.detect(cloud + np.float32(90))
        detector.detect_frame(camera_frame(2, 2))
        assert everything(detector.detect(cloud)) == wanted


@pytest.mark.parametrize("threads", [1, 2])
def test_depth_frames_leave_nothing_behind(make, threads):
    wanted = [everything(make(min_score=-2.0).detect_frame(camera_frame(k, 2))) for k in range(3)]
    detector = make(min_score=-2.0, threads=threads)
    for k in (0, 2, 1, 1, 0):
        assert everything(detector.detect_frame(camera_frame(k, 2))) == wanted[k]
        detector.detect_frame(camera_frame(k, 1))
        detector.detect(two_busts(k))


@pytest.mark.parametrize("threads", [1, 2])
def test_permuted_points_make_the_same_bytes(make, threads):
    cloud = two_busts()
    for cascade in ("stages", "votes"):
        detector = make(cascade, min_score=-1.0, threads=threads)
        wanted = everything(detector.detect(cloud))
        for seed in range(3):
            shuffled = np.random.default_rng(seed).permutation(cloud)
            assert everything(detector.detect(shuffled)) == wanted


def test_many_heads_outgrow_the_memory_for_candidates(make):
    """More candidates than there was room for, in each thread, and then few again."""
    rng = np.random.default_rng(4)
    few, many = two_busts(), (rng.uniform(-3, 3, (20_000, 3)) * [1, 1, 0.05]).astype(np.float32)
    one, two = make(max_range_m=3.0, min_score=0.0), make(max_range_m=3.0, min_score=0.0, threads=2)
    wanted = everything(one.detect(few))
    assert everything(one.detect(many)) == everything(two.detect(many))
    assert two.candidates > 2 * 4096
    assert everything(one.detect(few)) == everything(two.detect(few)) == wanted


@pytest.mark.parametrize("cascade", ["stages", "fourth", "votes", "default"])
def test_heads_on_both_sides_of_where_the_volume_is_cut(make, cascade):
    """Busts a voxel apart in x, so that some lie on every seam, where their neighbours belong to another slab."""
    rng = np.random.default_rng(5)
    places = [(0.05 * k - 1.4, 0.4 * (k % 7) - 1.2, 0.1) for k in range(56)]
    cloud = np.concatenate([scenes.bust(rng, place, 400) for place in places])
    settings = {"max_range_m": 2.0, "min_score": 0.0}
    wanted = make(cascade, **settings).detect(cloud)
    assert len(wanted) > 20
    for threads in (2, 3):
        detector = make(cascade, threads=threads, **settings)
        assert everything(detector.detect(cloud)) == everything(wanted)
        seams = detector._memory.slabs.seams
        assert 0 < len(seams) < threads
        at = detector._memory.lattice.centres(detector._memory.first + np.stack([seams] * 3, axis=1))[:, 0]
        assert (np.abs(wanted.centres[:, 0] - at[:, None]).min(axis=1) < 0.1).all()


def test_a_frame_that_fails_midway_leaves_nothing_behind(make, monkeypatch):
    detector = make(min_score=-1.0)
    wanted = everything(detector.detect(two_busts(0)))

    def fail(*_):
        raise KeyboardInterrupt

    for stage in ("_gate", "_vote", "_suppress", "_judge", "_refine"):
        with monkeypatch.context() as patch:
            patch.setattr(detector, stage, fail)
            with pytest.raises(KeyboardInterrupt):
                detector.detect(two_busts(1))
        assert everything(detector.detect(two_busts(0))) == wanted


def test_a_moving_camera_is_followed_even_when_its_matrix_is_changed_in_place(make):
    frame = camera_frame()
    image = frame.depths[0]
    T = image.T_world_camera.copy()
    detector = make(min_score=-2.0)
    moving = Frame(0, depths=(replace(image, T_world_camera=T),))
    detector.detect_frame(moving)
    T[:3, 3] += (0.1, 0.05, -0.1)
    there = Frame(0, depths=(replace(image, T_world_camera=T.copy()),))
    assert everything(detector.detect_frame(moving)) == everything(make(min_score=-2.0).detect_frame(there))


def test_two_cameras_of_one_name_are_two_cameras(make):
    frame = camera_frame(1, 2)
    same = Frame(0, depths=tuple(replace(image, name="camera") for image in frame.depths))
    for threads in (1, 2):
        detector = make(min_score=-2.0, threads=threads)
        wanted = everything(detector.detect_frame(frame))
        assert everything(detector.detect_frame(same)) == wanted
        assert everything(detector.detect_frame(same)) == wanted


# ----------------------------------------------------------------------------------------------- where the cloud lies


@pytest.mark.parametrize("steps", [(1, 0, 0), (-2, 3, 1), (4, -4, -2)])
def test_moving_the_cloud_by_whole_voxels_moves_the_heads(make, steps):
    """The grid is cropped to what is occupied: that may not change what is found."""
    cloud = np.round(two_busts() / np.float32(0.0125)) * np.float32(0.0125) + np.float32(0.005)
    shift = np.array(steps) * 0.05
    detector = make(max_range_m=1.5, min_height_m=-1.0, max_height_m=1.0, min_score=-2.0)
    here, there = detector.detect(cloud), detector.detect((cloud + shift).astype(np.float32))
    assert len(here) > 1
    # Equal scores may change their order with rounding of nothing but the centres: they are integers in 1/1024.
    assert there.scores.tolist() == here.scores.tolist()
    np.testing.assert_allclose(there.centres, here.centres + shift, atol=1e-9)


@pytest.mark.parametrize("cascade", ["stages", "votes", "default"])
def test_single_points_far_away_change_nothing(make, cascade):
    """They widen the box that the grid is cropped to, up to the whole of it."""
    cloud = two_busts()
    far = np.array(
        [[-1.9, 0, 0], [1.9, 0, 0], [0, -1.9, 0], [0, 1.9, 0], [0, 0, -1.95], [0, 0, 1.95]], np.float32
    )
    settings = {"max_range_m": 2.0, "min_height_m": -2.0, "max_height_m": 2.0}
    settings["min_score"] = -2.0 if cascade == "stages" else 0.0
    detector = make(cascade, **settings)
    alone = detector.detect(cloud)
    widened = detector.detect(np.concatenate([cloud, far]))
    near = np.linalg.norm(widened.centres, axis=1) < 1.0
    assert widened.scores[near].tolist() == alone.scores.tolist()
    np.testing.assert_array_equal(widened.centres[near], alone.centres)


def test_a_wider_region_finds_the_same_heads(make):
    near = make(min_score=-2.0).detect(two_busts())
    wide = make(max_range_m=2.0, min_height_m=-1.0, max_height_m=1.5, min_score=-2.0).detect(two_busts())
    assert wide.scores.tolist() == near.scores.tolist()
    np.testing.assert_allclose(wide.centres, near.centres, atol=1e-9)


def test_a_world_far_from_its_origin(make):
    """Sensor coordinates are small; the world's may be as large as the earth's."""
    T = np.eye(4)
    here = make(min_score=-2.0).detect(two_busts(), T)
    T[:3, 3] = (4_000_000.0, -5_000_000.0, 0.0)
    there = make(min_score=-2.0, centre=(4_000_000.0, -5_000_000.0, 0.0)).detect(two_busts(), T)
    assert there.scores.tolist() == here.scores.tolist()
    np.testing.assert_allclose(there.centres - T[:3, 3], here.centres, atol=1e-6)


def test_the_region_is_about_the_sensors_unless_told(make):
    T = np.eye(4)
    T[:3, 3] = (3.0, -2.0, 0.1)
    heads = make(centre=None, min_score=-2.0).detect(two_busts(), T)
    assert len(heads) > 1
    with pytest.raises(HeadvoxError, match=r"within 0.7 m of \(0.00, 0.00, 0.00\)"):
        make(min_score=-2.0).detect(two_busts(), T)


def test_depth_and_its_cloud_find_the_same_voxels(make):
    """Occupancy alone, as a cloud knows no empty space, and values that round alike on both ways."""
    T = scenes.looking_along_x(-0.75, 0.0, 0.125)
    image = camera_frame().depths[0]
    camera = Intrinsics(48, 40, 32.0, 32.0, 24.0, 20.0, 1 / 1024)
    image = DepthImage("d", image.depth, camera, T)
    v, u = np.nonzero(image.depth)
    z = image.depth[v, u].astype(np.float64) / 1024
    points = np.column_stack([(u - 24) / 32 * z, (v - 20) / 32 * z, z]).astype(np.float32)
    detector = make("votes", refine="none", voxel_m=0.0625, min_score=-2.0)
    by_depth, by_cloud = detector.detect_depth(image), detector.detect(points, T)
    assert len(by_depth) > 0
    assert everything(by_depth) == everything(by_cloud)


# ------------------------------------------------------------------------------------------------------------- input


def test_one_point_is_no_head(make):
    heads = make().detect(np.zeros((1, 3), np.float32))
    assert len(heads) == 0
    assert heads.centres.shape == (0, 3)
    assert heads.quaternions.shape == (0, 4)
    assert list(heads) == []


def test_a_million_points_in_one_place(make):
    cloud = np.concatenate([two_busts(), np.tile(np.float32([[0.0, 0.0, 0.4]]), (1_000_000, 1))])
    for cascade in ("stages", "votes"):
        detector = make(cascade, min_score=-2.0)
        once = detector.detect(cloud[: len(two_busts()) + 1])
        many = detector.detect(cloud)
        if cascade == "stages":
            assert everything(many) == everything(once)
        assert np.isfinite(many.centres).all()


def test_points_and_images_that_may_not_be_written(make):
    cloud = two_busts()
    detector = make(min_score=-2.0)
    wanted = everything(detector.detect(cloud))
    cloud.flags.writeable = False
    assert everything(detector.detect(cloud)) == wanted


def test_a_bad_point_among_good_ones_is_passed_over(make):
    cloud = two_busts()
    bad = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [1e30, 0, 0], [0, -3e38, 0]], np.float32)
    detector = make(min_score=-2.0)
    wanted = everything(detector.detect(cloud))
    assert everything(detector.detect(np.concatenate([bad, cloud, bad]))) == wanted


def depth_image(depth, **camera):
    shape = depth.shape if isinstance(depth, np.ndarray) and depth.ndim == 2 else (2, 3)
    values = {"width": shape[1], "height": shape[0], "fx": 2.0, "fy": 2.0, "cx": 1.0, "cy": 1.0, **camera}
    return DepthImage("left", depth, Intrinsics(**values), np.eye(4))


def test_wrong_points(make):
    good = two_busts()
    detector = make()
    for points, told in [
        (good[:, :2], r"points: expected points of shape \(N, 3\), got \(1600, 2\)"),
        (good[0], r"expected points of shape \(N, 3\), got \(3,\)"),
        (good.tolist(), r"expected points of shape \(N, 3\), got list"),
        (None, "got NoneType"),
        (good.astype(np.float64), "expected C-contiguous float32 points, got float64"),
        ((good * 1000).astype(np.int32), "float32 points, got int32"),
        (good[::2], "expected C-contiguous float32"),
        (np.asfortranarray(good), "expected C-contiguous float32"),
        (np.empty((0, 3), np.float32), "points: the cloud is empty"),
        (np.full((5, 3), np.nan, np.float32), "all 5 points are NaN or infinite"),
        (np.full((5, 3), np.inf, np.float32), "all 5 points are NaN or infinite"),
        ((good * 1000).astype(np.float32) + np.float32(2000), "are they in millimetres"),
        (good + np.float32(9), r"none of 1600 points is within 0.7 m of \(0.00, 0.00, 0.00\)"),
        (np.float32([[0.0, 0.0, 0.6]]), "between -0.5 m and 0.5 m high"),
        (np.full((5, 3), 1e30, np.float32), "millimetres"),
    ]:
        with pytest.raises(HeadvoxError, match=told) as error:
            detector.detect(points)
        assert error.value.do


def test_wrong_depth_images(make):
    detector = make()
    full = np.full((2, 3), 500, np.uint16)
    for image, told in [
        (
            depth_image(full.astype(np.float32)),
            r"left: expected a \(height, width\) uint16 depth image, got float32",
        ),
        (depth_image(full.astype(">u2")), "expected a .* uint16 depth image"),
        (depth_image(full[None]), "uint16 depth image"),
        (depth_image(full.tolist()), "uint16 depth image, got list"),
        (depth_image(full, width=4), "left: the image is 3x2, its camera 4x2"),
        (depth_image(full, height=3), "the image is 3x2, its camera 3x3"),
        (depth_image(np.empty((0, 3), np.uint16)), "the image is 3x0"),
        (depth_image(full, fx=0.0), "fx, fy and depth_scale must be above 0"),
        (depth_image(full, fy=float("nan")), "fx, fy and depth_scale"),
        (depth_image(full, depth_scale=-0.001), "fx, fy and depth_scale"),
        (depth_image(np.zeros((2, 3), np.uint16)), "left: the depth image has no return at all"),
        (depth_image(np.full((2, 3), 65535, np.uint16)), "left: no return is within 0.7 m"),
    ]:
        with pytest.raises(HeadvoxError, match=told) as error:
            detector.detect_depth(image)
        assert error.value.do


def test_wrong_transforms(make):
    detector = make()
    full = np.full((2, 3), 500, np.uint16)
    for T, told in [
        (np.eye(3), r"expected a 4x4 matrix, got shape \(3, 3\)"),
        (np.full((4, 4), np.nan), "NaN"),
        (2 * np.eye(4), "the last row"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "not a rotation"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "not a rotation"),
    ]:
        with pytest.raises(HeadvoxError, match=told):
            detector.detect(two_busts(), T)
        with pytest.raises(HeadvoxError, match=told):
            detector.detect_depth(replace(depth_image(full), T_world_camera=T))
        with pytest.raises(HeadvoxError, match=told):
            detector.detect_frame(Frame(0, clouds=(Cloud("c", two_busts(), T),)))


def test_no_sensor_at_all(make):
    with pytest.raises(HeadvoxError, match="neither points nor depth images"):
        make().detect_frame(Frame(0))
    with pytest.raises(HeadvoxError, match="neither points nor depth images"):
        make().detect_depth([])


def test_an_unknown_cascade_is_told_when_the_detector_is_made():
    with pytest.raises(HeadvoxError, match="Unknown cascade 'hats'"):
        Detector(DetectorConfig(cascade="hats"))


def test_a_region_that_no_grid_can_hold_is_refused(make):
    with pytest.raises(HeadvoxError, match=r"voxels of 0\.005 m"):
        make(max_range_m=50.0, voxel_m=0.005).detect(two_busts())


def test_cameras_out_of_sight_of_each_other(make):
    """One camera without any return does not stop the other."""
    frame = camera_frame(1, 2)
    blind = replace(frame.depths[1], depth=np.zeros_like(frame.depths[1].depth))
    alone = make(min_score=-2.0).detect_frame(Frame(0, depths=frame.depths[:1]))
    both = make(min_score=-2.0).detect_frame(Frame(0, depths=(frame.depths[0], blind)))
    assert both.scores.tolist() == alone.scores.tolist()


def test_stage_times_are_told(make):
    detector = make()
    detector.detect(two_busts())
    assert list(detector.stage_ms) == ["voxelize", "integral", "gate", "vote", "suppress", "judge", "refine"]
    assert all(isinstance(ms, float) and ms >= 0 for ms in detector.stage_ms.values())


def test_data_classes_iterate_and_compare():
    heads = Heads(np.zeros((2, 3)), np.zeros((2, 4)), np.array([0.1, 0.2]), np.array([2.0, 1.0]))
    assert len(heads) == 2
    assert [(head.radius, head.score) for head in heads] == [(0.1, 2.0), (0.2, 1.0)]
    assert BadFrame(3, "torn").reason == "torn"


def test_a_cascade_of_the_tests_is_a_cascade():
    assert parse_cascade(scenes.STAGES, "x").sees
    assert not parse_cascade(scenes.VOTES, "x").sees
