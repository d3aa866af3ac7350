"""Plain tables for people, on any terminal; names that come from files, made harmless."""

from __future__ import annotations

import re
from collections.abc import Sequence


def printable(text: str) -> str:
    """Return ``text`` on one line and without control characters: names in files may hold any."""
    return "".join(c if c.isprintable() else "?" for c in text)


def file_name(text: str) -> str:
    """Return ``text`` as a part of a file's name."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", text)[:60].strip("-") or "unnamed"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return lines of aligned columns: the first to the left; others to the right, unless they hold words.

    ``header`` may be empty.
    """
    cells = [[printable(cell) for cell in row] for row in ([header, *rows] if header else rows)]
    columns = list(zip(*cells, strict=True))
    widths = [max(map(len, column)) for column in columns]
    left = [k == 0 or not all(map(_is_number, column[bool(header) :])) for k, column in enumerate(columns)]
    lines = [
        "  ".join(
            c.ljust(w) if to_left else c.rjust(w) for c, w, to_left in zip(row, widths, left, strict=True)
        )
        for row in cells
    ]
    return "\n".join(line.rstrip() for line in lines)


def _is_number(cell: str) -> bool:
    return not cell or cell[0].isdigit() or cell[0] in "+-"
