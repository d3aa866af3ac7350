"""ROS parameters made of the library's configuration: names, types, defaults, limits and descriptions."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from headvox.config import DetectorConfig, TrackerConfig
from headvox.errors import HeadvoxError

# What the configuration accepts (it checks for itself): told to tools that show sliders.
RANGES: dict[str, tuple[float, float]] = {
    "max_range_m": (0.0, 50.0),
    "voxel_m": (0.005, 0.2),
    "threads": (1, 64),
}


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter: ``default`` None says that it may be left open, and then has no fixed type."""

    name: str
    default: Any
    description: str
    limits: tuple[float, float] | None


Config = TypeVar("Config", DetectorConfig, TrackerConfig)


def parameters_of(config: type[Config], prefix: str) -> list[Parameter]:
    """Return a parameter ``prefix.NAME`` for each field of a configuration, in order."""
    texts = _descriptions(config)
    defaults = config()
    made = []
    for field in fields(config):
        default = getattr(defaults, field.name)
        value = list(default) if isinstance(default, tuple) else default
        made.append(Parameter(f"{prefix}.{field.name}", value, texts[field.name], RANGES.get(field.name)))
    return made


def config_from(config: type[Config], prefix: str, values: Mapping[str, Any]) -> Config:
    """Return the configuration that the parameters ``prefix.NAME`` give; those that are None keep their default.

    Raises:
        HeadvoxError: a value that the configuration refuses, with the parameter's name.
    """
    start = f"{prefix}."
    given = {
        name.removeprefix(start): value
        for name, value in values.items()
        if name.startswith(start) and value is not None
    }
    for key, value in given.items():
        if not isinstance(value, (str, bool, int, float)):
            given[key] = tuple(value)
    try:
        return config(**given)
    except HeadvoxError as error:
        raise HeadvoxError(error.what.replace("Setting ", start), error.do) from None


def _descriptions(config: type) -> dict[str, str]:
    """Return the text below each field of a dataclass."""
    (body,) = ast.parse(inspect.getsource(config)).body
    assert isinstance(body, ast.ClassDef)
    texts: dict[str, str] = {}
    name = ""
    for line in body.body:
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name):
            name = line.target.id
        elif isinstance(line, ast.Expr) and isinstance(line.value, ast.Constant) and name:
            texts[name] = " ".join(str(line.value.value).split())
    return texts
