"""What README and docs say is tried out: every command, every flag, every piece of Python and JSON, every link.

The commands of a document run in its order in one folder that holds what README's own commands make (``recording``,
``heads``), and ``walk``, a recording of people who walk. What cannot run here is told, with the reason.
"""

from __future__ import annotations

import ast
import json
import re
import shlex
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from command import Done
from command import headvox as run_headvox

import headvox
from headvox.cli import main
from headvox.frames import unproject

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
PROGRAMS = sorted(path for kind in ("bench", "examples", "tools") for path in (ROOT / kind).rglob("*.py"))
SAMPLE = Path(headvox.__file__).parent / "assets" / "sample"
INSTALL = re.compile(r"pip install -e (?:\.|'\.\[([a-z,]+)\]')")
# What these do is done already, or is going on: the tests look at what they name instead.
DONE_OTHERWISE = {"pip install -e .", "pip install -e '.[dev]'", "pytest"}
# The same commands in every document: they are run once, first.
MADE_FIRST = [
    "headvox synth two-cameras --people 2 --frames 5 --sensor d435i-small -o recording",
    "headvox synth heads --count 1 -o heads",
]
# Commands in blocks of sh and bash that do not run here, by how they begin.
NOT_RUN_HERE = {
    "headvox masks evolve": "takes a night; a small search runs in tests/evolve",
    "headvox bench": "takes minutes; a quick one runs in test_bench.py",
    "headvox synth two-cameras --people 1": "a longer one of what README makes",
    "headvox run s3://": "needs a cluster and a bucket; test_workers.py has small ones of both",
    "dask ": "needs a cluster",
    "headvox eval recording --heads pcl.jsonl": "needs PCL",
    "python bench/": "takes minutes, or needs PCL",
    "pip install": "done already",
    "ln -s": "needs ROS 2",
    "cd ~/ros2_ws": "needs ROS 2",
    "rosdep": "needs ROS 2",
    "colcon": "needs ROS 2",
    "source install": "needs ROS 2",
    "ros2": "needs ROS 2; the nodes run in ros/headvox_ros/test",
    "rviz2": "needs ROS 2",
    "export FASTDDS": "needs ROS 2",
}


def blocks(document: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", document.read_text("utf-8"), re.MULTILINE | re.DOTALL)


def commands(document: Path) -> list[str]:
    lines = [line for block in blocks(document, "console") for line in block.splitlines()]
    assert all(line.startswith("$ ") for line in lines)
    return [command for line in lines for command in line[2:].split(" && ")]


def other_commands(document: Path) -> list[str]:
    """Return the commands in blocks of sh and bash, without comments."""
    text = "".join(block for language in ("sh", "bash") for block in blocks(document, language))
    lines = text.replace("\\\n", " ").splitlines()
    bare = [command for line in lines if (command := re.sub(r"(^|\s+)#.*", "", line))]
    return [command for line in bare for command in line.split(" && ")]


def spans(text: str) -> list[str]:
    """Return what stands between backticks, the commands of a line each by itself."""
    return [part for span in re.findall(r"`([^`\n]+)`", text) for part in span.split("; ")]


def docstring(program: Path) -> str:
    return ast.get_docstring(ast.parse(program.read_text("utf-8"))) or ""


def flags_in(text: str) -> set[str]:
    return set(re.findall(r"(?<=[ \[])--[a-z][a-z-]*", text))


def reason_not_to_run(command: str) -> str | None:
    return next((why for start, why in NOT_RUN_HERE.items() if command.startswith(start)), None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("docs")
    shutil.copytree(SAMPLE, folder / "walk")
    with pytest.MonkeyPatch.context() as patch:
        for command in MADE_FIRST:
            assert command in commands(ROOT / "README.md")
            done = run(command, folder, patch)
            assert done.returncode == 0, (command, done.stderr)
    return folder


def run(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Done:
    """Run a command in ``folder``; its output goes to a file where a ``>`` says so."""
    words, _, file = command.partition(" > ")
    monkeypatch.chdir(folder)
    program, *arguments = shlex.split(words)
    assert program == "headvox", command
    assert not set("|;&<>$`*") & set(words), command  # nothing that would take a shell
    done = run_headvox(*arguments)
    if file:
        (folder / file).write_text(done.stdout)
    return done


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_command_does_what_it_should(
    document: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for command in [*commands(document), *other_commands(document)]:
        if command in DONE_OTHERWISE or command in MADE_FIRST:
            continue
        if why := reason_not_to_run(command):
            print(f"not run: {command}: {why}")
            continue
        done = run(command, folder, monkeypatch)
        assert done.returncode == 0, (command, done.stderr)
        assert "error" not in done.stderr, (command, done.stderr)
        assert done.stdout, command


def test_only_what_is_in_the_documents_is_left_out() -> None:
    every = [command for document in DOCUMENTS for command in other_commands(document)]
    assert all(any(command.startswith(start) for command in every) for start in NOT_RUN_HERE)
    assert not any(reason_not_to_run(c) for d in DOCUMENTS for c in set(commands(d)) - DONE_OTHERWISE)


def test_every_flag_in_the_documents_is_one(capsys: pytest.CaptureFixture[str]) -> None:
    """Of commands that run and of those that do not, of commands in the text, and of flags by themselves."""

    def flags_of(*words: str) -> set[str]:
        assert main([*words, "--help"]) == 0, words
        return set(re.findall(r"--[a-z][a-z-]*", capsys.readouterr().out))

    told: dict[tuple[str, ...], set[str]] = {("run",): flags_of("run")}
    texts = {program: spans(docstring(program)) for program in PROGRAMS}
    for document in DOCUMENTS:
        prose = re.sub(r"^```.*?^```$", "", document.read_text("utf-8"), flags=re.M | re.S)
        texts[document] = [*commands(document), *other_commands(document), *spans(prose)]
    for document, told_there in texts.items():
        for text in told_there:
            if not (match := re.match(r"headvox ([a-z]+)((?: [a-z-]+)?)(?=$|\s)", text)):
                continue
            words = (match[1], *match[2].split()) if match[1] in ("masks", "synth") else (match[1],)
            if words not in told:
                told[words] = flags_of(*words)
            assert flags_in(text) <= told[words], (document.name, text)
    told[("bag",)] = flags_of("masks", "evolve") | flags_of("eval") | flags_of("align")
    known = set.union(*told.values())
    for document in DOCUMENTS:
        for flag in re.findall(r"`(--[a-z][a-z-]*)[^`\n]*`", document.read_text("utf-8")):
            assert flag in known, (document.name, flag)


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda path: path.name)
def test_every_flag_that_a_program_tells_of_itself_is_one(program: Path) -> None:
    name, source = program.relative_to(ROOT).as_posix(), program.read_text("utf-8")
    usage = re.findall(rf"^ *python {re.escape(name)} .*", docstring(program), re.MULTILINE)
    known = set(re.findall(r'"(--[a-z][a-z-]*)"', source))
    if "import Workers, add_flags" in source:
        known |= {"--workers", "--scheduler"}
    assert flags_in(" ".join(usage)) <= known


def test_the_readme_sets_up_what_the_gate_does() -> None:
    assert set(commands(ROOT / "README.md")) >= DONE_OTHERWISE
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    text = (ROOT / "README.md").read_text("utf-8")
    named = {extra for match in INSTALL.finditer(text) for extra in (match[1] or "").split(",") if extra}
    assert named <= set(extras)
    gate = (ROOT / ".ci" / "run").read_text("utf-8")
    assert re.search(r"^pytest$", gate, re.MULTILINE)
    installed = re.search(r'pip install .*"\.\[([a-z,]+)\]"', gate)
    assert installed is not None
    extra_named = re.findall(r"\(extra `([a-z]+)`\)|extra `([a-z]+)`", text)
    assert {name for pair in extra_named for name in pair if name} <= set(extras)
    assert "dev" in installed[1].split(",")
    assert not [extra for extra in installed[1].split(",") if extra != "dev" and extras[extra]]


def test_every_piece_of_python_runs(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    frame = next(iter(headvox.open_source("recording")))
    assert isinstance(frame, headvox.Frame)
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
        told = capsys.readouterr().out
        assert told.strip()
        assert "head 0" not in told  # what has no id yet is not a head that anybody should be told of
    assert len(names["heads"]) == len(names["heads"].centres)


def test_python_that_needs_a_cluster_is_python() -> None:
    pieces = [piece for document in DOCUMENTS for piece in blocks(document, "py")]
    assert len(pieces) == 2
    for piece in pieces:
        print(f"not run: {piece.splitlines()[0]}: needs a cluster")
        compile(piece, "scale.md", "exec")


def test_a_source_distribution_holds_what_tests_and_documents_name() -> None:
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]
    held = set(tools["hatch"]["build"]["targets"]["sdist"]["include"])
    named = {ROOT / path for path in tools["pytest"]["ini_options"]["testpaths"]}
    named |= {ROOT / ".ci" / "run", ROOT / "LICENSE", *DOCUMENTS, *PROGRAMS}
    assert {path.relative_to(ROOT).parts[0] for path in named} <= held
    assert all((ROOT / name).exists() for name in held)


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
    from headvox import assemble, pipeline, refine
    from headvox.config import DetectorConfig

    how = " ".join((ROOT / "docs" / "how-it-works.md").read_text("utf-8").split())
    assert refine.STEPS == 10
    for told in (
        f"{100 * refine.HAIR_M:g} cm below",
        f"at most {100 * refine.REACH_M:g} cm",
        f"closer than {100 * assemble.SAME_HEAD_M:g} cm",
        *(f"| {stage} |" for stage in pipeline.STAGES),
    ):
        assert told in how
    config, readme = DetectorConfig(), " ".join((ROOT / "README.md").read_text("utf-8").split())
    low, high, far = config.min_height_m, config.max_height_m, config.max_range_m
    assert f"{-low:g} m below and {high:g} m above z = 0, within {far:g} m" in readme


def test_the_figures_on_the_first_screen_are_those_of_the_documents() -> None:
    table = (ROOT / "README.md").read_text("utf-8").split("| default cascade | |")[1].split("\n\n")[0]
    known = "".join((ROOT / "docs" / f"{name}.md").read_text("utf-8") for name in ("speed", "accuracy"))
    known = " ".join(known.split())
    told = re.findall(r"[\d.]+ (?:ms|cm|mm|%|of \d+)|[\d.]+°|\d+,\d+", table)
    assert len(told) > 10
    assert not [figure for figure in told if not re.search(rf"(?<![\d.]){re.escape(figure)}", known)]


def test_the_shares_of_the_failure_cases_are_those_of_the_document() -> None:
    lines = (ROOT / "docs" / "accuracy.md").read_text("utf-8").splitlines()
    found = {}
    for start in ("| | standing", "| up to 1 m"):
        (head,) = [n for n, line in enumerate(lines) if line.startswith(start)]
        names, shares = ([cell.strip() for cell in lines[n].split("|")] for n in (head, head + 2))
        found.update(zip(names, (share.removesuffix(" %") for share in shares), strict=True))
    readme = " ".join((ROOT / "README.md").read_text("utf-8").split())
    for told in (
        f"found: {found['arms raised']}, {found['bending']} and {found['lying']} % of them; "
        f"standing: {found['standing']} %",
        f"found: {found['40-60 %']} % where 40-60 % of the head is seen, {found['80-100 %']} % from 80 % on",
        f"found: {found['3-4 m']} % at 3-4 m, {found['4-4.8 m']} % beyond",
    ):
        assert told in readme


def test_pictures_are_small() -> None:
    pictures = list((ROOT / "docs" / "pictures").iterdir())
    assert {"sample.gif", "cascade-default.png", "cascade-paper.png"} <= {path.name for path in pictures}
    assert all(path.stat().st_size < 2_000_000 for path in pictures)
