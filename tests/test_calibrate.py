"""Where cameras stand, by what they see: scenes with a known floor and known cameras."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from headvox.calibrate.command import _views, extrinsics_text, spread_frames
from headvox.calibrate.floor import camera_points, find_floor, level, stated, wrong_floor
from headvox.calibrate.rig import place
from headvox.commands.convert import convert
from headvox.data import Frame
from headvox.errors import HeadvoxError
from headvox.frames import inverse, transform
from headvox.sample import sample_folder
from headvox.sources import open_source
from headvox.sources.describe import describe
from headvox.sources.extrinsics import read_extrinsics
from headvox.sources.recording import RecordingSource

UP = np.array([0.0, 0.0, 1.0])
SAMPLE = sample_folder()


def room(rng: np.random.Generator, floor: int = 3000) -> np.ndarray:
    """A floor at z = 0, a table top, a wall and clutter; the sensor is at (0, 0, 1.5)."""
    ground = np.column_stack([rng.uniform(1, 4, floor), rng.uniform(-2, 2, floor), np.zeros(floor)])
    table = np.column_stack([rng.uniform(1.5, 2.5, 4000), rng.uniform(-1, 0, 4000), np.full(4000, 0.75)])
    wall = np.column_stack([np.full(4000, 4.0), rng.uniform(-2, 2, 4000), rng.uniform(0, 2.5, 4000)])
    clutter = rng.uniform([1, -2, 0], [4, 2, 2], (1500, 3))
    points = np.concatenate([ground, table, wall, clutter])
    return points + rng.normal(0, 0.004, points.shape)


@pytest.mark.parametrize("seed", range(4))
def test_the_floor_is_found_below_a_larger_table_and_before_a_wall(seed):
    rng = np.random.default_rng(seed)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = Rotation.from_euler("xyz", rng.uniform(-0.4, 0.4, 3)).as_matrix()
    T_world_camera[:3, 3] = 0.0, 0.0, 1.5
    points = transform(inverse(T_world_camera), room(rng))
    floor = find_floor(points, UP)
    assert floor is not None
    assert np.degrees(np.arccos(floor.normal @ T_world_camera[2, :3])) < 0.5
    assert floor.height_m == pytest.approx(1.5, abs=0.01)
    told = stated(floor, T_world_camera)
    assert told.is_level
    tilted = T_world_camera.copy()
    tilted[:3, :3] = Rotation.from_euler("x", 20, degrees=True).as_matrix() @ tilted[:3, :3]
    assert stated(floor, tilted).tilt_deg == pytest.approx(20.0, abs=0.7)
    assert not stated(floor, tilted).is_level
    assert np.allclose(transform(level(floor), points)[:3000, 2], 0.0, atol=0.04)


def test_nothing_that_could_be_a_floor_is_none():
    rng = np.random.default_rng(0)
    assert find_floor(np.empty((0, 3)), UP) is None
    assert find_floor(np.full((500, 3), np.nan), UP) is None
    assert find_floor(rng.uniform(-2, 2, (5000, 3)), UP) is None
    wall = np.column_stack([np.full(5000, 3.0), rng.uniform(-2, 2, (5000, 2))])
    assert find_floor(wall, UP) is None
    above = np.column_stack([rng.uniform(-2, 2, (5000, 2)), np.full(5000, 1.0)])  # a ceiling
    assert find_floor(above, UP) is None


def test_the_same_points_give_the_same_floor():
    points = room(np.random.default_rng(1)) - [0, 0, 1.5]
    first, second = find_floor(points, UP), find_floor(points, UP)
    assert first is not None
    assert second is not None
    assert first.normal.tobytes() == second.normal.tobytes()
    assert first.height_m == second.height_m


def walk(rng: np.random.Generator, people: int, frames: int) -> np.ndarray:
    """Heads (frames, people, 3) that go about a room."""
    start, pace = rng.uniform(-1.5, 1.5, (people, 2)), rng.uniform(-0.05, 0.05, (people, 2))
    k = np.arange(frames)[:, None, None]
    xy = start + k * pace + 0.4 * np.sin(0.2 * k + rng.uniform(0, 6, (people, 2)))
    height = np.broadcast_to(rng.uniform(1.5, 1.8, people), (frames, people))
    return np.concatenate([xy, height[..., None]], axis=-1)


@pytest.mark.parametrize(("people", "seed"), [(1, 0), (1, 1), (3, 2), (4, 3)])
def test_the_second_camera_is_found_by_heads_that_nobody_names(people, seed):
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    yaw = rng.uniform(-np.pi, np.pi)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:2, 3] = rng.uniform(-4, 4, 2)
    heads = walk(rng, people, 60)
    first, second = [], []
    for frame in heads:
        for camera, T_camera in ((first, np.eye(4)), (second, inverse(T))):
            seen = frame[rng.uniform(size=people) < 0.8]  # each camera misses a fifth
            false = rng.uniform([-3, -3, 1.5], [3, 3, 1.8], (int(rng.uniform() < 0.2), 3))
            camera.append(transform(T_camera, np.concatenate([seen, false]) + rng.normal(0, 0.01, 3)))
    found = place(first, second)
    turn = np.arctan2(found.T[1, 0], found.T[0, 0]) - yaw
    assert abs(np.degrees(np.arctan2(np.sin(turn), np.cos(turn)))) < 1.0
    assert np.hypot(*(found.T[:2, 3] - T[:2, 3])) < 0.04
    assert found.pairs > 20
    assert found.rms_m < 0.05


def test_people_who_stand_or_are_seen_by_one_camera_only_are_told():
    still = [np.array([[0.0, 0.0, 1.6]])] * 30
    with pytest.raises(HeadvoxError, match=r"left and right: no two heads that both see are 0\.6 m apart"):
        place(still, still, "left and right")
    with pytest.raises(HeadvoxError, match="seen by both in 0 frames"):
        place(still, [np.empty((0, 3))] * 30)
    rng = np.random.default_rng(0)
    here, there = ([rng.uniform([-2, -2, 1.5], [2, 2, 1.6], (1, 3)) for _ in range(12)] for _ in range(2))
    with pytest.raises(HeadvoxError, match="no place of the second explains more than"):
        place(here, there)


def test_a_wrong_floor_is_told_and_a_right_one_is_not():
    frame = next(iter(open_source(SAMPLE)))
    assert isinstance(frame, Frame)
    assert wrong_floor(frame) is None
    up = np.eye(4)
    up[2, 3] = 0.8
    higher = tuple(replace(image, T_world_camera=up @ image.T_world_camera) for image in frame.depths)
    told = wrong_floor(Frame(0, depths=higher))
    assert told is not None
    assert "left: what looks like the floor tilts by 0 degrees and lies at z = 0.80 m" in told
    optical = tuple(replace(image, T_world_camera=np.eye(4)) for image in frame.depths)
    told = wrong_floor(Frame(0, depths=optical))  # x right, y down, z ahead, as a camera has it
    assert told is not None
    assert "tilts by 97 degrees" in told
    assert len(camera_points(frame.depths[0])) > 5000


def headvox(*flags: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "headvox", *map(str, flags)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)


def test_the_rig_of_the_sample_is_found_again_from_nothing(tmp_path):
    shutil.copytree(SAMPLE, tmp_path / "rig")
    described = json.loads((tmp_path / "rig" / "recording.json").read_text())
    for camera in described["cameras"].values():
        camera["T_world_camera"] = np.eye(4).tolist()  # as with cameras that nobody has placed
    (tmp_path / "rig" / "recording.json").write_text(json.dumps(described))
    done = headvox("align", "rig", "-o", "found.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "WRONG" in done.stdout
    found = read_extrinsics(str(tmp_path / "found.toml"))
    true = {name: camera.T_world_camera for name, camera in RecordingSource(SAMPLE).cameras.items()}
    apart = inverse(inverse(found["left"]) @ found["right"]) @ inverse(true["left"]) @ true["right"]
    assert np.linalg.norm(apart[:3, 3]) < 0.06
    assert np.degrees(Rotation.from_matrix(apart[:3, :3]).magnitude()) < 1.5
    for name in true:
        assert found[name][2, 3] == pytest.approx(true[name][2, 3], abs=0.04)
    source = open_source(tmp_path / "rig", _options(tmp_path / "found.toml"))
    frame = next(iter(source))
    assert isinstance(frame, Frame)
    assert np.array_equal(frame.depths[0].T_world_camera, found["left"])


def test_frames_are_spread_over_the_whole_of_a_bag_of_several_cameras(tmp_path):
    convert(open_source(SAMPLE), tmp_path / "rig.mcap")
    every = [frame.stamp_ns for frame in open_source(SAMPLE)]
    for path in (SAMPLE, tmp_path / "rig.mcap"):
        with closing(open_source(path)) as source:
            chosen = spread_frames(source, 5, print)
        assert [frame.stamp_ns for frame in chosen] == every[::5]


def _options(file: Path):
    from headvox.sources.options import SourceOptions

    return SourceOptions(extrinsics=str(file))


def with_poses(folder: Path, step_m: float) -> Path:
    """Write the sample with a left camera that goes ``step_m`` to the left and right, in turn."""
    shutil.copytree(SAMPLE, folder)
    described = json.loads((folder / "recording.json").read_text())
    for k, frame in enumerate(described["frames"]):
        T = np.array(described["cameras"]["left"]["T_world_camera"])
        T[1, 3] += step_m * (k % 2)
        frame["T_world_camera"] = {"left": T.tolist()}
    (folder / "recording.json").write_text(json.dumps(described))
    return folder


def test_a_moving_camera_cannot_be_aligned(tmp_path):
    moving = with_poses(tmp_path / "moving", 0.05)
    with pytest.raises(
        HeadvoxError, match="left: the camera moves, and extrinsics are for cameras that stand"
    ):
        _views(list(open_source(moving))[:4])
    (left, right) = _views(list(open_source(with_poses(tmp_path / "jitter", 0.001)))[:4])
    assert (left.name, right.name) == ("left", "right")


def test_extrinsics_that_hold_a_moving_camera_still_are_told(tmp_path):
    moving = with_poses(tmp_path / "moving", 0.05)
    (tmp_path / "both.toml").write_text(extrinsics_text({"left": np.eye(4), "right": np.eye(4)}))
    (tmp_path / "right.toml").write_text(extrinsics_text({"right": np.eye(4)}))
    told: list[str] = []
    open_source(moving, _options(tmp_path / "right.toml"), told.append)
    open_source(SAMPLE, _options(tmp_path / "both.toml"), told.append)
    assert told == []
    open_source(moving, _options(tmp_path / "both.toml"), told.append)
    assert len(told) == 1
    assert "moving: --extrinsics holds cameras still that move in the recording: left;" in told[0]
    assert "moving" in dict(describe(moving))["camera left"]
    assert "moving" not in dict(describe(moving))["camera right"]
    assert "moving" not in dict(describe(with_poses(tmp_path / "jitter", 0.001)))["camera left"]


def test_bad_input_is_told_in_a_line(tmp_path):
    (tmp_path / "cloud.npy").write_bytes(b"")
    np.save(tmp_path / "cloud.npy", np.ones((100, 3), np.float32))
    done = headvox("align", "cloud.npy", cwd=tmp_path)
    assert done.returncode == 1
    assert "there are no depth images in it" in done.stderr
    described = (SAMPLE / "recording.json").read_text()
    (tmp_path / "recording.json").write_text(described)  # without its images
    done = headvox("align", ".", cwd=tmp_path)
    assert done.returncode == 1
    assert "24 of its frames are bad, and no other can be used" in done.stderr
    assert "000000.png: cannot be read: No such file" in done.stderr
    (tmp_path / "other.toml").write_text(extrinsics_text({"nobody": np.eye(4)}))
    done = headvox("align", SAMPLE, "--extrinsics", "other.toml", cwd=tmp_path)
    assert done.returncode == 1
    assert "has no camera nobody, only left, right" in done.stderr
    done = headvox("align", "nothing", "-o", "no/x.toml", cwd=tmp_path)  # before anything is read
    assert "headvox: error: Output no/x.toml: No such file or directory." in done.stderr
