"""Can what is made be written where it is to go? Better asked before hours of work than after."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryFile

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


def make_folder(folder: Path, named: Path | None = None) -> None:
    """Make a folder, and those that it lies in, where there is none; ``named`` is what it is called in the error.

    Raises:
        HeadvoxError: it cannot be made, or no file can be written into it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=folder).close()
    except OSError as error:
        raise HeadvoxError(
            f"Output {named or folder}: {error.strerror or error}.", "Choose another folder."
        ) from None
