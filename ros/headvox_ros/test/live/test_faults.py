"""What goes wrong on robots, sent to one running node: it says so, does not stop, and is right again afterwards."""

from __future__ import annotations

import array
import itertools
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rclpy
from conftest import NS, START_S, WAIT_S, Robot, cloud_of, data_of, stamp_of, xyz
from geometry_msgs.msg import PoseArray
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from visualization_msgs.msg import Marker, MarkerArray

from headvox import Detector, Frame
from headvox.frames import inverse, transform, unproject

CAMERAS = ("left", "right")
STEP = NS // 10
QUEUE = 5  # answers that a publisher of the node holds at most


class Time:
    """Stamps that only go on, whoever asks."""

    def __init__(self) -> None:
        self.now = 1000 * NS

    def next(self) -> int:
        self.now += STEP
        return self.now


@pytest.fixture(scope="module")
def clock() -> Time:
    return Time()


@pytest.fixture(scope="module")
def node(robot, start, frames):
    """A node with two cameras and a LiDAR, all of which are placed."""
    process = start(
        "head_detector",
        "depths:=['/left/image','/right/image']",
        "clouds:=['/lidar/points']",
        "target_frame:=world",
        "sensor_timeout_s:=3.0",
        "sync_wait_s:=1.0",  # this process may be slow
        "tf_wait_s:=1.0",
        "tracking:=false",  # so that every frame is by itself
        "reliability:=reliable",
    )
    for image in frames[0].depths:
        robot.place(f"{image.name}_optical", image.T_world_camera)
    robot.place("lidar", np.eye(4))
    robot.wait(lambda: robot.node.count_subscribers("/left/image") > 0, START_S)
    yield process
    code, said = process.end()
    assert code == 0, said
    assert "Traceback" not in said, said


@pytest.fixture
def settled(robot, node, frames, clock):
    """Both cameras deliver, and the node is well: where every test begins and ends."""

    def well():
        both(robot, frames[0], clock.next())
        return robot.poses() and stamp_of(robot.poses()[-1]) >= clock.now - STEP

    robot.wait(well)
    for messages in robot.got.values():
        messages.clear()
    yield robot
    robot.wait(well)


def both(robot: Robot, frame: Frame, stamp_ns: int, only: tuple[str, ...] = CAMERAS) -> None:
    for image in frame.depths:
        if image.name in only:
            robot.see(image.name, image, stamp_ns)


def centres_of(message: PoseArray) -> np.ndarray:
    return np.array([xyz(pose) for pose in message.poses]).reshape(-1, 3)


def expect_count(robot: Robot, kind: str, action, at_least: int = 1) -> dict[str, str]:
    """Call ``action`` and wait for the diagnostics to count it."""
    before = int(robot.wait(robot.status)[kind])
    action()
    return robot.wait(lambda: int(robot.status()[kind]) >= before + at_least and robot.status())


def answers(robot: Robot, stamp_ns: int) -> list[PoseArray]:
    return [message for message in robot.poses() if stamp_of(message) == stamp_ns]


# ------------------------------------------------------------------------------------------------------ as it should be


def test_heads_are_those_of_the_library_to_the_bit(settled, frames, clock):
    detector = Detector()
    expected = [detector.detect_frame(frame) for frame in frames[:5]]
    both(settled, frames[0], clock.next())  # so that both cameras are known again
    settled.spin(0.3)
    for frame, heads in zip(frames, expected, strict=False):
        stamp = clock.next()
        both(settled, frame, stamp)
        message = settled.wait(lambda stamp=stamp: answers(settled, stamp))[0]
        assert message.header.frame_id == "world"
        np.testing.assert_allclose(centres_of(message), heads.centres, atol=1e-6)  # TF is a quaternion
        assert len(heads) > 0


def test_a_cloud_gives_heads_too(settled, frames, clock):
    image = frames[0].depths[0]
    points = np.concatenate([unproject(i.depth, i.intrinsics, i.T_world_camera) for i in frames[0].depths])
    stamp = clock.next()
    settled.publish("/lidar/points", cloud_of(points, "world", stamp))
    message = settled.wait(lambda: answers(settled, stamp))[0]
    heads = Detector().detect(points.astype(np.float32))
    assert len(message.poses) == len(heads) > 0
    assert image.depth.dtype == np.uint16


def test_markers_of_who_is_gone_are_deleted(settled, frames, clock):
    robot = settled
    markers = robot.got["/head_detector/markers"]
    both(robot, frames[0], stamp := clock.next())
    robot.wait(lambda: any(stamp_of(m) == stamp for one in markers for m in one.markers))
    added = {(m.ns, m.id) for m in markers[-1].markers if m.action == Marker.ADD}
    assert len(added) >= 2
    assert all(m.lifetime.sec + m.lifetime.nanosec > 0 for m in markers[-1].markers if m.action == Marker.ADD)
    wall = [replace(image, depth=np.full_like(image.depth, 2500)) for image in frames[0].depths]
    both(robot, Frame(0, depths=tuple(wall)), stamp := clock.next())
    robot.wait(lambda: answers(robot, stamp))
    robot.wait(lambda: any(stamp_of(m) == stamp for one in markers for m in one.markers))
    deleted = {(m.ns, m.id) for m in markers[-1].markers if m.action == Marker.DELETE}
    shown = {(m.ns, m.id) for m in markers[-1].markers if m.action == Marker.ADD}
    assert deleted == added - shown
    assert deleted


# --------------------------------------------------------------------------------------------------- cameras and clouds


def test_a_camera_stops_and_returns(settled, frames, clock):
    robot = settled

    def only_left():
        both(robot, frames[0], clock.next(), only=("left",))

    robot.wait(lambda: "/right/image" in robot.status().get("sensors_silent", ""), meanwhile=only_left)
    assert "/right/image" in robot.status()["message"]
    for _ in range(5):  # and it does not wait for the other
        only_left()
        robot.wait(lambda: answers(robot, clock.now))
    robot.wait(
        lambda: "/right/image" in robot.status()["sensors_alive"],
        meanwhile=lambda: both(robot, frames[0], clock.next()),
    )
    alone, together = (
        Detector().detect_frame(Frame(0, depths=d)) for d in (frames[0].depths[:1], frames[0].depths)
    )
    both(robot, frames[0], stamp := clock.next())
    message = robot.wait(lambda: answers(robot, stamp))[0]
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
        status = expect_count(settled, "bad_messages", lambda m=message: settled.publish("/lidar/points", m))
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
        status = expect_count(
            settled, "bad_messages", lambda c=changes, s=stamp: settled.see("left", image, s, **c)
        )
        assert "/left/image" in status["last_problem"]
        assert not answers(settled, stamp)


def test_nan_everywhere_is_not_nobody(settled, frames, clock):
    """A sensor that measures nothing must not look like an empty room."""
    image = frames[0].depths[0]
    nan = data_of(np.full(image.depth.shape, np.nan, np.float32))
    stamps = [clock.next(), clock.next(), clock.next()]
    change = {"encoding": "32FC1", "step": 4 * image.depth.shape[1], "data": nan}
    expect_count(settled, "frames_without_answer", lambda: settled.see("left", image, stamps[0], **change))
    cloud = cloud_of(np.full((1000, 3), np.nan), "world", stamps[1])
    expect_count(settled, "frames_without_answer", lambda: settled.publish("/lidar/points", cloud))
    empty = cloud_of(np.empty((0, 3)), "world", stamps[2])
    expect_count(settled, "bad_messages", lambda: settled.publish("/lidar/points", empty))
    assert not any(answers(settled, stamp) for stamp in stamps)


def test_one_good_camera_is_enough(settled, frames, clock):
    """A broken image does not take the good one of the same moment with it."""
    stamp = clock.next()
    settled.see("left", frames[0].depths[0], stamp, encoding="rgb8")
    settled.see("right", frames[0].depths[1], stamp)
    message = settled.wait(lambda: answers(settled, stamp))[0]
    alone = Detector().detect_frame(Frame(0, depths=frames[0].depths[1:]))
    np.testing.assert_allclose(centres_of(message), alone.centres, atol=1e-6)


def test_three_million_points(settled, frames, clock):
    points = np.concatenate([unproject(i.depth, i.intrinsics, i.T_world_camera) for i in frames[0].depths])
    many = np.tile(points, (-(-3_000_000 // len(points)), 1))[:3_000_000]
    stamp = clock.next()
    settled.publish("/lidar/points", cloud_of(many, "world", stamp))
    message = settled.wait(lambda: answers(settled, stamp))[0]
    assert len(message.poses) > 0


# ----------------------------------------------------------------------------------------------------------- transforms


def test_a_transform_that_is_missing_then_comes(settled, frames, clock):
    image = frames[0].depths[0]
    robot, T = settled, image.T_world_camera
    cloud = transform(inverse(T), unproject(image.depth, image.intrinsics, T))
    stamp = clock.next()
    status = expect_count(
        robot, "without_transform", lambda: robot.publish("/lidar/points", cloud_of(cloud, "arm", stamp))
    )
    assert "arm" in status["last_problem"]
    assert not answers(robot, stamp)
    robot.place("arm", T, stamp := clock.next(), static=False)
    robot.spin(0.2)
    robot.publish("/lidar/points", cloud_of(cloud, "arm", stamp))
    assert robot.wait(lambda: answers(robot, stamp))[0].poses


def test_a_transform_that_is_late_is_waited_for_and_one_that_stopped_is_not(settled, frames, clock):
    image = frames[0].depths[0]
    robot, T = settled, image.T_world_camera
    cloud = transform(inverse(T), unproject(image.depth, image.intrinsics, T))
    robot.place("hand", T, clock.next(), static=False)
    robot.spin(0.2)
    stamp = clock.next()
    robot.publish("/lidar/points", cloud_of(cloud, "hand", stamp))
    time.sleep(0.03)
    robot.place("hand", T, stamp, static=False)
    assert robot.wait(lambda: answers(robot, stamp))
    clock.now += 3 * NS
    robot.spin(0.2)
    stale = clock.next()
    expect_count(
        robot, "without_transform", lambda: robot.publish("/lidar/points", cloud_of(cloud, "hand", stale))
    )
    assert not answers(robot, stale)


def test_a_transform_that_jumps_moves_the_heads_from_then_on(settled, frames, clock):
    image = frames[0].depths[0]
    robot, T = settled, image.T_world_camera
    cloud = transform(inverse(T), unproject(image.depth, image.intrinsics, T))
    before, after = clock.next(), clock.next()
    moved = T.copy()
    moved[:3, 3] += (0.8, 0.4, 0.0)
    robot.place("base", T, before, static=False)
    robot.place("base", moved, after, static=False)
    robot.spin(0.2)
    for stamp in (before, after):
        robot.publish("/lidar/points", cloud_of(cloud, "base", stamp))
        robot.wait(lambda stamp=stamp: answers(robot, stamp))
    first, second = (centres_of(answers(robot, stamp)[0]) for stamp in (before, after))
    assert len(first) > 0
    assert np.linalg.norm(first[0] + (0.8, 0.4, 0.0) - second, axis=1).min() < 0.05


# ----------------------------------------------------------------------------------------------------------------- time


def test_a_bag_that_begins_again(settled, frames, clock):
    robot = settled
    clock.now -= 500 * NS
    jumps = int(robot.wait(robot.status)["clock_jumps"])
    for _ in range(5):
        both(robot, frames[0], stamp := clock.next())
        robot.spin(0.1)
    assert robot.wait(lambda: answers(robot, stamp))
    robot.wait(lambda: int(robot.status()["clock_jumps"]) > jumps)


def test_a_subscriber_that_never_reads_holds_nobody_up(settled, frames, clock):
    robot = settled
    deaf = rclpy.create_node("deaf")
    for topic in ("/head_detector/poses", "/head_detector/markers"):
        kind = PoseArray if topic.endswith("poses") else MarkerArray
        deaf.create_subscription(kind, topic, lambda m: None, 1)  # and nobody spins it
    robot.spin(0.5)
    many = 4 * QUEUE  # more than wait for anybody
    seen = itertools.cycle(frames)
    robot.wait(
        lambda: len(robot.poses()) >= many,
        meanwhile=lambda: both(robot, next(seen), clock.next()),
        every_s=0.05,
    )
    assert robot.wait(lambda: answers(robot, clock.now))
    deaf.destroy_node()


def test_an_overloaded_node_gets_fresher_never_later(settled, frames, clock):
    """Sent far faster than it can work, it leaves frames out, and the answers keep up with the newest."""
    robot = settled

    def left_out() -> int:
        return int(robot.status()["replaced_by_fresher"]) + int(robot.status()["lost"])

    robot.wait(robot.status)
    before = left_out()
    for k in range(300):
        both(robot, frames[k % len(frames)], stamp := clock.next())
        rclpy.spin_once(robot.node, timeout_sec=0.0)
    robot.wait(lambda: answers(robot, stamp))
    stamps = [stamp_of(message) for message in robot.poses()]
    assert stamps == sorted(stamps)
    assert len(stamps) < 300
    robot.wait(lambda: left_out() > before)


def test_messages_that_do_not_get_to_the_node_are_counted(settled, node, frames, clock):
    """More than its queue holds while it stands still."""
    robot = settled
    lost = int(robot.wait(robot.status)["lost"])
    os.kill(node.pid, signal.SIGSTOP)
    try:
        for _ in range(20):
            both(robot, frames[0], clock.next())
            robot.spin(0.02)
    finally:
        os.kill(node.pid, signal.SIGCONT)
    robot.wait(
        lambda: int(robot.status()["lost"]) > lost + 10,
        meanwhile=lambda: both(robot, frames[0], clock.next()),
    )
    assert ": messages do not get here" in robot.status()["last_problem"]


# ----------------------------------------------------------------------------------------------------------- parameters


def set_parameter(robot: Robot, name: str, value):
    kinds = {
        bool: (ParameterType.PARAMETER_BOOL, "bool_value"),
        int: (ParameterType.PARAMETER_INTEGER, "integer_value"),
        float: (ParameterType.PARAMETER_DOUBLE, "double_value"),
        str: (ParameterType.PARAMETER_STRING, "string_value"),
        list: (ParameterType.PARAMETER_DOUBLE_ARRAY, "double_array_value"),
    }
    kind, attribute = kinds[type(value)]
    client = robot.node.create_client(SetParameters, "/head_detector/set_parameters")
    assert client.wait_for_service(WAIT_S)
    request = SetParameters.Request(
        parameters=[Parameter(name=name, value=ParameterValue(type=kind, **{attribute: value}))]
    )
    future = client.call_async(request)
    rclpy.spin_until_future_complete(robot.node, future, timeout_sec=WAIT_S)
    robot.node.destroy_client(client)
    return future.result().results[0]


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("detector.max_range_m", -1.0, "range"),
        ("detector.max_range_m", 1e9, "range"),
        ("detector.max_range_m", 0.0, "detector.max_range_m: expected more than 0"),
        ("detector.voxel_m", 1.0, "range"),
        ("detector.voxel_m", "coarse", "detector.voxel_m"),
        ("detector.cascade", "nobody", "nobody"),
        ("detector.refine", "magic", 'expected "pose", "sphere" or "none"'),
        ("detector.centre", [1.0, 2.0], "three numbers"),
        ("detector.threads", 65, "range"),
        ("detector.max_height_m", -3.0, "above min_height_m"),
        ("track.hidden_s", -1.0, "track.hidden_s: expected a number above 0"),
        ("track.confirm_hits", 9, "track.confirm_frames: expected confirm_hits (9) to 60"),
        ("tf_wait_s", 5.0, "range"),
        ("target_frame", "map", "deactivate it first"),
        ("depths", "x", "type"),
    ],
)
def test_a_parameter_that_makes_no_sense_is_refused_with_a_reason(settled, name, value, reason):
    result = set_parameter(settled, name, value)
    assert not result.successful
    assert reason in result.reason


def test_a_parameter_can_be_changed_while_the_node_runs(settled, frames, clock):
    robot = settled
    assert set_parameter(robot, "detector.centre", [50.0, 50.0, 0.0]).successful
    expect_count(robot, "frames_without_answer", lambda: both(robot, frames[0], clock.next()))
    assert set_parameter(robot, "detector.centre", [0.0, 0.0, 1.65]).successful
    both(robot, frames[0], stamp := clock.next())
    assert robot.wait(lambda: answers(robot, stamp))[0].poses


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ([], "There is no topic to listen to"),
        (["depths:=['/a/image']", "detector.refine:=magic"], "detector.refine"),
        (["depths:=['/a/image']", "reliability:=maybe"], "expected best_effort or reliable"),
        (["depths:=['/a/image']", "camera_infos:=['/a','/b']"], "expected one for each of the 1 depths"),
    ],
)
def test_a_node_that_cannot_start_says_why_and_exits_with_1(start, parameters, said):
    code, output = start("head_detector", *parameters).wait()
    assert code == 1
    assert said in output
    assert "Traceback" not in output


# ------------------------------------------------------------------------------------------------------------------ end


def shared_memory_of(pid: int) -> set[str]:
    """The shared memory that a process has mapped and nobody else has."""
    maps = Path(f"/proc/{pid}/maps").read_text()
    return {line.split()[-1] for line in maps.splitlines() if "/dev/shm/fastdds" in line}


def test_interrupted_in_mid_frame_it_ends_cleanly(robot, start, frames):
    """Frames come as fast as they can while it is told to end: no traceback, no thread, no shared memory stays."""
    ours = shared_memory_of(os.getpid())
    process = start(
        "head_detector", "depths:=['/only/image']", "target_frame:=world", "reliability:=reliable"
    )
    robot.place("only_optical", frames[0].depths[0].T_world_camera)
    stamps = itertools.count(5000 * NS, STEP)
    seen = len(robot.poses())
    robot.wait(
        lambda: len(robot.poses()) > seen + 3,
        START_S,
        meanwhile=lambda: robot.see("only", frames[0].depths[0], next(stamps)),
        every_s=0.02,
    )
    theirs = shared_memory_of(process.pid) - ours
    assert theirs
    for k in range(40):
        robot.see("only", frames[0].depths[0], next(stamps))
        if k == 20:
            process.interrupt()
    code, said = process.wait()
    assert code == 0, said
    assert "Traceback" not in said
    assert "rror" not in said, said
    assert not Path(f"/proc/{process.pid}").exists()
    own = {name for name in theirs if "port" not in name}  # ports are closed when both ends are
    assert not [name for name in own if Path(name).exists()]


def test_interrupted_while_it_compiles_it_ends_cleanly(robot, start, tmp_path):
    process = start("head_detector", "depths:=['/a/image']", NUMBA_CACHE_DIR=str(tmp_path))
    robot.wait(lambda: any(tmp_path.rglob("*.nbi")), START_S)
    process.interrupt()
    code, said = process.wait(START_S)
    assert code == 0, said
    assert "Traceback" not in said, said
