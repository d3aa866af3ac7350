"""One row a head. A frame without heads has no row; JSON lines keep those too."""

from __future__ import annotations

from pathlib import Path

from headvox.data import Track
from headvox.sinks.jsonl import DIGITS, METRE_DIGITS, number
from headvox.sinks.linefile import LineFile
from headvox.sinks.result import Result

COLUMNS = (
    "frame", "stamp_ns", "latency_ms", "id", "x", "y", "z", "qx", "qy", "qz", "qw", "radius", "score",
    "vx", "vy", "vz", "state",
)  # fmt: skip


class CsvFile:
    """Writes a file: a header, then a row a head; an unknown value is an empty field."""

    def __init__(self, path: Path) -> None:
        self._file = LineFile(path)
        self._head = [",".join(COLUMNS)]

    def write(self, result: Result) -> None:
        """Write the rows of one frame."""
        lines = self._head + [_row(result, row) for row in result.rows()]
        if lines:
            self._file.line("\n".join(lines))
        self._head = []

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _row(result: Result, row: Track) -> str:
    fields = [
        result.frame,
        result.stamp_ns,
        number(result.latency_ms, 3),
        row.id or None,
        *(number(value, METRE_DIGITS) for value in row.centre),
        *(number(value, DIGITS) for value in row.quaternion),
        number(row.radius, METRE_DIGITS),
        number(row.score, DIGITS),
        *(number(value, METRE_DIGITS) for value in row.velocity),
        None if row.state is None else row.state.name.lower(),
    ]
    return ",".join("" if field is None else str(field) for field in fields)
