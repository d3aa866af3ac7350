"""Ctrl-C that is not lost, wherever it falls."""

from __future__ import annotations

import _thread
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

AGAIN_S = 0.02


@contextmanager
def heeded() -> Iterator[None]:
    """Interrupt again, in a moment, where Python swallows a KeyboardInterrupt: in finalizers, and in callbacks from C.

    Compilers call back often: now and then a Ctrl-C while the loops are compiled would only print a traceback. To be
    entered in the main thread.

    Raises:
        KeyboardInterrupt: one was swallowed, and what it fell into broke down, or ended.
    """
    before = sys.unraisablehook
    due: list[threading.Timer] = []

    def interrupt_again(unraisable: Any) -> None:
        if unraisable.exc_type is KeyboardInterrupt:
            due.append(threading.Timer(AGAIN_S, _thread.interrupt_main))
            due[-1].start()
        else:
            before(unraisable)

    sys.unraisablehook = interrupt_again
    try:
        yield
    finally:
        sys.unraisablehook = before
        late = [timer for timer in due if timer.is_alive()]
        for timer in late:
            timer.cancel()
        if late:
            raise KeyboardInterrupt
