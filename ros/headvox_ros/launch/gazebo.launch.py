"""The paper's world in Gazebo: two D435i, a walking actor, and head_detector on what the cameras see."""

from launch.actions import DeclareLaunchArgument, ExecuteProcess, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

CAMERAS = {"left": "0", "right": "3.141592653589793"}  # yaw
TYPES = {
    "depth_image": "sensor_msgs/msg/Image[gz.msgs.Image",
    "camera_info": "sensor_msgs/msg/CameraInfo[gz.msgs.CameraInfo",
    "points": "sensor_msgs/msg/PointCloud2[gz.msgs.PointCloudPacked",
}


def generate_launch_description() -> LaunchDescription:
    """Return what is to be launched."""
    share = FindPackageShare("headvox_ros")
    bridged = [f"/{camera}/{topic}@{kind}" for camera in CAMERAS for topic, kind in TYPES.items()]
    places = [
        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            # Gazebo's cameras look along x; images are optical: x right, y down, z forward
            arguments=[
                *("--roll", "-1.5707963267948966", "--yaw", "-1.5707963267948966"),
                *("--frame-id", f"{camera}_link", "--child-frame-id", f"{camera}_depth_optical_frame"),
            ],
            parameters=[{"use_sim_time": True}],
        )
        for camera in CAMERAS
    ] + [
        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            arguments=[
                *(
                    "--x",
                    "-2.0" if camera == "left" else "2.0",
                    "--z",
                    "1.65",
                    "--pitch",
                    "0.12",
                    "--yaw",
                    yaw,
                ),
                *("--frame-id", "world", "--child-frame-id", f"{camera}_link"),
            ],
            parameters=[{"use_sim_time": True}],
        )
        for camera, yaw in CAMERAS.items()
    ]
    return LaunchDescription(
        [
            DeclareLaunchArgument("rviz", default_value="true", description="show the heads in RViz"),
            SetEnvironmentVariable(
                "FASTDDS_DEFAULT_PROFILES_FILE",
                PathJoinSubstitution([share, "config", "fastdds_large_clouds.xml"]),
            ),
            ExecuteProcess(
                cmd=["gz", "sim", "-r", PathJoinSubstitution([share, "worlds", "two_cameras.sdf"])],
                output="screen",
            ),
            Node(
                package="ros_gz_bridge",
                executable="parameter_bridge",
                arguments=["/clock@rosgraph_msgs/msg/Clock[gz.msgs.Clock", *bridged],
            ),
            *places,
            Node(
                package="headvox_ros",
                executable="head_detector",
                output="screen",
                parameters=[
                    PathJoinSubstitution([share, "config", "head_detector.yaml"]),
                    {
                        "depths": [f"/{camera}/depth_image" for camera in CAMERAS],
                        "target_frame": "world",
                        "use_sim_time": True,
                    },
                ],
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", PathJoinSubstitution([share, "rviz", "heads.rviz"])],
                parameters=[{"use_sim_time": True}],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
