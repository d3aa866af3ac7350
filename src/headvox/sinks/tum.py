"""A trajectory file a track, as the TUM RGB-D benchmark has them: ``stamp x y z qx qy qz qw`` a line, in seconds."""

from __future__ import annotations

import re
from pathlib import Path

from headvox.data import Track
from headvox.sinks.jsonl import DIGITS, METRE_DIGITS
from headvox.sinks.linefile import LineFile
from headvox.sinks.result import Result
from headvox.writable import check_file


class TumFiles:
    """Writes ``NAME_ID.tum`` for each id, beside where ``NAME.tum`` would be; older files of that kind are removed
    by the first frame.

    An orientation that is not known is ``nan nan nan nan``. A head that is not seen has lines too: where it should be.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._any = False
        check_file(self._file(1))

    def write(self, result: Result) -> None:
        """Write a line for each track that has an id."""
        if not self._any:
            self._any = True
            self._remove_older()
        for row in result.rows():
            if row.id:
                # Opened anew each time: a run may last for weeks, and have more ids than there may be open files.
                file = LineFile(self._file(row.id), append=True)
                file.line(_line(result.stamp_ns, row))
                file.close()

    def close(self) -> None:
        """Do nothing: every file is complete."""

    def _file(self, identity: int) -> Path:
        return self._path.with_name(f"{self._path.stem}_{identity}.tum")

    def _remove_older(self) -> None:
        ours = re.compile(re.escape(self._path.stem) + r"_[1-9][0-9]*\.tum")
        for older in self._path.parent.iterdir():
            if ours.fullmatch(older.name):
                older.unlink()


def _line(stamp_ns: int, row: Track) -> str:
    seconds, rest = divmod(abs(stamp_ns), 1_000_000_000)
    sign = "-" if stamp_ns < 0 else ""
    place = " ".join(f"{value + 0.0:.{METRE_DIGITS}f}" for value in row.centre)
    turn = " ".join(f"{value + 0.0:.{DIGITS}f}" for value in row.quaternion)
    return f"{sign}{seconds}.{rest:09d} {place} {turn}"
