"""Robots, nodes and frames that the tests of live nodes share."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import rclpy
from rclpy.signals import SignalHandlerOptions
from robot import NS, START_S, STEP, Process, Robot, stamp_of

import headvox

PACKAGE = Path(__file__).resolve().parents[2]


def pytest_configure() -> None:
    """Heed Ctrl-C, as the nodes then do: what a shell starts in the background ignores it, and so would they."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


class Time:
    """Stamps that only go on, whoever asks."""

    def __init__(self) -> None:
        self.now = 1000 * NS

    def next(self) -> int:
        self.now += STEP
        return self.now


@pytest.fixture(scope="session", autouse=True)
def ros():
    """Only this machine, a domain of our own, and shared memory that holds a cloud."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ["FASTDDS_DEFAULT_PROFILES_FILE"] = str(PACKAGE / "config" / "fastdds_large_clouds.xml")
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    yield
    rclpy.try_shutdown()


@pytest.fixture(scope="module")
def robot():
    robot = Robot()
    yield robot
    robot.close()


@pytest.fixture(scope="module")
def start():
    """Return a function that starts a node; whatever still runs at the end is killed."""
    started: list[Process] = []

    def start(module: str, *parameters: str, words: Sequence[str] = (), **environment: str) -> Process:
        started.append(Process(module, *parameters, words=words, **environment))
        return started[-1]

    yield start
    for one in started:
        if one.process.poll() is None:
            one.process.kill()
            one.process.communicate()


@pytest.fixture(scope="session")
def sample() -> Path:
    """The recording that ships with headvox: two cameras, three people."""
    return Path(headvox.__file__).parent / "assets" / "sample"


@pytest.fixture(scope="session")
def frames(sample):
    return list(headvox.open_source(sample))


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
        robot.see_frame(frames[0], clock.next())
        return robot.poses() and stamp_of(robot.poses()[-1]) >= clock.now - STEP

    robot.wait(well)
    for messages in robot.got.values():
        messages.clear()
    yield robot
    robot.wait(well)
