"""The loop and its account, with a source and a detector made of lists."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from headvox.data import BadFrame, Expected, Frame, Heads
from headvox.errors import HeadvoxError
from headvox.run import Report, follow, run
from headvox.sinks import Result
from headvox.sinks.summary import summary
from headvox.tracking.tracker import Tracker

HEADS = Heads(np.zeros((2, 3)), np.full((2, 4), np.nan), np.full(2, 0.1), np.array([2.0, 1.0]))


class ListSource:
    name = "list"

    def __init__(self, *frames: Frame | BadFrame | BaseException) -> None:
        self.frames = frames
        self.length: int | None = len(frames)

    def __iter__(self) -> Iterator[Frame | BadFrame]:
        for frame in self.frames:
            if isinstance(frame, BaseException):
                raise frame
            yield frame

    def close(self) -> None:
        pass


class TwoHeads:
    """Finds two heads, or finds fault with frames of negative time."""

    def __init__(self) -> None:
        self.stage_ms = {"look": 1.0}

    def detect_frame(self, frame: Frame, expected: Expected | None = None) -> Heads:
        if frame.stamp_ns < 0:
            raise HeadvoxError("Before time.", "Wait.")
        return HEADS


class Keep:
    def __init__(self) -> None:
        self.results: list[Result] = []

    def write(self, result: Result) -> None:
        self.results.append(result)

    def close(self) -> None:
        pass


def test_every_frame_is_counted_and_good_ones_are_written() -> None:
    kept, told, seen = Keep(), [], []
    source = ListSource(Frame(10), BadFrame(20, "torn"), Frame(-1), Frame(40))
    report = run(
        source,
        TwoHeads(),
        [kept],
        on_bad=lambda index, reason: told.append((index, reason)),
        on_frame=lambda report: seen.append(report.frames),
    )
    assert [(result.frame, result.stamp_ns) for result in kept.results] == [(0, 10), (3, 40)]
    assert told == [(1, "torn"), (2, "Before time. Wait.")]
    assert seen == [1, 2, 3, 4]
    assert (report.frames, report.bad, report.heads, report.frames_with_heads) == (4, 2, 4, 2)
    assert list(report.stage_ms["look"]) == [1.0, 1.0]
    assert len(report.latency_ms) == 2
    assert report.last is kept.results[-1]


def test_limit_counts_bad_frames_too() -> None:
    assert run(ListSource(BadFrame(0, "torn"), Frame(1), Frame(2)), TwoHeads(), limit=2).frames == 2


def test_strict_names_the_frame() -> None:
    with pytest.raises(HeadvoxError, match=r"Frame 1: Before time\. Wait\."):
        run(ListSource(Frame(0), Frame(-1)), TwoHeads(), strict=True)


def test_a_single_bad_frame_is_the_error_itself() -> None:
    with pytest.raises(HeadvoxError, match=r"^Before time"):
        run(ListSource(Frame(-1)), TwoHeads())


def test_nothing_and_nothing_good_are_errors() -> None:
    with pytest.raises(HeadvoxError, match="no frame"):
        run(ListSource(), TwoHeads())
    with pytest.raises(HeadvoxError, match="none of the 2 frames"):
        run(ListSource(BadFrame(0, "torn"), Frame(-1)), TwoHeads())


def test_ctrl_c_keeps_the_account() -> None:
    report = run(ListSource(Frame(0), KeyboardInterrupt(), Frame(1)), TwoHeads())
    assert report.interrupted
    assert report.frames == 1
    assert run(ListSource(KeyboardInterrupt()), TwoHeads()).interrupted


def test_an_error_of_the_source_goes_through() -> None:
    with pytest.raises(HeadvoxError, match="torn off"):
        run(ListSource(Frame(0), HeadvoxError("The file is torn off.")), TwoHeads())


def test_the_summary_of_a_run_without_good_frames_has_no_times() -> None:
    assert "ms a frame" not in summary(Report(interrupted=True))
    assert summary(run(ListSource(Frame(0)), TwoHeads())).startswith("head ")
    assert summary(run(ListSource(Frame(0), Frame(1)), TwoHeads())).startswith("frames ")


def times(told: list[str], *stamps: int) -> list[int]:
    """The stamps of the frames that are followed; those before 0 cannot be used."""
    frames = [BadFrame(0, "cut off") if stamp == 7 else Frame(stamp) for stamp in stamps]
    return [frame.stamp_ns for frame, _ in follow(frames, TwoHeads(), Tracker(), told.append)]


def test_to_follow_skips_what_cannot_be_used_and_says_why() -> None:
    told: list[str] = []
    assert times(told, 10, -1, 20, 7, 30) == [10, 20, 30]
    assert told == ["Before time. Wait.", "cut off"]
    with pytest.warns(RuntimeWarning, match=r"headvox: a frame is skipped: Before time\. Wait\."):
        assert len(list(follow([Frame(0), Frame(-1)], TwoHeads(), Tracker()))) == 1


def test_to_follow_tells_where_heads_are_expected() -> None:
    expected: list[int] = []

    class Asked(TwoHeads):
        def detect_frame(self, frame: Frame, expected_: Expected | None = None) -> Heads:
            expected.append(0 if expected_ is None else len(expected_))
            return HEADS

    frames = [Frame(k * 33_000_000) for k in range(12)]
    ids = [[track.id for track in tracks] for _, tracks in follow(frames, Asked(), Tracker())]
    assert (ids[0], expected[0]) == ([0, 0], 0)
    assert (ids[-1], expected[-1]) == ([1, 2], 2)


@pytest.mark.parametrize(
    ("stamps", "says"),
    [
        ((), "there is no frame to follow"),
        ((-1, -2), "none of 2 frames could be used; the last: Before time"),
    ],
)
def test_to_follow_what_cannot_be_used_at_all_is_an_error(stamps: tuple[int, ...], says: str) -> None:
    with pytest.raises(HeadvoxError, match=says):
        times([], *stamps)


def test_what_the_caller_raises_is_his() -> None:
    told: list[str] = []

    def fails_in_the_loop() -> None:
        for _ in follow([Frame(0), Frame(1)], TwoHeads(), Tracker(), told.append):
            raise HeadvoxError("mine")

    with pytest.raises(HeadvoxError, match="mine"):
        fails_in_the_loop()
    assert told == []
