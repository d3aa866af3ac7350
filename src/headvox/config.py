"""What can be set: one frozen dataclass, read from TOML, overridden by flags.

Flags beat the file, the file beats the defaults. An unknown key is an error, so that a typo never runs silently.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar

from headvox.errors import HeadvoxError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


REFINE = ("pose", "sphere", "none")
BACKENDS = ("cpu", "cuda", "auto")


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
    refine: str = "pose"
    """How a candidate is sharpened: "pose" (a head fitted to the points: centre and orientation, each with how sure it
    is), "sphere" (a sphere fitted to the surface voxels: centre only) or "none"."""
    score_slack: float = 1.0
    """Where a tracker expects a head, it may score this much less than others."""
    threads: int = 1
    """Threads a frame is split over. The output does not depend on it."""
    backend: str = "cpu"
    """Where heads are searched for: "cpu", "cuda" (an NVIDIA GPU) or "auto" (the GPU if there is one). What is
    found does not depend on it; what is fitted, in its last digits (docs/cuda.md)."""

    def __post_init__(self) -> None:
        for field in fields(self):
            _check_type(field.name, getattr(self, field.name))
        _require(self.score_slack >= 0.0, "score_slack", "at least 0", self.score_slack)
        if self.centre is not None:
            object.__setattr__(self, "centre", tuple(float(v) for v in self.centre))
        _require(
            0.0 < self.max_range_m <= 50.0, "max_range_m", "more than 0 and at most 50 m", self.max_range_m
        )
        low, high = self.min_height_m, self.max_height_m
        _require(
            low < high <= low + 20.0, "max_height_m", f"above min_height_m ({low:g}), by 20 m at most", high
        )
        _require(self.refine in REFINE, "refine", '"pose", "sphere" or "none"', self.refine)
        _require(self.backend in BACKENDS, "backend", '"cpu", "cuda" or "auto"', self.backend)
        _require(1 <= self.threads <= 64, "threads", "1 to 64", self.threads)
        if self.voxel_m is not None:
            _require(0.005 <= self.voxel_m <= 0.2, "voxel_m", "0.005 to 0.2 m", self.voxel_m)


@dataclass(frozen=True, slots=True)
class TrackerConfig:
    """Everything a :class:`~headvox.tracking.tracker.Tracker` can be told."""

    confirm_hits: int = 2
    """A new head gets an id when it was seen in so many (more, where it scores less than ``strong_score``) ..."""
    confirm_frames: int = 5
    """... of so many frames in a row, or in each of these."""
    strong_score: float = 4.0
    """What true heads mostly score; what scores less counts for less."""
    gate_sigmas: float = 4.0
    """A detection farther than this from where a track should be, in standard deviations, is not its head."""
    speed_change_m_s: float = 1.0
    """How much the velocity of a moving head changes within a second (standard deviation, each axis)."""
    turn_change_deg_s: float = 200.0
    """How much a head's turn rate changes within a second (standard deviation, each axis)."""
    empty_s: float = 0.3
    """A track ends when its place is seen to be empty for so long ..."""
    out_of_view_s: float = 0.5
    """... or is out of every sensor's view for so long ..."""
    missed_s: float = 1.0
    """... or gives no return to a sensor, or is in a cloud, and nothing is found there ..."""
    present_s: float = 2.8
    """... or something is there, but no head (less if it was seen in few frames, or scores little) ..."""
    weak_s: float = 2.0
    """... or only what scores too little to be a head by itself ..."""
    hidden_s: float = 3.0
    """... or is hidden behind something for so long."""
    remember_s: float = 8.0
    """A head that turns up where one was lost is the same one, up to so long after it was last seen."""
    sight_m: float = 5.0
    """How far the sensors see."""
    reset_s: float = 1.0
    """When time jumps back by more than this, a recording began again: everything is forgotten."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name in ("confirm_hits", "confirm_frames"):
                _require(_is_whole(value), field.name, "a whole number", value)
            else:
                good = _is_number(value, 1e9) and value > 0
                _require(good, field.name, "a number above 0, 1e9 at most", value)
        hits, frames = self.confirm_hits, self.confirm_frames
        _require(1 <= hits <= 60, "confirm_hits", "1 to 60", hits)
        _require(hits <= frames <= 60, "confirm_frames", f"confirm_hits ({hits}) to 60", frames)


TABLES: dict[type, str] = {DetectorConfig: "detector", TrackerConfig: "track"}
Config = TypeVar("Config", DetectorConfig, TrackerConfig)


def given_or_default(config: Config | None, kind: type[Config]) -> Config:
    """Return ``config``, or the defaults where there is none.

    Raises:
        HeadvoxError: it is something else.
    """
    if config is None:
        return kind()
    if not isinstance(config, kind):
        raise HeadvoxError(
            f"Expected a {kind.__name__}, got {_short(config)}.", f"Write {kind.__name__}(setting=value)."
        )
    return config


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
    """Read the ``[detector]`` table of a TOML file; what it leaves out has its default.

    Raises:
        HeadvoxError: the file is missing, is no TOML, or has an unknown key or a value of the wrong type.
    """
    return _load(path, DetectorConfig)


def load_tracker_config(path: str | Path) -> TrackerConfig:
    """Read the ``[track]`` table of a TOML file, as :func:`load_config` does the other."""
    return _load(path, TrackerConfig)


def _load(path: str | Path, kind: type[Config]) -> Config:
    try:
        # Editors of Windows may begin it with a BOM.
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise HeadvoxError(f"Configuration {path}: {error.strerror or error}.", "Check the path.") from None
    except (ValueError, RecursionError) as error:  # not TOML, not UTF-8, too many digits, nested too deep
        raise HeadvoxError(
            f"Configuration {path} is not TOML: {error}.", "`headvox config` prints one."
        ) from None
    names = sorted(TABLES.values())
    unknown = sorted(set(tables) - set(names))
    if unknown:
        expected = " and ".join(f"[{name}]" for name in names)
        raise HeadvoxError(f"Configuration {path}: unknown table [{unknown[0]}].", f"Expected {expected}.")
    name = TABLES[kind]
    values = tables.get(name, {})
    if not isinstance(values, dict):
        raise HeadvoxError(f"Configuration {path}: {name}: expected a table.", f"Write [{name}].")
    return _over_defaults(kind, values, str(path))


def _over_defaults(kind: type[Config], values: dict[str, Any], origin: str) -> Config:
    """Return a configuration with ``values`` over the defaults; ``origin`` names them in errors."""
    known = {field.name for field in fields(kind)}
    for key in values:
        if key not in known:
            raise HeadvoxError(f"{origin}: unknown setting {key!r}.", f"Known: {', '.join(sorted(known))}.")
    try:
        return replace(kind(), **values)
    except HeadvoxError as error:
        raise HeadvoxError(f"{origin}: {error.what}", error.do) from None


def _check_type(key: str, value: object) -> None:
    if key == "centre":
        good = value is None or (
            isinstance(value, (list, tuple)) and len(value) == 3 and all(_is_number(v, 1e8) for v in value)
        )
        _require(good, key, "three numbers, 1e8 m at most", value)
    elif key in ("cascade", "refine", "backend"):
        _require(isinstance(value, str), key, "text", value)
    elif key == "threads":
        _require(_is_whole(value), key, "a whole number", value)
    elif value is not None or key not in ("min_score", "voxel_m"):
        _require(_is_number(value, 1e9), key, "a number from -1e9 to 1e9", value)


def _is_whole(value: object) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _is_number(value: object, most: float) -> bool:
    if isinstance(value, bool) or not isinstance(value, Real):
        return False
    try:
        return -most <= float(value) <= most
    except OverflowError:  # a whole number that is greater than any float
        return False


def to_toml(config: DetectorConfig | TrackerConfig) -> str:
    """Return ``config`` as a table of TOML; settings that are left to headvox are commented out."""
    lines = [f"[{TABLES[type(config)]}]"]
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
