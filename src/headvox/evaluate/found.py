"""Found heads: those of a detector in this process, or the JSON lines that any program wrote."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from headvox.data import F64, I64
from headvox.errors import HeadvoxError
from headvox.evaluate.truth import NO_ID, frame_heads, numbers, quaternion, stamped_lines


@dataclass(frozen=True, slots=True)
class FoundHeads:
    """What was found in one frame, as a structure of arrays.

    ``centres``     (N, 3) float64, metres, world frame
    ``quaternions`` (N, 4) float64, x y z w, world from head; a row of NaN where not stated
    ``scores``      (N,)   float64; NaN where not stated
    ``ids``         (N,)   int64, the track; ``NO_ID`` where not stated
    ``latency_ms``  NaN where nobody measured it
    """

    centres: F64
    quaternions: F64
    scores: F64
    ids: I64
    latency_ms: float = math.nan

    def __len__(self) -> int:
        return len(self.centres)

    @staticmethod
    def none(latency_ms: float = math.nan) -> FoundHeads:
        """Return no heads."""
        return FoundHeads(np.empty((0, 3)), np.empty((0, 4)), np.empty(0), np.empty(0, np.int64), latency_ms)


def read_found(path: Path) -> dict[int, FoundHeads]:
    """Return the heads of every line by its stamp: lines as ``headvox run --json`` prints them.

    Only ``stamp_ns``, ``heads`` and each head's ``centre`` have to be there; ``id`` may be any number or word.

    Raises:
        HeadvoxError: no such file, a line that is not as described, or two lines of one stamp.
    """
    numbered: dict[object, int] = {}
    found: dict[int, FoundHeads] = {}
    for name, stamp_ns, line in stamped_lines(path):
        heads = frame_heads(line, name)
        ids = [head.get("id") for head in heads]
        if not all(value is None or isinstance(value, (int, str)) for value in ids):
            raise HeadvoxError(f"{name}: expected a number, a word or null under 'id'.", "Correct it.")
        found[stamp_ns] = FoundHeads(
            np.array([numbers(head.get("centre"), 3, f"{name}: centre") for head in heads]).reshape(-1, 3),
            np.array([quaternion(head, name) for head in heads]).reshape(-1, 4),
            np.array([_number_or_nan(head.get("score"), f"{name}: score") for head in heads]),
            np.array(
                [NO_ID if value is None else numbered.setdefault(value, len(numbered)) for value in ids],
                np.int64,
            ),
            _number_or_nan(line.get("latency_ms"), f"{name}: latency_ms"),
        )
    return found


def _number_or_nan(value: object, name: str) -> float:
    return math.nan if value is None else numbers([value], 1, name)[0]
