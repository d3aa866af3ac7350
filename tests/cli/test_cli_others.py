"""The other commands, the version and the help."""

from __future__ import annotations

import subprocess
import sys
import types
from pathlib import Path

import pytest
from command import assert_explained, headvox, headvox_process
from inputs import write_recording

from headvox import __version__, cli

COMMANDS = [
    "run",
    "info",
    "convert",
    "config",
    "warmup",
    "view",
    "render",
    "masks",
    "doctor",
    "completion",
    "synth",
    "eval",
    "align",
    "bench",
]
HEAVY = ("numba", "numpy", "scipy", "PIL", "matplotlib")


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


def test_a_negative_number_may_have_an_exponent(recording: Path) -> None:
    assert "\nmin_score = -100000.0\n" in headvox("config", "--min-score", "-1e5").stdout
    place = ("0", "0", "-1.5e-3", "0", "-.5", "0")
    assert "mount" in headvox("info", recording, "--mount", *place).stderr  # read, and not for recordings
    assert headvox("synth", "walk", "-o", "x", "--hz", "-1e3").stderr.endswith(
        "expected 0.01 to 1000, got '-1e3'\n"
    )


def test_info_tells_what_is_there(recording: Path) -> None:
    done = headvox("info", recording)
    assert done.returncode == 0, done.stderr
    assert "80x60" in done.stdout


def test_a_conversion_tells_which_frames_it_leaves_out_and_why(tmp_path: Path) -> None:
    bag = tmp_path / "out.mcap"
    done = headvox("convert", write_recording(tmp_path / "some", 4, bad=(1, 2)), "-o", bag)
    assert done.returncode == 0
    skipped, more = done.stderr.splitlines()
    assert skipped.startswith("headvox: frame 1 skipped: cam/bad.png: ")
    assert more == "headvox: 1 more skipped for the same reason"
    rows = dict(line.rsplit(maxsplit=1) for line in done.stdout.splitlines() if "frames" in line)
    assert rows == {"frames": "2", "bad frames": "2"}
    before = bag.read_bytes()
    done = headvox("convert", write_recording(tmp_path / "none", 2, bad=(0, 1)), "-o", bag)
    assert (done.returncode, done.stdout) == (1, "")
    assert "frame 0 skipped: " in done.stderr
    assert "none: none of the 2 frames could be used" in done.stderr
    assert bag.read_bytes() == before


def test_info_and_convert_take_addresses(recording: Path, tmp_path: Path) -> None:
    pytest.importorskip("fsspec")
    assert headvox("info", f"file://{recording}").stdout == headvox("info", recording).stdout
    for source, name in ((f"file://{recording}", "fetched.mcap"), (recording, "here.mcap")):
        assert headvox("convert", source, "-o", tmp_path / name).returncode == 0
    assert (tmp_path / "fetched.mcap").read_bytes() == (tmp_path / "here.mcap").read_bytes()


def test_masks_are_listed_and_shown(anything: Path) -> None:
    assert {line.split()[0] for line in headvox("masks", "list").stdout.splitlines()} >= {"default"}
    shown = headvox("masks", "show", anything).stdout
    assert "Stage 1, the gate: 1 conditions, at most 8 look-ups a voxel" in shown
    assert "Stage 2, boosted: 1 trees in 1 stages" in shown
    assert "radius 0.1, height +0, 0.1x0.1x0.1" in shown


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_says_what_it_does(command: str) -> None:
    shown = headvox(command, "--help").stdout
    assert shown.split("\n\n")[1].endswith(".")


def test_warmup_leaves_nothing_to_compile() -> None:
    done = headvox("warmup")
    assert done.returncode == 0, done.stderr
    assert "All loops are ready after" in done.stdout


def test_bench_gets_its_own_flags(monkeypatch: pytest.MonkeyPatch) -> None:
    got: list[list[str]] = []
    bench = types.ModuleType("headvox.bench.command")
    monkeypatch.setattr(bench, "main", lambda argv: got.append(argv) or 3, raising=False)
    monkeypatch.setitem(sys.modules, "headvox.bench.command", bench)
    assert cli.main(["bench", "--repeat", "5", "--debug"]) == 3
    assert got == [["--repeat", "5"]]


def test_version() -> None:
    assert headvox_process("--version").stdout == f"headvox {__version__}\n"
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
