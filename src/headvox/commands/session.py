"""A source, a detector and a tracker as the flags of a command ask for them, and a live line: ready to run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from headvox.commands.flags import config_of, source_options_of, tracker_config_of
from headvox.commands.live import Live
from headvox.config import DetectorConfig
from headvox.data import Frame
from headvox.pipeline import Detector
from headvox.remarks import Remarks
from headvox.run import Report, run
from headvox.sample import sample_folder
from headvox.sinks import Result, Sink
from headvox.sources import Source, open_source
from headvox.sources.remote import fetched
from headvox.tracking.tracker import Tracker
from headvox.warmup import kept_loops, warm_up


@dataclass(frozen=True, slots=True)
class Session:
    """What a run needs. ``inputs`` are the files and folders that it reads."""

    source: Source
    detector: Detector
    tracker: Tracker | None
    live: Live
    inputs: tuple[str | Path | None, ...]
    config: DetectorConfig
    strict: bool
    limit: int | None

    def run(
        self, sinks: Sequence[Sink] = (), on_result: Callable[[Frame, Result], None] | None = None
    ) -> Report:
        """Warm up, go through the source as :func:`headvox.run.run` does, and return how it went.

        Raises:
            HeadvoxError: no frame could be used, or a bad one with ``--strict``.
        """
        if kept_loops() == 0:  # also where nobody watches: silence for so long looks like a hang
            self.live.note("the first run compiles its loops, for half a minute or so, and keeps them")
        self.live.show("getting ready")
        warm_up(self.config)
        with closing(Remarks(self.live.tell)) as remarks:

            def show(frame: Frame, result: Result) -> None:
                remarks.used(frame)
                if on_result is not None:
                    on_result(frame, result)

            report = run(
                self.source,
                self.detector,
                sinks,
                tracker=self.tracker,
                strict=self.strict,
                limit=self.limit,
                on_bad=remarks.skipped,
                on_frame=self.live.frame,
                on_result=show,
            )
        remarks.ended(self.source, report)
        return report


@contextmanager
def opened(args: argparse.Namespace, track: bool = True) -> Iterator[Session]:
    """Yield what the flags of :mod:`headvox.commands.flags` ask for; all of it is closed after.

    Raises:
        UsageError: flags that do not go together.
        HeadvoxError: a source or settings that cannot be used.
    """
    config, tracker_config = config_of(args), tracker_config_of(args)
    with ExitStack() as stack:
        path = stack.enter_context(fetched(args.source)) if args.source else sample_folder()
        live = stack.enter_context(closing(Live(sys.stderr)))
        if args.source is None:
            live.note(f"no SOURCE given: running the sample that ships with headvox, {path}")
        source = stack.enter_context(closing(open_source(path, source_options_of(args), live.tell)))
        live.expect(source.length)
        detector = stack.enter_context(closing(Detector(config, note=live.tell)))
        tracker = Tracker(tracker_config) if track else None
        inputs = (path, args.config, args.extrinsics, config.cascade)
        yield Session(source, detector, tracker, live, inputs, config, args.strict, args.limit)
