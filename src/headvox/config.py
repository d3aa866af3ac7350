"""What can be set: one frozen dataclass, read from TOML, overridden by flags.

Flags beat the file, the file beats the defaults. An unknown key is an error, so that a typo never runs silently.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields, replace
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
    min_height_m: float = -0.6
    """World height below which points are dropped."""
    max_height_m: float = 2.6
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
        _require(0.0 < self.max_range_m <= 50.0, "max_range_m", "more than 0 and at most 50 m", self.max_range_m)
        low, high = self.min_height_m, self.max_height_m
        _require(low < high <= low + 20.0, "max_height_m", f"above min_height_m ({low:g}), by 20 m at most", high)
        _require(self.refine in ("sphere", "none"), "refine", '"sphere" or "none"', self.refine)
        _require(1 <= self.threads <= 64, "threads", "1 to 64", self.threads)
        if self.voxel_m is not None:
            _require(0.005 <= self.voxel_m <= 0.2, "voxel_m", "0.005 to 0.2 m", self.voxel_m)


def _require(good: bool, key: str, expected: str, got: object) -> None:
    if not good:
        raise HeadvoxError(f"Setting {key}: expected {expected}, got {got!r}.", "Run `headvox config` to see all settings.")


def load_config(path: str | Path) -> DetectorConfig:
    """Read the ``[detector]`` table of a TOML file.

    Raises:
        HeadvoxError: the file is missing, is no TOML, or has an unknown key or a value of the wrong type.
    """
    try:
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise HeadvoxError(f"Configuration {path}: {error.strerror or error}.", "Check the path.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise HeadvoxError(f"Configuration {path} is not TOML: {error}.", "`headvox config` prints a valid one.") from None
    unknown = sorted(set(tables) - {"detector"})
    if unknown:
        raise HeadvoxError(f"Configuration {path}: unknown table [{unknown[0]}].", "Expected [detector].")
    return from_mapping(tables.get("detector", {}), str(path))


def from_mapping(values: dict[str, Any], origin: str) -> DetectorConfig:
    """Return a configuration with ``values`` over the defaults; ``origin`` names them in errors."""
    known = {field.name: field for field in fields(DetectorConfig)}
    for key, value in values.items():
        if key not in known:
            raise HeadvoxError(f"{origin}: unknown setting {key!r}.", f"Known: {', '.join(sorted(known))}.")
        _check_type(key, value, origin)
    if isinstance(values.get("centre"), list):
        values = {**values, "centre": tuple(float(v) for v in values["centre"])}
    return replace(DetectorConfig(), **values)


def _check_type(key: str, value: object, origin: str) -> None:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if key == "centre":
        good = (
            isinstance(value, (list, tuple))
            and len(value) == 3
            and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in value)
        )
        expected = "three numbers"
    elif key in ("cascade", "refine"):
        good, expected = isinstance(value, str), "text"
    elif key == "threads":
        good, expected = number and isinstance(value, int), "a whole number"
    else:
        good, expected = number, "a number"
    if not good:
        raise HeadvoxError(f"{origin}: setting {key}: expected {expected}, got {value!r}.", "See `headvox config`.")


def to_toml(config: DetectorConfig) -> str:
    """Return ``config`` as TOML, each setting under its explanation; settings left to the default are commented."""
    lines = ["[detector]"]
    for field in fields(config):
        value = getattr(config, field.name)
        if value is None:
            lines.append(f"# {field.name} =    (left to headvox)")
        elif isinstance(value, str):
            lines.append(f'{field.name} = "{value}"')
        elif isinstance(value, tuple):
            lines.append(f"{field.name} = [{', '.join(str(v) for v in value)}]")
        else:
            lines.append(f"{field.name} = {value}")
    return "\n".join(lines) + "\n"
