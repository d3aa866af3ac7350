"""Parameters that are set while the node runs."""

from __future__ import annotations

import pytest
import rclpy
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from robot import WAIT_S, Robot


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
    robot.expect_count("frames_without_answer", lambda: robot.see_frame(frames[0], clock.next()))
    assert set_parameter(robot, "detector.centre", [0.0, 0.0, 1.65]).successful
    robot.see_frame(frames[0], stamp := clock.next())
    assert robot.wait(lambda: robot.answers(stamp))[0].poses
