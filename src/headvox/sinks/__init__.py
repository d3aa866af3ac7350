"""Where results go.

The contract: ``write`` takes the results in frame order, one call a frame that could be used, and never waits
for anyone but the disk; ``close`` may be called at any time and more than once, and leaves what was written
complete. A sink raises :class:`~headvox.errors.HeadvoxError` when its file cannot be made.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from headvox.errors import HeadvoxError

if TYPE_CHECKING:
    from headvox.data import Heads

SUFFIXES = (".jsonl", ".csv")


@dataclass(frozen=True, slots=True)
class Result:
    """What was found in one frame.

    ``frame`` counts the frames of the source from 0, bad ones included; ``latency_ms`` is the time of the
    detection alone, without reading the frame.
    """

    frame: int
    stamp_ns: int
    latency_ms: float
    heads: Heads


class Sink(Protocol):
    """Something that takes results."""

    def write(self, result: Result) -> None:
        """Take the result of one frame."""
        ...

    def close(self) -> None:
        """Finish."""
        ...


def open_sink(path: Path) -> Sink:
    """Return a sink that writes ``path``, of the kind that its suffix says; an older file is replaced.

    Raises:
        HeadvoxError: an unknown suffix, or a file that cannot be made.
    """
    if path.suffix == ".jsonl":
        from headvox.sinks.jsonl import JsonFile

        return JsonFile(path)
    if path.suffix == ".csv":
        from headvox.sinks.csvfile import CsvFile

        return CsvFile(path)
    raise HeadvoxError(
        f"Output {path}: expected a name that ends with {' or '.join(SUFFIXES)}.", "Rename it."
    )
