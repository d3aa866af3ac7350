"""Where frames come from.

The contract: a source is iterated once, in time order; it yields a :class:`~headvox.data.Frame` for what it
could read and a :class:`~headvox.data.BadFrame` for what it could not; ``len`` frames in all, or ``length``
is None when nobody knows; ``close`` may be called at any time and more than once. A source raises
:class:`~headvox.errors.HeadvoxError` when the input as a whole cannot be used.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from headvox.data import BadFrame, Frame
from headvox.errors import HeadvoxError


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


def open_source(path: str | os.PathLike[str]) -> Source:
    """Open whatever lies at a path; its kind is told by its content, never by its name.

    A folder with a ``recording.json`` (or that file itself) is a depth recording, any other folder is a
    sequence of point-cloud files in natural order of their names, 1/30 s apart, and a file is one cloud: ply,
    pcd, npy or npz.

    Raises:
        HeadvoxError: there is nothing there, or nothing that headvox can read.
    """
    # The kinds are imported here: `import headvox.sources` is to cost nothing.
    from headvox.sources.cloudfile import CloudFileSource
    from headvox.sources.folder import FolderSource
    from headvox.sources.recording import FILE, RecordingSource

    place = Path(path)
    try:
        if place.is_dir():
            return RecordingSource(place) if (place / FILE).is_file() else FolderSource(place)
    except OSError as error:
        raise HeadvoxError(f"{place}: cannot be read: {error.strerror}.", "Check the path.") from None
    if place.name == FILE:
        return RecordingSource(place.parent)
    return CloudFileSource(place)
