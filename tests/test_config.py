import math
from dataclasses import fields, replace

import pytest

from headvox.config import DetectorConfig, TrackerConfig, load_config, to_toml
from headvox.errors import HeadvoxError
from headvox.pipeline import Detector
from headvox.tracking.tracker import Tracker

ROUND = [
    DetectorConfig(),
    DetectorConfig(cascade="paper", max_range_m=3.5, centre=(0.5, -1.25, 1e-9), threads=2),
    DetectorConfig(min_height_m=-1, max_height_m=3, min_score=-2.5, voxel_m=0.04, refine="none"),
    DetectorConfig(cascade="C:\\new\\tables\\mine.toml"),
    DetectorConfig(cascade='a "quoted" name'),
    DetectorConfig(cascade="Köpfe/頭\t\x7f😀.toml"),
]


@pytest.mark.parametrize("config", ROUND)
def test_what_is_written_is_read_back(config, tmp_path):
    path = tmp_path / "headvox.toml"
    path.write_text(to_toml(config), encoding="utf-8")
    assert load_config(path) == config
    for field in fields(config):
        assert field.name in to_toml(config)


def load(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_config(path)


def test_a_file_beats_the_defaults_and_leaves_the_rest(tmp_path):
    assert load(tmp_path, "[detector]\nthreads = 2\ncentre = [1, 2, 3]") == replace(
        DetectorConfig(), threads=2, centre=(1.0, 2.0, 3.0)
    )
    assert load(tmp_path, "") == DetectorConfig()


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[detector]\nthread = 2", "unknown setting 'thread'"),
        ("threads = 2", r"unknown table \[threads\]"),
        ("[tracker]", r"unknown table \[tracker\]"),
        ("detector = 3", "detector"),
        ("[[detector]]", "detector"),
        ("[detector", "is not TOML"),
        (b"\xff\xfe", "is not TOML"),
        ("x = " + "[" * 50_000, "is not TOML"),
        ("[detector]\nthreads = 1" + "0" * 5000, "is not TOML"),
        ("[detector]\nthreads = 2.0", "threads: expected a whole number, got 2.0"),
        ("[detector]\nthreads = true", "threads: expected a whole number, got True"),
        ("[detector]\nthreads = 0", "threads: expected 1 to 64, got 0"),
        ("[detector]\nthreads = 65", "threads: expected 1 to 64, got 65"),
        ("[detector]\ncascade = 1", "cascade: expected text, got 1"),
        ('[detector]\nrefine = "ball"', "refine: expected .*, got 'ball'"),
        ('[detector]\nmax_range_m = "5"', "max_range_m: expected a number from -1e9 to 1e9, got '5'"),
        ("[detector]\nmax_range_m = 0", "max_range_m: expected more than 0"),
        ("[detector]\nmax_range_m = 51", "max_range_m: expected more than 0 and at most 50 m, got 51"),
        ("[detector]\nmax_range_m = nan", "max_range_m"),
        ("[detector]\nmax_range_m = inf", "max_range_m: expected a number from -1e9 to 1e9, got inf"),
        ("[detector]\nmin_score = 1e30", r"min_score: expected a number from -1e9 to 1e9, got 1e\+30"),
        ("[detector]\nthreads = 1" + "0" * 30, "threads: expected 1 to 64, got 10"),
        ("[detector]\nmin_height_m = 3.0", "max_height_m: expected above min_height_m"),
        ("[detector]\nmin_height_m = -inf", "min_height_m|max_height_m"),
        ("[detector]\nmin_height_m = nan", "min_height_m|max_height_m"),
        ("[detector]\nmax_height_m = 30", "max_height_m: .* by 20 m at most"),
        ("[detector]\nvoxel_m = 0.001", "voxel_m: expected 0.005 to 0.2 m, got 0.001"),
        ("[detector]\nvoxel_m = nan", "voxel_m"),
        ("[detector]\nmin_score = nan", "min_score"),
        ("[detector]\nmin_score = inf", "min_score"),
        ("[detector]\ncentre = [1, 2]", "centre: expected three"),
        ("[detector]\ncentre = 0", "centre: expected three"),
        ('[detector]\ncentre = [1, 2, "3"]', "centre: expected three"),
        ("[detector]\ncentre = [1, 2, nan]", "centre"),
        ("[detector]\ncentre = [1, 2, 1" + "0" * 400 + "]", "centre"),
    ],
)
def test_a_bad_file_is_an_error_that_names_the_setting(tmp_path, text, told):
    with pytest.raises(HeadvoxError, match=told) as error:
        load(tmp_path, text)
    assert error.value.do


def test_a_byte_order_mark_is_no_part_of_a_file(tmp_path):
    assert load(tmp_path, b"\xef\xbb\xbf[detector]\nthreads = 2").threads == 2


def test_a_missing_file(tmp_path):
    with pytest.raises(HeadvoxError, match=r"Configuration .*none\.toml: No such file"):
        load_config(tmp_path / "none.toml")
    with pytest.raises(HeadvoxError, match="Configuration"):
        load_config(tmp_path)


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ({"threads": 1.5}, "threads: expected a whole number"),
        ({"threads": "2"}, "threads: expected a whole number"),
        ({"cascade": None}, "cascade: expected text"),
        ({"max_range_m": "far"}, "max_range_m: expected a number"),
        ({"max_range_m": 10**400}, "max_range_m: expected a number"),
        ({"max_range_m": None}, "max_range_m: expected a number"),
        ({"centre": (0.0, 0.0)}, "centre: expected three"),
        ({"centre": (0.0, 0.0, math.inf)}, "centre"),
        ({"centre": (0.0, 0.0, 1e12)}, "centre"),
        ({"min_score": math.nan}, "min_score"),
    ],
)
def test_a_bad_setting_made_in_python(setting, told):
    with pytest.raises(HeadvoxError, match=told):
        DetectorConfig(**setting)


def test_a_setting_of_the_tracker_that_is_too_large_is_told_how_large_it_may_be():
    with pytest.raises(
        HeadvoxError, match=r"gate_sigmas: expected a number above 0, 1e9 at most, got 1e\+30"
    ):
        TrackerConfig(gate_sigmas=1e30)


@pytest.mark.parametrize("make", [Detector, Tracker])
def test_what_is_no_configuration_is_told(make):
    name = make.__name__ + "Config"
    with pytest.raises(HeadvoxError, match=f"Expected a {name}, got 'paper'") as told:
        make("paper")
    assert told.value.do == f"Write {name}(setting=value)."
