"""What can be set: one frozen dataclass, read from TOML, overridden by flags.

Flags beat the file, the file beats the defaults. An unknown key is an error, so that a typo never runs silently.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any

from headvox.errors import HeadvoxError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """Everything a :class:`~headvox.pipeline.Detector` can be told."""

    cascade: str = "default"
    """Name of a cascade that ships with headvox, or the path of a cascade file."""
    max_range_m: float = 5.0
    """Points farther than this from the centre are dropped."""
    centre: tuple[float, float, float] | None = None
    """Centre of the region in the world; by default the mean position of the sensors, or the origin if unknown."""
    min_height_m: float = -0.5
    """World height below which points are dropped."""
    max_height_m: float = 2.5
    """World height above which points are dropped."""
    min_score: float | None = None
    """Heads that score less are dropped; by default the cascade's own threshold."""
    voxel_m: float | None = None
    """Edge of a voxel; by default the cascade's own."""
    refine: str = "sphere"
    """How a candidate's centre is sharpened: "sphere" (fit to the surface voxels) or "none"."""
    threads: int = 1
    """Threads a frame is split over. The output does not depend on it."""

    def __post_init__(self) -> None:
        for field in fields(self):
            _check_type(field.name, getattr(self, field.name))
        if self.centre is not None:
            object.__setattr__(self, "centre", tuple(float(v) for v in self.centre))
        _require(
            0.0 < self.max_range_m <= 50.0, "max_range_m", "more than 0 and at most 50 m", self.max_range_m
        )
        low, high = self.min_height_m, self.max_height_m
        _require(
            low < high <= low + 20.0, "max_height_m", f"above min_height_m ({low:g}), by 20 m at most", high
        )
        _require(self.refine in ("sphere", "none"), "refine", '"sphere" or "none"', self.refine)
        _require(1 <= self.threads <= 64, "threads", "1 to 64", self.threads)
        if self.voxel_m is not None:
            _require(0.005 <= self.voxel_m <= 0.2, "voxel_m", "0.005 to 0.2 m", self.voxel_m)


def _require(good: bool, key: str, expected: str, got: object) -> None:
    if not good:
        raise HeadvoxError(f"Setting {key}: expected {expected}, got {_short(got)}.", "See `headvox config`.")


def _short(value: object) -> str:
    try:
        text = repr(value)
    except ValueError:  # Python does not write whole numbers of more than 4300 digits
        text = "a number of thousands of digits"
    return text if len(text) < 80 else text[:77] + "..."


def load_config(path: str | Path) -> DetectorConfig:
    """Read the ``[detector]`` table of a TOML file.

    Raises:
        HeadvoxError: the file is missing, is no TOML, or has an unknown key or a value of the wrong type.
    """
    try:
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise HeadvoxError(f"Configuration {path}: {error.strerror or error}.", "Check the path.") from None
    except (ValueError, RecursionError) as error:  # not TOML, not UTF-8, too many digits, nested too deep
        raise HeadvoxError(
            f"Configuration {path} is not TOML: {error}.", "`headvox config` prints one."
        ) from None
    unknown = sorted(set(tables) - {"detector"})
    if unknown:
        raise HeadvoxError(f"Configuration {path}: unknown table [{unknown[0]}].", "Expected [detector].")
    values = tables.get("detector", {})
    if not isinstance(values, dict):
        raise HeadvoxError(f"Configuration {path}: detector: expected a table.", "Write [detector].")
    return from_mapping(values, str(path))


def from_mapping(values: dict[str, Any], origin: str) -> DetectorConfig:
    """Return a configuration with ``values`` over the defaults; ``origin`` names them in errors."""
    known = {field.name for field in fields(DetectorConfig)}
    for key in values:
        if key not in known:
            raise HeadvoxError(f"{origin}: unknown setting {key!r}.", f"Known: {', '.join(sorted(known))}.")
    try:
        return replace(DetectorConfig(), **values)
    except HeadvoxError as error:
        raise HeadvoxError(f"{origin}: {error.what}", error.do) from None


def _check_type(key: str, value: object) -> None:
    if key == "centre":
        good = value is None or (
            isinstance(value, (list, tuple)) and len(value) == 3 and all(_is_number(v, 1e8) for v in value)
        )
        _require(good, key, "three numbers, 1e8 m at most", value)
    elif key in ("cascade", "refine"):
        _require(isinstance(value, str), key, "text", value)
    elif key == "threads":
        _require(isinstance(value, Integral) and _is_number(value, 1e9), key, "a whole number", value)
    elif value is not None or key not in ("min_score", "voxel_m"):
        _require(_is_number(value, 1e9), key, "a number", value)


def _is_number(value: object, most: float) -> bool:
    return not isinstance(value, bool) and isinstance(value, Real) and -most <= value <= most  # type: ignore[operator]


def to_toml(config: DetectorConfig) -> str:
    """Return ``config`` as TOML; settings that are left to headvox are commented out."""
    lines = ["[detector]"]
    for field in fields(config):
        value = getattr(config, field.name)
        if value is None:
            lines.append(f"# {field.name} =    (left to headvox)")
        elif isinstance(value, str):
            text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
            lines.append(f"{field.name} = {text}")
        elif isinstance(value, tuple):
            lines.append(f"{field.name} = [{', '.join(str(v) for v in value)}]")
        else:
            lines.append(f"{field.name} = {value}")
    return "\n".join(lines) + "\n"
