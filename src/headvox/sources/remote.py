"""Recordings that lie elsewhere: brought here as a whole, looked at, and removed.

``s3://bucket/recording``, ``gs://...``, ``https://...``: whatever fsspec has a file system for. Only what is asked for
is on the disk, one recording for each process that reads.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from headvox.errors import HeadvoxError, MissingExtra


def is_remote(place: str | os.PathLike[str]) -> bool:
    """Tell an address from a path on this machine."""
    return "://" in str(place)


@contextmanager
def fetched(place: str | os.PathLike[str]) -> Iterator[Path]:
    """Give the path of a recording or a file; one that lies elsewhere is brought here for as long as this lasts.

    Raises:
        HeadvoxError: fsspec or what it needs for this address is not installed, there is nothing there, or it cannot
            be read.
    """
    if not is_remote(place):
        yield Path(place)
        return
    address = str(place).rstrip("/")
    try:
        import fsspec
    except ImportError:
        raise MissingExtra(f"{address}: to read it takes fsspec.", "cluster") from None
    with tempfile.TemporaryDirectory(prefix="headvox-") as folder:
        try:
            files, root = fsspec.core.url_to_fs(address)
            found = files.isdir(root), files.isfile(root)
        except ImportError as error:  # fsspec tells which package has the file system
            raise HeadvoxError(f"{address}: {error}.", "Install that package.") from None
        except (OSError, ValueError) as error:
            raise HeadvoxError(
                f"{address}: cannot be reached: {error}.", "Check the address, and the rights."
            ) from None
        if not any(found):
            raise HeadvoxError(f"{address}: there is nothing there.", "Check the address.")
        target = Path(folder) / (root.rstrip("/").rsplit("/", 1)[-1] or "recording")
        try:
            files.get(root, str(target), recursive=found[0])
        except OSError as error:
            raise HeadvoxError(f"{address}: cannot be read: {error}.", "Is there room on the disk?") from None
        yield target
