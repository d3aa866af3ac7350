"""What the node's tracker is told: when the node is started, and while it runs."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from robot import START_S, stamp_of

EMPTY_M = 4.0  # a wall behind all heads


@pytest.fixture
def tracking(robot, start, frames):
    """A node whose tracks outlive by far that their places are seen to be empty."""
    robot.listen(Odometry, "/head_detector/tracks")
    process = start(
        "head_detector",
        "depths:=['/left/image','/right/image']",
        "target_frame:=world",
        "sync_wait_s:=1.0",
        "reliability:=reliable",
        "track.empty_s:=60.0",
        "track.present_s:=60.0",
    )
    for image in frames[0].depths:
        robot.place(f"{image.name}_optical", image.T_world_camera)
    robot.wait(lambda: robot.node.count_subscribers("/left/image") > 0, START_S)
    yield robot
    code, said = process.end()
    assert code == 0, said


def test_settings_of_the_tracker_count_when_it_starts_and_while_it_runs(tracking, frames, clock):
    robot = tracking
    empty = replace(
        frames[0],
        depths=tuple(
            replace(image, depth=np.full_like(image.depth, EMPTY_M / image.intrinsics.depth_scale))
            for image in frames[0].depths
        ),
    )

    def ids(frame) -> set[str]:
        """Show a frame, and return who is followed then."""
        robot.see_frame(frame, stamp := clock.next())
        robot.wait(lambda: robot.answers(stamp))
        robot.spin(0.2)  # another topic: it may come later
        tracks = robot.got["/head_detector/tracks"]
        return {track.child_frame_id for track in tracks if stamp_of(track) == stamp}

    shown = itertools.cycle(frames[:5])
    robot.wait(lambda: len(ids(next(shown))) >= 2)
    for _ in range(10):  # a second: by default they end after 0.3 s
        left = ids(empty)
    assert len(left) >= 2
    for name in ("empty_s", "hidden_s", "missed_s", "out_of_view_s"):  # they may have walked on anywhere
        assert robot.set_parameter(f"track.{name}", 0.1).successful
    for _ in range(3):
        left = ids(empty)
    assert not left
