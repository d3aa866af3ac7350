"""A mailbox for one: who comes late finds the newest letter, and how many were thrown away."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class Latest(Generic[T]):
    """A queue of length one where the newest wins, so that an overloaded reader gets fresher data, never later."""

    def __init__(self) -> None:
        self.replaced = 0
        """How many items nobody took before the next one came."""
        self._item: T | None = None
        self._closed = False
        self._changed = threading.Condition()

    def put(self, item: T) -> None:
        """Leave ``item``, in the place of one that is still there."""
        with self._changed:
            self.replaced += self._item is not None
            self._item = item
            self._changed.notify()

    def take(self, timeout_s: float) -> T | None:
        """Return the newest item and forget it; None when none comes in time, or the mailbox was closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._item is not None or self._closed, timeout_s)
            item, self._item = self._item, None
            return None if self._closed else item

    def close(self) -> None:
        """Let whoever waits go, now and for ever."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
