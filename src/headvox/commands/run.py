"""The command ``headvox run``: heads of one source to the terminal and files, or of many sources to a file each."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

from headvox.commands.flags import (
    GOOD,
    INTERRUPTED,
    KNOWN_ERROR,
    UsageError,
    add_command,
    add_settings,
    add_source,
    add_tracker_settings,
    config_of,
    either,
    keep_input,
    named,
    place,
    source_options_of,
    tracker_config_of,
)
from headvox.commands.table import table
from headvox.parallel.workers import ALONE, add_flags, of_flags
from headvox.sinks import SUFFIXES

if TYPE_CHECKING:
    from headvox.commands.flags import Commands
    from headvox.parallel.batch import Done


def add_to(commands: Commands) -> None:
    """Add ``headvox run`` to the command line."""
    run = add_command(
        commands, "run", _run, "find heads in a recording, a bag, a cloud, or a folder of clouds"
    )
    add_source(run)
    run.add_argument("more", nargs="*", type=place, metavar="SOURCE", help="more of them, with --into")
    run.add_argument(
        "--into",
        type=Path,
        metavar="DIR",
        help="write NAME.jsonl of each source there; what is there already is not done again",
    )
    add_flags(run, 1)
    run.add_argument("--json", action="store_true", help="print one JSON object a frame, and nothing else")
    run.add_argument(
        "-o",
        dest="output",
        type=named(*SUFFIXES),
        metavar="OUT",
        help=f"also write a file: {either(SUFFIXES)}; NAME.tum writes a trajectory a track, NAME_ID.tum",
    )
    run.add_argument(
        "--no-track",
        action="store_true",
        help="every frame by itself: bare detections, without ids and velocities",
    )
    run.add_argument(
        "--view",
        nargs="?",
        const=False,
        type=named(".rrd"),
        metavar="OUT.rrd",
        help="show the run in rerun's viewer, or write a file for it: ten frames a second at most, never waited for",
    )
    add_settings(run)
    add_tracker_settings(run)
    run.usage = (
        "%(prog)s [SOURCE] [--json] [-o OUT] [flags]\n       %(prog)s SOURCE [SOURCE ...] --into DIR [flags]"
    )


def _run(args: argparse.Namespace) -> int:
    if args.into is not None:
        return _run_batch(args)
    if args.more:
        raise UsageError("several sources go with --into DIR, which gets a file of each")
    if of_flags(args) != ALONE:
        raise UsageError("--workers and --scheduler go with --into DIR: they share several sources out")
    if args.no_track and args.output is not None and args.output.suffix == ".tum":
        raise UsageError("-o NAME.tum writes a file a track: it does not go with --no-track")
    from headvox.commands.session import opened
    from headvox.sinks import Sink, open_sink
    from headvox.sinks.jsonl import JsonStream
    from headvox.sinks.summary import summary
    from headvox.sources.bag import BagSource

    with opened(args, track=not args.no_track) as session, ExitStack() as stack:
        sinks: list[Sink] = []
        if args.output is not None:
            source = session.source
            frame = source.frame if isinstance(source, BagSource) else "world"
            # Before the stream: what was printed is in the file, however the run ends.
            keep_input(args.output, session.inputs)
            sinks.append(stack.enter_context(closing(open_sink(args.output, frame))))
        if args.json:
            sinks.append(JsonStream(sys.stdout))
        watch = None
        if args.view is not None:
            from headvox.view.watch import Watch

            if args.view:
                keep_input(args.view, session.inputs)
            watch = stack.enter_context(closing(Watch(session.detector, args.view or None)))
        report = session.run(sinks, on_result=watch.show if watch else None)
        if watch is not None and watch.dropped:
            session.live.note(f"headvox: {watch.dropped} frames were not shown: the viewer was busy")
    if not args.json:
        print(summary(report))
    return INTERRUPTED if report.interrupted else GOOD


def _run_batch(args: argparse.Namespace) -> int:
    if (
        args.json
        or args.output is not None
        or args.view is not None
        or args.strict
        or args.limit
        or args.source is None
    ):
        raise UsageError(
            "--into goes with one SOURCE or more, and with none of --json, -o, --view, --strict and --limit"
        )
    from headvox.commands.live import Live
    from headvox.parallel.batch import Settings, run_batch

    places = [str(place) for place in (args.source, *args.more)]
    tracker = None if args.no_track else tracker_config_of(args)
    settings = Settings(args.into, config_of(args), source_options_of(args), tracker)
    inputs = (*places, args.config, args.extrinsics, settings.detector.cascade)
    for source in places:  # true heads are called heads.jsonl: results of that name would be taken for them
        keep_input(settings.target(source), inputs)
    rows = []
    with closing(Live(sys.stderr)) as live:

        def tell(done: Done) -> None:
            counts = ["-" if n is None else str(n) for n in (done.frames, done.heads, done.bad)]
            rows.append([done.name, *counts, _how(done)])
            for line in (*done.notes, *([done.failure] if done.failure else [])):
                live.tell(f"{done.name}: {line}")
            for choice in done.choices:
                live.note(f"    {choice}")
            live.show(f"{len(rows)} of {len(places)} done")

        every = run_batch(places, settings, of_flags(args), tell)
    print(table(["recording", "frames", "heads", "bad frames", ""], rows))
    return KNOWN_ERROR if any(done.failure for done in every) else GOOD


def _how(done: Done) -> str:
    if done.failure:
        return "failed"
    return "was there already" if done.was_there else "done"
