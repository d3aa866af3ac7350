"""Pictures: that they are made, of what, and what their words say; not how they look."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from headvox import cli
from headvox.commands.table import file_name
from headvox.masks.cascade import Cascade
from headvox.masks.describe import describe_cascade
from headvox.masks.pictures import GREEN, RED, influence_of_features, influence_of_groups, pictures_of
from headvox.masks.plot import plot_cascade
from headvox.masks.read import load_cascade, parse_cascade, shipped_cascades

pytest.importorskip("matplotlib")

BOOSTED = r"""
format = "headvox-cascade"
version = 1
name = "../$evil_{name"
summary = "tree $x^"
voxel_m = 0.05
subdivision = 2
occupancy = "parts"
min_score = 0.0
[[gate]]
name = "both"
boxes = [{ centre = [0, 0, 0], size = [0.25, 0.25, 0.25] }]
min = 0.03
max = 0.4
[[gate]]
name = "clear"
ring = { radius = 0.2, height = 0.15, size = [0.15, 0.15, 0.15] }
rank = 8
max = 0.26
[[gate]]
name = "hollow"
boxes = [
  { centre = [0, 0, 0], size = [0.25, 0.25, 0.25] },
  { centre = [0, 0, 0], size = [0.1, 0.1, 0.1], weight = -3 },
]
min = -0.5
[[group]]
name = "../../$ring"
ring = { radius = 0.1, height = 0.0, size = [0.1, 0.1, 0.1] }
[[group]]
name = "around"
channel = "empty"
ring = { radius = 0.25, height = 0.05, size = [0.15, 0.15, 0.15] }
[[group]]
name = "idle"
boxes = [{ centre = [0, 0, 0], size = [0.1, 0.1, 0.1] }]
[[stage]]
name = "a"
keep = -2.0
trees = [["../../$ring.sum", 0.15, -1.0, ["../../$ring.min", 0.05, 0.1, 1.0]]]
[[stage]]
name = "judge"
at = "peaks"
trees = [0.0]
[[stage]]
name = "b"
at = "peaks"
trees = [["around.sum", 0.5, 2.0, 0.5], ["around.max", 0.5, 0.0, ["../../$ring.sum", 0.3, 0.5, 0.0]]]
"""


@pytest.fixture(scope="module")
def boosted() -> Cascade:
    return parse_cascade(BOOSTED, "test")


def test_influence_is_the_change_of_the_mean_leaf(boosted: Cascade) -> None:
    features = influence_of_features(boosted)
    assert features["../../$ring.min"].change == pytest.approx(0.9)
    # -1 to the mean of 0.1 and 1.0, then 0.5 to 0.0
    assert features["../../$ring.sum"].change == pytest.approx(1.55 - 0.5)
    assert features["../../$ring.sum"].total == pytest.approx(1.55 + 0.5)
    assert features["../../$ring.sum"].cuts == 2
    groups = influence_of_groups(boosted)
    assert set(groups) == {"../../$ring", "around"}
    assert groups["around"].change == pytest.approx(-1.5 + 0.25)


def test_pictures_say_what_they_show(boosted: Cascade) -> None:
    both, clear, hollow, ring, around = pictures_of(boosted)
    assert both.words == "the box: at least 3 % full and at most 40 % full"
    assert (both.boxes[0].face, both.boxes[0].edge) == (GREEN, RED)
    assert clear.words == "the fullest of 8 boxes: at most 26 % full"
    assert {painted.face for painted in clear.boxes} == {RED}
    assert len(clear.boxes) == 8
    assert hollow.words == "the weighted sum of 2 boxes: at least -50 % full"
    assert [(painted.face, painted.label) for painted in hollow.boxes] == [(GREEN, ""), (RED, "−3×")]
    assert "more surface here speaks for a head; 3 cuts" in ring.words
    assert "more seen-empty space here speaks against a head; 2 cuts" in around.words
    assert (ring.boxes[0].face, around.boxes[0].face) == (GREEN, RED)


def test_every_picture_of_a_hostile_file_lands_in_the_folder(boosted: Cascade, tmp_path: Path) -> None:
    folder = tmp_path / "new" / "pictures"
    paths = list(plot_cascade(boosted, folder))
    names = [
        "gate-01-both",
        "gate-02-clear",
        "gate-03-hollow",
        "group-01-ring",
        "group-02-around",
        "overview",
        "cuts",
    ]
    assert [path.name for path in paths] == [f"{name}.png" for name in names]
    assert sorted(folder.iterdir()) == sorted(paths)
    for path in paths:
        with Image.open(path) as image:
            assert min(image.size) > 200
            assert len(image.convert("RGB").getcolors(1 << 20) or []) > 50  # something is drawn


@pytest.mark.parametrize("name", shipped_cascades())
def test_shipped_cascades_have_a_picture_for_everything(name: str) -> None:
    cascade = load_cascade(name)
    stems = [picture.stem for picture in pictures_of(cascade)]
    assert len(set(stems)) == len(stems)
    masks = len(cascade.votes.masks) + bool(cascade.votes.mirrored) if cascade.votes else 0
    assert len(stems) == len(cascade.conditions) + masks + len(influence_of_groups(cascade))
    for word in (condition.group.name for condition in cascade.conditions):
        assert word in describe_cascade(cascade)


def test_the_paper_s_masks_have_both_colours() -> None:
    masks = [picture for picture in pictures_of(load_cascade("paper")) if picture.stem.startswith("mask-")]
    assert len(masks) == 5
    for mask in masks:
        assert {painted.face for painted in mask.boxes} == {GREEN, RED}


def test_file_names_are_harmless() -> None:
    assert file_name("../../etc/pass wd") == "etc-pass-wd"
    assert file_name("\x00/..") == "unnamed"
    assert len(file_name("x" * 500)) == 60


def test_the_command_prints_the_paths(tmp_path: Path) -> None:
    (tmp_path / "boosted.toml").write_text(BOOSTED)
    command = [sys.executable, "-m", "headvox", "masks", "plot", "boosted.toml"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.splitlines()[-1] == "masks-evil_-name/cuts.png"
    assert (tmp_path / "masks-evil_-name" / "overview.png").is_file()


def test_a_folder_that_is_a_file_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "taken").write_text("")
    assert cli.main(["masks", "plot", "paper", "-o", str(tmp_path / "taken")]) == 1
    assert "File exists" in capsys.readouterr().err


def test_without_matplotlib_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert cli.main(["masks", "plot", "paper", "-o", str(tmp_path)]) == 1
    assert "pip install 'headvox[plot]'" in capsys.readouterr().err
