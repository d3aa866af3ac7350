"""A text file that is whole lines at every moment."""

from __future__ import annotations

from pathlib import Path

from headvox.errors import HeadvoxError


class LineFile:
    """Writes line by line, unbuffered: whatever ends the program, the file holds every line so far, complete.

    Raises:
        HeadvoxError: the file cannot be made, or the disk is full.
    """

    def __init__(self, path: Path, append: bool = False) -> None:
        self.path = path
        try:
            self._file = path.open("ab" if append else "wb", buffering=0)
        except OSError as error:
            raise HeadvoxError(f"Output {path}: {error.strerror or error}.", "Check the path.") from None

    def line(self, text: str) -> None:
        """Append one line, or several with line feeds between them."""
        data = text.encode() + b"\n"
        try:
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
        self._file.close()
