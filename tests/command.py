"""The command ``headvox`` as a user gives it, and what it says."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from headvox.cli import main

COMMAND = Path(sys.executable).with_name("headvox")
Done = subprocess.CompletedProcess[str]


def headvox(*arguments: object) -> Done:
    """Run the command in this process: what it does and prints, without a second for every start of Python."""
    words = [str(argument) for argument in arguments]
    with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as errors:
        code = main(words)
    return subprocess.CompletedProcess(["headvox", *words], code, out.getvalue(), errors.getvalue())


def headvox_process(*arguments: object) -> Done:
    """Run the command in a process of its own, where that is what is tested."""
    command = [str(COMMAND), *(str(argument) for argument in arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


def parse(line: str) -> dict[str, object]:
    def refuse(token: str) -> None:
        raise AssertionError(f"{token} is not JSON")

    parsed: dict[str, object] = json.loads(line, parse_constant=refuse)
    return parsed


def heads_of(output: str) -> list[Any]:
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
