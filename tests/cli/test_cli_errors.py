"""Bad input and wrong usage: one line what, one line what to do, and the right exit code."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from command import assert_explained, headvox, parse
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from inputs import write_recording

from headvox import cli
from headvox.commands import run as run_command


def test_a_bad_frame_is_told_counted_and_skipped(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "recording", 3, bad=(1,))
    done = headvox("run", folder, "--json")
    assert done.returncode == 0
    assert [parse(line)["frame"] for line in done.stdout.splitlines()] == [0, 2]
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("headvox: frame 1 skipped: ")
    assert ["bad", "frames", "1"] in [line.split() for line in headvox("run", folder).stdout.splitlines()]


def test_one_reason_of_many_frames_is_told_once(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "recording", 5, bad=(1,))
    done = headvox("run", folder, "--centre", 40, 40, 0)
    assert done.returncode == 1
    told = [line.partition(": ")[2] for line in done.stderr.splitlines() if not line.startswith(" ")]
    assert [line.split(":")[0] for line in told] == [
        "frame 0 skipped",
        "frame 1 skipped",
        "frame 2 skipped",
        "2 more skipped for the same reason",
        "error",
    ]


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


@pytest.mark.parametrize("command", [("run", "keep.csv"), ("run", "keep.mcap"), ("view", "keep.rrd")])
def test_a_run_that_fails_leaves_an_older_file_as_it_was(tmp_path: Path, command: tuple[str, str]) -> None:
    folder = write_recording(tmp_path / "recording", 2, bad=(0, 1))
    name, output = command
    (tmp_path / output).write_text("precious\n")
    for target in (tmp_path / output, tmp_path / f"new_{output}"):
        assert headvox(name, folder, "-o", target).returncode == 1
    assert (tmp_path / output).read_text() == "precious\n"
    assert not (tmp_path / f"new_{output}").exists()


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
        ("run", "--limit", "99999999999999999999"),
        ("render", "-o", "a.png", "--at", "9223372036854775807"),
        ("run", "--refine", "magic"),
        ("run", ""),
        ("info", ""),
        ("align", ""),
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


def test_a_library_of_the_system_that_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pyrealsense2.py").write_text("raise ImportError('libusb-1.0.so.0: cannot open')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    done = headvox("run", "realsense:")
    assert_explained(done)
    assert "libusb-1.0.so.0: cannot open" in done.stderr
    assert "apt install libusb-1.0-0" in done.stderr


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


@pytest.mark.parametrize(
    ("command", "function", "told"),
    [("run", "_run", "--max-range"), ("warmup", "_warmup", "Close other programs.")],
)
def test_flags_that_save_memory_are_named_where_there_are_any(
    monkeypatch: pytest.MonkeyPatch, command: str, function: str, told: str
) -> None:
    def fail(args: object) -> int:
        raise MemoryError

    monkeypatch.setattr(run_command if command == "run" else cli, function, fail)
    done = headvox(command)
    assert_explained(done)
    assert told in done.stderr


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
