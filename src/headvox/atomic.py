"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8; what stood at ``path`` stays until all of it is written.

    The spare file has the same name each time, so that the next try takes away what a killed one has left.

    Raises:
        OSError: it cannot be written; what was begun is removed.
    """
    part = path.with_name(path.name + ".part")
    try:
        part.write_text(text, encoding="utf-8")
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
