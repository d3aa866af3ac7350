"""``headvox run``: what it prints and writes."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from command import COMMAND, assert_explained, heads_of, headvox, headvox_process, parse
from inputs import write_recording

from headvox.commands import session
from headvox.commands.flags import TRACKER_FLAGS
from headvox.config import TrackerConfig
from headvox.sample import sample_folder

# ----------------------------------------------------------------------------------------------------------- run --json


def test_json_lines_are_what_the_format_says(recording: Path, anything: Path) -> None:
    done = headvox("run", recording, "--json", "--no-track", "--cascade", anything)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    lines = [parse(line) for line in done.stdout.splitlines()]
    assert [line["frame"] for line in lines] == [0, 1, 2]
    assert [line["stamp_ns"] for line in lines] == [0, 100_000_000, 200_000_000]
    for line in lines:
        assert list(line) == ["stamp_ns", "frame", "latency_ms", "heads"]
        assert isinstance(line["latency_ms"], float)
        assert line["latency_ms"] > 0
        heads = line["heads"]
        assert isinstance(heads, list)
        assert heads
        for head in heads:
            wanted = [
                "id",
                "centre",
                "quaternion",
                "radius",
                "score",
                "velocity",
                "centre_sigma",
                "rotation_sigma",
            ]
            assert list(head) == wanted
            assert head["id"] is None
            assert head["velocity"] is None
            assert head["quaternion"] is None or abs(sum(v * v for v in head["quaternion"]) - 1.0) < 1e-4
            assert all(abs(v - round(v, 4)) < 1e-12 for v in [*head["centre"], head["radius"]])


def test_the_same_heads_again_and_with_two_threads(recording: Path, anything: Path) -> None:
    """In one process and in two others."""
    command = ("run", recording, "--json", "--cascade", anything, "--threads")
    first = headvox(*command, 1)
    for done in (headvox_process(*command, 1), headvox_process(*command, 2)):
        assert (done.returncode, done.stderr) == (0, "")
        assert json.dumps(heads_of(first.stdout)) == json.dumps(heads_of(done.stdout))


def test_the_first_run_says_why_it_is_silent(
    recording: Path, anything: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "kept_loops", lambda: 0)
    done = headvox("run", recording, "--cascade", anything)
    assert done.returncode == 0
    assert done.stderr == "the first run compiles its loops, for half a minute or so, and keeps them\n"


def test_limit_stops_early(recording: Path) -> None:
    done = headvox("run", recording, "--json", "--limit", 2)
    assert len(done.stdout.splitlines()) == 2


# ---------------------------------------------------------------------------------------------------- the summary table


def test_a_run_ends_with_a_summary(recording: Path, anything: Path) -> None:
    done = headvox("run", recording, "--cascade", anything)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""  # no live line where nobody watches
    rows = dict(line.rsplit(maxsplit=1) for line in done.stdout.splitlines() if line)
    assert rows["frames"] == "3"
    assert rows["bad frames"] == "0"
    assert rows["frames with heads"] == "3"
    assert float(rows["Hz, reading included"]) > 0
    assert done.stdout.split("ms a frame")[1].split()[:3] == ["p50", "p95", "p99"]
    for stage in ("voxelize", "gate", "vote", "total"):
        assert f"\n{stage} " in done.stdout


def test_a_single_frame_shows_its_heads(recording: Path, anything: Path) -> None:
    done = headvox("run", recording, "--limit", 1, "--cascade", anything)
    assert done.stdout.split("\n")[0].split() == ["head", "x", "y", "z", "radius", "score"]


def test_a_terminal_gets_one_live_line(recording: Path) -> None:
    pty = pytest.importorskip("pty")
    master, slave = pty.openpty()
    command = [str(COMMAND), "run", str(recording), "--json"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=slave) as process:
        os.close(slave)
        seen = b""
        while True:
            try:
                data = os.read(master, 4096)
            except OSError:  # the terminal is gone
                break
            if not data:
                break
            seen += data
    os.close(master)
    assert process.returncode == 0
    text = seen.decode()
    assert "frame 1/3  heads " in text
    assert "dropped 0" in text
    assert "\n" not in text
    assert "\x1b" not in text  # no colours: NO_COLOR has nothing to switch off
    assert text.endswith("\r")


# --------------------------------------------------------------------------------------------------------------- -o OUT


def test_output_files_hold_what_json_prints(recording: Path, anything: Path, tmp_path: Path) -> None:
    done = headvox("run", recording, "--json", "--cascade", anything, "-o", tmp_path / "out.jsonl")
    assert (tmp_path / "out.jsonl").read_text() == done.stdout
    headvox("run", recording, "--cascade", anything, "-o", tmp_path / "out.csv")
    header, *rows = (tmp_path / "out.csv").read_text().splitlines()
    assert header.startswith("frame,stamp_ns,latency_ms,id,x,y,z,")
    told = [dict(zip(header.split(","), row.split(","), strict=True)) for row in rows]
    heads = [head for frame in heads_of(done.stdout) for head in frame]
    for row, head in zip(told, heads, strict=True):
        assert [float(row[axis]) for axis in "xyz"] == head["centre"]
        stated = [row[f"q{axis}"] for axis in "xyzw"]
        assert stated == [""] * 4 or [float(v) for v in stated] == head["quaternion"]
        assert (head["quaternion"] is None) == (stated == [""] * 4)
    assert {head["quaternion"] is None for head in heads} == {True, False}
    assert told[0]["id"] == told[0]["vx"] == ""


def test_an_unknown_kind_of_output_is_wrong_usage(recording: Path, tmp_path: Path) -> None:
    done = headvox("run", recording, "-o", tmp_path / "out.txt")
    assert done.returncode == 2
    assert ".jsonl, .csv, .tum or .mcap" in done.stderr
    assert not (tmp_path / "out.txt").exists()


@pytest.mark.parametrize("link", ["inside", "hard", "soft"])
def test_the_input_is_never_written_over(tmp_path: Path, link: str) -> None:
    folder = write_recording(tmp_path / "recording", 1)
    truth = folder / "heads.jsonl"
    truth.write_text("precious\n")
    target = truth
    if link == "soft":
        target = tmp_path / "link.jsonl"
        target.symlink_to(truth)
    if link == "hard":
        cloud = tmp_path / "cloud.npy"
        np.save(cloud, np.random.default_rng(0).uniform(-1, 1, (500, 3)).astype(np.float32))
        target = tmp_path / "link.csv"
        target.hardlink_to(cloud)
        before = cloud.read_bytes()
        assert_explained(headvox("run", cloud, "-o", target))
        assert cloud.read_bytes() == before
        return
    assert_explained(headvox("run", folder, "-o", target))
    assert truth.read_text() == "precious\n"


@pytest.mark.parametrize("truth", [None, "precious\n"])
def test_results_of_many_are_never_written_into_a_source(tmp_path: Path, truth: str | None) -> None:
    """True heads are called heads.jsonl: so would be the results of a recording of that name."""
    folder = write_recording(tmp_path / "heads", 1)
    if truth is not None:
        (folder / "heads.jsonl").write_text(truth)
    before = sorted(folder.iterdir())
    for places in ([folder], [write_recording(tmp_path / "other", 1), folder], [folder / "recording.json"]):
        done = headvox("run", *places, "--into", folder)
        assert_explained(done)
        assert "would be written into the input" in done.stderr
    assert sorted(folder.iterdir()) == before
    assert truth is None or (folder / "heads.jsonl").read_text() == truth


def test_extrinsics_are_never_written_over(recording: Path, tmp_path: Path) -> None:
    told = "[cameras.cam]\nT_world_camera = [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]]\n"
    place = tmp_path / "place.csv"
    place.write_text(told)
    done = headvox("run", recording, "--extrinsics", place, "-o", place)
    assert_explained(done)
    assert "would be written into the input" in done.stderr
    assert place.read_text() == told


def test_an_output_that_cannot_be_made_is_explained(recording: Path, tmp_path: Path) -> None:
    assert_explained(headvox("run", recording, "-o", tmp_path / "nowhere" / "out.csv"))


# ------------------------------------------------------------------------------------------------------------- tracking


def test_a_run_tracks_unless_told_not_to(recording: Path, anything: Path) -> None:
    done = headvox("run", recording, "--json", "--cascade", anything)
    lines = heads_of(done.stdout)
    assert {head["state"] for head in lines[0]} == {"tentative"}
    assert {head["id"] for head in lines[0]} == {None}
    confirmed = [head for head in lines[1] if head["state"] == "confirmed"]
    assert [head["id"] for head in confirmed] == list(range(1, len(confirmed) + 1))
    assert len(confirmed) > 0
    ids = {head["id"] for line in lines for head in line if head["id"] is not None}
    for head in confirmed:
        assert max(map(abs, head["velocity"])) < 0.05  # nothing moves here
    table = headvox("run", recording, "--cascade", anything).stdout
    rows = dict(line.rsplit(maxsplit=1) for line in table.splitlines() if line)
    assert rows["heads with an id"] == str(len(ids))
    assert "\ntrack " in table
    bare = headvox("run", recording, "--cascade", anything, "--no-track").stdout
    assert "heads with an id" not in bare
    assert "\ntrack " not in bare


def test_settings_of_the_tracker_by_flag_and_file(recording: Path, anything: Path, tmp_path: Path) -> None:
    done = headvox("config", "--confirm-hits", 1, "--cascade", anything)
    assert "\nconfirm_hits = 1\n" in done.stdout
    (tmp_path / "mine.toml").write_text(done.stdout)
    done = headvox("run", recording, "--json", "--limit", 1, "--config", tmp_path / "mine.toml")
    assert {head["state"] for head in heads_of(done.stdout)[0]} == {"confirmed"}
    more = ("--config", tmp_path / "mine.toml", "--confirm-hits", 2)
    done = headvox("run", recording, "--json", "--limit", 1, *more)
    assert {head["state"] for head in heads_of(done.stdout)[0]} == {"tentative"}
    assert_explained(headvox("run", recording, "--confirm-hits", 9), 2)


def test_every_setting_of_the_tracker_has_a_flag() -> None:
    assert {name for _, name, *_ in TRACKER_FLAGS} == {field.name for field in fields(TrackerConfig)}
    shown = headvox("config", "--strong-score", 3.5, "--present", 2).stdout
    assert "\nstrong_score = 3.5\n" in shown
    assert "\npresent_s = 2.0\n" in shown


def test_a_trajectory_a_track(recording: Path, anything: Path, tmp_path: Path) -> None:
    (tmp_path / "out_77.tum").write_text("of an older run\n")
    (tmp_path / "out_x.tum").write_text("somebody else's\n")
    done = headvox("run", recording, "--json", "--cascade", anything, "-o", tmp_path / "out.tum")
    assert done.returncode == 0, done.stderr
    confirmed = [head for head in heads_of(done.stdout)[2] if head["id"] is not None]
    names = {path.name for path in tmp_path.iterdir()}
    assert len(confirmed) > 0
    assert names == {"out_x.tum", *(f"out_{head['id']}.tum" for head in confirmed)}
    for head in confirmed:
        rows = np.loadtxt(tmp_path / f"out_{head['id']}.tum", ndmin=2)
        np.testing.assert_allclose(rows[-1, :4], [0.2, *head["centre"]], atol=1e-9)
        wanted = [np.nan] * 4 if head["quaternion"] is None else head["quaternion"]
        np.testing.assert_allclose(rows[-1, 4:], wanted, atol=1e-6)
    assert_explained(headvox("run", recording, "--no-track", "-o", tmp_path / "out.tum"), 2)
    assert_explained(headvox("run", recording, "-o", tmp_path / "nowhere" / "out.tum"))


# ------------------------------------------------------------------------------------------------------- many, --into


def test_a_batch_tells_what_every_run_tells(tmp_path: Path) -> None:
    """Each in turn: a frame that is skipped, a floor elsewhere, one that cannot be used, one that is there already."""
    some = write_recording(tmp_path / "some", 3, bad=(1,))
    high = tmp_path / "high"
    shutil.copytree(sample_folder(), high)
    text = json.loads((high / "recording.json").read_text())
    for camera in text["cameras"].values():
        camera["T_world_camera"][2][3] += 0.8
    (high / "recording.json").write_text(json.dumps(text))
    none = write_recording(tmp_path / "none", 2, bad=(0, 1))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "there.jsonl").touch()
    done = headvox("run", some, high, none, tmp_path / "there", "--into", tmp_path / "out", "--no-track")
    assert done.returncode == 1
    lines = done.stderr.splitlines()
    assert lines[0].startswith("headvox: some: frame 1 skipped: cam/bad.png: ")
    assert (
        "headvox: high: left: what looks like the floor tilts by 0 degrees and lies at z = 0.80 m" in lines[1]
    )
    assert lines[2].startswith("headvox: none: frame 0 skipped: ")
    assert lines[3] == "headvox: none: 1 more skipped for the same reason"
    assert lines[4].startswith("headvox: none: none: none of the 2 frames could be used.")
    rows = {line.split()[0]: line.split()[1:] for line in done.stdout.splitlines()}
    assert rows["some"] == ["3", "0", "1", "done"]
    assert rows["none"] == ["-", "-", "-", "failed"]
    assert rows["there"] == ["-", "-", "-", "was", "there", "already"]
