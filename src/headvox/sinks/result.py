"""What was found in a frame, and what takes it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from headvox.data import Heads, Track, Tracks


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
    """Something that takes results.

    ``write`` takes the results in frame order, one call a frame that could be used, and never waits for anyone but the
    disk; ``close`` may be called at any time and more than once, and leaves what was written complete. A sink raises
    :class:`~headvox.errors.HeadvoxError` when its file cannot be made.
    """

    def write(self, result: Result) -> None:
        """Take the result of one frame."""
        ...

    def close(self) -> None:
        """Finish."""
        ...
