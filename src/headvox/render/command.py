"""The command ``headvox render``: pictures of a run, for a paper or a README, with no display."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from headvox.commands.flags import (
    GOOD,
    INTERRUPTED,
    UsageError,
    add_command,
    add_settings,
    add_source,
    add_tracker_settings,
    keep_input,
    named,
    seed_number,
)

if TYPE_CHECKING:
    from headvox.commands.flags import Commands
    from headvox.data import Frame
    from headvox.sinks import Result

SUFFIXES = (".gif", ".mp4", ".png")
NARROWEST, WIDEST = 320, 4096


def add_to(commands: Commands) -> None:
    """Add ``headvox render`` to the command line."""
    render = add_command(commands, "render", _render, "draw what is found, as an mp4, a gif or a png")
    add_source(render)
    render.add_argument(
        "-o",
        dest="output",
        type=named(*SUFFIXES),
        required=True,
        metavar="OUT",
        help="NAME.mp4, NAME.gif or NAME.png",
    )
    render.add_argument(
        "--at", type=seed_number, metavar="N", help="of a png: which frame, from 0; without it, the last"
    )
    render.add_argument("--width", type=_width, default=1200, metavar="PIXELS", help="of the picture (1200)")
    add_settings(render)
    add_tracker_settings(render)
    render.usage = "%(prog)s [SOURCE] -o OUT [flags]"


def _width(text: str) -> int:
    value = int(text)
    if not NARROWEST <= value <= WIDEST:
        raise argparse.ArgumentTypeError(f"expected {NARROWEST} to {WIDEST} pixels, got {text!r}")
    return value


def _render(args: argparse.Namespace) -> int:
    still = args.output.suffix == ".png"
    if args.at is not None:
        if not still:
            raise UsageError("--at goes with -o NAME.png only")
        if args.limit is not None:
            raise UsageError("--at and --limit both say where to stop: give one of them")
        args.limit = args.at + 1
    from headvox.commands.session import opened
    from headvox.commands.table import printable
    from headvox.errors import HeadvoxError
    from headvox.render.film import open_film
    from headvox.render.sheet import Sheets

    with opened(args) as session:
        keep_input(args.output, session.inputs)
        sheets, film = Sheets(args.width), open_film(args.output)
        last: list[tuple[Frame, Result]] = []

        def draw(frame: Frame, result: Result) -> None:
            sheets.follow(result)
            if still:
                last[:] = [(frame, result)]
            else:
                film.add(sheets.draw(frame, result), result.stamp_ns)

        with film:
            report = session.run(on_result=draw)
            for frame, result in last:
                if args.at is not None and result.frame != args.at:
                    raise HeadvoxError(
                        f"Frame {args.at} cannot be drawn: the source has {report.frames} frames, {report.bad} bad.",
                        "Give --at another number.",
                    )
                film.add(sheets.draw(frame, result), result.stamp_ns)
    print(printable(str(args.output)))
    return INTERRUPTED if report.interrupted else GOOD
