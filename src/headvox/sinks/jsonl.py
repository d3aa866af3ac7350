"""One JSON object a line: what ``headvox run --json`` prints and what a ``.jsonl`` file holds."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TextIO

from headvox.data import Track
from headvox.sinks.linefile import LineFile
from headvox.sinks.result import Result

METRE_DIGITS = 4  # 0.1 mm, far below what any depth camera can tell
DEGREE_DIGITS = 2
DIGITS = 6


class JsonStream:
    """Writes to an open text stream, each line at once: the reader of a pipe does not wait for the next."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, result: Result) -> None:
        """Write one line."""
        self._stream.write(to_json(result) + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Do nothing: the stream belongs to the caller."""


class JsonFile:
    """Writes a file."""

    def __init__(self, path: Path) -> None:
        self._file = LineFile(path)

    def write(self, result: Result) -> None:
        """Write one line."""
        self._file.line(to_json(result))

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def to_json(result: Result) -> str:
    """Return ``result`` as a line of JSON: unknown values as null.

    Metres are told to 0.1 mm, degrees to 0.01, others to 1e-6.
    """
    return json.dumps(
        {
            "stamp_ns": result.stamp_ns,
            "frame": result.frame,
            "latency_ms": number(result.latency_ms, 3),
            "heads": [_head(row) for row in result.rows()],
        },
        allow_nan=False,
    )


def _head(row: Track) -> dict[str, object]:
    head: dict[str, object] = {
        "id": row.id or None,
        "centre": _numbers(row.centre, METRE_DIGITS),
        "quaternion": _numbers(row.quaternion, DIGITS),
        "radius": number(row.radius, METRE_DIGITS),
        "score": number(row.score, DIGITS),
        "velocity": _numbers(row.velocity, METRE_DIGITS),
        "centre_sigma": _numbers(row.centre_sigma, METRE_DIGITS),
        "rotation_sigma": _numbers(map(math.degrees, row.rotation_sigma), DEGREE_DIGITS),
    }
    if row.state is not None:
        head["state"] = row.state.name.lower()
    return head


def _numbers(values: Iterable[float], digits: int) -> list[float | None] | None:
    """Return the rounded values, or null when none of them is known."""
    rounded = [number(value, digits) for value in values]
    return None if all(value is None for value in rounded) else rounded


def number(value: float, digits: int) -> float | None:
    """Return ``value`` rounded, never -0; None for NaN and infinity, which JSON does not have."""
    return round(float(value), digits) + 0.0 if math.isfinite(value) else None
