"""head_detector on a bag of point clouds or depth images, in the bag's own time."""

from launch.actions import DeclareLaunchArgument, ExecuteProcess, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ARGUMENTS = {
    "bag": ("", "folder of the bag"),
    "depth": ("", "topic of a depth image in it"),
    "cloud": ("", "topic of a point cloud in it"),
    "target_frame": ("base_link", "frame of the results, z up"),
    "rviz": ("true", "show the heads in RViz"),
}


def generate_launch_description() -> LaunchDescription:
    """Return what is to be launched."""
    share = FindPackageShare("headvox_ros")
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(n, default_value=d, description=t) for n, (d, t) in ARGUMENTS.items()),
            SetEnvironmentVariable(
                "FASTDDS_DEFAULT_PROFILES_FILE",
                PathJoinSubstitution([share, "config", "fastdds_large_clouds.xml"]),
            ),
            Node(
                package="headvox_ros",
                executable="head_detector",
                output="screen",
                parameters=[
                    PathJoinSubstitution([share, "config", "head_detector.yaml"]),
                    {
                        "depths": PythonExpression(["['", value["depth"], "']"]),
                        "clouds": PythonExpression(["['", value["cloud"], "']"]),
                        "target_frame": value["target_frame"],
                        "use_sim_time": True,
                    },
                ],
            ),
            ExecuteProcess(cmd=["ros2", "bag", "play", value["bag"], "--clock", "--loop"], output="screen"),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=[
                    "-d",
                    PathJoinSubstitution([share, "rviz", "heads.rviz"]),
                    "-f",
                    value["target_frame"],
                ],
                parameters=[{"use_sim_time": True}],
                condition=IfCondition(value["rviz"]),
            ),
        ]
    )
