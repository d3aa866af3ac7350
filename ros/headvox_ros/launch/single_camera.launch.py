"""head_detector for one depth camera whose driver runs already, with RViz if asked.

The camera's frames come from its driver. ``target_frame`` has to point up with its z: base_link of a robot, or, for a
camera that stands level by itself, the driver's camera_link, with the heights given from there.
"""

from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ARGUMENTS = {
    "depth": (
        "/camera/camera/depth/image_rect_raw",
        "topic of the depth image; its camera_info lies beside it",
    ),
    "target_frame": ("camera_link", "frame of the results, z up"),
    "min_height_m": ("-1.8", "lowest height of interest in target_frame"),
    "max_height_m": ("1.2", "greatest height of interest in target_frame"),
    "rviz": ("false", "show the heads in RViz"),
}


def generate_launch_description() -> LaunchDescription:
    """Return what is to be launched."""
    share = FindPackageShare("headvox_ros")
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    detector = Node(
        package="headvox_ros",
        executable="head_detector",
        output="screen",
        parameters=[
            PathJoinSubstitution([share, "config", "head_detector.yaml"]),
            {
                "depths": PythonExpression(["['", value["depth"], "']"]),
                "target_frame": value["target_frame"],
                "detector.min_height_m": PythonExpression(["float(", value["min_height_m"], ")"]),
                "detector.max_height_m": PythonExpression(["float(", value["max_height_m"], ")"]),
            },
        ],
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", PathJoinSubstitution([share, "rviz", "heads.rviz"]), "-f", value["target_frame"]],
        condition=IfCondition(value["rviz"]),
    )
    profile = PathJoinSubstitution([share, "config", "fastdds_large_clouds.xml"])
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(n, default_value=d, description=t) for n, (d, t) in ARGUMENTS.items()),
            SetEnvironmentVariable("FASTDDS_DEFAULT_PROFILES_FILE", profile),
            detector,
            rviz,
        ]
    )
