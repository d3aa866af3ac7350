"""The command, run as a user runs it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import types
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from headvox import __version__, cli
from headvox.commands.flags import TRACKER_FLAGS
from headvox.config import TrackerConfig

COMMAND = Path(sys.executable).with_name("headvox")
HEAVY = ("numba", "numpy", "scipy", "PIL", "matplotlib")

# Finds something wherever there is a surface, and is sure of it: what it finds does not matter here.
CASCADE = """
format = "headvox-cascade"
version = 1
name = "anything"
summary = "Every surface is a head"
voxel_m = 0.05
subdivision = 2
occupancy = "parts"
min_score = 0.0
[[gate]]
name = "shell"
boxes = [{ centre = [0, 0, 0], size = [0.25, 0.25, 0.25] }]
min = 0.03
[[group]]
name = "ring"
ring = { radius = 0.1, height = 0.0, size = [0.1, 0.1, 0.1] }
[[stage]]
name = "only"
trees = [["ring.sum", 0.1, 4.25, 4.5]]
"""


def headvox(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [str(COMMAND), *(str(argument) for argument in arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


def write_recording(folder: Path, frames: int, bad: tuple[int, ...] = ()) -> Path:
    """A camera 1.5 m high that looks ahead at a wall 2 m away with a ball before it."""
    (folder / "cam").mkdir(parents=True)
    depth = np.full((60, 80), 2000, np.uint16)
    v, u = np.mgrid[:60, :80]
    depth[(u - 40) ** 2 + (v - 30) ** 2 < 36] = 1500
    for name in ("good", "bad"):
        Image.fromarray(depth).save(folder / "cam" / f"{name}.png")
    (folder / "cam" / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\n and then nothing")
    camera = {"width": 80, "height": 60, "fx": 70.0, "fy": 70.0, "cx": 39.5, "cy": 29.5, "depth_scale": 0.001}
    camera["T_world_camera"] = [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]]  # type: ignore[assignment]
    lines = [
        {"stamp_ns": 100_000_000 * k, "depth": {"cam": f"cam/{'bad' if k in bad else 'good'}.png"}}
        for k in range(frames)
    ]
    text = {"format": "headvox-recording", "version": 1, "cameras": {"cam": camera}, "frames": lines}
    (folder / "recording.json").write_text(json.dumps(text))
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("cli") / "three", 3)


@pytest.fixture(scope="module")
def anything(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cascade") / "anything.toml"
    path.write_text(CASCADE)
    return path


def parse(line: str) -> dict[str, object]:
    def refuse(token: str) -> None:
        raise AssertionError(f"{token} is not JSON")

    parsed: dict[str, object] = json.loads(line, parse_constant=refuse)
    return parsed


def heads_of(output: str) -> list[object]:
    return [parse(line)["heads"] for line in output.splitlines()]


def assert_explained(done: subprocess.CompletedProcess[str], code: int = 1) -> None:
    """One line what, at most one line what to do."""
    assert done.returncode == code, done
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    assert "internal error" not in done.stderr
    lines = done.stderr.splitlines()
    assert sum(line.startswith("headvox: error: ") for line in lines) == 1
    if code == 1:
        assert 1 <= len(lines) <= 2


# ------------------------------------------------------------------------------------------------ run --json


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
    first, again, two = (
        headvox("run", recording, "--json", "--cascade", anything, "--threads", threads)
        for threads in (1, 1, 2)
    )
    assert json.dumps(heads_of(first.stdout)) == json.dumps(heads_of(again.stdout))
    assert json.dumps(heads_of(first.stdout)) == json.dumps(heads_of(two.stdout))


def test_limit_stops_early(recording: Path) -> None:
    done = headvox("run", recording, "--json", "--limit", 2)
    assert len(done.stdout.splitlines()) == 2


# ----------------------------------------------------------------------------------------- the summary table


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


# ---------------------------------------------------------------------------------------------------- -o OUT


def test_output_files_hold_what_json_prints(recording: Path, anything: Path, tmp_path: Path) -> None:
    done = headvox("run", recording, "--json", "--cascade", anything, "-o", tmp_path / "out.jsonl")
    assert (tmp_path / "out.jsonl").read_text() == done.stdout
    headvox("run", recording, "--cascade", anything, "-o", tmp_path / "out.csv")
    header, *rows = (tmp_path / "out.csv").read_text().splitlines()
    assert header.startswith("frame,stamp_ns,latency_ms,id,x,y,z,")
    heads = heads_of(done.stdout)
    assert len(rows) == sum(len(frame) for frame in heads)  # type: ignore[arg-type]
    first = dict(zip(header.split(","), rows[0].split(","), strict=True))
    assert [float(first[axis]) for axis in "xyz"] == heads[0][0]["centre"]  # type: ignore[index]
    assert first["qx"] == first["id"] == first["vx"] == ""


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


def test_an_output_that_cannot_be_made_is_explained(recording: Path, tmp_path: Path) -> None:
    assert_explained(headvox("run", recording, "-o", tmp_path / "nowhere" / "out.csv"))


# ----------------------------------------------------------------------------------------------- how it ends


def heed_ctrl_c() -> None:
    """Undo what a shell does to its background jobs, should the tests be one."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def test_ctrl_c_ends_with_130_and_whole_lines(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "long", 20_000)
    command = [str(COMMAND), "run", str(folder), "--json", "-o", str(tmp_path / "out.jsonl")]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=heed_ctrl_c,
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        first = process.stdout.readline()
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
        errors = process.stderr.read()
    assert process.returncode == 130
    assert errors == ""
    written = (tmp_path / "out.jsonl").read_text()
    assert written.endswith("\n")
    assert written.startswith(first + rest)
    assert all(parse(line) for line in written.splitlines())


def test_a_closed_pipe_ends_quietly(recording: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    for arguments in (
        ["run", str(recording), "--json"],
        ["info", str(recording)],
        ["masks", "list"],
        ["--help"],
    ):
        done = subprocess.run(
            [str(COMMAND), *arguments], stdout=writing, stderr=subprocess.PIPE, check=False, timeout=300
        )
        assert done.returncode == 0
        assert done.stderr == b""
    os.close(writing)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_explained(recording: Path) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [str(COMMAND), "run", str(recording), "--json"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 1
    assert "No space left" in done.stderr
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr


# ------------------------------------------------------------------------------------------------- bad input


def test_a_bad_frame_is_told_counted_and_skipped(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "recording", 3, bad=(1,))
    done = headvox("run", folder, "--json")
    assert done.returncode == 0
    assert [parse(line)["frame"] for line in done.stdout.splitlines()] == [0, 2]
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("headvox: frame 1 skipped: ")
    assert ["bad", "frames", "1"] in [line.split() for line in headvox("run", folder).stdout.splitlines()]


def test_strict_stops_at_a_bad_frame(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "recording", 3, bad=(1,))
    done = headvox("run", folder, "--json", "--strict")
    assert done.returncode == 1
    assert [parse(line)["frame"] for line in done.stdout.splitlines()] == [0]
    assert "headvox: error: Frame 1: " in done.stderr


def test_only_bad_frames_are_no_success(tmp_path: Path) -> None:
    done = headvox("run", write_recording(tmp_path / "recording", 2, bad=(0, 1)), "--json")
    assert done.returncode == 1
    assert "none of the 2 frames" in done.stderr
    assert_explained(headvox("run", write_recording(tmp_path / "one", 1, bad=(0,)), "--json"))


def test_a_source_without_frames_is_no_success(tmp_path: Path) -> None:
    assert_explained(headvox("run", write_recording(tmp_path / "recording", 0)))
    (tmp_path / "empty").mkdir()
    assert_explained(headvox("run", tmp_path / "empty"))


def test_known_errors_are_explained(recording: Path, tmp_path: Path) -> None:
    settings = tmp_path / "settings.toml"
    settings.write_text("[detector]\nmax_rage_m = 3.0\n")
    garbage = tmp_path / "garbage.ply"
    garbage.write_bytes(bytes(range(256)))
    evil = tmp_path / "line\nfeed\x1b[31m.ply"
    for arguments in (
        ("run", tmp_path / "missing.ply"),
        ("run", garbage),
        ("run", evil),
        ("info", tmp_path / "missing"),
        ("run", recording, "--cascade", "nonesuch"),
        ("run", recording, "--cascade", garbage),
        ("run", recording, "--config", settings),
        ("run", recording, "--config", tmp_path / "missing.toml"),
        ("config", "--cascade", "nonesuch"),
        ("masks", "show", "nonesuch"),
        ("masks", "plot", "nonesuch"),
    ):
        assert_explained(headvox(*arguments))


def test_a_cloud_far_away_says_so(tmp_path: Path) -> None:
    np.save(tmp_path / "far.npy", np.full((100, 3), 40.0, np.float32))
    done = headvox("run", tmp_path / "far.npy")
    assert_explained(done)
    assert "none of 100 points" in done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        (),
        ("frobnicate",),
        ("run", "--frobnicate"),
        ("run", "--max-range", "far"),
        ("run", "--max-range", "nan"),
        ("run", "--max-range", "-1"),
        ("run", "--centre", "1", "2"),
        ("run", "--threads", "0"),
        ("run", "--threads", "1000"),
        ("run", "--limit", "0"),
        ("run", "--refine", "magic"),
        ("config", "--voxel", "7"),
        ("info",),
        ("masks",),
        ("masks", "plot"),
    ],
)
def test_wrong_usage_ends_with_2(arguments: tuple[str, ...]) -> None:
    done = headvox(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "error: " in done.stderr
    assert "Traceback" not in done.stderr


def test_debug_shows_the_trace(tmp_path: Path) -> None:
    done = headvox("run", tmp_path / "missing.ply", "--debug")
    assert done.returncode == 1
    assert "Traceback" in done.stderr


@pytest.mark.parametrize("debug", [True, False])
def test_a_fault_of_headvox_asks_for_a_report(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], debug: bool
) -> None:
    def fail(args: object) -> int:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr(cli, "_warmup", fail)
    assert cli.main(["warmup", "--debug"] if debug else ["warmup"]) == 1
    errors = capsys.readouterr().err
    assert "headvox: internal error: ZeroDivisionError: by zero" in errors
    assert "please report it" in errors
    assert ("Traceback" in errors) == debug


def test_a_place_without_a_cache_is_explained(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(args: object) -> int:
        raise RuntimeError("cannot cache function 'f': no locator available for file 'gate.py'")

    monkeypatch.setattr(cli, "_warmup", fail)
    assert cli.main(["warmup"]) == 1
    assert "Set NUMBA_CACHE_DIR" in capsys.readouterr().err


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    data=st.binary(max_size=300),
    start=st.sampled_from(
        [b"", b"ply\nformat ascii 1.0\n", b"# .PCD v0.7\n", b"\x93NUMPY\x01\x00", b"PK\x03\x04"]
    ),
    name=st.sampled_from(["a.ply", "a.pcd", "a.npy", "a.npz", "recording.json", "a"]),
)
def test_no_file_makes_the_command_fall_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], data: bytes, start: bytes, name: str
) -> None:
    path = tmp_path / name
    path.write_bytes(start + data)
    assert cli.main(["info", str(path)]) in (0, 1)
    assert cli.main(["masks", "show", str(path)]) == 1
    assert cli.main(["config", "--config", str(path)]) in (0, 1)
    assert "internal error" not in capsys.readouterr().err


# ---------------------------------------------------------------------------------------- the other commands


def test_without_source_it_runs_the_sample_or_says_that_there_is_none() -> None:
    done = headvox("run", "--limit", 1)
    if (Path(cli.__file__).parent / "assets" / "sample").is_dir():
        assert done.returncode == 0
        assert "sample" in done.stderr
    else:
        assert_explained(done)


def test_flags_beat_the_file_and_the_file_beats_the_defaults(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    file.write_text("[detector]\nmax_range_m = 3.5\nthreads = 2\ncentre = [0, 0, 1]\n")
    done = headvox("config", "--config", file, "--max-range", "4.5", "--min-height", "-0.25")
    assert done.returncode == 0, done.stderr
    assert "max_range_m = 4.5\n" in done.stdout
    assert "min_height_m = -0.25\n" in done.stdout
    assert "threads = 2\n" in done.stdout
    assert "centre = [0.0, 0.0, 1.0]\n" in done.stdout
    assert 'refine = "pose"\n' in done.stdout
    again = tmp_path / "again.toml"
    again.write_text(done.stdout)
    assert headvox("config", "--config", again).stdout == done.stdout


def test_info_tells_what_is_there(recording: Path) -> None:
    done = headvox("info", recording)
    assert done.returncode == 0, done.stderr
    assert "80x60" in done.stdout


def test_masks_are_listed_and_shown(anything: Path) -> None:
    assert {line.split()[0] for line in headvox("masks", "list").stdout.splitlines()} >= {"default"}
    shown = headvox("masks", "show", anything).stdout
    assert "Stage 1, the gate: 1 conditions, at most 8 look-ups a voxel" in shown
    assert "Stage 2, boosted: 1 trees in 1 stages" in shown
    assert "radius 0.1, height +0, 0.1x0.1x0.1" in shown


def test_warmup_leaves_nothing_to_compile() -> None:
    done = headvox("warmup")
    assert done.returncode == 0, done.stderr
    assert "All loops are ready after" in done.stdout


def test_bench_gets_its_own_flags(monkeypatch: pytest.MonkeyPatch) -> None:
    got: list[list[str]] = []
    bench = types.ModuleType("headvox.bench.command")
    bench.main = lambda argv: got.append(argv) or 3  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "headvox.bench.command", bench)
    assert cli.main(["bench", "--repeat", "5", "--debug"]) == 3
    assert got == [["--repeat", "5"]]


def test_version() -> None:
    assert headvox("--version").stdout == f"headvox {__version__}\n"
    module = subprocess.run(
        [sys.executable, "-m", "headvox", "--version"], capture_output=True, text=True, check=True
    )
    assert module.stdout == f"headvox {__version__}\n"


@pytest.mark.parametrize("statement", ["import headvox", "from headvox.cli import main; main(['--help'])"])
def test_help_and_import_are_light(statement: str) -> None:
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", statement], capture_output=True, text=True, check=True
    )
    imported = {line.rpartition("|")[2].strip().partition(".")[0] for line in done.stderr.splitlines()}
    assert "headvox" in imported
    assert not imported & set(HEAVY)


# ----------------------------------------------------------------------------------------------------------- tracking


def test_a_run_tracks_unless_told_not_to(recording: Path, anything: Path) -> None:
    done = headvox("run", recording, "--json", "--cascade", anything)
    lines = heads_of(done.stdout)
    assert {head["state"] for head in lines[0]} == {"tentative"}  # type: ignore[attr-defined]
    assert {head["id"] for head in lines[0]} == {None}  # type: ignore[attr-defined]
    confirmed = [head for head in lines[1] if head["state"] == "confirmed"]  # type: ignore[attr-defined]
    assert [head["id"] for head in confirmed] == list(range(1, len(confirmed) + 1))
    assert len(confirmed) > 0
    ids = {head["id"] for line in lines for head in line if head["id"] is not None}  # type: ignore[attr-defined]
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
    assert {head["state"] for head in heads_of(done.stdout)[0]} == {"confirmed"}  # type: ignore[attr-defined]
    more = ("--config", tmp_path / "mine.toml", "--confirm-hits", 2)
    done = headvox("run", recording, "--json", "--limit", 1, *more)
    assert {head["state"] for head in heads_of(done.stdout)[0]} == {"tentative"}  # type: ignore[attr-defined]
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
    confirmed = [head for head in heads_of(done.stdout)[2] if head["id"] is not None]  # type: ignore[attr-defined]
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
