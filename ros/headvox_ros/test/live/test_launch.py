"""Launch files, parameters, RViz, the world: that they name what there is (`launch` and Gazebo are not to be had)."""

from __future__ import annotations

import importlib.util
import math
import re
import sys
import types
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import yaml

from headvox.synth.mounts import lens
from headvox.synth.presets import two_cameras
from headvox_ros import head_detector, node

PACKAGE = Path(__file__).resolve().parents[2]
LAUNCH = sorted((PACKAGE / "launch").glob("*.launch.py"))
DECLARED = {p.name for p in (*node.SENSOR_PARAMETERS, *head_detector.PARAMETERS)} | {"use_sim_time"}


MADE: list[Recorded] = []


class Recorded:
    """Stands for anything of `launch`: keeps what it was made with."""

    def __init__(self, *arguments, **named):
        self.arguments, self.named = arguments, named
        MADE.append(self)


@pytest.fixture
def launched(monkeypatch):
    """Return a function that loads a launch file and returns the nodes in it, each as what it was made with."""
    kinds = {}
    names = {
        "launch": ["LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument", "ExecuteProcess", "SetEnvironmentVariable"],
        "launch.conditions": ["IfCondition"],
        "launch.substitutions": ["LaunchConfiguration", "PathJoinSubstitution", "PythonExpression"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
        "launch_ros.substitutions": ["FindPackageShare"],
    }
    for module, classes in names.items():
        stub = types.ModuleType(module)
        for name in classes:
            kinds[name] = type(name, (Recorded,), {})
            setattr(stub, name, kinds[name])
        monkeypatch.setitem(sys.modules, module, stub)

    def load(path):
        MADE.clear()
        spec = importlib.util.spec_from_file_location(path.stem.replace(".", "_"), path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        description = module.generate_launch_description()
        (actions,) = description.arguments
        paths = [one.arguments[0][1:] for one in MADE if isinstance(one, kinds["PathJoinSubstitution"])]
        return [a.named for a in actions if isinstance(a, kinds["Node"])], [
            "/".join(parts) for parts in paths
        ]

    return load


def test_there_is_a_launch_file_for_each_use():
    assert [path.name.split(".")[0] for path in LAUNCH] == [
        "bag_replay",
        "gazebo",
        "single_camera",
        "two_realsense",
    ]


@pytest.mark.parametrize("path", LAUNCH, ids=lambda path: path.name)
def test_a_launch_file_names_what_there_is(path, launched):
    nodes, files = launched(path)
    assert files
    for file in files:
        assert (PACKAGE / file).is_file(), file
    ours = [one for one in nodes if one["package"] == "headvox_ros"]
    assert len(ours) == 1
    executables = re.findall(r'f"(\w+) = ', (PACKAGE / "setup.py").read_text())
    assert ours[0]["executable"] in executables
    given = [one for one in ours[0]["parameters"] if isinstance(one, dict)]
    assert given
    for parameters in given:
        assert set(parameters) <= DECLARED
    depends = ET.parse(PACKAGE / "package.xml").getroot()
    named = {element.text for element in depends if element.tag == "exec_depend"}
    assert {"launch", "launch_ros"} <= named


def test_the_parameter_file_names_parameters_of_the_node():
    rows = yaml.safe_load((PACKAGE / "config" / "head_detector.yaml").read_text())
    values = rows["head_detector"]["ros__parameters"]
    defaults = {p.name: p.default for p in (*node.SENSOR_PARAMETERS, *head_detector.PARAMETERS)}
    for name, value in values.items():
        flat = (
            {f"{name}.{key}": one for key, one in value.items()} if isinstance(value, dict) else {name: value}
        )
        for key, one in flat.items():
            assert defaults[key] == one
            assert type(defaults[key]) is type(one)


def test_rviz_shows_topics_that_are_published():
    config = yaml.safe_load((PACKAGE / "rviz" / "heads.rviz").read_text())
    topics = [d["Topic"]["Value"] for d in config["Visualization Manager"]["Displays"] if "Topic" in d]
    assert {"/head_detector/markers", "/head_detector/poses"} <= set(topics)


def test_the_world_is_the_rig_of_the_paper():
    world = ET.parse(PACKAGE / "worlds" / "two_cameras.sdf").getroot().find("world")
    models = {model.get("name"): model for model in world.findall("model")}
    wanted = {camera.name: camera for camera in two_cameras(3).cameras}
    for name in ("left", "right"):
        x, y, z, roll, pitch, yaw = map(float, models[name].find("pose").text.split())
        place = wanted[name].T_world_camera
        np.testing.assert_allclose((x, y, z), place[:3, 3], atol=1e-9)
        ahead = (math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), -math.sin(pitch))
        np.testing.assert_allclose(ahead, place[:3, 2], atol=1e-6)
        assert (y, roll) == (0.0, 0.0)
        camera = models[name].find("link/sensor/camera")
        width, height = int(camera.find("image/width").text), int(camera.find("image/height").text)
        ours = lens("d435i")
        assert (width, height) == (ours.width, ours.height)
        focal = width / 2 / math.tan(float(camera.find("horizontal_fov").text) / 2)
        assert focal == pytest.approx(ours.fx, abs=0.1)
    walk = [
        [float(v) for v in p.text.split()] for p in world.findall("actor/script/trajectory/waypoint/pose")
    ]
    times = [float(t.text) for t in world.findall("actor/script/trajectory/waypoint/time")]
    assert times == sorted(times)
    assert np.abs(np.array(walk)[:, :2]).max() < 2.0  # between the cameras
