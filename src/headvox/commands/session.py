"""A source, a detector and a tracker as the flags of a command ask for them, and a live line: ready to run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from headvox.calibrate.floor import wrong_floor
from headvox.commands.flags import config_of, source_options_of, tracker_config_of
from headvox.commands.live import Live
from headvox.config import DetectorConfig
from headvox.data import Frame
from headvox.pipeline import Detector
from headvox.run import Report, run
from headvox.sample import sample_folder
from headvox.sinks import Result, Sink
from headvox.sources import Source, open_source
from headvox.sources.recording import RecordingSource
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
        told_floor = False

        def look_at_floor(frame: Frame, result: Result) -> None:
            nonlocal told_floor
            if not told_floor:
                told_floor = True
                note = wrong_floor(frame)
                if note is not None:
                    self.live.note(f"headvox: {note}")
            if on_result is not None:
                on_result(frame, result)

        if kept_loops() == 0:  # also where nobody watches: silence for so long looks like a hang
            self.live.note("the first run compiles its loops, for half a minute or so, and keeps them")
        self.live.show("getting ready")
        warm_up(self.config)
        with closing(Skipped(self.live.note)) as skipped:
            report = run(
                self.source,
                self.detector,
                sinks,
                tracker=self.tracker,
                strict=self.strict,
                limit=self.limit,
                on_bad=skipped.tell,
                on_frame=self.live.frame,
                on_result=look_at_floor,
            )
        if report.heads == 0 and not report.interrupted and not isinstance(self.source, RecordingSource):
            self.live.note("no head in any frame: headvox expects metres, and a world whose z points up")
        return report


class Skipped:
    """Notes on frames that are skipped: those with the reason of the one before are only counted."""

    def __init__(self, note: Callable[[str], None]) -> None:
        self._note = note
        self._reason = ""
        self._more = 0

    def tell(self, index: int, reason: str) -> None:
        """Take the next frame that is skipped."""
        if reason == self._reason:
            self._more += 1
            return
        self.close()
        self._reason = reason
        self._note(f"headvox: frame {index} skipped: {reason}")

    def close(self) -> None:
        """Tell of those that were only counted."""
        if self._more:
            self._note(f"headvox: {self._more} more skipped for the same reason")
        self._more = 0


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
        notes: list[str] = []
        source = stack.enter_context(closing(open_source(path, source_options_of(args), notes.append)))
        live = stack.enter_context(closing(Live(sys.stderr, source.length)))
        if args.source is None:
            live.note(f"no SOURCE given: running the sample that ships with headvox, {path}")
        for note in notes:
            live.note(f"headvox: {note}")
        detector = stack.enter_context(
            closing(Detector(config, note=lambda text: live.note(f"headvox: {text}")))
        )
        tracker = Tracker(tracker_config) if track else None
        inputs = (path, args.config, args.extrinsics, config.cascade)
        yield Session(source, detector, tracker, live, inputs, config, args.strict, args.limit)
