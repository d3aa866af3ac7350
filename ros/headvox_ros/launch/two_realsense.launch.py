"""The paper's rig: two D435i, 4 m apart, 1.65 m high, facing each other; drivers, their places, and head_detector.

``left_serial`` and ``right_serial`` say which camera is which (``rs-enumerate-devices``, with an underscore before it).
"""

import math

from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

HEIGHT_M, HALF_GAP_M, DOWN_RAD = 1.65, 2.0, 0.12
PLACES = {"left": (-HALF_GAP_M, 0.0), "right": (HALF_GAP_M, math.pi)}  # x and yaw


def generate_launch_description() -> LaunchDescription:
    """Return what is to be launched."""
    share = FindPackageShare("headvox_ros")
    actions = [
        DeclareLaunchArgument("rviz", default_value="true", description="show the heads in RViz"),
        SetEnvironmentVariable(
            "FASTDDS_DEFAULT_PROFILES_FILE",
            PathJoinSubstitution([share, "config", "fastdds_large_clouds.xml"]),
        ),
    ]
    for name, (x, yaw) in PLACES.items():
        serial = f"{name}_serial"
        actions += [
            DeclareLaunchArgument(
                serial, default_value="''", description=f"serial number of the {name} camera"
            ),
            Node(
                package="realsense2_camera",
                executable="realsense2_camera_node",
                namespace=name,
                name="camera",
                parameters=[
                    {
                        "serial_no": LaunchConfiguration(serial),
                        "camera_name": name,
                        "depth_module.depth_profile": "848x480x30",
                        "enable_color": False,
                        "enable_infra1": False,
                        "enable_infra2": False,
                    }
                ],
            ),
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                arguments=[
                    *("--x", str(x), "--z", str(HEIGHT_M), "--yaw", str(yaw), "--pitch", str(DOWN_RAD)),
                    *("--frame-id", "world", "--child-frame-id", f"{name}_link"),
                ],
            ),
        ]
    actions += [
        Node(
            package="headvox_ros",
            executable="head_detector",
            output="screen",
            parameters=[
                PathJoinSubstitution([share, "config", "head_detector.yaml"]),
                {
                    "depths": [f"/{name}/camera/depth/image_rect_raw" for name in PLACES],
                    "target_frame": "world",
                },
            ],
        ),
        Node(
            package="rviz2",
            executable="rviz2",
            arguments=["-d", PathJoinSubstitution([share, "rviz", "heads.rviz"])],
            condition=IfCondition(LaunchConfiguration("rviz")),
        ),
    ]
    return LaunchDescription(actions)
