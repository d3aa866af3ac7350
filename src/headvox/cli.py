"""The command ``headvox``: flags in, calls to the library, exit codes out.

0 good, 1 a known error, 2 wrong usage, 3 a limit of eval missed, 130 Ctrl-C, 143 SIGTERM. Heavy imports are inside the
commands, so that ``--help`` is immediate. Results go to standard output and nothing else does.
"""

from __future__ import annotations

import argparse
import importlib
import io
import os
import sys
import traceback
from collections.abc import Sequence
from contextlib import closing
from typing import TextIO

from headvox import __version__
from headvox.commands import completion, doctor
from headvox.commands import masks as masks_command
from headvox.commands import run as run_command
from headvox.commands.flags import (
    GOOD,
    INTERRUPTED,
    KNOWN_ERROR,
    TERMINATED,
    USAGE,
    Parser,
    UsageError,
    add_command,
    add_settings,
    add_source_options,
    add_tracker_settings,
    config_of,
    keep_input,
    named,
    place,
    source_options_of,
    tracker_config_of,
)
from headvox.commands.table import printable, table
from headvox.errors import HeadvoxError, Undecided
from headvox.machine.interrupts import heeded, terminable
from headvox.render import command as render_command
from headvox.view import command as view_command

# Commands that read their own flags: `headvox NAME ...` is main([...]) of a module, which returns the code.
MODULES = {
    "synth": ("headvox.synth.command", "make heads, people and recordings with known truth"),
    "eval": (
        "headvox.evaluate.command",
        "measure how good it is, on the paper's scenarios and on recordings",
    ),
    "align": ("headvox.calibrate.command", "tell where cameras stand, by the floor and by people who walk"),
    "bench": ("headvox.bench.command", "measure how fast it is here"),
}

# Commands with the settings of the detector, which decide how much memory it takes.
WITH_SETTINGS = {"run", "view", "render", "eval"}

DESCRIPTION = (
    "Find human heads in 3-D, in real time, in point clouds and depth images, without a neural network."
)
EXAMPLES = """\
examples:
  headvox run                                  the sample recording that ships with headvox
  headvox run cloud.ply                        the heads in one cloud
  headvox run recording/ --json                one JSON object a frame
  headvox run recording/ -o heads.csv          one row a head
  headvox view recording/                      the run in rerun's viewer; render makes a film of it
  headvox align recording/ -o extrinsics.toml  where the cameras stand
  headvox config --max-range 4 > my.toml       settings to keep, for --config my.toml
  headvox synth two-cameras -o rig             a recording of synthetic people, with their true heads
  headvox eval rig                             how many of them are found, and how well

exit codes: 0 good, 1 an error that is explained, 2 wrong usage, 3 an eval limit missed, 130 Ctrl-C,
  143 SIGTERM
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` (by default the process's own) and return its exit code."""
    with terminable() as terminated:
        code = _main(list(sys.argv[1:] if argv is None else argv))
    return TERMINATED if terminated and code == INTERRUPTED else code


def _main(arguments: list[str]) -> int:
    debug = "--debug" in arguments
    _prepare_streams()
    try:
        with heeded():
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
        _complain(*_words(error, arguments))
        if isinstance(error, Undecided):
            for choice in error.choices:
                print(printable(f"    {choice}"), file=sys.stderr)
            return USAGE
        return KNOWN_ERROR
    return code


def _prepare_streams() -> None:
    """Let what is printed go nowhere where a stream was closed before we began, as daemons have it.

    Letters that the terminal does not know are printed as "?"; on standard error Python sees to that.
    """
    sys.stdout = sys.stdout or _nowhere()
    sys.stderr = sys.stderr or _nowhere()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def _nowhere() -> TextIO:
    return open(os.devnull, "w", encoding="utf-8")


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


def _words(error: Exception, arguments: Sequence[str]) -> tuple[str, str]:
    """Return what happened and what to do about it."""
    if isinstance(error, HeadvoxError):
        return f"error: {error.what}", error.do
    if isinstance(error, MemoryError):
        has_settings = WITH_SETTINGS.intersection(arguments[:1])
        do = "Set a smaller --max-range, or a larger --voxel." if has_settings else "Close other programs."
        return "error: not enough memory.", do
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


def _convert(args: argparse.Namespace) -> int:
    from headvox.commands.convert import convert
    from headvox.commands.live import Live
    from headvox.remarks import Remarks
    from headvox.sources import open_source
    from headvox.sources.remote import fetched

    with (
        fetched(args.source) as path,
        closing(Live(sys.stderr)) as live,
        closing(open_source(path, source_options_of(args), live.tell)) as source,
    ):
        keep_input(args.output, [path])
        with closing(Remarks(live.tell)) as remarks:
            done, bad = convert(source, args.output, lambda k: live.show(f"frame {k}"), remarks.skipped)
    size = f"{args.output.stat().st_size / 1e6:.1f} MB"
    print(
        table(
            [],
            [
                ["file", str(args.output)],
                ["frames", str(done - bad)],
                ["bad frames", str(bad)],
                ["size", size],
            ],
        )
    )
    return GOOD


def _info(args: argparse.Namespace) -> int:
    from headvox.sources.describe import describe
    from headvox.sources.remote import fetched

    notes: list[str] = []
    with fetched(args.source) as path:
        rows = describe(path, source_options_of(args), notes.append)
    print(table([], [list(row) for row in rows]))
    for note in notes:
        _complain(note, "")
    return GOOD


def _show_config(args: argparse.Namespace) -> int:
    from headvox.config import to_toml
    from headvox.masks.read import load_cascade

    config = config_of(args)
    load_cascade(config.cascade)  # a wrong name is to be told now, not when the file is used
    print(to_toml(config), to_toml(tracker_config_of(args)), sep="\n", end="")
    return GOOD


def _warmup(args: argparse.Namespace) -> int:
    import time

    begun = time.perf_counter()
    from headvox.config import DetectorConfig
    from headvox.masks.read import shipped_cascades
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


# -------------------------------------------------------------------------------------------------- flags


def _parser() -> Parser:
    parser = Parser(
        "headvox",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"headvox {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    run_command.add_to(commands)
    info = add_command(commands, "info", _info, "tell what a source holds")
    info.add_argument("source", type=place, metavar="SOURCE", help="as for run")
    add_source_options(info)

    conversion = add_command(
        commands, "convert", _convert, "write a recording, or any source, as a bag (MCAP)"
    )
    conversion.add_argument("source", type=place, metavar="SOURCE", help="as for run")
    conversion.add_argument(
        "-o",
        dest="output",
        type=named(".mcap"),
        required=True,
        metavar="OUT.mcap",
        help="messages of ROS 2, without ROS",
    )
    add_source_options(conversion)

    config = add_command(
        commands, "config", _show_config, "print the settings as TOML, as --config takes them"
    )
    add_settings(config)
    add_tracker_settings(config)
    config.usage = "%(prog)s [flags]"

    add_command(commands, "warmup", _warmup, "compile every loop now, so that no first run has to wait")
    view_command.add_to(commands)
    render_command.add_to(commands)
    masks_command.add_to(commands)
    doctor.add_to(commands)
    completion.add_to(commands, _whole_parser)
    for name, (_, text) in MODULES.items():
        commands.add_parser(name, help=text)
    return parser


def _whole_parser() -> Parser:
    """Return the parser of the command line, with those of the commands that read their own flags in it."""
    parser = _parser()
    commands = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    for name, (module, _) in MODULES.items():
        own = importlib.import_module(module)._parser()
        own.prog = f"headvox {name}"
        commands.choices[name] = own
    return parser


if __name__ == "__main__":
    sys.exit(main())
