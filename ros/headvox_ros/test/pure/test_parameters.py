from dataclasses import fields

import pytest

from headvox import HeadvoxError
from headvox.config import DetectorConfig, TrackerConfig
from headvox_ros.parameters import RANGES, config_from, parameters_of


@pytest.mark.parametrize("kind", [DetectorConfig, TrackerConfig])
def test_every_setting_is_a_parameter_with_a_description(kind):
    made = parameters_of(kind, "x")
    assert [parameter.name for parameter in made] == [f"x.{field.name}" for field in fields(kind)]
    assert all(parameter.description for parameter in made)
    assert config_from(kind, "x", {p.name: p.default for p in made}) == kind()


def test_a_parameter_has_the_default_and_the_limits_of_its_setting():
    made = {parameter.name: parameter for parameter in parameters_of(DetectorConfig, "detector")}
    assert made["detector.max_range_m"].default == 5.0
    assert made["detector.min_score"].default is None
    assert made["detector.max_range_m"].limits == (0.0, 50.0)
    assert "farther" in made["detector.max_range_m"].description


def test_values_get_through():
    values = {"detector.max_range_m": 4.0, "detector.centre": [1.0, 2.0, 3.0], "detector.min_score": 9}
    config = config_from(DetectorConfig, "detector", values)
    assert (config.max_range_m, config.centre, config.min_score) == (4.0, (1.0, 2.0, 3.0), 9)


@pytest.mark.parametrize("name", sorted(RANGES))
def test_the_limits_are_those_that_the_configuration_has(name):
    low, high = RANGES[name]
    step = 1 if isinstance(low, int) else 1e-9
    inside = [high] if name == "max_range_m" else [low, high]  # more than 0
    for value in inside:
        config_from(DetectorConfig, "detector", {f"detector.{name}": value})
    for value in (low - step, high + step):
        with pytest.raises(HeadvoxError):
            config_from(DetectorConfig, "detector", {f"detector.{name}": value})


@pytest.mark.parametrize(
    ("name", "value"),
    [("max_range_m", float("nan")), ("refine", "magic"), ("centre", [1.0]), ("centre", []), ("threads", 2.5)],
)
def test_a_refusal_names_the_parameter(name, value):
    with pytest.raises(HeadvoxError) as refused:
        config_from(DetectorConfig, "detector", {f"detector.{name}": value})
    assert f"detector.{name}" in refused.value.what
