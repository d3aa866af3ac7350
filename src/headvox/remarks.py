"""What there is to tell of a run beside its results: frames that are skipped, and what makes it look in vain."""

from __future__ import annotations

from collections.abc import Callable

from headvox.data import Frame
from headvox.run import UNTRACKED, Report
from headvox.sources import Source


class Remarks:
    """Tells lines about the frames of one run, each once.

    Of the frames that are skipped, those with the reason of the one before are only counted; of a floor that is not
    where it should be, the first frame that can be used tells.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._reason = ""
        self._more = 0
        self._any = False

    def skipped(self, index: int, reason: str) -> None:
        """Take the next frame that is skipped."""
        if reason == self._reason:
            self._more += 1
            return
        self.close()
        self._reason = reason
        self._tell(f"frame {index} skipped: {reason}")

    def used(self, frame: Frame) -> None:
        """Take the next frame that could be used."""
        if self._any:
            return
        self._any = True
        from headvox.calibrate.floor import wrong_floor
        from headvox.machine.threads import Threads
        from headvox.organise import Organiser

        note = wrong_floor(Organiser(Threads(1)).organised(frame))
        if note is not None:
            self._tell(note)

    def close(self) -> None:
        """Tell of those that were only counted."""
        if self._more:
            self._tell(f"{self._more} more skipped for the same reason")
        self._more = 0

    def ended(self, source: Source, report: Report) -> None:
        """Tell at the end of a run why nothing may have been found or followed, and what its velocities depend on."""
        from headvox.sources.folder import FolderSource
        from headvox.sources.recording import RecordingSource

        if report.ids and isinstance(source, FolderSource) and source.rate_hz is None:
            self._tell("velocities are for 30 clouds a second, for files have no stamps: see --rate")
        for what, count in report.untracked.items():
            self._tell(f"{count} {UNTRACKED[what]}")
        if report.heads == 0 and not report.interrupted and not isinstance(source, RecordingSource):
            self._tell("no head in any frame: headvox expects metres, and a world whose z points up")
