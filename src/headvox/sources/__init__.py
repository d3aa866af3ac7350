"""Where frames come from.

The contract: a source is iterated once, in time order; it yields a :class:`~headvox.data.Frame` for what it could
read and a :class:`~headvox.data.BadFrame` for what it could not; ``len`` frames in all, or ``length`` is None when
nobody knows; ``close`` may be called at any time and more than once. A source raises
:class:`~headvox.errors.HeadvoxError` when the input as a whole cannot be used.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from headvox.data import BadFrame, Frame


class Source(Protocol):
    """Something that yields frames."""

    name: str
    length: int | None

    def __iter__(self) -> Iterator[Frame | BadFrame]:
        """Yield the frames in time order."""
        ...

    def close(self) -> None:
        """Release files and devices."""
        ...
