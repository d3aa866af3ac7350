"""Where results go.

The contract: ``write`` takes the results in frame order, one call a frame that could be used, and never waits
for anyone but the disk; ``close`` may be called at any time and more than once, and leaves what was written
complete. A sink raises :class:`~headvox.errors.HeadvoxError` when its file cannot be made.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from headvox.errors import HeadvoxError

if TYPE_CHECKING:
    from headvox.data import Heads, Track, Tracks

SUFFIXES = (".jsonl", ".csv", ".tum", ".mcap")


@dataclass(frozen=True, slots=True)
class Result:
    """What was found in one frame.

    ``frame`` counts the frames of the source from 0, bad ones included; ``latency_ms`` is the time of the
    detection and tracking, without reading the frame. ``tracks`` is None where nothing is tracked.
    """

    frame: int
    stamp_ns: int
    latency_ms: float
    heads: Heads
    tracks: Tracks | None = None

    def rows(self) -> Iterator[Track]:
        """Return what there is to write, a row a head: the tracks, or the bare heads where nothing is tracked."""
        from headvox.data import Track, sigmas

        if self.tracks is not None:
            return iter(self.tracks)
        heads = self.heads
        return (
            Track(
                0, None, head.centre, (math.nan,) * 3, head.quaternion, head.radius, head.score,
                sigmas(heads.centre_covariances[n]), sigmas(heads.rotation_covariances[n]),
            )
            for n, head in enumerate(heads)
        )  # fmt: skip


class Sink(Protocol):
    """Something that takes results."""

    def write(self, result: Result) -> None:
        """Take the result of one frame."""
        ...

    def close(self) -> None:
        """Finish."""
        ...


def open_sink(path: Path, frame: str = "world") -> Sink:
    """Return a sink that writes ``path``, of the kind that its suffix says; an older file is replaced.

    ``frame`` is what ROS calls the world that the heads are in.

    Raises:
        HeadvoxError: an unknown suffix, or a file that cannot be made.
    """
    if path.suffix == ".jsonl":
        from headvox.sinks.jsonl import JsonFile

        return JsonFile(path)
    if path.suffix == ".csv":
        from headvox.sinks.csvfile import CsvFile

        return CsvFile(path)
    if path.suffix == ".tum":
        from headvox.sinks.tum import TumFiles

        return TumFiles(path)
    if path.suffix == ".mcap":
        from headvox.sinks.mcapfile import McapSink

        return McapSink(path, frame)
    raise HeadvoxError(
        f"Output {path}: expected a name that ends with {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}.",
        "Rename it.",
    )
