"""How the command ends when it is interrupted, and when what it prints cannot be written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command import COMMAND, parse
from inputs import write_recording


def heed_ctrl_c() -> None:
    """Undo what a shell does to its background jobs, should the tests be one."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_what_is_interrupted_ends_with_whole_lines(tmp_path: Path, number: int, code: int) -> None:
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
        process.send_signal(number)
        rest = process.stdout.read()
        errors = process.stderr.read()
    assert process.returncode == code
    assert errors == ""
    written = (tmp_path / "out.jsonl").read_text()
    assert written.endswith("\n")
    assert written.startswith(first + rest)
    assert all(parse(line) for line in written.splitlines())


def test_ctrl_c_while_the_command_is_imported_ends_quietly(tmp_path: Path) -> None:
    (tmp_path / "argparse.py").write_text("raise KeyboardInterrupt")
    done = subprocess.run(
        [sys.executable, "-c", "import sys; from headvox.__main__ import main; sys.exit(main())"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        capture_output=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, b"", b"")


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


@pytest.mark.parametrize(("closed", "told"), [(">&-", "stderr"), ("2>&-", "stdout")])
def test_a_closed_stream_spoils_nothing(recording: Path, closed: str, told: str) -> None:
    for arguments in (f"run {recording} --json", "config", "--version", "run nothing"):
        shown = subprocess.run(
            [str(COMMAND), *arguments.split()], capture_output=True, text=True, check=False
        )
        done = subprocess.run(
            f"{COMMAND} {arguments} {closed}", shell=True, capture_output=True, text=True, check=False
        )
        assert done.returncode == shown.returncode
        assert done.stdout.count("\n") == (shown.stdout.count("\n") if told == "stdout" else 0)
        assert done.stderr == (shown.stderr if told == "stderr" else "")


def test_letters_that_the_terminal_does_not_know_are_question_marks(recording: Path) -> None:
    shown, done = (
        subprocess.run(
            [str(COMMAND), "info", str(recording)],
            env={**os.environ, "PYTHONIOENCODING": encoding},
            capture_output=True,
            check=False,
        )
        for encoding in ("utf-8", "ascii")
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert "tilted 0.0°" in shown.stdout.decode()
    assert done.stdout.decode("ascii") == shown.stdout.decode().replace("°", "?")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="/dev/full exists on Linux only")
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
