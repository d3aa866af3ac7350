"""Can a file be written where it is to go? Better asked before hours of work than after."""

from __future__ import annotations

from pathlib import Path

from headvox.errors import HeadvoxError


def check_file(path: Path) -> None:
    """Raise what would keep a file from being written at ``path``; what stands there stays as it is.

    Raises:
        HeadvoxError: its folder is missing or cannot be written, or what stands there can not.
    """
    try:
        target = path.resolve()  # a link may lead to where nothing is yet
        if not target.exists():
            target.open("xb").close()
            target.unlink()
        elif not target.is_fifo():  # whose reader would take this for all there is
            target.open("ab").close()
    except OSError as error:
        raise HeadvoxError(f"Output {path}: {error.strerror or error}.", "Check the path.") from None
