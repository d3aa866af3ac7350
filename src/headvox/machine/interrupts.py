"""Ctrl-C that is not lost, wherever it falls, and SIGTERM that ends as well."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

AGAIN_S = 0.02


class Terminated(KeyboardInterrupt):
    """SIGTERM: what is done at Ctrl-C is to be done."""


@contextmanager
def terminable() -> Iterator[list[int]]:
    """Let SIGTERM end what runs as Ctrl-C does; the list that this gives holds it once it has come.

    Files are finished then, and workers ended. To be entered in the main thread; in another one it does nothing.

    Raises:
        Terminated: it came.
    """
    came: list[int] = []

    def end(number: int, frame: Any) -> None:
        came.append(number)
        raise Terminated

    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    before = signal.signal(signal.SIGTERM, end)
    try:
        yield came
    finally:
        signal.signal(signal.SIGTERM, before)


def _signal_main(number: signal.Signals) -> None:
    """Send a signal to the main thread, so that it wakes where it waits; where none can be sent, it heeds it later."""
    main = threading.main_thread().ident
    if sys.platform == "win32" or main is None:
        _thread.interrupt_main(number)
    else:
        signal.pthread_kill(main, number)


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
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            number = signal.SIGTERM if unraisable.exc_type is Terminated else signal.SIGINT
            due.append(threading.Timer(AGAIN_S, _signal_main, [number]))
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
