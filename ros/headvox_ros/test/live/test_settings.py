"""Parameters that are set while the node runs."""

from __future__ import annotations

import pytest


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
    result = settled.set_parameter(name, value)
    assert not result.successful
    assert reason in result.reason


def test_a_parameter_can_be_changed_while_the_node_runs(settled, frames, clock):
    robot = settled
    assert robot.set_parameter("detector.centre", [50.0, 50.0, 0.0]).successful
    robot.expect_count("frames_without_answer", lambda: robot.see_frame(frames[0], clock.next()))
    assert robot.set_parameter("detector.centre", [0.0, 0.0, 1.65]).successful
    robot.see_frame(frames[0], stamp := clock.next())
    assert robot.wait(lambda: robot.answers(stamp))[0].poses
