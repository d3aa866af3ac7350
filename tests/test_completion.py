"""A real shell completes commands and flags with what ``headvox completion`` prints."""

import shutil
import subprocess
from pathlib import Path

import pytest

from headvox.cli import main


def completed(script: Path, *words: str) -> set[str]:
    """Return what bash offers for the last of ``words``."""
    function = "$(complete -p headvox | sed 's/.*-F \\([^ ]*\\) .*/\\1/')"
    code = f"source {script}; COMP_WORDS=({' '.join(repr(w) for w in words)}); COMP_CWORD={len(words) - 1}; "
    code += f'{function} headvox "{words[-1]}" "{words[-2]}"; printf "%s\\n" "${{COMPREPLY[@]}}"'
    done = subprocess.run(["bash", "--norc", "-c", code], capture_output=True, text=True, check=False)
    return {line.strip() for line in done.stdout.splitlines() if line.strip()}


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_completes_commands_and_flags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "headvox.bash"
    script.write_text(capsys.readouterr().out)
    assert completed(script, "headvox", "ren") == {"render"}
    assert {"run", "eval", "bench", "synth", "masks", "doctor"} <= completed(script, "headvox", "")
    assert "--max-range" in completed(script, "headvox", "run", "--max-r")
    assert "--details" in completed(script, "headvox", "eval", "--det")  # a parser of its own
    assert "list" in completed(script, "headvox", "masks", "li")


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_get_theirs(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    assert "render" in capsys.readouterr().out


def test_without_shtab_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "shtab", None)
    assert main(["completion", "bash"]) == 1
    assert "headvox[completion]" in capsys.readouterr().err
