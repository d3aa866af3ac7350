"""Two processes: MuJoCo renders what two cameras see of somebody who walks, and the node finds the head in it."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_msgs.msg import PoseArray
from robot import NS, START_S, stamp_of, xyz
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from headvox.errors import HeadvoxError
from headvox.synth.presets import two_cameras
from headvox.synth.simulator import Simulator

ANSWERS = 12
TOPICS = {
    "/true_heads": PoseArray,
    "/clock": Clock,
    "/left/depth/image_rect_raw": Image,
    "/right/depth/camera_info": CameraInfo,
    "/left/depth/points": PointCloud2,
}


def of_known_truth(heard):
    """The answers to frames whose truth was heard, each with the place of the true head."""
    true = {stamp_of(message): xyz(message.poses[0]) for message in heard["/true_heads"]}
    answers = heard["/head_detector/poses"]
    return [(message, true[stamp_of(message)]) for message in answers if stamp_of(message) in true]


@pytest.fixture(scope="module")
def simulated(robot, start):
    """What is to be heard of the simulated cameras, and of a node that takes their depth images."""
    try:
        Simulator(two_cameras(duration_s=0.1, mode="d435i-small")).close()
    except HeadvoxError as error:
        if not error.what.startswith("MuJoCo cannot"):
            raise
        pytest.skip(f"MuJoCo cannot render on this machine, so there is nothing to listen to: {error}")
    for topic, kind in TOPICS.items():
        robot.listen(kind, topic)
    node = start(
        "head_detector", "depths:=['/left/depth/image_rect_raw','/right/depth/image_rect_raw']",
        "target_frame:=world", "use_sim_time:=true", "sync_wait_s:=1.0", "reliability:=reliable",
    )  # fmt: skip
    robot.wait(lambda: robot.node.count_subscribers("/left/depth/image_rect_raw") > 0, START_S)
    cameras = start(
        "simulate_cameras", "mode:=d435i-small", "clouds:=true", "clock:=true", "rate_hz:=4.0", "walk_s:=20.0"
    )
    # The truth of the first frames may be told before the listener has found who tells it.
    robot.wait(lambda: len(of_known_truth(robot.got)) >= ANSWERS, START_S)
    robot.wait(lambda: all(len(robot.got[topic]) > 3 for topic in TOPICS))
    for process in (cameras, node):
        code, said = process.end()
        assert code == 0, said
        assert "Traceback" not in said, said
    return robot.got


def test_the_head_is_found_where_it_truly_is(simulated):
    assert {message.header.frame_id for message in simulated["/head_detector/poses"]} == {"world"}
    errors = []
    for message, true in of_known_truth(simulated):
        centres = np.array([xyz(pose) for pose in message.poses]).reshape(-1, 3)
        errors.append(np.linalg.norm(centres - true, axis=1).min(initial=9.0))
    errors = np.array(errors)
    assert len(errors) >= ANSWERS
    print(f"\n{len(errors)} answers, centre error {100 * np.median(errors):.2f} cm in the median")
    assert np.mean(errors < 0.15) > 0.9
    assert np.median(errors) < 0.03


def test_the_person_walks(simulated):
    places = np.array([xyz(message.poses[0]) for message in simulated["/true_heads"]])
    assert np.ptp(places[:, :2], axis=0).max() > 0.1


def test_all_that_a_driver_publishes_is_there_with_the_time_of_the_simulation(simulated):
    times = {message.clock.sec * NS + message.clock.nanosec for message in simulated["/clock"]}
    for topic, frame in (
        ("/left/depth/image_rect_raw", "left_depth_optical_frame"),
        ("/right/depth/camera_info", "right_depth_optical_frame"),
        ("/left/depth/points", "left_depth_optical_frame"),
    ):
        messages = simulated[topic]
        assert {message.header.frame_id for message in messages} == {frame}
        # What was told before the listener found the clock has no time to be compared with.
        assert {stamp for stamp in map(stamp_of, messages) if stamp >= min(times)} <= times


@pytest.mark.parametrize(
    ("module", "parameter", "said"),
    [
        ("simulate_cameras", "mode:=nonsense", "Expected a lens"),
        ("simulate_cameras", "rate_hz:=0.0", "expected more than 0"),
        ("simulate_cameras", "seed:=-1", "seed: expected 0 or more, got -1"),
        ("play_recording", "reliability:=maybe", "expected best_effort or reliable, got 'maybe'"),
        ("play_recording", "silent:=['left:now']", "expected NAME:FROM:TO in seconds, got 'left:now'"),
        ("play_recording", "silent:=['up:0:1']", "There is left, right"),
    ],
)
def test_cameras_that_cannot_be_are_refused_with_a_reason(start, sample, module, parameter, said):
    recording = [f"recording:={sample}"] if module == "play_recording" else []
    code, output = start(module, *recording, parameter).wait()
    assert code == 1
    assert said in output
    assert "Traceback" not in output
