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


def test_fish_completes_commands_flags_and_choices(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["completion", "fish"]) == 0
    script = tmp_path / "headvox.fish"
    script.write_text(capsys.readouterr().out)
    assert "render" in script.read_text()
    if shutil.which("fish") is None:
        pytest.skip("no fish: only what is printed was looked at")

    def completed_by_fish(line: str) -> set[str]:
        command = ["fish", "--no-config", "-c", f"source {script}; complete -C '{line}'"]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        return {row.split("\t")[0] for row in done.stdout.splitlines()}

    assert completed_by_fish("headvox ren") == {"render"}
    assert {"--max-range", "--max-height"} <= completed_by_fish("headvox run --max-")
    assert completed_by_fish("headvox run --backend ") >= {"cpu", "cuda", "auto"}


def test_zsh_takes_what_is_evaluated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "zsh"]) == 0
    script = tmp_path / "headvox.zsh"
    script.write_text(capsys.readouterr().out)
    assert "render" in script.read_text()
    if shutil.which("zsh") is None:
        pytest.skip("no zsh: only what is printed was looked at")
    code = f'autoload -Uz compinit; compinit -u -d {tmp_path}/dump; eval "$(cat {script})"; '
    code += 'print "${_comps[headvox]}"'
    done = subprocess.run(["zsh", "-f", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "_shtab_headvox"
    assert not done.stderr


def test_without_shtab_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "shtab", None)
    assert main(["completion", "bash"]) == 1
    assert "headvox[completion]" in capsys.readouterr().err
