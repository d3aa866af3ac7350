"""Installs the nodes, their launch files and settings as colcon expects it."""

from glob import glob

from setuptools import setup

NAME = "headvox_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *(
            (f"share/{NAME}/{folder}", glob(f"{folder}/*"))
            for folder in ("launch", "config", "rviz", "worlds")
        ),
    ],
    install_requires=["setuptools", "headvox"],
    zip_safe=False,
    maintainer="The headvox authors",
    maintainer_email="headvox@example.org",
    description="The headvox library as ROS 2 nodes.",
    license="BSD-3-Clause",
    entry_points={
        "console_scripts": [
            f"head_detector = {NAME}.head_detector:main",
            f"cloud_concatenate = {NAME}.cloud_concatenate:main",
            f"play_recording = {NAME}.play_recording:main",
            f"simulate_cameras = {NAME}.simulate_cameras:main",
            f"scenario = {NAME}.scenario:main",
            f"endurance = {NAME}.endurance:main",
        ]
    },
)
