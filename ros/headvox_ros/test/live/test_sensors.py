"""What cameras and LiDARs send, sound and broken: the answers of one running node."""

from __future__ import annotations

import array
from dataclasses import replace

import numpy as np
from robot import centres_of, cloud_of, data_of, stamp_of
from visualization_msgs.msg import Marker

from headvox import Detector, Frame
from headvox.frames import unproject


def test_heads_are_those_of_the_library_to_the_bit(settled, frames, clock):
    detector = Detector()
    expected = [detector.detect_frame(frame) for frame in frames[:5]]
    settled.see_frame(frames[0], clock.next())  # so that both cameras are known again
    settled.spin(0.3)
    for frame, heads in zip(frames, expected, strict=False):
        stamp = clock.next()
        settled.see_frame(frame, stamp)
        message = settled.wait(lambda stamp=stamp: settled.answers(stamp))[0]
        assert message.header.frame_id == "world"
        np.testing.assert_allclose(centres_of(message), heads.centres, atol=1e-6)  # TF is a quaternion
        assert len(heads) > 0


def test_a_cloud_gives_heads_too(settled, frames, clock):
    image = frames[0].depths[0]
    points = np.concatenate([unproject(i.depth, i.intrinsics, i.T_world_camera) for i in frames[0].depths])
    stamp = clock.next()
    settled.publish("/lidar/points", cloud_of(points, "world", stamp))
    message = settled.wait(lambda: settled.answers(stamp))[0]
    heads = Detector().detect(points.astype(np.float32))
    assert len(message.poses) == len(heads) > 0
    assert image.depth.dtype == np.uint16


def test_markers_of_who_is_gone_are_deleted(settled, frames, clock):
    robot = settled
    markers = robot.got["/head_detector/markers"]
    robot.see_frame(frames[0], stamp := clock.next())
    robot.wait(lambda: any(stamp_of(m) == stamp for one in markers for m in one.markers))
    added = {(m.ns, m.id) for m in markers[-1].markers if m.action == Marker.ADD}
    assert len(added) >= 2
    assert all(m.lifetime.sec + m.lifetime.nanosec > 0 for m in markers[-1].markers if m.action == Marker.ADD)
    wall = [replace(image, depth=np.full_like(image.depth, 2500)) for image in frames[0].depths]
    robot.see_frame(Frame(0, depths=tuple(wall)), stamp := clock.next())
    robot.wait(lambda: robot.answers(stamp))
    robot.wait(lambda: any(stamp_of(m) == stamp for one in markers for m in one.markers))
    deleted = {(m.ns, m.id) for m in markers[-1].markers if m.action == Marker.DELETE}
    shown = {(m.ns, m.id) for m in markers[-1].markers if m.action == Marker.ADD}
    assert deleted == added - shown
    assert deleted


def test_a_camera_stops_and_returns(settled, frames, clock):
    robot = settled

    def only_left():
        robot.see_frame(frames[0], clock.next(), only=("left",))

    robot.wait(lambda: "/right/image" in robot.status().get("sensors_silent", ""), meanwhile=only_left)
    assert "/right/image" in robot.status()["message"]
    for _ in range(5):  # and it does not wait for the other
        only_left()
        robot.wait(lambda: robot.answers(clock.now))
    robot.wait(
        lambda: "/right/image" in robot.status()["sensors_alive"],
        meanwhile=lambda: robot.see_frame(frames[0], clock.next()),
    )
    alone, together = (
        Detector().detect_frame(Frame(0, depths=d)) for d in (frames[0].depths[:1], frames[0].depths)
    )
    robot.see_frame(frames[0], stamp := clock.next())
    message = robot.wait(lambda: robot.answers(stamp))[0]
    np.testing.assert_allclose(centres_of(message), together.centres, atol=1e-6)
    assert not np.array_equal(alone.centres, together.centres)


def test_a_megabyte_of_garbage(settled, clock):
    garbage = array.array("B", np.random.default_rng(0).bytes(1_000_000))
    fields = cloud_of(np.zeros((1, 3)), "world", 0).fields
    for changes in (
        {"width": 2**32 - 1, "height": 2**32 - 1},
        {"width": 50_000, "point_step": 8, "row_step": 400_000},
        {"fields": []},
        {"fields": [*fields[:2], type(fields[0])(name="z", offset=2**32 - 1, datatype=7, count=1)]},
        {"fields": [*fields[:2], type(fields[0])(name="z", offset=8, datatype=99, count=1)]},
        {"point_step": 0},
    ):
        message = cloud_of(np.zeros((83_333, 3)), "world", clock.next(), data=garbage, **changes)
        status = settled.expect_count("bad_messages", lambda m=message: settled.publish("/lidar/points", m))
        assert status["level"] > 0
    # Garbage with an honest header is points, somewhere: an answer, or a reason why there is none.
    message = cloud_of(np.zeros((83_333, 3)), "world", clock.next(), data=garbage)
    frames_before = int(settled.status()["frames"]) + int(settled.status()["frames_without_answer"])
    settled.publish("/lidar/points", message)
    settled.wait(
        lambda: (
            int(settled.status()["frames"]) + int(settled.status()["frames_without_answer"]) > frames_before
        )
    )


def test_an_image_that_is_no_depth_image(settled, frames, clock):
    image = frames[0].depths[0]
    for changes in ({"encoding": "rgb8"}, {"step": 3}, {"data": array.array("B", bytes(100))}, {"height": 9}):
        stamp = clock.next()
        status = settled.expect_count(
            "bad_messages", lambda c=changes, s=stamp: settled.see("left", image, s, **c)
        )
        assert "/left/image" in status["last_problem"]
        assert not settled.answers(stamp)


def test_nan_everywhere_is_not_nobody(settled, frames, clock):
    """A sensor that measures nothing must not look like an empty room."""
    image = frames[0].depths[0]
    nan = data_of(np.full(image.depth.shape, np.nan, np.float32))
    stamps = [clock.next(), clock.next(), clock.next()]
    change = {"encoding": "32FC1", "step": 4 * image.depth.shape[1], "data": nan}
    settled.expect_count("frames_without_answer", lambda: settled.see("left", image, stamps[0], **change))
    cloud = cloud_of(np.full((1000, 3), np.nan), "world", stamps[1])
    settled.expect_count("frames_without_answer", lambda: settled.publish("/lidar/points", cloud))
    empty = cloud_of(np.empty((0, 3)), "world", stamps[2])
    settled.expect_count("bad_messages", lambda: settled.publish("/lidar/points", empty))
    assert not any(settled.answers(stamp) for stamp in stamps)


def test_one_good_camera_is_enough(settled, frames, clock):
    """A broken image does not take the good one of the same moment with it."""
    stamp = clock.next()
    settled.see("left", frames[0].depths[0], stamp, encoding="rgb8")
    settled.see("right", frames[0].depths[1], stamp)
    message = settled.wait(lambda: settled.answers(stamp))[0]
    alone = Detector().detect_frame(Frame(0, depths=frames[0].depths[1:]))
    np.testing.assert_allclose(centres_of(message), alone.centres, atol=1e-6)


def test_three_million_points(settled, frames, clock):
    points = np.concatenate([unproject(i.depth, i.intrinsics, i.T_world_camera) for i in frames[0].depths])
    many = np.tile(points, (-(-3_000_000 // len(points)), 1))[:3_000_000]
    stamp = clock.next()
    settled.publish("/lidar/points", cloud_of(many, "world", stamp))
    message = settled.wait(lambda: settled.answers(stamp))[0]
    assert len(message.poses) > 0
