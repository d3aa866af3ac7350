"""What a detector takes, and what it refuses."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
import scenes
from busts import camera_frame, everything, two_busts

from headvox import Cloud, DepthImage, Detector, Frame, Heads, HeadvoxError, Intrinsics, Tracker
from headvox.config import DetectorConfig
from headvox.data import BadFrame
from headvox.masks.read import parse_cascade
from headvox.placing import Placing


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
    room = np.random.default_rng(0).uniform([1.0, -3.0, -1.0], [5.0, 3.0, 1.0], (500, 3)).astype(np.float32)
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
        ((room * 1000).astype(np.float32), r"points: .* \(0.00, 0.00, 0.00\) .* these look like millimetres"),
        ((room * 100).astype(np.float32), "their middle: metres are expected"),
        ((room * 39.37).astype(np.float32), "their middle: metres are expected"),
        (room + np.float32([5e5, 4.5e6, 0.0]), "m or more from .*, though they lie together"),
        (good + np.float32(9), r"none of 1600 points is within 0.7 m of \(0.00, 0.00, 0.00\)"),
        (np.float32([[0.0, 0.0, 0.6]]), "between -0.5 m and 0.5 m high"),
        (np.full((5, 3), 1e30, np.float32), "though they lie together"),
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
        (depth_image(full, fx=0.0), r"left: fx: expected a finite number above 0, got 0\.0"),
        (depth_image(full, fx=float("inf")), "left: fx: expected a finite number above 0, got inf"),
        (depth_image(full, fy=float("nan")), "left: fy: expected a finite number above 0, got nan"),
        (depth_image(full, fy="2"), "left: fy: expected a finite number above 0, got '2'"),
        (depth_image(full, cx=float("nan")), "left: cx: expected a finite number, got nan"),
        (depth_image(full, cy=float("-inf")), "left: cy: expected a finite number, got -inf"),
        (
            depth_image(full, depth_scale=-0.001),
            r"depth_scale: expected a finite number above 0, got -0\.001",
        ),
        (
            depth_image(full, depth_scale=float("inf")),
            "depth_scale: expected a finite number above 0, got inf",
        ),
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


def test_heads_are_rows_of_their_arrays(make):
    heads = make().detect(two_busts())
    assert len(heads) >= 2
    assert [head.score for head in heads] == heads.scores.tolist()
    assert heads[1].centre.tolist() == heads.centres[1].tolist()
    assert heads[-1].radius == heads.radii[-1]


def test_a_frame_that_is_none(make):
    with pytest.raises(HeadvoxError, match=r"nothing in a bad frame: damaged\. Leave it out"):
        make().detect_frame(BadFrame(0, "damaged."))
    for stamp_ns in (1.5, float("nan"), 2**63, None):
        with pytest.raises(HeadvoxError, match=r"stamp_ns: expected whole nanoseconds, .* got "):
            make().detect_frame(Frame(stamp_ns, clouds=(Cloud("c", two_busts()),)))


def test_a_reading_of_another_kind_is_told_with_what_makes_one(make):
    detector, points, image = make(), two_busts(), depth_image(np.full((2, 3), 500, np.uint16))
    cloud = Cloud("c", points)
    for call, told in [
        (lambda: detector.detect_frame(None), r"headvox\.Frame, got NoneType\. Make it by headvox\.Frame\(stamp_ns, "),
        (lambda: detector.detect_batch([image]), "detect_frame: expected headvox.Frame, got DepthImage"),
        (lambda: detector.detect_depth(image.depth), r"got ndarray\. Make it by headvox\.DepthImage\(name, depth, "),
        (lambda: detector.detect_depth([image.depth]), "depths of the frame: expected headvox.DepthImage, got ndarray"),
        (lambda: detector.detect_depth(None), "expected headvox.DepthImage, got NoneType"),
        (lambda: detector.detect_frame(Frame(0, (points,))), "clouds of the frame: expected headvox.Cloud, got nd"),
        (lambda: detector.detect_frame(Frame(0, cloud)), r"tuple of Cloud, got Cloud\. Write clouds=\(reading,\)"),
        (lambda: detector.detect_frame(Frame(0, depths=image)), "expected a tuple of DepthImage, got DepthImage"),
        (lambda: detector.detect_frame(Frame(0, None)), "expected a tuple of Cloud, got NoneType"),
        (lambda: detector.detect_depth(replace(image, intrinsics=(3, 2))), "expected headvox.Intrinsics, got tuple"),
        (lambda: detector.detect_depth(replace(image, T_world_camera=np.eye(4).tolist())), "got list"),
        (lambda: detector.detect_frame(Frame(0, (Cloud("c", points, np.eye(4).tolist()),))), "got list"),
        (lambda: detector.detect_frame(Frame(0, (cloud,)), Heads()), r"expected: expected headvox\.Expected, got H"),
        (lambda: Tracker().update(None, Frame(0)), r"Tracker\.update: heads: expected headvox.Heads, got NoneType"),
        (lambda: Tracker().update(Heads(), BadFrame(0, "dark")), "frame: expected headvox.Frame, got BadFrame"),
    ]:  # fmt: skip
        with pytest.raises(HeadvoxError, match=told) as error:
            call()
        assert error.value.do


def test_what_is_masked_or_imaginary_is_not_passed_over(make):
    points, image = two_busts(), depth_image(np.full((2, 3), 500, np.uint16))
    with pytest.raises(HeadvoxError, match=r"points: .* got a masked one\. Take \.filled\(np\.nan\)"):
        make().detect(np.ma.array(points, mask=points > 0))
    with pytest.raises(HeadvoxError, match=r"left: .* got a masked one\. Take \.filled\(0\)"):
        make().detect_depth(replace(image, depth=np.ma.array(image.depth)))
    with pytest.raises(HeadvoxError, match="left: T_world_camera: expected a 4x4 matrix of real numbers"):
        make().detect_depth(replace(image, T_world_camera=np.eye(4) + 0j))


def test_settings_are_not_changed_half(make):
    detector = make()
    config = detector.config
    with pytest.raises(HeadvoxError, match=r"fixed when it is made\. Make a new one"):
        detector.config = replace(config, max_range_m=1.0)
    assert detector.config is config


def test_many_frames_may_come_one_by_one(make):
    detector = make(min_score=-2.0)
    frames = [camera_frame(k) for k in range(3)] * 4
    wanted = [everything(detector.detect_frame(frame)) for frame in frames]
    assert [everything(heads) for heads in detector.detect_batch(iter(frames))] == wanted
    assert detector.detect_batch(iter([])) == []


def test_a_place_of_other_numbers_is_the_same_place(make):
    frame = camera_frame()
    T = np.round(frame.depths[0].T_world_camera)
    for kind in (np.float32, np.int64):
        found = [
            make(min_score=-2.0).detect_frame(
                Frame(0, depths=(replace(frame.depths[0], T_world_camera=one),))
            )
            for one in (T, T.astype(kind))
        ]
        assert everything(found[0]) == everything(found[1])


def test_a_second_thread_is_refused_in_the_midst_of_a_frame_and_the_first_goes_on(make, monkeypatch):
    detector, frame = make(min_score=-2.0), Frame(0, clouds=(Cloud("c", two_busts()),))
    wanted, gate, refused = everything(detector.detect_frame(frame)), detector._gate, []

    def gate_while_others_ask(*args):
        for ask in (
            lambda: detector.detect(two_busts()),
            lambda: detector.detect_depth(camera_frame().depths),
            lambda: detector.detect_frame(frame),
            lambda: detector.detect_batch([frame]),
            detector.candidates_of_last_frame,
            detector.close,
        ):
            with pytest.raises(HeadvoxError, match=r"at work in another thread\. Give each thread its own"):
                other.submit(ask).result()
            refused.append(ask)
        return gate(*args)

    with ThreadPoolExecutor(1) as other:
        with monkeypatch.context() as patch:
            patch.setattr(detector, "_gate", gate_while_others_ask)
            assert everything(detector.detect_frame(frame)) == wanted
            assert len(refused) == 6
        with pytest.raises(HeadvoxError):
            detector.detect(two_busts()[:0])
        assert everything(other.submit(detector.detect_frame, frame).result()) == wanted


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


def back_to_back(apart_m):
    """Two cameras so far apart that look away from each other, each at a wall 1 m before it."""
    depth, images = np.full((6, 8), 1000, np.uint16), []
    for name, sign in (("left", -1.0), ("right", 1.0)):
        T = np.eye(4)
        T[:3, :3] = np.array([[0, 0, sign], [-sign, 0, 0], [0, -1, 0]])
        T[:3, 3] = sign * apart_m / 2, 0.0, 1.5
        images.append(DepthImage(name, depth, Intrinsics(8, 6, 8.0, 8.0, 3.5, 2.5, 0.001), T))
    return images


def test_a_sensor_before_which_nobody_looks_is_told_once(cascades):
    config = DetectorConfig(cascade=cascades["stages"])
    told: list[str] = []
    with closing(Detector(config, note=told.append)) as detector:
        detector.detect_depth(back_to_back(7.0)[:1])  # the other one comes later
        detector.detect_depth(back_to_back(5.0))
        assert told == []
        images = back_to_back(7.0)
        detector.detect_depth([*images, replace(images[0], name="third")])
        detector.detect_depth(images)
    (line,) = told
    assert line.startswith(
        "right stands 4.7 m from the mean of the sensors, and no head is sought farther than 5 m"
    )
    assert "not even 2 m ahead of it; set centre or max_range_m (--centre, --max-range)" in line


def test_whether_nobody_looks_before_a_sensor():
    def told(frame, **settings):
        return Placing(DetectorConfig(**settings)).unsearched(frame)

    away = back_to_back(8.0)
    assert "left stands 4.0 m" in told(Frame(0, depths=tuple(away)))
    assert told(Frame(0, depths=tuple(away)), centre=(0.0, 0.0, 1.5)) is None  # somebody chose it
    assert told(Frame(0, depths=tuple(away)), max_range_m=7.0) is None
    turn = np.diag([-1.0, 1.0, -1.0, 1.0])
    inward = tuple(replace(image, T_world_camera=image.T_world_camera @ turn) for image in away)
    assert told(Frame(0, depths=inward)) is None
    assert told(Frame(0, depths=tuple(away[:1])), max_range_m=0.5) is None
    points = np.ones((5, 3), np.float32)
    clouds = tuple(Cloud(image.name, points, image.T_world_camera) for image in away)
    assert "left stands 4.0 m" in told(Frame(0, clouds=clouds))
    assert told(Frame(0, clouds=(Cloud("placed", points),))) is None
