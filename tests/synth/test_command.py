"""``headvox synth``, run as a user runs it, and the sample that it made for the package."""

import json
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command import COMMAND, Done
from command import headvox as run_headvox

import headvox
from headvox import cli
from headvox.data import Frame
from headvox.sources import open_source
from headvox.synth import presets, record

SAMPLE = Path(headvox.__file__).parent / "assets" / "sample"


def synth(*arguments: object) -> Done:
    return run_headvox("synth", *arguments)


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def truth(folder):
    return [json.loads(line) for line in (folder / "heads.jsonl").read_text().splitlines()]


def test_heads_by_two_processes_equal_those_by_one_and_are_not_made_again(tmp_path):
    few = ("heads", "--count", 2, "--points", 200, "--metric", "--seed", 3)
    for workers in (1, 2):
        done = synth(*few, "--workers", workers, "-o", tmp_path / str(workers))
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        assert "points of each  200" in done.stdout
    assert contents(tmp_path / "1") == contents(tmp_path / "2")
    assert json.loads((tmp_path / "1" / "manifest.json").read_text())["metric"] is True
    (tmp_path / "1" / "head_01.ply").unlink()
    assert synth(*few, "--workers", 1, "-o", tmp_path / "1").returncode == 0
    assert contents(tmp_path / "1") == contents(tmp_path / "2")


def test_a_scene_by_two_processes_equals_one_by_one(tmp_path):
    small = ("scene", "--people", 2, "--cameras", 2, "--sensor", "d435i-small", "--frames", 3, "--hz", 5)
    for workers in (1, 2):
        done = synth(*small, "--seed", 1, "--workers", workers, "-o", tmp_path / str(workers))
        assert done.returncode == 0, done.stderr
    assert contents(tmp_path / "1") == contents(tmp_path / "2")
    frames = list(open_source(tmp_path / "1"))
    assert [frame.stamp_ns for frame in frames] == [0, 200_000_000, 400_000_000]
    assert all(isinstance(frame, Frame) and len(frame.depths) == 2 for frame in frames)
    for line in truth(tmp_path / "1"):
        people = [head for head in line["heads"] if head["posture"] != "mannequin"]
        assert [head["id"] for head in people] == [1, 2]
        assert all(set(head["visible"]) == {"camera_0", "camera_1"} for head in people)


@pytest.mark.parametrize("preset", ["walk", "turn", "two-cameras"])
def test_presets_become_recordings(tmp_path, preset):
    done = synth(preset, "--sensor", "kinect", "--frames", 1, "--workers", 1, "-o", tmp_path / "new")
    assert done.returncode == 0, done.stderr
    (frame,) = open_source(tmp_path / "new")
    assert len(frame.depths) == (2 if preset == "two-cameras" else 1)
    assert {depth.depth.shape for depth in frame.depths} == {(480, 640)}
    assert [head["ignore"] for head in truth(tmp_path / "new")[0]["heads"]] == [False]


def test_nobody_is_a_scene_too(tmp_path):
    done = synth("scene", "--people", 0, "--sensor", "ideal", "--frames", 1, "-o", tmp_path / "empty")
    assert done.returncode == 0, done.stderr
    assert [h for h in truth(tmp_path / "empty")[0]["heads"] if h["posture"] != "mannequin"] == []


def test_a_lidar_scene_is_a_folder_of_clouds_with_truth(tmp_path):
    done = synth("scene", "--sensor", "lidar", "--people", 1, "--frames", 2, "-o", tmp_path / "clouds")
    assert done.returncode == 0, done.stderr
    frames = list(open_source(tmp_path / "clouds"))
    lines = truth(tmp_path / "clouds")
    assert [frame.stamp_ns for frame in frames] == [line["stamp_ns"] for line in lines]
    scene = presets.lidar(0, None, duration_s=0.2, count=1)
    for frame in frames:
        (cloud,) = frame.clouds
        wanted = scene.frame(0)[0].clouds[0]
        assert cloud.points.shape == wanted.points.shape
        np.testing.assert_allclose(cloud.T_world_sensor, wanted.T_world_sensor, atol=1e-6)
    np.testing.assert_array_equal(frames[0].clouds[0].points, scene.frame(0)[0].clouds[0].points)


@pytest.mark.parametrize("kind", [("heads", "--count", 1), ("walk", "--frames", 1), ("sample",)])
def test_what_is_there_is_never_mixed_or_lost(tmp_path, kind):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    done = synth(*kind, "-o", tmp_path / "mine")
    assert done.returncode == 1
    assert done.stdout == ""
    assert done.stderr.startswith("headvox: error: ")
    assert len(done.stderr.splitlines()) == 2
    assert contents(tmp_path / "mine") == {"letter.txt": b"dear"}


@pytest.mark.parametrize("kind", [("heads", "--count", 1), ("walk", "--frames", 1)])
def test_a_place_that_cannot_be_written_is_named_as_it_was_given(tmp_path, kind):
    (tmp_path / "file").touch()
    done = synth(*kind, "-o", tmp_path / "file" / "new")
    assert done.returncode == 1
    assert f"headvox: error: Output {tmp_path / 'file' / 'new'}: Not a directory.\n" in done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("frobnicate", "-o", "new"),
        ("heads",),
        ("heads", "--count", 0, "-o", "new"),
        ("heads", "--points", "many", "-o", "new"),
        ("heads", "--points", 10**11, "-o", "new"),
        ("heads", "--seed", -1, "-o", "new"),
        ("scene", "--people", 7, "-o", "new"),
        ("scene", "--sensor", "sonar", "-o", "new"),
        ("scene", "--sensor", "lidar", "--hz", 10, "-o", "new"),
        ("walk", "--sensor", "lidar", "-o", "new"),
        ("walk", "--hz", "nan", "-o", "new"),
        ("turn", "--frames", 0, "-o", "new"),
        ("crowd", "--workers", 0, "-o", "new"),
    ],
)
def test_wrong_usage_ends_with_2(arguments, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["synth", *map(str, arguments)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert "error: " in said.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pseudo-terminal")
def test_a_terminal_is_told_how_far_it_is(tmp_path):
    screen, terminal = pty.openpty()
    command = [
        str(COMMAND),
        "synth",
        "heads",
        "--count",
        "2",
        "--points",
        "50",
        "--workers",
        "1",
        "-o",
        "new",
    ]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=terminal, cwd=tmp_path, check=True)
    os.close(terminal)
    told = os.read(screen, 10_000).decode()
    os.close(screen)
    assert "head 1/2" in told
    assert "head 2/2" in told
    assert "\n" not in told
    assert b"head 1/2" not in done.stdout


def test_ctrl_c_ends_quietly_and_the_command_goes_on_when_given_again(tmp_path):
    few = ["two-cameras", "--sensor", "d435i-small", "--frames", "8", "--workers", "1"]
    begun = tmp_path / "new.partial" / "truth"
    with subprocess.Popen(
        [str(COMMAND), "synth", *few, "-o", tmp_path / "new"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        until = time.monotonic() + 60.0
        while time.monotonic() < until and not (begun.is_dir() and any(begun.glob("*.json"))):
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGINT)
        said = process.communicate()
    assert (process.returncode, said) == (130, (b"", b""))
    assert not (tmp_path / "new").exists()
    assert synth(*few, "-o", tmp_path / "new").returncode == 0
    assert synth(*few, "-o", tmp_path / "whole").returncode == 0
    assert contents(tmp_path / "new") == contents(tmp_path / "whole")


def test_help_imports_nothing_heavy():
    code = "import sys, headvox.synth.command as c\ntry: c.main(['--help'])\nexcept SystemExit: pass\n"
    code += "print({'numba', 'scipy', 'PIL'} & set(sys.modules), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "set()\n"


def test_the_sample_in_the_package_is_what_synth_makes():
    scene = record.sample_scene_of_three()
    shipped = list(open_source(SAMPLE))
    lines = (SAMPLE / "heads.jsonl").read_text().splitlines()
    assert len(shipped) == len(lines) == record.SAMPLE_FRAMES
    for k in (0, 17):
        frame, heads = scene.frame(record.stamps(record.SAMPLE_FRAMES)[k])
        assert shipped[k].stamp_ns == frame.stamp_ns
        for got, wanted in zip(shipped[k].depths, frame.depths, strict=True):
            assert (got.name, got.intrinsics) == (wanted.name, wanted.intrinsics)
            np.testing.assert_array_equal(got.depth, wanted.depth)
        assert [row["id"] for row in json.loads(lines[k])["heads"]] == [head.id for head in heads]
        for row, head in zip(json.loads(lines[k])["heads"], heads, strict=True):
            np.testing.assert_allclose(row["centre"], head.centre, atol=1e-5)
            assert row["visible"] == head.visible
            assert (row["posture"], row["hair"]) == (head.posture, head.hair)


def test_the_sample_is_small_and_everybody_is_seen():
    assert sum(len(data) for data in contents(SAMPLE).values()) < 3.5e6
    for line in truth(SAMPLE):
        people = [head for head in line["heads"] if head["posture"] != "mannequin"]
        assert len(people) == 3
        assert max(max(head["visible"].values()) for head in people) > 0.5
