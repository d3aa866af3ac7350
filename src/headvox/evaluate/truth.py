"""True heads: a line a frame in ``heads.jsonl``, as docs/conventions.md describes it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from headvox.data import F64, I64
from headvox.errors import HeadvoxError

FILE = "heads.jsonl"
LEAST_SEEN = 0.15  # a camera that sees less of a head is no view of it
LABELS = ("posture", "hair")
NO_ID = -1
_MAX_BYTES = 256 << 20

Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class TrueHeads:
    """The true heads of one frame, as a structure of arrays.

    ``centres``     (N, 3) float64, metres, world frame
    ``quaternions`` (N, 4) float64, x y z w, world from head; a row of NaN where not known
    ``ids``         (N,)   int64, the person; ``NO_ID`` where not told
    ``ignored``     (N,)   bool: neither hit nor miss
    ``truncated``   (N,)   bool: cut by the border of the image
    ``shares``      for each head, sensor -> the share that is seen by it, 0..1; empty where not told
    ``labels``      name -> N words, "" where not told
    """

    stamp_ns: int
    centres: F64
    quaternions: F64
    ids: I64
    ignored: Bools
    truncated: Bools
    shares: tuple[Mapping[str, float], ...]
    labels: Mapping[str, tuple[str, ...]]

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def visible(self) -> F64:
        """The share of each head (N,) that the sensor that sees most of it sees; NaN where not told."""
        return np.array([max(seen.values(), default=math.nan) for seen in self.shares], np.float64)

    @property
    def views(self) -> F64:
        """How many sensors see at least 15 % of each head (N,); NaN where not told."""
        counts = [sum(share >= LEAST_SEEN for share in seen.values()) for seen in self.shares]
        return np.where([bool(seen) for seen in self.shares], counts, math.nan).astype(np.float64)

    @staticmethod
    def of(stamp_ns: int, heads: Sequence[Mapping[str, Any]], name: str = "heads") -> TrueHeads:
        """Return the heads that entries of ``heads.jsonl`` describe; only ``centre`` has to be there.

        Raises:
            HeadvoxError: an entry that is not as described; ``name`` says where.
        """
        return TrueHeads(
            stamp_ns,
            np.array([numbers(head.get("centre"), 3, f"{name}: centre") for head in heads]).reshape(-1, 3),
            np.array([quaternion(head, name) for head in heads]).reshape(-1, 4),
            np.array([_id(head.get("id"), name) for head in heads], np.int64),
            np.array([_flag(head, "ignore", name) for head in heads], bool),
            np.array([_flag(head, "truncated", name) for head in heads], bool),
            tuple(_shares(head, name) for head in heads),
            {label: tuple(_word(head, label, name) for head in heads) for label in LABELS},
        )


def read_truth(path: Path) -> dict[int, TrueHeads]:
    """Return the heads of every frame whose heads are all known, by its stamp.

    Raises:
        HeadvoxError: no such file, a line that is not as docs/conventions.md has it, or two lines of one stamp.
    """
    truth: dict[int, TrueHeads] = {}
    for name, stamp_ns, line in stamped_lines(path):
        heads = frame_heads(line, name)
        if line.get("exhaustive", True) is True:
            truth[stamp_ns] = TrueHeads.of(stamp_ns, heads, name)
    return truth


def stamped_lines(path: Path) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Yield what :func:`read_lines` does, with the stamp that each line has and no other."""
    known: set[int] = set()
    for name, line in read_lines(path):
        stamp_ns = stamp_of(line, name)
        if stamp_ns in known:
            what = f"{name}: a second line of the stamp {stamp_ns}."
            raise HeadvoxError(what, "Put a frame's heads on one line.")
        known.add(stamp_ns)
        yield name, stamp_ns, line


def read_lines(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the JSON object of each line that is not empty, after the name of its place."""
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise HeadvoxError(f"{path}: more than {_MAX_BYTES >> 20} MB.", "Cut the recording in pieces.")
        text = path.read_text(encoding="utf-8-sig")  # editors of Windows may begin it with a BOM
    except OSError as error:
        raise HeadvoxError(f"{path}: {error.strerror or error}.", "Check the path.") from None
    except UnicodeDecodeError:
        raise HeadvoxError(f"{path}: expected text in UTF-8.", "Is it a file of JSON lines?") from None
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip():
            name = f"{path}, line {number}"
            try:
                content = json.loads(line)
            except (ValueError, RecursionError) as error:
                raise HeadvoxError(
                    f"{name}: no JSON: {str(error)[:100]}.", "Expected one JSON object a line."
                ) from None
            if not isinstance(content, dict):
                raise HeadvoxError(
                    f"{name}: expected an object in braces.", "Expected one JSON object a line."
                )
            yield name, content


def frame_heads(line: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    """Return the entries under "heads" of a line."""
    heads = line.get("heads")
    if not isinstance(heads, list) or not all(isinstance(head, dict) for head in heads):
        raise HeadvoxError(f"{name}: expected a list of objects under 'heads'.", "See docs/conventions.md.")
    return heads


def stamp_of(line: Mapping[str, Any], name: str) -> int:
    """Return the stamp of a line."""
    stamp = line.get("stamp_ns")
    if type(stamp) is not int or not -(2**63) <= stamp < 2**63:
        raise HeadvoxError(f"{name}: expected a whole number under 'stamp_ns'.", "See docs/conventions.md.")
    return stamp


def numbers(value: object, count: int, name: str) -> list[float]:
    """Return ``count`` finite numbers."""
    if not (isinstance(value, list) and len(value) == count and all(map(_is_number, value))):
        raise HeadvoxError(f"{name}: expected {count} finite numbers.", "See docs/conventions.md.")
    return [float(number) for number in value]


def quaternion(head: Mapping[str, Any], name: str) -> list[float]:
    """Return the unit quaternion of an entry, NaN where it is null or not there."""
    if head.get("quaternion") is None:
        return [math.nan] * 4
    values = numbers(head["quaternion"], 4, f"{name}: quaternion")
    norm = math.hypot(*values)
    if not 0.9 < norm < 1.1:
        raise HeadvoxError(
            f"{name}: the quaternion has the norm {norm:.3g}, expected 1.", "Order: x, y, z, w."
        )
    return [value / norm for value in values]


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < 1e9  # neither NaN nor infinite


def _id(value: object, name: str) -> int:
    if value is None:
        return NO_ID
    if type(value) is not int or not 0 <= value < 2**63:
        raise HeadvoxError(f"{name}: expected a whole number or null under 'id'.", "See docs/conventions.md.")
    return value


def _flag(head: Mapping[str, Any], key: str, name: str) -> bool:
    value = head.get(key, False)
    if not isinstance(value, bool):
        raise HeadvoxError(f"{name}: expected true or false under {key!r}.", "See docs/conventions.md.")
    return value


def _word(head: Mapping[str, Any], key: str, name: str) -> str:
    value = head.get(key) or ""
    if not isinstance(value, str):
        raise HeadvoxError(f"{name}: expected a word under {key!r}.", "See docs/conventions.md.")
    return value


def _shares(head: Mapping[str, Any], name: str) -> dict[str, float]:
    shares = head.get("visible") or {}
    if not isinstance(shares, dict):
        raise HeadvoxError(f"{name}: expected camera: share under 'visible'.", "See docs/conventions.md.")
    return dict(zip(shares, numbers(list(shares.values()), len(shares), f"{name}: visible"), strict=True))
