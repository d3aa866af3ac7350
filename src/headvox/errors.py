"""What the library raises for what it cannot use."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


class HeadvoxError(Exception):
    """Input, configuration or files that headvox cannot use.

    ``what`` is one line that says what was expected and what came; ``do`` is one line that says what to do
    about it. The command line prints both and exits with 1; the library only raises.
    """

    def __init__(self, what: str, do: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.do = do

    def __str__(self) -> str:
        return f"{self.what} {self.do}".rstrip()

    def __reduce__(self) -> tuple[Any, ...]:
        """Say how another process makes it again: by what it holds, as kinds of errors are made from other things."""
        return _again, (type(self), self.args), self.__dict__


def _again(kind: type[HeadvoxError], args: tuple[Any, ...]) -> HeadvoxError:
    """Return an error that is still to be told what it holds."""
    return kind.__new__(kind, *args)


class Undecided(HeadvoxError):
    """Input that can be taken in several ways: the user has to choose, from ``choices`` (lines to show).

    The command line exits with 2 then, as for flags that are missing.
    """

    def __init__(self, what: str, do: str, choices: Sequence[str] = ()) -> None:
        super().__init__(what, do)
        self.choices = tuple(choices)


class MissingExtra(HeadvoxError):
    """A package is not installed that comes with an ``extra`` of headvox; ``instead`` is what goes without it."""

    def __init__(self, what: str, extra: str, instead: str = "") -> None:
        super().__init__(
            what, f"Run: pip install 'headvox[{extra}]'" + (f", or {instead}" if instead else "")
        )
