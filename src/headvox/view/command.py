"""The command ``headvox view``: a run in rerun's viewer, every frame."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from headvox.commands.flags import (
    GOOD,
    INTERRUPTED,
    add_command,
    add_settings,
    add_source,
    add_tracker_settings,
    keep_input,
    named,
)

if TYPE_CHECKING:
    from headvox.commands.flags import Commands


def add_to(commands: Commands) -> None:
    """Add ``headvox view`` to the command line."""
    view = add_command(commands, "view", _view, "show what is found, and how, in rerun's viewer")
    add_source(view)
    view.add_argument(
        "-o",
        dest="output",
        type=named(".rrd"),
        metavar="OUT.rrd",
        help="write a file for the viewer instead of showing it",
    )
    add_settings(view)
    add_tracker_settings(view)
    view.usage = "%(prog)s [SOURCE] [-o OUT.rrd] [flags]"


def _view(args: argparse.Namespace) -> int:
    from contextlib import closing

    from headvox.commands.session import opened
    from headvox.sinks.summary import summary
    from headvox.view.watch import Watch, check

    check(args.output)
    with opened(args) as session:
        if args.output is not None:
            keep_input(args.output, session.inputs)
        with closing(Watch(session.detector, args.output, every=True)) as watch:
            report = session.run(on_result=watch.show)
    print(summary(report))
    return INTERRUPTED if report.interrupted else GOOD
