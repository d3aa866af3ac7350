"""What the commands share: their flags, the settings these stand for, and the exit codes."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from headvox.errors import HeadvoxError

if TYPE_CHECKING:
    from headvox.config import Config, DetectorConfig, TrackerConfig
    from headvox.sources.options import SourceOptions

    Commands = argparse._SubParsersAction["Parser"]
    Command = Callable[[argparse.Namespace], int]

GOOD, KNOWN_ERROR, USAGE, LIMIT_MISSED, INTERRUPTED, TERMINATED = 0, 1, 2, 3, 130, 143
"""What a command tells the shell."""


class UsageError(Exception):
    """The flags do not go together."""


class Parser(argparse.ArgumentParser):
    """Reads flags by their whole names; -1e-3 is a number, which older versions of argparse take for a flag."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.allow_abbrev = False
        self._negative_number_matcher = re.compile(r"-\.?\d")


def config_of(args: argparse.Namespace) -> DetectorConfig:
    """Return the settings of the detector: flags beat the file, the file beats the defaults."""
    from headvox.config import DetectorConfig, load_config

    return _with_flags(DetectorConfig() if args.config is None else load_config(args.config), args)


def tracker_config_of(args: argparse.Namespace) -> TrackerConfig:
    """Return the settings of the tracker, in the same way."""
    from headvox.config import TrackerConfig, load_tracker_config

    return _with_flags(TrackerConfig() if args.config is None else load_tracker_config(args.config), args)


def source_options_of(args: argparse.Namespace) -> SourceOptions:
    """Return what the flags tell about the source."""
    from headvox.sources.options import SourceOptions, mount

    return SourceOptions(
        topics=tuple(args.topic),
        frame=args.frame,
        extrinsics=args.extrinsics,
        rate_hz=args.rate,
        T_world_mount=None if args.mount is None else mount(*args.mount),
    )


def _with_flags(config: Config, args: argparse.Namespace) -> Config:
    from dataclasses import fields, replace

    names = [field.name for field in fields(config)]
    flags = {name: getattr(args, name) for name in names if getattr(args, name, None) is not None}
    if "centre" in flags:
        flags["centre"] = tuple(flags["centre"])
    try:
        return replace(config, **flags)
    except HeadvoxError as error:
        raise UsageError(error.what) from None


def keep_input(output: Path, inputs: Sequence[str | Path | None]) -> None:
    """Refuse to write over what is read.

    Raises:
        HeadvoxError: ``output`` is one of ``inputs``, or lies in one.
    """
    target = output.resolve()
    for path in inputs:
        if path is None or not Path(path).exists():
            continue
        source = Path(path).resolve()
        if source.name == "recording.json":  # its folder is what is read
            source = source.parent
        same = target == source or (target.exists() and target.samefile(source))
        if same or (source.is_dir() and source in target.parents):
            raise HeadvoxError(
                f"Output {output} would be written into the input {path}.", "Choose another place."
            )


def sentence(text: str) -> str:
    """Return what the list of commands says of one, as a sentence."""
    return text[0].upper() + text[1:] + "."


def add_command(commands: Commands, name: str, function: Command, text: str) -> Parser:
    """Add a command that is done by ``function``, and return its parser."""
    parser = commands.add_parser(name, help=text, description=sentence(text))
    parser.add_argument("--debug", action="store_true", help="show the trace of an error")
    parser.set_defaults(command=function, parser=parser)
    return parser


def add_source(parser: argparse.ArgumentParser) -> None:
    """Add the frames to look at."""
    parser.add_argument(
        "source",
        nargs="?",
        type=place,
        metavar="SOURCE",
        help="a depth recording (folder), a bag of ROS 1 or 2 (.bag, .mcap, sqlite3), a ply, pcd, npy or npz file, "
        "a folder of those, or realsense:[SERIAL,...]; without it, the sample recording that ships with headvox",
    )
    parser.add_argument("--strict", action="store_true", help="stop at the first bad frame, with exit code 1")
    parser.add_argument("--limit", type=whole_number, metavar="N", help="stop after N frames")
    add_source_options(parser)


def place(text: str) -> Path | str:
    """Return a path, or the address of what lies elsewhere as it is, for argparse."""
    from headvox.sources.remote import is_remote

    if not text:  # a variable of a shell that is not set: the path would be that of the current folder
        raise argparse.ArgumentTypeError("expected a path or an address, got ''")
    return text if is_remote(text) else Path(text)


def named(*suffixes: str) -> Callable[[str], Path]:
    """Return what reads the name of a file that ends with one of ``suffixes``, for argparse."""

    def file(text: str) -> Path:
        path = Path(text)
        if path.suffix not in suffixes:
            raise argparse.ArgumentTypeError(
                f"expected a name that ends with {either(suffixes)}, got {text!r}"
            )
        return path

    return file


def either(names: Sequence[str]) -> str:
    """Return "a", "a or b", "a, b or c"."""
    return " or ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)


def add_source_options(parser: argparse.ArgumentParser) -> None:
    """Add a flag for each thing that a source may not tell by itself."""
    group = parser.add_argument_group("bags, cameras and clouds", "what they do not tell by themselves")
    group.add_argument(
        "--topic", action="append", default=[], metavar="NAME", help="read this topic (again for another)"
    )
    group.add_argument("--frame", metavar="NAME", help="frame that the heads are to be in; its z points up")
    group.add_argument(
        "--mount",
        nargs=6,
        type=number,
        metavar=("X", "Y", "Z", "ROLL", "PITCH", "YAW"),
        help="where that frame, or the one sensor, also of clouds in files, stands: metres and degrees; PITCH above 0 "
        "looks down",
    )
    group.add_argument(
        "--extrinsics",
        metavar="FILE",
        help="TOML or JSON that tells where each camera stands: see headvox align",
    )
    group.add_argument(
        "--rate",
        dest="rate",
        type=number,
        metavar="HZ",
        help="clouds of a folder a second (30): files have no stamps",
    )


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add a flag for each setting; without the flag, the file or the default says."""
    group = parser.add_argument_group(
        "settings of the detector", "flags beat --config, --config beats the defaults"
    )
    group.add_argument(
        "--config", type=Path, metavar="FILE", help="settings, as `headvox config` prints them"
    )
    group.add_argument(
        "--cascade", metavar="NAME|FILE", help="which masks to look with: see `headvox masks list`"
    )
    group.add_argument(
        "--max-range", dest="max_range_m", type=number, metavar="M", help="drop farther points"
    )
    group.add_argument(
        "--centre", nargs=3, type=number, metavar=("X", "Y", "Z"), help="what --max-range is measured from"
    )
    group.add_argument(
        "--min-height", dest="min_height_m", type=number, metavar="M", help="drop lower points"
    )
    group.add_argument(
        "--max-height", dest="max_height_m", type=number, metavar="M", help="drop higher points"
    )
    group.add_argument("--min-score", type=number, metavar="S", help="drop heads that score less")
    group.add_argument("--voxel", dest="voxel_m", type=number, metavar="M", help="edge of a voxel")
    group.add_argument("--refine", choices=("pose", "sphere", "none"), help="how a head is sharpened")
    group.add_argument(
        "--score-slack",
        type=number,
        metavar="S",
        help="how much less a head may score where a tracker expects it",
    )
    group.add_argument(
        "--backend", choices=("cpu", "cuda", "auto"), help="where heads are searched for: see docs/cuda.md"
    )
    group.add_argument(
        "--threads", type=whole_number, metavar="N", help="threads for a frame; the heads are the same"
    )


def add_tracker_settings(parser: argparse.ArgumentParser) -> None:
    """Add a flag for each setting of the tracker; :func:`add_settings` adds ``--config``."""
    tracker = parser.add_argument_group("settings of the tracker", "the same holds")
    for flag, name, kind, metavar, text in TRACKER_FLAGS:
        tracker.add_argument(flag, dest=name, type=kind, metavar=metavar, help=text)


# argparse names these in its messages: "invalid number value: 'x'", "invalid whole_number value: 'x'".


def number(text: str) -> float:
    """Return the finite number that ``text`` is."""
    value = float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected a finite number, got {text!r}")
    return value


def between(least: float, most: float) -> Callable[[str], float]:
    """Return what reads a number within limits, for argparse."""

    def limited_number(text: str) -> float:
        value = number(text)
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"expected {least:g} to {most:g}, got {text!r}")
        return value

    return limited_number


def whole(least: int, most: int) -> Callable[[str], int]:
    """Return what reads a whole number within limits, for argparse."""

    def whole_number(text: str) -> int:
        value = int(text)
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"expected {least} to {most}, got {text!r}")
        return value

    return whole_number


whole_number = whole(1, 1_000_000_000)
"""Reads how many of something."""
seed_number = whole(0, sys.maxsize - 1)
"""Reads the number of a frame, or what random numbers begin with."""

TRACKER_FLAGS = (
    (
        "--confirm-hits",
        "confirm_hits",
        whole_number,
        "N",
        "a new head gets an id when it was seen in N (more, if it scores little) ...",
    ),
    (
        "--confirm-frames",
        "confirm_frames",
        whole_number,
        "N",
        "... of N frames in a row, or in each of these",
    ),
    (
        "--strong-score",
        "strong_score",
        number,
        "SCORE",
        "what true heads mostly score; what scores less counts for less",
    ),
    ("--gate-sigmas", "gate_sigmas", number, "SIGMAS", "how far from its prediction a head is sought"),
    ("--speed-change", "speed_change_m_s", number, "M/S", "how fast a moving head changes its velocity"),
    ("--turn-change", "turn_change_deg_s", number, "DEG/S", "how fast a head changes its turn rate"),
    ("--empty", "empty_s", number, "S", "a track ends when its place is seen to be empty for so long"),
    ("--out-of-view", "out_of_view_s", number, "S", "... or is out of every sensor's view"),
    (
        "--missed",
        "missed_s",
        number,
        "S",
        "... or gives no return, or is in a cloud, and nothing is found there",
    ),
    (
        "--present",
        "present_s",
        number,
        "S",
        "... or something is there, but no head (less if it was seen little)",
    ),
    ("--weak", "weak_s", number, "S", "... or only what scores too little to be a head by itself"),
    ("--hidden", "hidden_s", number, "S", "... or is hidden behind something"),
    ("--remember", "remember_s", number, "S", "how long a head that was lost is the same when it comes back"),
    ("--sight", "sight_m", number, "M", "how far the sensors see"),
    ("--reset", "reset_s", number, "S", "a jump back in time by more than this begins anew"),
)
