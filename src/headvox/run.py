"""The loop: source -> detector -> sinks, and an account of how it went."""

from __future__ import annotations

import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Protocol

from headvox.data import BadFrame, Expected, Frame, Heads, Tracks
from headvox.errors import HeadvoxError
from headvox.sinks import Result, Sink
from headvox.sources import Source

if TYPE_CHECKING:
    from headvox.tracking.tracker import Tracker

RECENT = 100_000  # frames that the percentiles look back over: a run may last for weeks
UNTRACKED = {
    "repeated": "frames with the stamp of the one before, not tracked",
    "late": "frames with an earlier stamp, not tracked",
    "resets": "jumps back in time, tracks begun anew",
}
"""What the counts of :attr:`Report.untracked` are, in words."""


class FrameDetector(Protocol):
    """What the loop needs of a :class:`~headvox.pipeline.Detector`."""

    stage_ms: dict[str, float]

    def detect_frame(self, frame: Frame, expected: Expected | None = None) -> Heads:
        """Return the heads in one frame; ``expected`` tells where a tracker expects them."""
        ...


def _recent() -> deque[float]:
    return deque(maxlen=RECENT)


@dataclass(slots=True)
class Report:
    """How a run went so far; ``stage_ms`` and ``latency_ms`` have a number for each of the last frames."""

    frames: int = 0
    """Frames that the source gave, bad ones included."""
    bad: int = 0
    heads: int = 0
    """Heads that were found; those that a tracker only expects do not count."""
    frames_with_heads: int = 0
    ids: int | None = None
    """How many heads were given an id; None without a tracker."""
    untracked: dict[str, int] = field(default_factory=dict)
    """Frames whose stamp did not go on, by what was wrong: see :class:`~headvox.tracking.tracker.Tracker`."""
    seconds: float = 0.0
    """Wall time of the whole loop: reading, detecting, writing."""
    latency_ms: deque[float] = field(default_factory=_recent)
    stage_ms: dict[str, deque[float]] = field(default_factory=dict)
    last: Result | None = None
    interrupted: bool = False

    def add(self, result: Result, stage_ms: dict[str, float]) -> None:
        """Count a good frame."""
        self.heads += len(result.heads)
        self.frames_with_heads += len(result.heads) > 0
        self.latency_ms.append(result.latency_ms)
        for stage, ms in stage_ms.items():
            self.stage_ms.setdefault(stage, _recent()).append(ms)
        self.last = result


def run(
    source: Source,
    detector: FrameDetector,
    sinks: Sequence[Sink] = (),
    *,
    tracker: Tracker | None = None,
    strict: bool = False,
    limit: int | None = None,
    on_bad: Callable[[int, str], None] | None = None,
    on_frame: Callable[[Report], None] | None = None,
    on_result: Callable[[Frame, Result], None] | None = None,
) -> Report:
    """Run ``detector`` and ``tracker`` over ``source``, hand each result to every sink, and return what happened.

    A frame that cannot be read or used is counted, told to ``on_bad`` (its index, the reason) and skipped.
    ``on_result`` gets every frame that could be used, after the sinks; ``on_frame`` is called after every frame.
    Ctrl-C ends the run as the end of the source does, the report tells. Neither source nor sinks are closed.

    Args:
        tracker: without one, every frame is by itself.
        strict: end at the first bad frame.
        limit: end after this many frames.

    Raises:
        HeadvoxError: no frame at all, none that could be used, or a bad one with ``strict``.
    """
    report = Report()
    begun = time.perf_counter()
    try:
        for index, frame in enumerate(islice(iter(source), limit)):
            report.frames += 1
            try:
                result, stage_ms = look(detector, tracker, frame, index)
            except HeadvoxError as error:
                report.bad += 1
                if strict or source.length == 1:
                    raise HeadvoxError(
                        f"Frame {index}: {error.what}" if strict else error.what, error.do
                    ) from error
                if on_bad is not None:
                    on_bad(index, str(error))
            else:
                report.add(result, stage_ms)
                if tracker is not None:
                    report.ids = tracker.ids_given
                    report.untracked = tracker.untracked
                for sink in sinks:
                    sink.write(result)
                if on_result is not None:
                    assert isinstance(frame, Frame)  # a bad frame has no result
                    on_result(frame, result)
            report.seconds = time.perf_counter() - begun
            if on_frame is not None:
                on_frame(report)
    except KeyboardInterrupt:
        report.interrupted = True
        return report
    check_any(source, report.frames, report.bad)
    return report


def follow(
    frames: Iterable[Frame | BadFrame],
    detector: FrameDetector,
    tracker: Tracker,
    on_bad: Callable[[str], None] | None = None,
) -> Iterator[tuple[Frame, Tracks]]:
    """Yield each of ``frames`` with the heads that are followed in it: for programs of one's own.

    A frame that cannot be read or used, such as an image without any return, is told to ``on_bad`` (the reason), by
    default as a Python warning, and skipped. Heads that were not seen often enough yet have the id 0.

    Raises:
        HeadvoxError: at the end, where there was no frame, or none that could be used.
    """
    tell, good, bad, why = on_bad or _warn, 0, 0, ""
    for frame in frames:
        try:
            if isinstance(frame, BadFrame):
                raise HeadvoxError(frame.reason)
            heads = detector.detect_frame(frame, tracker.expected(frame.stamp_ns))
        except HeadvoxError as error:
            bad, why = bad + 1, str(error)
            tell(why)
            continue
        good += 1
        yield frame, tracker.update(heads, frame)
    if good == 0:
        what = (
            f"none of {bad} frames could be used; the last: {why}" if bad else "there is no frame to follow."
        )
        raise HeadvoxError(what, "" if bad else "Check how it was recorded.")


def _warn(reason: str) -> None:
    warnings.warn(f"headvox: a frame is skipped: {reason}", RuntimeWarning, stacklevel=3)


def check_any(source: Source, frames: int, bad: int) -> None:
    """See that there was something in a source.

    Raises:
        HeadvoxError: there was no frame at all, or none that could be used.
    """
    if frames == 0:
        raise HeadvoxError(f"{source.name}: there is no frame in it.", "Check how it was recorded.")
    if bad == frames:
        raise HeadvoxError(
            f"{source.name}: none of the {frames} frames could be used.", "The reasons are above."
        )


def look(
    detector: FrameDetector, tracker: Tracker | None, frame: Frame | BadFrame, index: int
) -> tuple[Result, dict[str, float]]:
    """Return what was found in a frame, timed, and what each stage took.

    Raises:
        HeadvoxError: the frame could not be read, or cannot be used.
    """
    if isinstance(frame, BadFrame):
        raise HeadvoxError(frame.reason)
    begun = time.perf_counter()
    if tracker is None:
        heads = detector.detect_frame(frame)
        return Result(index, frame.stamp_ns, _ms_since(begun), heads), detector.stage_ms
    expected = tracker.expected(frame.stamp_ns)
    expected_ms = _ms_since(begun)
    heads = detector.detect_frame(frame, expected)
    found = time.perf_counter()
    tracks = tracker.update(heads, frame)
    stage_ms = {**detector.stage_ms, "track": expected_ms + _ms_since(found)}
    return Result(index, frame.stamp_ns, _ms_since(begun), heads, tracks), stage_ms


def _ms_since(begun: float) -> float:
    return 1e3 * (time.perf_counter() - begun)
