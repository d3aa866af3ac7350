"""Thresholds, and what the command refuses."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from headvox.cli import main
from headvox.errors import HeadvoxError
from headvox.evolve import search
from headvox.evolve.check import Outcome


def test_thresholds_leave_no_more_false_heads_than_allowed():
    outcome = Outcome(np.array([3.0, 1.0, -np.inf]), np.array([0.5, 2.004, 2.0]), 100)
    assert outcome.threshold(0.02) == 0.51
    assert outcome.threshold(0.0) == 2.01
    assert (outcome.false >= outcome.threshold(0.0)).sum() == 0
    assert outcome.recall(1.0) == pytest.approx(2 / 3)
    assert Outcome(np.empty(0), np.empty(0), 10).threshold(0.02) < -7


def test_a_folder_of_another_seed_is_not_mixed(tmp_path):
    (tmp_path / "search.json").write_text(json.dumps({"format": "headvox-search", "version": 1, "seed": 4}))
    with pytest.raises(HeadvoxError, match="another seed"):
        search.evolve(search.Settings(tmp_path, 200, seed=5), print)


def test_too_few_views_are_told(tmp_path):
    with pytest.raises(HeadvoxError, match="Expected at least 200 views"):
        search.evolve(search.Settings(tmp_path, 199), print)


@pytest.mark.parametrize("library", ["lightgbm", "cmaes"])
def test_what_is_missing_is_named_before_any_view_is_made(tmp_path, monkeypatch, capsys, library):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, library, None)
    assert main(["masks", "evolve"]) == 1
    assert "pip install 'headvox[evolve]'" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_bad_commands_end_before_any_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["masks", "evolve", "--views", "20"]) == 2
    assert "--views: expected at least 200, got '20'" in capsys.readouterr().err
    (tmp_path / "evolved.toml").write_text("mine")
    assert main(["masks", "evolve"]) == 1
    assert "exists already" in capsys.readouterr().err
    assert (tmp_path / "evolved.toml").read_text() == "mine"
    assert main(["masks", "evolve", "-o", "no/x.toml"]) == 1
    assert "Output no/x.toml: No such file or directory." in capsys.readouterr().err
    assert main(["masks", "evolve", "-o", "x.toml", "--work", "evolved.toml/work"]) == 1
    assert "Output evolved.toml/work: Not a directory." in capsys.readouterr().err
    assert main(["masks", "evolve", "--seed", "-1"]) == 2
