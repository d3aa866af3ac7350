"""``headvox eval`` as a user gives it: what it prints, writes and returns."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import headvox
from headvox.cli import main
from headvox.data import Frame
from headvox.evaluate.found import FoundHeads
from headvox.evaluate.heldout import tuned_frames, word
from headvox.evaluate.loop import Mishap, _hold
from headvox.evaluate.truth import TrueHeads

SAMPLE = Path(headvox.__file__).parent / "assets" / "sample"
CENTRES = {0: [[0.0, 0.0, 1.6], [1.0, 0.0, 1.6]], 1: [], 2: [[0.0, 0.0, 1.6]]}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first six frames of the sample."""
    folder = tmp_path_factory.mktemp("eval") / "six"
    shutil.copytree(SAMPLE, folder)
    description = json.loads((folder / "recording.json").read_text("utf-8"))
    description["frames"] = description["frames"][:6]
    (folder / "recording.json").write_text(json.dumps(description))
    return folder


def lines(path: Path, heads: dict[int, list[list[float]]], **more: object) -> Path:
    rows = [
        {"stamp_ns": s, "heads": [{"centre": c, **more} for c in centres]} for s, centres in heads.items()
    ]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


@pytest.fixture
def clouds(tmp_path: Path) -> Path:
    """Three clouds, 1/30 s apart, and where heads are in them."""
    folder = tmp_path / "three"
    folder.mkdir()
    for k in range(3):
        np.save(folder / f"{k}.npy", np.zeros((9, 3), np.float32))
    lines(folder / "heads.jsonl", {k * 33_333_333: centres for k, centres in CENTRES.items()})
    return folder


def test_a_recording_is_scored(recording: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "report"
    assert main(["eval", str(recording), "--details", "-o", str(out)]) == 0
    shown = capsys.readouterr().out
    assert shown.splitlines()[0].split()[:3] == ["detection", "detector", "tuned"]
    assert shown.splitlines()[1].split()[:3] == ["six", "default", "no"]
    assert "distance [m]" in shown
    assert "both thresholds: recording filinha" in shown
    report = json.loads((out / "report.json").read_text("utf-8"))
    scores, tracks = report["scores"]
    assert (scores["detector"], tracks["detector"]) == ("default", "default tracked")
    assert scores["hota"] is None
    assert 0 < tracks["hota"] <= 1
    assert (scores["frames"], scores["heads"], scores["truncated"]) == (6, 17, 1)
    assert scores["recall"] == scores["found"] / 17 > 0.8
    assert scores["latency_p50_ms"] > 0
    assert scores["centre_mean_m"] < 0.05
    assert scores["curve"][-1][1] >= scores["recall"]
    assert sum(group["heads"] for group in scores["groups"]["posture"]) == 17
    expected = {"report.json", "six.png"}
    for row in (scores, tracks):
        stem = f"six-{row['detector'].replace(' ', '-')}"
        expected |= {f"{stem}-false.png"} if row["false"] else set()
        expected |= {f"{stem}-misses.png"} if row["found"] < 17 else set()
    assert {path.name for path in out.iterdir()} == expected


def test_the_worst_mistakes_are_drawn(
    recording: Path, clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # With a radius of 1 mm everything is missed and false: six rows each of a depth image and two views.
    command = ["eval", str(recording), "--no-track", "--radius", "0.001", "-o", str(tmp_path / "depth")]
    assert main(command) == 0
    found = lines(tmp_path / "other.jsonl", {0: [[2, 0, 1]]})
    assert main(["eval", str(clouds), "--heads", str(found), "-o", str(tmp_path / "cloud")]) == 0
    sizes = {}
    for path in tmp_path.glob("*/*.png"):
        with Image.open(path) as image:
            sizes[path.name] = image.size
            assert len(np.unique(np.asarray(image.convert("L")))) > 50
    assert set(sizes) == {
        "six.png", "six-default-misses.png", "six-default-false.png",
        "three.png", "three-other-misses.png", "three-other-false.png",
    }  # fmt: skip
    # Three people and three detections, at about the same place in all frames; two heads missed, one false.
    rows = {name: height // 396 for name, (_, height) in sizes.items()}
    assert rows["six-default-misses.png"] >= 3
    assert (rows["three-other-misses.png"], rows["three-other-false.png"]) == (2, 1)


def test_mistakes_at_one_place_are_told_once() -> None:
    def mishap(badness: float, number: int, x: float) -> Mishap:
        place = np.array([x, 0.0, 0.0])
        nobody = TrueHeads.of(0, [])
        return Mishap(badness, -number, "", 1, Frame(0), place, FoundHeads.none(), nobody, nobody.ignored)

    for moving, expected in (
        (True, [(5.0, 2, 2), (3.0, 1, 1)]),
        (False, [(5.0, 2, 1), (4.0, 0, 1), (3.0, 1, 1)]),
    ):
        worst: list[Mishap] = []
        for one in (mishap(4.0, 0, 0.0), mishap(3.0, 1, 2.0), mishap(5.0, 2, 0.1)):
            _hold(worst, moving, one)
        assert [(m.badness, m.number, m.times) for m in worst] == expected


def test_what_headvox_run_wrote_scores_as_the_detector_does(
    recording: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["eval", str(recording), "--json"]) == 0
    ours = json.loads(capsys.readouterr().out)["scores"]
    for row, more in zip(ours, (["--no-track"], []), strict=True):
        found = tmp_path / "mine.jsonl"
        assert main(["run", str(recording), "-o", str(found), *more]) == 0
        capsys.readouterr()
        assert main(["eval", str(recording), "--json", "--heads", str(found)]) == 0
        (theirs,) = json.loads(capsys.readouterr().out)["scores"]
        assert theirs["detector"] == "mine"
        for figure in ("frames", "heads", "found", "false", "recall", "precision", "switches"):
            assert row[figure] == theirs[figure]
        assert theirs["centre_mean_m"] == pytest.approx(row["centre_mean_m"], abs=1e-4)
        assert theirs["hota"] == pytest.approx(row["hota"], abs=0.02)


def test_another_detector_by_hand(clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Frame 0: one of two heads, 3 cm off, and one at 4 m; frame 1: nobody, one found; frame 2 has no line: missed.
    found = lines(tmp_path / "other.jsonl", {0: [[0.03, 0, 1.6], [4, 0, 1]], 33_333_333: [[2, 0, 1]]}, id="a")
    assert main(["eval", str(clouds), "--heads", str(found), "--name", "Other", "--json"]) == 0
    (scores,) = json.loads(capsys.readouterr().out)["scores"]
    assert scores["detector"] == "Other"
    assert (scores["frames"], scores["heads"], scores["found"], scores["false"]) == (3, 3, 1, 2)
    assert scores["centre_mean_m"] == pytest.approx(0.03)
    assert scores["latency_p50_ms"] is None


def test_without_matplotlib_there_is_a_report_without_pictures(
    clouds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    found = lines(tmp_path / "other.jsonl", {0: CENTRES[0]})
    out = tmp_path / "report"
    assert main(["eval", str(clouds), "--heads", str(found), "-o", str(out)]) == 0
    assert "without matplotlib there will be report.json alone" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["report.json"]


@pytest.mark.parametrize("inside", [".", "report"])
def test_a_report_is_never_written_into_what_it_is_about(
    clouds: Path, capsys: pytest.CaptureFixture[str], inside: str
) -> None:
    before = sorted(clouds.iterdir())
    assert main(["eval", str(clouds), "-o", str(clouds / inside)]) == 1
    assert f"would be written into the input {clouds}" in capsys.readouterr().err
    assert sorted(clouds.iterdir()) == before


def test_limits_set_the_exit_code(clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = lines(tmp_path / "other.jsonl", {0: CENTRES[0], 33_333_333: [[2, 0, 1]]})
    command = ["eval", str(clouds), "--heads", str(found), "--limit"]
    # Recall 2/3, one false head in three frames.
    assert main([*command, "recall=0.6", "false_per_frame=0.34", "three:found=2"]) == 0
    assert main([*command, "recall=0.67", "false_per_frame=0.33"]) == 3
    told = capsys.readouterr().err
    assert "three, other: recall is 0.6667, the limit is at least 0.67" in told
    assert "false_per_frame is 0.3333, the limit is at most 0.33" in told
    assert main([*command, "hota=0.5"]) == 3
    assert "hota was not measured" in capsys.readouterr().err
    assert main([*command, "four:recall=0.1"]) == 3
    for wrong in ("recall", "recall=x", "recall=nan", "heads=3", "centre_bias_m=1"):
        assert main([*command, wrong]) == 2
        assert "expected" in capsys.readouterr().err


def test_two_reports_are_compared(clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, heads in (("old", {0: CENTRES[0], 33_333_333: [[2, 0, 1]]}), ("new", {0: [CENTRES[0][0]]})):
        found = lines(tmp_path / f"{name}.jsonl", heads)
        assert main(["eval", str(clouds), "--heads", str(found), "-o", str(tmp_path / name)]) == 0
    capsys.readouterr()
    reports = [str(tmp_path / name / "report.json") for name in ("old", "new")]
    assert main(["eval", "compare", *reports]) == 0
    rows = {row.split()[1]: row.split() for row in capsys.readouterr().out.splitlines()[1:]}
    assert rows["recall"] == ["three", "recall", "0.6667", "0.3333", "-0.3333", "worse"]
    assert rows["false_per_frame"][-1] == "better"
    assert main(["eval", "compare", reports[0], reports[0]]) == 0
    assert "No figure differs" in capsys.readouterr().out
    assert main(["eval", "compare", reports[0], str(clouds / "heads.jsonl")]) == 1
    assert "expected a report of `headvox eval -o`" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[", "line 1: no JSON"),
        ("[]", "expected an object"),
        ('{"stamp_ns": 0}', "expected a list of objects under 'heads'"),
        ('{"stamp_ns": 0.5, "heads": []}', "whole number under 'stamp_ns'"),
        ('{"stamp_ns": 0, "heads": [{"centre": [0, 0]}]}', "centre: expected 3 finite numbers"),
        ('{"stamp_ns": 0, "heads": [{"centre": [0, 0, NaN]}]}', "centre: expected 3 finite numbers"),
        ('{"stamp_ns": 0, "heads": [{"centre": [0, 0, 0], "quaternion": [0, 0, 0, 9]}]}', "norm 9"),
        ('{"stamp_ns": 0, "heads": []}\n{"stamp_ns": 0, "heads": []}', "line 2: a second line"),
        ('{"stamp_ns": 5, "heads": []}', "no line has the stamp"),
        ("\xff", "UTF-8"),
    ],
)
def test_bad_lines_are_told(
    clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, told: str
) -> None:
    found = tmp_path / "bad.jsonl"
    found.write_bytes(text.encode("latin-1"))
    assert main(["eval", str(clouds), "--heads", str(found)]) == 1
    assert told in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ('{"stamp_ns": 0, "heads": [{"centre": [0, 0, 0], "id": "a"}]}', "whole number or null under 'id'"),
        ('{"stamp_ns": 0, "heads": [{"centre": [0, 0, 0], "ignore": 1}]}', "true or false under 'ignore'"),
        ('{"stamp_ns": 0, "heads": [{"centre": [0, 0, 0], "visible": [1]}]}', "camera: share"),
        ('{"stamp_ns": 0, "heads": [{"centre": [0, 0, 0], "posture": 3}]}', "a word under 'posture'"),
        ('{"stamp_ns": 0, "heads": [], "exhaustive": false}', "no frame has labels"),
        ('{"stamp_ns": 7, "heads": []}', "no frame has labels"),
        (
            '{"stamp_ns": 0, "heads": [], "exhaustive": false}\n{"stamp_ns": 0, "heads": []}',
            "line 2: a second line",
        ),
    ],
)
def test_bad_truth_is_told(
    clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], line: str, told: str
) -> None:
    found = lines(tmp_path / "other.jsonl", {0: []})
    (clouds / "heads.jsonl").write_text(line)
    assert main(["eval", str(clouds), "--heads", str(found)]) == 1
    assert told in capsys.readouterr().err


def test_heads_in_a_frame_that_cannot_be_read_are_missed(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = tmp_path / "damaged"
    shutil.copytree(recording, damaged)
    (damaged / "left" / "000002.png").write_bytes(b"no picture")
    found = {}
    for path in (recording, damaged):
        assert main(["eval", str(path), "--json"]) == 0
        captured = capsys.readouterr()
        found[path.name] = json.loads(captured.out)["scores"][0]
    assert "damaged: 1 of 6 frames could not be used" in captured.err
    assert found["damaged"]["heads"] == found["six"]["heads"] == 17
    assert found["six"]["found"] - 3 <= found["damaged"]["found"] < found["six"]["found"]


def test_without_motmetrics_nothing_is_begun_that_needs_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "motmetrics", None)
    monkeypatch.setattr("headvox.evaluate.command._show", lambda *_: pytest.fail("a frame was looked at"))
    for what in ("rotation", "sample", str(headvox.sample_folder())):
        assert main(["eval", what]) == 1
        assert "pip install 'headvox[eval]'" in capsys.readouterr().err


def test_wrong_usage(clouds: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval"]) == 2
    assert main(["eval", "static", "--heads", "x.jsonl"]) == 2
    for radius in ("-1", "0", "11"):
        assert main(["eval", str(clouds), "--radius", radius]) == 2
    for revolutions in ("0", "1e9"):
        assert main(["eval", "rotation", "--revolutions", revolutions]) == 2
    assert main(["eval", str(clouds), "--max-range", "-1"]) == 2
    assert main(["eval", "static", "--seed", "-1"]) == 2
    assert main(["eval", str(clouds), "--name", "mine"]) == 2
    capsys.readouterr()
    assert main(["eval", "two-cameras", "--scheduler", "local"]) == 2
    assert "two-cameras is made by --workers N of this machine" in capsys.readouterr().err
    assert main(["eval", str(clouds), "--against", "nonsense"]) == 1
    (tmp_path / "file").touch()
    assert main(["eval", str(clouds), "-o", str(tmp_path / "file")]) == 1
    assert f"Output {tmp_path / 'file'}: " in capsys.readouterr().err
    capsys.readouterr()
    (clouds / "heads.jsonl").unlink()
    assert main(["eval", str(clouds)]) == 1
    assert "there is no heads.jsonl beside it" in capsys.readouterr().err
    assert main(["eval", str(tmp_path / "nothing")]) == 1
    assert "there is no such file or folder" in capsys.readouterr().err


def test_which_frames_a_cascade_was_tuned_on() -> None:
    told = ["boosting: synthetic views", "thresholds: recording filinha, every other labelled frame from the first",
            "thresholds: recording five_people"]  # fmt: skip
    assert tuned_frames(told, "filinha", 5).tolist() == [True, False, True, False, True]
    assert tuned_frames(told, "five_people", 2).tolist() == [True, True]
    for other in ("five", "people", "fil", "five_people-2", "chocapics"):
        assert not tuned_frames(told, other, 3).any()
    assert word(tuned_frames(told, "filinha", 5), told, False) == "partly"
    assert word(tuned_frames(told, "five_people", 1), told, False) == "yes"
    assert word(tuned_frames(told, "x", 1), told, False) == "no"
    assert word(tuned_frames(told, "x", 1), told, True) == "alike"
    assert word(tuned_frames([], "x", 1), [], True) == "not told"
