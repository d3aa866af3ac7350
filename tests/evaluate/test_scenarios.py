"""The frames of the scenarios are what they say, and their truth is true."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from headvox.cli import main
from headvox.data import Frame
from headvox.errors import HeadvoxError
from headvox.evaluate.around import HEADS_M, around
from headvox.evaluate.keep import keep
from headvox.evaluate.scenarios import (
    SHELL_POINTS,
    Scenario,
    recording,
    rotation,
    shell_in_head_frame,
    static,
    two_cameras,
)
from headvox.evaluate.truth import TrueHeads, read_truth
from headvox.frames import unproject
from headvox.synth.heads import ply_bytes
from headvox.synth.wear import HAIR_STYLES, HATS


def all_of(scenario: Scenario) -> list[tuple[Frame, TrueHeads]]:
    frames = []
    for frame, true in scenario.frames():
        assert isinstance(frame, Frame)
        assert true is not None
        frames.append((frame, true))
    assert len(frames) == scenario.length
    return frames


def test_a_shell_is_a_head_in_its_own_frame() -> None:
    shell = shell_in_head_frame(3, 0, 0)
    assert shell.shape == (SHELL_POINTS, 3)
    low, high = shell.min(axis=0), shell.max(axis=0)
    assert (low[2], high[2]) == (pytest.approx(-0.15, abs=0.05), pytest.approx(0.11, abs=0.02))
    # The nose sticks out forward: the foremost point is in the middle, below the eyes.
    nose = shell[shell[:, 0].argmax()]
    assert abs(nose[1]) < 0.01
    assert -0.06 < nose[2] < 0.0


def test_static_turns_each_shell_about_its_centre() -> None:
    frames = all_of(static(identities=2, turns=3))
    assert frames[0][1].quaternions[0] != pytest.approx(frames[1][1].quaternions[0])
    for k, (frame, true) in enumerate(frames):
        points = frame.clouds[0].points.astype(np.float64)
        back = Rotation.from_quat(true.quaternions[0]).inv().apply(points)
        assert back == pytest.approx(shell_in_head_frame(2, k // 3, 0), abs=1e-6)
        assert true.centres.tolist() == [[0, 0, 0]]
    again = all_of(static(identities=2, turns=3))
    assert all(
        np.array_equal(a.clouds[0].points, b.clouds[0].points)
        for (a, _), (b, _) in zip(frames, again, strict=True)
    )


def test_rotation_goes_by_twelve_degrees_a_second() -> None:
    every, fifth = all_of(rotation(1, 0.05)), all_of(rotation(5, 0.05))
    assert (len(every), len(fifth)) == (45, 9)
    yaws = [Rotation.from_quat(true.quaternions[0]).as_euler("ZYX", degrees=True)[0] for _, true in every]
    assert np.diff(yaws) == pytest.approx(0.4)
    assert every[30][0].stamp_ns == 10**9
    assert yaws[30] == pytest.approx(12.0)
    assert [f.stamp_ns for f, _ in fifth] == [f.stamp_ns for f, _ in every[::5]]
    assert np.array_equal(fifth[1][0].clouds[0].points, every[5][0].clouds[0].points)


def test_two_cameras_and_keeping_their_frames(tmp_path: Path) -> None:
    made = two_cameras(walkers=1, frames=2)
    kept = keep(made, tmp_path / "kept")
    again = recording(tmp_path / "kept")
    assert (kept.name, again.name) == ("two-cameras", "kept")
    for (a, heads), (b, read) in zip(all_of(made), all_of(kept), strict=True):
        assert a.stamp_ns == b.stamp_ns
        assert [d.name for d in a.depths] == [d.name for d in b.depths] == ["left", "right"]
        for one, other in zip(a.depths, b.depths, strict=True):
            assert np.array_equal(one.depth, other.depth)
            assert np.array_equal(one.T_world_camera, other.T_world_camera)
        assert np.array_equal(heads.centres, read.centres)
        assert heads.quaternions == pytest.approx(read.quaternions)
        assert (heads.shares, heads.labels) == (read.shares, read.labels)
        assert heads.labels["posture"][0] == "walking"
        assert heads.labels["hair"][0] in (*HAIR_STYLES, *HATS)
        assert (heads.visible >= 0.15).any()
    assert len(read_truth(tmp_path / "kept" / "heads.jsonl")) == 2
    with pytest.raises(HeadvoxError, match="holds something"):
        keep(made, tmp_path / "kept")
    with pytest.raises(HeadvoxError, match="no depth images"):
        keep(static(1, 1), tmp_path / "clouds")


@pytest.fixture
def bodies(tmp_path: Path) -> Path:
    """Four bodies that are a cube of 20 cm about each true centre."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.1
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    for name, centre in HEADS_M.items():
        (tmp_path / f"{name}.ply").write_bytes(ply_bytes(corners + centre, faces))
    return tmp_path


def test_bodies_are_seen_from_eight_sides(bodies: Path) -> None:
    frames = all_of(around(bodies))
    assert len(frames) == 32
    for k, (frame, true) in enumerate(frames):
        (image,) = frame.depths
        head = np.array(list(HEADS_M.values())[k // 8])
        assert true.centres[0] == pytest.approx(head)
        azimuth = np.radians(45 * (k % 8))
        eye = head[:2] + 2.5 * np.array([np.cos(azimuth), np.sin(azimuth)])
        assert image.T_world_camera[:3, 3] == pytest.approx([*eye, 1.4])
        points = unproject(image.depth, image.intrinsics, image.T_world_camera)
        on_cube = points[np.abs(points - head).max(axis=1) < 0.12]
        assert len(on_cube) > 1000
        # The faces that look at the camera were hit, to the noise: at 2.5 m it is 9 mm.
        assert np.abs(np.abs(on_cube - head).max(axis=1) - 0.1).mean() < 0.01
        wall = (points[:, :2] - head[:2]) @ -np.array([np.cos(azimuth), np.sin(azimuth)])
        assert wall.max() == pytest.approx(1.5, abs=0.15)
        assert 0.5 < (np.abs(wall - 1.5) < 0.1).mean() < 0.95
        assert np.percentile(points[:, 2], 0.1) == pytest.approx(0.0, abs=0.05)


def test_a_missing_body_is_told(bodies: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (bodies / "male.ply").unlink()
    assert main(["eval", "peers", "--clouds", str(bodies)]) == 1
    assert "there is no male.ply" in capsys.readouterr().err
    assert main(["eval", "peers"]) == 2
    assert main(["eval", "static", "--keep", str(bodies / "new")]) == 2


def test_the_paper_s_scenarios_are_scored(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["eval", "static", "--identities", "1", "--turns", "4", "rotation", "--revolutions", "0.02"]
    assert main([*command, "--limit", "static:recall=1", "centre_mean_m=0.03"]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert rows[1].split()[:6] == ["static", "default", "alike", "4", "4", "4"]
    assert [row.split("  ")[0] for row in rows[1:6]] == [
        "static",
        *2 * ["rotation"],
        *2 * ["rotation, every 5th"],
    ]
