"""Many recordings: each is one piece of work, and leaves one file. What is there already is not done again."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from headvox.config import DetectorConfig, TrackerConfig
from headvox.errors import HeadvoxError, Undecided
from headvox.parallel.workers import Workers
from headvox.sinks import Result, Sink
from headvox.sources.options import SourceOptions
from headvox.writable import make_folder

if TYPE_CHECKING:
    from headvox.run import Report

SUFFIX = ".jsonl"


@dataclass(frozen=True, slots=True)
class Settings:
    """What every source is opened and run with, and the folder for the results; no tracker: bare detections."""

    into: Path
    detector: DetectorConfig
    options: SourceOptions
    tracker: TrackerConfig | None

    def target(self, place: str) -> Path:
        """Return the file for the results of one source."""
        return self.into / f"{name_of(place)}{SUFFIX}"


@dataclass(frozen=True, slots=True)
class Done:
    """What came of one recording: how much there was, None where that is not known.

    ``failure`` is one line, if it could not be used, and ``choices`` are lines to choose from, if it can be taken in
    several ways. ``notes`` are the lines that any run has to tell.
    """

    name: str
    frames: int | None = None
    bad: int | None = None
    heads: int | None = None
    was_there: bool = False
    failure: str = ""
    choices: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def run_batch(
    places: Sequence[str], settings: Settings, workers: Workers, on_done: Callable[[Done], None]
) -> list[Done]:
    """Run the detector over each of ``places``, paths or addresses; write NAME.jsonl of each into the folder.

    Lines are those of ``headvox run --json``, but for ``latency_ms``, which is null: the files are the same bytes
    whoever does the work. A file appears when its recording is done. ``on_done`` is told of each, in order.

    Raises:
        HeadvoxError: two of the same name, or a folder that cannot be made.
    """
    names = [name_of(place) for place in places]
    for name in names:
        if names.count(name) > 1:
            raise HeadvoxError(
                f"Two of the sources are called {name}: their results would be one file.",
                "Run them into folders of their own.",
            )
    make_folder(settings.into)
    settings = replace(settings, into=settings.into.absolute())
    every = []
    for done in workers.map(partial(run_one, settings=settings), [_absolute(place) for place in places]):
        on_done(done)
        every.append(done)
    return every


def name_of(place: str) -> str:
    """Return what a recording is called: the last part of its path."""
    return Path(place.rstrip("/")).name.removesuffix(".mcap").removesuffix(".bag")


def _absolute(place: str) -> str:
    from headvox.sources.remote import is_remote

    return place if is_remote(place) else str(Path(place).absolute())


def run_one(place: str, settings: Settings) -> Done:
    """Run over one recording, unless its file is there."""
    name = name_of(place)
    target = settings.target(place)
    if target.exists():
        return Done(name, was_there=True)
    part = target.with_name(f"{target.name}.{os.getpid()}.part")
    notes: list[str] = []
    try:
        report = _run(place, part, settings, notes.append)
        os.replace(part, target)
        return Done(name, report.frames, report.bad, report.heads, notes=tuple(notes))
    except HeadvoxError as error:
        choices = error.choices if isinstance(error, Undecided) else ()
        return Done(name, failure=str(error), choices=choices, notes=tuple(notes))
    finally:  # whatever ends it, Ctrl-C too: what is not whole is nothing
        part.unlink(missing_ok=True)


def _run(place: str, part: Path, settings: Settings, tell: Callable[[str], None]) -> Report:
    from headvox.pipeline import Detector
    from headvox.remarks import Remarks
    from headvox.run import run
    from headvox.sinks.jsonl import JsonFile
    from headvox.sources import open_source
    from headvox.sources.remote import fetched
    from headvox.tracking.tracker import Tracker

    with (
        fetched(place) as path,
        closing(open_source(path, settings.options, tell)) as source,
        closing(Detector(settings.detector, note=tell)) as detector,
        closing(_Untimed(JsonFile(part))) as sink,
        closing(Remarks(tell)) as remarks,
    ):
        report = run(
            source,
            detector,
            [sink],
            tracker=None if settings.tracker is None else Tracker(settings.tracker),
            on_bad=remarks.skipped,
            on_result=lambda frame, result: remarks.used(frame),
        )
        remarks.ended(source, report)
    if report.interrupted:
        raise KeyboardInterrupt
    return report


class _Untimed:
    """Leaves the time that a frame took out of what is written."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink

    def write(self, result: Result) -> None:
        self._sink.write(replace(result, latency_ms=math.nan))

    def close(self) -> None:
        self._sink.close()
