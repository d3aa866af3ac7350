"""A text file that is whole lines at every moment."""

from __future__ import annotations

from io import FileIO
from pathlib import Path
from typing import Literal

from headvox.errors import HeadvoxError
from headvox.writable import check_file


class LineFile:
    """Writes line by line, unbuffered: whatever ends the program, the file holds every line so far, complete.

    An older file is replaced by the first line: without one it stays.

    Raises:
        HeadvoxError: the file cannot be made, or the disk is full.
    """

    def __init__(self, path: Path, append: bool = False) -> None:
        if not append:
            check_file(path)
        self.path = path
        self._mode: Literal["ab", "wb"] = "ab" if append else "wb"
        self._file: FileIO | None = None

    def line(self, text: str) -> None:
        """Append one line, or several with line feeds between them."""
        data = text.encode() + b"\n"
        try:
            if self._file is None:
                self._file = self.path.open(self._mode, buffering=0)
            written = self._file.write(data)
            if written != len(
                data
            ):  # a disk that is nearly full takes a part and says so in the next call only
                self._file.truncate(self._file.tell() - written)
                raise OSError(None, "No space left on device")
        except OSError as error:
            raise HeadvoxError(
                f"Output {self.path}: {error.strerror or error}.", "The lines before are complete."
            ) from None

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
