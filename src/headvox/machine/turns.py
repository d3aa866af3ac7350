"""One thread at a time, where two would write to the same memory."""

from __future__ import annotations

from threading import RLock
from typing import Any

from headvox.errors import HeadvoxError


class Turns:
    """Lets one thread in at a time. Others wait; or get an error, if ``refusal`` says what it tells and what to do.

    Who is in may enter again: methods call each other. A copy, or what was pickled, is new, and nobody is in it.
    """

    def __init__(self, refusal: tuple[str, str] | None = None) -> None:
        self._refusal = refusal
        self._lock = RLock()

    def __enter__(self) -> None:
        if self._refusal is None:
            self._lock.acquire()
        elif not self._lock.acquire(blocking=False):
            raise HeadvoxError(*self._refusal)

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def __reduce__(self) -> tuple[Any, ...]:
        """Say how to make another one: a lock cannot be copied."""
        return Turns, (self._refusal,)
