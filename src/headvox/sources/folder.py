"""A folder of point-cloud files, a frame each."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from headvox.data import BadFrame, Frame
from headvox.errors import HeadvoxError
from headvox.sources.cloudfile import OF_DEPTH, SUFFIXES, read_cloud

if TYPE_CHECKING:
    from headvox.sources.mounting import Mounting

FRAME_NS = 33_333_333  # files have no stamps: unless somebody says, they are taken to be 30 a second
RATES_HZ = 0.001, 10_000.0  # what a rate may be


class FolderSource:
    """The point-cloud files of a folder in natural order of their names, 1/30 s apart or as ``rate_hz`` says.

    Files that do not end in ply, pcd, npy or npz, hidden files and folders inside are passed over. A file
    that cannot be used is a :class:`~headvox.data.BadFrame`, and keeps its place in time.
    """

    length: int | None

    def __init__(self, folder: Path, rate_hz: float | None = None, mounting: Mounting | None = None) -> None:
        """Raise HeadvoxError where the folder cannot be read or has no point-cloud file, or of a rate that is none."""
        if rate_hz is not None and not RATES_HZ[0] <= rate_hz <= RATES_HZ[1]:
            raise HeadvoxError(
                f"--rate: expected {RATES_HZ[0]:g} to {RATES_HZ[1]:g} clouds a second, got {rate_hz!r}.",
                "Say how many were recorded a second.",
            )
        self.name = folder.name or str(folder)
        self.paths = _cloud_paths(folder)
        self.length = len(self.paths)
        self.rate_hz = rate_hz
        """As it was given; None: it is assumed."""
        self.mounting = mounting
        self._open = True

    def __iter__(self) -> Iterator[Frame | BadFrame]:
        """Yield a frame a file, until closed."""
        for index, path in enumerate(self.paths):
            if not self._open:
                return
            stamp_ns = self.stamp_ns(index)
            try:
                frame = Frame(stamp_ns, clouds=(read_cloud(path, self.mounting),))
            except HeadvoxError as error:
                yield BadFrame(stamp_ns, str(error))
            else:
                yield frame

    def stamp_ns(self, index: int) -> int:
        """Return the stamp of a file, by its place in the order."""
        return index * FRAME_NS if self.rate_hz is None else round(index * 1e9 / self.rate_hz)

    def close(self) -> None:
        """End the iteration."""
        self._open = False


def natural_key(name: str) -> tuple[tuple[int, str], ...]:
    """Return what sorts ``frame2`` before ``frame10``."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return tuple((int(part), part) if part[0] in "0123456789" else (-1, part) for part in parts)


def _cloud_paths(folder: Path) -> list[Path]:
    try:
        paths = [
            path
            for path in folder.iterdir()
            if path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and not path.is_dir()
        ]
    except OSError as error:
        raise HeadvoxError(
            f"{folder}: cannot be read: {error.strerror}.", "Check the path and its permissions."
        ) from None
    if not paths:
        has_images = any(folder.glob("*.png"))
        raise HeadvoxError(
            f"{folder}: the folder holds neither recording.json nor any file that ends in "
            f"{', '.join(SUFFIXES)}.",
            OF_DEPTH if has_images else "Give the folder of a recording, or a folder of point clouds.",
        )
    return sorted(paths, key=lambda path: natural_key(path.name))
