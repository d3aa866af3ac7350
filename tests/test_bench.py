"""The bench runs and tells everything; no time is asserted, for a test machine may be busy."""

from __future__ import annotations

import json
import math
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from headvox import cli
from headvox.bench import command
from headvox.bench import measure as bench
from headvox.bench.report import report
from headvox.masks.cascade import Stage, cuts
from headvox.masks.read import load_cascade
from headvox.pipeline import STAGES

ROOT = Path(__file__).resolve().parents[1]
CASES = [
    "detect, cloud", "detect_frame, clouds of 2 cameras", "detect_depth", "detect_depth, 2 threads",
    "detect, shell of 9000",
]  # fmt: skip


@pytest.fixture(scope="module")
def result() -> dict[str, object]:
    return bench.measure("default", "sphere", rounds=3, frames=5, small=True, note=lambda text: None)


def test_it_measures_all_that_it_promises(result):
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert [*result["ms"]][: len(CASES)] == CASES
    assert {bench.COPY, bench.PLAIN} <= set(result["ms"])
    assert (bench.OPEN3D in result["ms"]) == (result["open3d"] is not None)
    for row in result["ms"].values():
        assert 0 < row["p50"] <= row["p99"]
        assert row["calls"] >= 1
        assert 0 < row["cold_p50"] <= row["cold_p99"]
        assert 0 < row["second_p50"] <= row["second_p99"]
        assert math.isclose(
            row["times_the_copy"], row["p50"] / result["ms"][bench.COPY]["p50"], rel_tol=1e-3, abs_tol=0.01
        )
    for case in CASES:
        assert [*result["stages_ms"][case]] == list(STAGES)
    assert [result["ms"][case]["heads"] for case in CASES] == [3, 3, 3, 3, 1]
    assert result["rounds"] == 3
    assert result["same_heads_with_2_threads"] is True


def test_the_input_is_what_it_says(result):
    told = result["input"]
    assert told["cameras"] == ["424x240", "424x240"]
    assert told["points_within_range"] <= told["points"] <= 2 * 424 * 240
    assert told["shell_points"] == 9000
    assert told["people"] == 3


def test_scaling_memory_and_first_result_are_there(result):
    points = [row["points"] for row in result["by_points"]["rows"]]
    assert points == sorted(points)
    assert points[-1] == result["input"]["points"]
    assert abs(points[0] - points[-1] / 8) <= 1
    assert [row["voxels"] for row in result["by_box_size"]["rows"]] == list(bench.BOX_VOXELS)
    assert all(row["gate_p50"] > 0 for row in result["by_box_size"]["rows"])
    assert result["by_box_size"]["slowest_over_fastest"] >= 1
    assert result["memory"]["frames"] == 5
    assert result["memory"]["peak_bytes_a_frame"] > 0
    assert result["first_result_s"]["from_start_of_python"] > result["first_result_s"]["first_frame"] > 0


def test_the_machine_is_named(result):
    machine = result["machine"]
    assert machine["processor"]
    assert machine["cores"] >= 1
    assert machine["python"].startswith(f"{sys.version_info.major}.{sys.version_info.minor}")
    text = report(result)
    for told in (machine["processor"], machine["numba"], "slowest / fastest", "million points", *STAGES):
        assert told in text


def test_the_input_is_the_same_every_time():
    one, other = bench.make_input(small=True), bench.make_input(small=True)
    assert one.cloud.tobytes() == other.cloud.tobytes()
    assert one.shell.tobytes() == other.shell.tobytes()
    assert [i.depth.tobytes() for i in one.images] == [i.depth.tobytes() for i in other.images]


def test_the_command_prints_one_json_object(capsys, monkeypatch, result):
    asked = []
    monkeypatch.setattr(command, "measure", lambda *args: asked.append(args[:5]) or result)
    assert cli.main(["bench", "--quick", "--json", "--cascade", "paper"]) == 0
    assert json.loads(capsys.readouterr().out) == result
    assert cli.main(["bench", "--rounds", "7"]) == 0
    assert "load average" in capsys.readouterr().out
    assert asked == [("paper", "pose", 5, 20, True), ("default", "pose", 7, 1000, False)]


def test_wrong_usage_and_unknown_cascades_are_told(capsys):
    assert cli.main(["bench", "--rounds", "0"]) == 2
    assert cli.main(["bench", "--cascade", "nothing"]) == 1
    errors = capsys.readouterr().err
    assert "expected 1 to 1000000000" in errors
    assert "Unknown cascade 'nothing'" in errors


def test_without_open3d_it_says_so(monkeypatch, result):
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert bench._import_open3d() is None
    without = {**result, "open3d": None, "ms": {k: v for k, v in result["ms"].items() if k != bench.OPEN3D}}
    assert "Open3D is not installed" in report(without)


def test_the_comparison_of_commits_explains_itself():
    script = ROOT / "bench" / "compare.py"
    done = subprocess.run([sys.executable, script, "--help"], capture_output=True, text=True, check=True)
    assert "OLD NEW OLD NEW" in done.stdout
    done = subprocess.run(
        [sys.executable, script, "no-such-commit"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr.startswith("fatal: ")


def test_a_cascade_without_some_stages_or_boxes():
    study = SimpleNamespace(**runpy.run_path(str(ROOT / "bench" / "cascade.py")))
    cascade = load_cascade("default")
    first = study.of_first_stages(cascade, 3)
    assert [stage.name for stage in first.every_stage] == [stage.name for stage in cascade.every_stage[:3]]
    assert first.judge == first.stages
    assert study.look_ups(first) < study.look_ups(cascade)
    assert study.of_first_stages(cascade, len(cascade.every_stage)) == replace(cascade, relief=None)
    hidden = frozenset(group.name for group in cascade.groups if study.PLACES["hidden"](group))
    for more in (False, True):
        blind = study.without(cascade, hidden, more)
        asked = {f.rpartition(".")[0] for s in blind.every_stage for t in s.trees for f, _ in cuts(t)}
        assert asked == {group.name for group in cascade.groups} - hidden
    tree = ("a.sum", 0.5, ("b.sum", 0.1, 1.0, 2.0), 3.0)
    small = replace(cascade, stages=(Stage("one", 0.0, (tree,)),), judge=())
    answers = [study.without(small, frozenset({"a"}), more).stages[0].trees[0] for more in (False, True)]
    assert answers == [("b.sum", 0.1, 1.0, 2.0), 3.0]
