"""One row a head. A frame without heads has no row; JSON lines keep those too."""

from __future__ import annotations

from pathlib import Path

from headvox.data import Head
from headvox.sinks import Result
from headvox.sinks.jsonl import DIGITS, METRE_DIGITS, number
from headvox.sinks.linefile import LineFile

COLUMNS = (
    "frame", "stamp_ns", "latency_ms", "id", "x", "y", "z", "qx", "qy", "qz", "qw", "radius", "score",
    "vx", "vy", "vz",
)  # fmt: skip


class CsvFile:
    """Writes a file: a header, then a row a head; an unknown value is an empty field."""

    def __init__(self, path: Path) -> None:
        self._file = LineFile(path)
        self._file.line(",".join(COLUMNS))

    def write(self, result: Result) -> None:
        """Write the rows of one frame."""
        rows = [_row(result, head) for head in result.heads]
        if rows:
            self._file.line("\n".join(rows))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _row(result: Result, head: Head) -> str:
    fields = [
        result.frame,
        result.stamp_ns,
        number(result.latency_ms, 3),
        None,
        *(number(value, METRE_DIGITS) for value in head.centre),
        *(number(value, DIGITS) for value in head.quaternion),
        number(head.radius, METRE_DIGITS),
        number(head.score, DIGITS),
        *(None, None, None),
    ]
    return ",".join("" if field is None else str(field) for field in fields)
