"""The command ``headvox``: flags in, calls to the library, exit codes out.

0 good, 1 a known error, 2 wrong usage, 3 a limit of eval missed, 130 Ctrl-C. Heavy imports are inside the commands,
so that ``--help`` is immediate. Results go to standard output and nothing else does.
"""

from __future__ import annotations

import argparse
import importlib
import math
import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

from headvox import __version__
from headvox.errors import HeadvoxError, Undecided
from headvox.sinks import SUFFIXES
from headvox.table import printable, table

if TYPE_CHECKING:
    from headvox.config import Config, DetectorConfig, TrackerConfig
    from headvox.sources.options import SourceOptions

GOOD, KNOWN_ERROR, USAGE, LIMIT_MISSED, INTERRUPTED = 0, 1, 2, 3, 130

# Commands that read their own flags: `headvox NAME ...` is main([...]) of a module, which returns the code.
MODULES = {
    "synth": ("headvox.synth.command", "make heads, people and recordings with known truth"),
    "eval": (
        "headvox.evaluate.command",
        "measure how good it is, on the paper's scenarios and on recordings",
    ),
    "bench": ("headvox.bench", "measure how fast it is here"),
}

DESCRIPTION = (
    "Find human heads in 3-D, in real time, in point clouds and depth images, without a neural network."
)
EXAMPLES = """\
examples:
  headvox run                                  the sample recording that ships with headvox
  headvox run cloud.ply                        the heads in one cloud
  headvox run recording/ --json                one JSON object a frame
  headvox run recording/ -o heads.csv          one row a head
  headvox config --max-range 4 > my.toml       settings to keep, for --config my.toml
  headvox synth two-cameras -o rig             a recording of synthetic people, with their true heads
  headvox eval rig                             how many of them are found, and how well

exit codes: 0 good, 1 an error that is explained, 2 wrong usage, 3 an eval limit missed, 130 Ctrl-C
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` (by default the process's own) and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    try:
        code = _dispatch(arguments)
        sys.stdout.flush()
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        _forget_stdout()
        return GOOD
    except Exception as error:
        if debug:
            traceback.print_exc()
        _complain(*_words(error))
        if isinstance(error, Undecided):
            for choice in error.choices:
                print(printable(f"    {choice}"), file=sys.stderr)
            return USAGE
        return KNOWN_ERROR
    return code


def _dispatch(arguments: list[str]) -> int:
    try:
        if arguments and arguments[0] in MODULES:
            module = importlib.import_module(MODULES[arguments[0]][0])
            return int(module.main([argument for argument in arguments[1:] if argument != "--debug"]) or GOOD)
        args = _parser().parse_args(arguments)
    except SystemExit as done:  # after --help, --version or wrong usage
        return int(done.code or GOOD)
    try:
        return int(args.command(args))
    except UsageError as error:
        args.parser.print_usage(sys.stderr)
        _complain(f"error: {error}", f"See {args.parser.prog} --help.")
        return USAGE


class UsageError(Exception):
    """The flags do not go together."""


def _words(error: Exception) -> tuple[str, str]:
    """Return what happened and what to do about it."""
    if isinstance(error, HeadvoxError):
        return f"error: {error.what}", error.do
    if isinstance(error, MemoryError):
        return "error: not enough memory.", "Set a smaller --max-range, or a larger --voxel."
    if isinstance(error, OSError):
        name = f"{error.filename}: " if error.filename else ""
        return f"error: {name}{error.strerror or error}.", ""
    if "no locator available" in str(error):  # Numba, in a read-only installation without a home
        return (
            "error: there is no folder to keep compiled loops in.",
            "Set NUMBA_CACHE_DIR to one that can be written.",
        )
    return (
        f"internal error: {type(error).__name__}: {error}",
        "This is a fault of headvox: please report it, with what the same command prints with --debug.",
    )


def _complain(what: str, do: str) -> None:
    try:
        for line in (f"headvox: {what}", f"  {do}" if do else ""):
            if line:
                print(printable(line), file=sys.stderr)
    except BrokenPipeError:
        pass


def _forget_stdout() -> None:
    """Let what is still buffered go nowhere: the pipe is closed, and Python would complain at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


# ----------------------------------------------------------------------------------------------- commands


def _run(args: argparse.Namespace) -> int:
    config, tracker_config = config_of(args), tracker_config_of(args)
    if args.no_track and args.output is not None and args.output.suffix == ".tum":
        raise UsageError("-o NAME.tum writes a file a track: it does not go with --no-track")
    from headvox.sinks import Sink, open_sink
    from headvox.sources import open_source

    path = args.source or sample_folder()
    with ExitStack() as stack:
        notes: list[str] = []
        source = stack.enter_context(closing(open_source(path, source_options_of(args), notes.append)))

        from headvox.live import Live
        from headvox.pipeline import Detector
        from headvox.run import run
        from headvox.sinks.jsonl import JsonStream
        from headvox.sinks.summary import summary
        from headvox.sources.recording import RecordingSource
        from headvox.track import Tracker
        from headvox.warmup import warm_up

        live = stack.enter_context(closing(Live(sys.stderr, source.length)))
        if args.source is None:
            live.note(f"no SOURCE given: running the sample that ships with headvox, {path}")
        for note in notes:
            live.note(f"headvox: {note}")
        detector = stack.enter_context(closing(Detector(config)))
        sinks: list[Sink] = []
        if args.output is not None:
            # Before the stream: what was printed is in the file, however the run ends.
            _keep_input(args.output, [path, args.config, config.cascade])
            sinks.append(stack.enter_context(closing(open_sink(args.output))))
        if args.json:
            sinks.append(JsonStream(sys.stdout))
        live.show("getting ready (the first time compiles, ten seconds or more)")
        warm_up(config)
        report = run(
            source,
            detector,
            sinks,
            tracker=None if args.no_track else Tracker(tracker_config),
            strict=args.strict,
            limit=args.limit,
            on_bad=lambda index, reason: live.note(f"headvox: frame {index} skipped: {reason}"),
            on_frame=live.frame,
        )
        if report.heads == 0 and not report.interrupted and not isinstance(source, RecordingSource):
            live.note("no head in any frame: headvox expects metres, and a world whose z points up")
    if not args.json:
        print(summary(report))
    return INTERRUPTED if report.interrupted else GOOD


def _info(args: argparse.Namespace) -> int:
    from headvox.sources.describe import describe

    notes: list[str] = []
    print(table([], [list(row) for row in describe(args.source, source_options_of(args), notes.append)]))
    for note in notes:
        _complain(note, "")
    return GOOD


def _show_config(args: argparse.Namespace) -> int:
    from headvox.config import to_toml
    from headvox.masks import load_cascade

    config = config_of(args)
    load_cascade(config.cascade)  # a wrong name is to be told now, not when the file is used
    print(to_toml(config), to_toml(tracker_config_of(args)), sep="\n", end="")
    return GOOD


def _warmup(args: argparse.Namespace) -> int:
    import time

    begun = time.perf_counter()
    from headvox.config import DetectorConfig
    from headvox.masks import shipped_cascades
    from headvox.warmup import cache_folder, warm_up

    rows = []
    for cascade in shipped_cascades():
        for threads in (1, 2):
            started = time.perf_counter()
            warm_up(DetectorConfig(cascade=cascade, threads=threads))
            seconds = time.perf_counter() - started
            rows.append([cascade, str(threads), f"{seconds:.2f}"])
            print(f"{cascade}, {threads} thread{'s' * (threads > 1)}: {seconds:.2f} s", file=sys.stderr)
    print(table(["cascade", "threads", "seconds"], rows))
    print(f"\nAll loops are ready after {time.perf_counter() - begun:.1f} s, kept in {cache_folder()}")
    return GOOD


def _masks_list(args: argparse.Namespace) -> int:
    from headvox.masks import load_cascade, shipped_cascades

    cascades = [(name, load_cascade(name)) for name in shipped_cascades()]
    rows = [
        [name, "votes" if cascade.votes else "stages", f"{1e3 * cascade.voxel_m:g} mm", cascade.summary]
        for name, cascade in cascades
    ]
    print(table(["cascade", "second stage", "voxel", "summary"], rows))
    return GOOD


def _masks_show(args: argparse.Namespace) -> int:
    from headvox.describe_masks import describe_cascade
    from headvox.masks import load_cascade

    print(describe_cascade(load_cascade(args.cascade)))
    return GOOD


def _masks_plot(args: argparse.Namespace) -> int:
    from headvox.masks import load_cascade
    from headvox.plot_masks import file_name, plot_cascade

    cascade = load_cascade(args.cascade)
    folder = args.output or Path(f"masks-{file_name(cascade.name)}")
    for path in plot_cascade(cascade, folder):
        print(printable(str(path)), flush=True)
    return GOOD


def _masks_evolve(args: argparse.Namespace) -> int:
    from headvox.evolve.search import Settings, evolve
    from headvox.evolve.write import write_cascade

    out = args.output or Path(f"{args.name}.toml")
    if out.exists():
        raise HeadvoxError(f"{out}: exists already.", "Give another file with -o, or move it away.")
    settings = Settings(args.work, args.views, args.name, args.seed, args.rounds, args.workers)
    found = evolve(settings, lambda text: print(text, file=sys.stderr, flush=True))
    write_cascade(out, args.name, found)
    print(printable(str(out)))
    return GOOD


def sample_folder() -> Path:
    """Return the recording that ships with headvox."""
    sample = Path(__file__).parent / "assets" / "sample"
    if not sample.is_dir():
        raise HeadvoxError("This headvox has no sample recording in it.", "Give a SOURCE: headvox run PATH.")
    return sample


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


def _keep_input(output: Path, inputs: Sequence[str | Path | None]) -> None:
    """Refuse to write over what is read."""
    target = output.resolve()
    for path in inputs:
        if path is None or not Path(path).exists():
            continue
        source = Path(path).resolve()
        same = target == source or (target.exists() and target.samefile(source))
        if same or (source.is_dir() and source in target.parents):
            raise HeadvoxError(
                f"Output {output} would be written into the input {path}.", "Choose another place."
            )


# -------------------------------------------------------------------------------------------------- flags


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "headvox",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"headvox {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    run = _command(commands, "run", _run, "find heads in a recording, a bag, a cloud, or a folder of clouds")
    run.add_argument(
        "source",
        nargs="?",
        type=Path,
        metavar="SOURCE",
        help="a depth recording (folder), a bag of ROS 1 or 2 (.bag, .mcap, sqlite3), a ply, pcd, npy or npz file, "
        "or a folder of those; without it, the sample recording that ships with headvox",
    )
    run.add_argument("--json", action="store_true", help="print one JSON object a frame, and nothing else")
    run.add_argument(
        "-o",
        dest="output",
        type=output_file,
        metavar="OUT",
        help=f"also write a file: {_either(SUFFIXES)}; NAME.tum writes a trajectory a track, NAME_ID.tum",
    )
    run.add_argument(
        "--no-track",
        action="store_true",
        help="every frame by itself: bare detections, without ids and velocities",
    )
    run.add_argument("--strict", action="store_true", help="stop at the first bad frame, with exit code 1")
    run.add_argument("--limit", type=whole_number, metavar="N", help="stop after N frames")
    add_source_options(run)
    add_settings(run)
    add_tracker_settings(run)
    run.usage = "%(prog)s [SOURCE] [--json] [-o OUT] [flags]"

    info = _command(commands, "info", _info, "tell what a source holds")
    info.add_argument("source", type=Path, metavar="SOURCE", help="as for run")
    add_source_options(info)

    config = _command(commands, "config", _show_config, "print the settings as TOML, as --config takes them")
    add_settings(config)
    add_tracker_settings(config)
    config.usage = "%(prog)s [flags]"

    _command(commands, "warmup", _warmup, "compile every loop now, so that no first run has to wait")
    _add_masks(commands)
    for name, (_, text) in MODULES.items():
        commands.add_parser(name, help=text)
    return parser


def _add_masks(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    masks = commands.add_parser("masks", help="list, show and plot cascades of masks", allow_abbrev=False)
    actions = masks.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _command(actions, "list", _masks_list, "list the cascades that ship with headvox")
    cascade = "name of a shipped cascade, or a cascade file"
    show = _command(
        actions, "show", _masks_show, "show the conditions, groups and stages of a cascade as tables"
    )
    show.add_argument("cascade", metavar="CASCADE", help=cascade)
    plot = _command(actions, "plot", _masks_plot, "draw each mask of a cascade to a PNG file")
    plot.add_argument("cascade", metavar="CASCADE", help=cascade)
    plot.add_argument(
        "-o", dest="output", type=Path, metavar="DIR", help="folder for the pictures (masks-NAME)"
    )
    search = _command(actions, "evolve", _masks_evolve, "search for a cascade, with synthetic views")
    search.add_argument("--views", type=whole_number, default=10_000, metavar="N", help="how many (10000)")
    search.add_argument(
        "--seed", type=seed_number, default=0, metavar="S", help="of the views and the search (0)"
    )
    search.add_argument(
        "--rounds", type=whole_number, default=3, metavar="N", help="of hard negatives, at most (3)"
    )
    search.add_argument("--workers", type=whole_number, default=1, metavar="N", help="processes (1)")
    search.add_argument("--name", default="evolved", help="of the cascade (evolved)")
    search.add_argument(
        "--work",
        type=Path,
        default=Path("evolve"),
        metavar="DIR",
        help="keeps the views: a search goes on from there (evolve)",
    )
    search.add_argument("-o", dest="output", type=Path, metavar="FILE", help="the cascade file (NAME.toml)")


def _command(
    commands: argparse._SubParsersAction[argparse.ArgumentParser], name: str, function: object, text: str
) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name, help=text, description=text[0].upper() + text[1:] + ".", allow_abbrev=False
    )
    parser.add_argument("--debug", action="store_true", help="show the trace of an error")
    parser.set_defaults(command=function, parser=parser)
    return parser


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
        "--threads", type=whole_number, metavar="N", help="threads for a frame; the heads are the same"
    )


def add_source_options(parser: argparse.ArgumentParser) -> None:
    """Add a flag for each thing that a bag may not tell by itself."""
    group = parser.add_argument_group("bags", "what a bag does not tell by itself")
    group.add_argument(
        "--topic", action="append", default=[], metavar="NAME", help="read this topic (again for another)"
    )
    group.add_argument("--frame", metavar="NAME", help="frame that the heads are to be in; its z points up")
    group.add_argument(
        "--mount",
        nargs=6,
        type=number,
        metavar=("X", "Y", "Z", "ROLL", "PITCH", "YAW"),
        help="where that frame, or the one sensor, stands: metres and degrees; PITCH above 0 looks down",
    )


def add_tracker_settings(parser: argparse.ArgumentParser) -> None:
    """Add a flag for each setting of the tracker; :func:`add_settings` adds ``--config``."""
    tracker = parser.add_argument_group("settings of the tracker", "the same holds")
    for flag, name, kind, metavar, text in TRACKER_FLAGS:
        tracker.add_argument(flag, dest=name, type=kind, metavar=metavar, help=text)


# argparse names these three in its messages: "invalid number value: 'x'".


def number(text: str) -> float:
    """Return the finite number that ``text`` is."""
    value = float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected a finite number, got {text!r}")
    return value


def whole_number(text: str) -> int:
    """Return the whole number, at least 1, that ``text`` is."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected at least 1, got {text!r}")
    return value


def seed_number(text: str) -> int:
    """Return the whole number, at least 0, that ``text`` is."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"expected at least 0, got {text!r}")
    return value


def output_file(text: str) -> Path:
    """Return the path of a file that a sink can write."""
    path = Path(text)
    if path.suffix not in SUFFIXES:
        raise argparse.ArgumentTypeError(f"expected a name that ends with {_either(SUFFIXES)}, got {text!r}")
    return path


def _either(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} or {names[-1]}"


TRACKER_FLAGS = (
    ("--confirm-hits", "confirm_hits", whole_number, "N", "a new head gets an id when it was seen in N ..."),
    ("--confirm-frames", "confirm_frames", whole_number, "N", "... of N frames in a row"),
    ("--gate-sigmas", "gate_sigmas", number, "SIGMAS", "how far from its prediction a head is sought"),
    ("--speed-change", "speed_change_m_s", number, "M/S", "how fast a moving head changes its velocity"),
    ("--turn-change", "turn_change_deg_s", number, "DEG/S", "how fast a head changes its turn rate"),
    ("--empty", "empty_s", number, "S", "a track ends when its place is seen to be empty for so long"),
    ("--out-of-view", "out_of_view_s", number, "S", "... or is out of every sensor's view"),
    ("--missed", "missed_s", number, "S", "... or is in view, but nothing is found there"),
    ("--weak", "weak_s", number, "S", "... or only what scores too little to be a head by itself"),
    ("--hidden", "hidden_s", number, "S", "... or is hidden behind something"),
    ("--remember", "remember_s", number, "S", "how long a head that was lost is the same when it comes back"),
    ("--sight", "sight_m", number, "M", "how far the sensors see"),
    ("--reset", "reset_s", number, "S", "a jump back in time by more than this begins anew"),
)


if __name__ == "__main__":
    sys.exit(main())
