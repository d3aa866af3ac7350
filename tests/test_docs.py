"""What README and docs say is tried out: every command, every piece of Python, every link, every piece of JSON.

The commands of a document run in its order in one folder that holds ``recording`` (the beginning of the sample that
ships with headvox) and ``cloud.ply`` (its first frame).
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import headvox
from headvox.cli import main
from headvox.frames import unproject
from headvox.synth.heads import ply_bytes

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
SAMPLE = Path(headvox.__file__).parent / "assets" / "sample"
INSTALL = re.compile(r"pip install -e (?:\.|'\.\[([a-z,]+)\]')")
# What these do is done already, or is going on: the tests look at what they name instead.
DONE_OTHERWISE = {"pip install -e .", "pip install -e '.[dev]'", "pytest"}


def blocks(document: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", document.read_text("utf-8"), re.MULTILINE | re.DOTALL)


def commands(document: Path) -> list[str]:
    lines = [line for block in blocks(document, "console") for line in block.splitlines()]
    assert all(line.startswith("$ ") for line in lines)
    return [line[2:] for line in lines]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("docs")
    shutil.copytree(SAMPLE, folder / "recording")
    description = json.loads((SAMPLE / "recording.json").read_text("utf-8"))
    description["frames"] = description["frames"][:4]
    (folder / "recording" / "recording.json").write_text(json.dumps(description))
    frame = next(iter(headvox.open_source(SAMPLE)))
    points = np.concatenate([unproject(i.depth, i.intrinsics, i.T_world_camera) for i in frame.depths])
    (folder / "cloud.ply").write_bytes(ply_bytes(points))
    return folder


def run(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path}
    return subprocess.run(
        command, shell=True, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_command_does_what_it_should(document: Path, folder: Path) -> None:
    for line in commands(document):
        for command in line.split(" && "):
            if command not in DONE_OTHERWISE:
                assert command.startswith("headvox "), command
                done = run(command, folder)
                assert done.returncode == 0, (command, done.stderr)
                assert "error" not in done.stderr, (command, done.stderr)
                assert done.stdout or ">" in command, command


def test_the_readme_sets_up_what_the_gate_does() -> None:
    ours = {part for line in commands(ROOT / "README.md") for part in line.split(" && ")}
    assert ours >= DONE_OTHERWISE
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    text = (ROOT / "README.md").read_text("utf-8")
    named = {extra for match in INSTALL.finditer(text) for extra in (match[1] or "").split(",") if extra}
    assert named <= set(extras)
    gate = (ROOT / ".ci" / "run").read_text("utf-8")
    assert re.search(r"^pytest$", gate, re.MULTILINE)
    installed = re.search(r'pip install .*"\.\[([a-z,]+)\]"', gate)
    assert installed is not None
    assert "dev" in installed[1].split(",")
    assert not [extra for extra in installed[1].split(",") if extra != "dev" and extras[extra]]


def test_every_piece_of_python_runs(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    frame = next(iter(headvox.open_source("recording")))
    image = frame.depths[0]
    depth = np.zeros((480, 848), np.uint16)
    depth[:240, :424] = image.depth
    points = unproject(image.depth, image.intrinsics, image.T_world_camera).astype(np.float32)
    names = {"depth": depth, "T_world_camera": image.T_world_camera, "points": points}
    pieces = [piece for document in DOCUMENTS for piece in blocks(document, "python")]
    assert pieces
    for piece in pieces:
        assert len(piece.splitlines()) <= 10
        exec(compile(piece, "README.md", "exec"), names)
        assert capsys.readouterr().out.strip()
    assert len(names["heads"]) == len(names["heads"].centres)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_link_leads_somewhere(document: Path) -> None:
    text = document.read_text("utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("https://"):
            continue
        name, _, anchor = target.partition("#")
        place = (document.parent / name).resolve() if name else document
        assert place.is_file(), target
        assert ROOT in place.parents
        if anchor:
            headings = re.findall(r"^#+ (.*)$", place.read_text("utf-8"), re.MULTILINE)
            assert anchor in [re.sub(r"[^a-z0-9 -]", "", h.lower()).replace(" ", "-") for h in headings]


def test_every_piece_of_json_is_what_headvox_reads_and_writes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(SAMPLE), "--json", "--limit", "1"]) == 0
    real = json.loads(capsys.readouterr().out)
    true = json.loads((SAMPLE / "heads.jsonl").read_text("utf-8").splitlines()[0])
    assert real["heads"]
    pieces = [json.loads(block) for document in DOCUMENTS for block in blocks(document, "json")]
    kinds = {"recording": 0, "result": 0, "truth": 0}
    for piece in pieces:
        if "format" in piece:
            kinds["recording"] += 1
            (tmp_path / "recording.json").write_text(json.dumps(piece))
            assert headvox.open_source(tmp_path).length == len(piece["frames"])
        elif "exhaustive" in piece:
            kinds["truth"] += 1
            assert set(piece) == set(true)
            assert set(piece["heads"][0]) <= set(true["heads"][0])
        else:
            kinds["result"] += 1
            assert list(piece) == list(real)
            assert list(piece["heads"][0]) == list(real["heads"][0])
    assert min(kinds.values()) >= 1


def test_the_columns_of_a_csv_file_are_told() -> None:
    from headvox.sinks.csvfile import COLUMNS

    text = " ".join((ROOT / "docs" / "conventions.md").read_text("utf-8").split())
    assert ", ".join(COLUMNS) in text


def test_the_numbers_are_those_of_the_code() -> None:
    from headvox import pipeline, refine
    from headvox.config import DetectorConfig

    how = " ".join((ROOT / "docs" / "how-it-works.md").read_text("utf-8").split())
    assert refine.STEPS == 10
    for told in (
        f"{100 * refine.HAIR_M:g} cm below",
        f"at most {100 * refine.REACH_M:g} cm",
        f"closer than {100 * pipeline.SAME_HEAD_M:g} cm",
        *(f"| {stage} |" for stage in pipeline.STAGES),
    ):
        assert told in how
    config, readme = DetectorConfig(), " ".join((ROOT / "README.md").read_text("utf-8").split())
    low, high, far = config.min_height_m, config.max_height_m, config.max_range_m
    assert f"{-low:g} m below and {high:g} m above z = 0, within {far:g} m" in readme


def test_pictures_are_small() -> None:
    pictures = list((ROOT / "docs" / "pictures").iterdir())
    assert {"sample.gif", "cascade-default.png", "cascade-paper.png"} <= {path.name for path in pictures}
    assert all(path.stat().st_size < 2_000_000 for path in pictures)
