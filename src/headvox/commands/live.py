"""The one line on standard error that tells how a run is going, while somebody watches."""

from __future__ import annotations

import time
from typing import TextIO

from headvox.commands.table import printable
from headvox.run import Report

EVERY_S = 0.05  # nobody reads faster, and a slow terminal must not slow the loop


class Live:
    """Notes for a person, and below them a line that is written anew; without a terminal only the notes."""

    def __init__(self, stream: TextIO, length: int | None = None) -> None:
        self._stream = stream
        self.expect(length)
        self._watched = stream.isatty()
        self._shown = 0
        self._next = 0.0

    def expect(self, length: int | None) -> None:
        """Say of how many frames a run will be; None: nobody knows."""
        self._of = "" if length is None else f"/{length}"

    def note(self, text: str) -> None:
        """Write a line that stays."""
        self._wipe()
        self._stream.write(printable(text) + "\n")

    def tell(self, text: str) -> None:
        """Write a line that stays and says who tells it."""
        self.note(f"headvox: {text}")

    def frame(self, report: Report) -> None:
        """Show the state of the run."""
        now = time.monotonic()
        if now < self._next:
            return
        self._next = now + EVERY_S
        hertz = report.frames / report.seconds if report.seconds > 0 else 0.0
        heads, ms = (len(report.last.heads), report.last.latency_ms) if report.last else (0, 0.0)
        rate = f"{hertz:.1f} Hz  {ms:.1f} ms"
        text = f"frame {report.frames}{self._of}  heads {heads}  {rate}  dropped {report.bad}"
        self.show(text)

    def show(self, text: str) -> None:
        """Show ``text`` until the next thing is to be shown."""
        if self._watched:
            self._stream.write("\r" + text.ljust(self._shown))
            self._stream.flush()
            self._shown = len(text)

    def close(self) -> None:
        """Take the live line away."""
        self._wipe()
        self._stream.flush()

    def _wipe(self) -> None:
        if self._shown:
            self._stream.write("\r" + " " * self._shown + "\r")
            self._shown = 0
