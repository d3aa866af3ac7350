"""What a run shows of itself: a letter a frame, for the process that talks to rerun."""

from __future__ import annotations

import importlib.util
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from headvox.data import F64, Frame
from headvox.errors import HeadvoxError, MissingExtra
from headvox.sinks import Result
from headvox.view.mailbox import Mailbox
from headvox.writable import check_file

SHOWN_HZ = 10
"""How many frames of a second are shown at most, unless all are wanted: what draws them leaves the loop cold caches."""

if TYPE_CHECKING:
    from headvox.pipeline import Detector


@dataclass(frozen=True, slots=True)
class Seen:
    """What there is to show of a frame."""

    frame: Frame
    result: Result
    candidates: F64
    """(N, 3) metres, world: the voxels that passed the gate."""
    votes: F64
    """(N,) what the second stage gave each of them; NaN where it dropped it."""
    stage_ms: dict[str, float]


class Watch:
    """Shows frames in rerun's viewer, or writes them to an rrd file: at most :data:`SHOWN_HZ` a second of their stamps.

    ``dropped`` counts those that were not shown because the viewer was busy.
    """

    def __init__(self, detector: Detector, path: Path | None = None, every: bool = False) -> None:
        """Start the process that logs.

        Args:
            detector: what finds the heads of the frames that are shown.
            path: an rrd file to write; without one the viewer is started, or the one that runs already used.
            every: show every frame, whatever their rate, and wait for the viewer.

        Raises:
            HeadvoxError: rerun is not installed, there is no display, or the file cannot be made.
        """
        check(path)
        self._detector = detector
        self._every = every
        self._slot: int | None = None
        command = ["-m", "headvox.view.log", "every" if every else "newest"]
        self._mailbox = Mailbox([*command, *([] if path is None else [str(path)])], every)

    @property
    def dropped(self) -> int:
        """How many frames were not shown so far."""
        return self._mailbox.dropped

    def show(self, frame: Frame, result: Result) -> None:
        """Hand over the frame that the detector has just looked at, unless its share of a second had one already."""
        slot = frame.stamp_ns * SHOWN_HZ // 10**9
        if slot == self._slot and not self._every:
            return
        self._slot = slot
        candidates, votes = self._detector.candidates_of_last_frame()
        self._mailbox.put(Seen(frame, result, candidates, votes, dict(self._detector.stage_ms)))

    def close(self) -> None:
        """Let what is under way be shown, and end the process; the viewer stays."""
        self._mailbox.close()


def check(path: Path | None) -> None:
    """Raise what would keep frames from being shown, before anything is started.

    Raises:
        HeadvoxError: rerun is not installed, there is no display, or the file cannot be made.
    """
    if importlib.util.find_spec("rerun") is None:
        raise MissingExtra("The viewer needs rerun.", "view")
    if path is not None:
        check_file(path)
    elif sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise HeadvoxError(
            "There is no display to show anything on.",
            "Write a file: view -o NAME.rrd, or run --view NAME.rrd. Or use headvox render.",
        )
