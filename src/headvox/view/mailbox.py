"""Frames for another process: the newest one waits, an older one that was not taken yet is dropped."""

from __future__ import annotations

import os
import pickle
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from threading import Condition, Thread
from typing import IO, Any

from headvox.errors import HeadvoxError

CLOSE_S = 20.0
LENGTH = struct.Struct("<Q")


class Mailbox:
    """Hands objects to a child process, which reads them with :func:`letters` from its standard input.

    A thread writes; :meth:`put` takes microseconds, whatever the child does. With ``every`` nothing is dropped, and
    :meth:`put` waits until the one before has been taken.
    """

    def __init__(self, command: list[str], every: bool = False) -> None:
        self.dropped = 0
        self._every = every
        self._letter: object = None
        self._closing = False
        self._changed = Condition()
        self._child = subprocess.Popen(
            [sys.executable, *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            start_new_session=True,  # Ctrl-C is for the loop, which then closes the mailbox
        )
        self._thread = Thread(target=self._deliver, name="headvox view", daemon=True)
        self._thread.start()

    def put(self, letter: object) -> None:
        """Leave ``letter``, anything that can be pickled, for the child.

        Raises:
            HeadvoxError: the child has ended.
        """
        with self._changed:
            if self._every:
                while self._letter is not None and self._thread.is_alive():
                    self._changed.wait(0.1)
            if not self._thread.is_alive():
                raise HeadvoxError(
                    "The viewer has ended." if self._child.poll() == 0 else "The viewer cannot go on.",
                    "What it said is above, if anything.",
                )
            self.dropped += self._letter is not None
            self._letter = letter
            self._changed.notify_all()

    def close(self) -> None:
        """Let the child finish what it was given, for some seconds at most."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(CLOSE_S)
        with suppress(subprocess.TimeoutExpired):
            self._child.wait(CLOSE_S)
        if self._child.poll() is None:
            self._child.kill()
            self._child.wait()
        self._thread.join(CLOSE_S)

    def _deliver(self) -> None:
        assert self._child.stdin is not None
        with suppress(BrokenPipeError), self._child.stdin as pipe:
            while True:
                with self._changed:
                    while self._letter is None and not self._closing:
                        self._changed.wait()
                    letter, self._letter = self._letter, None
                    self._changed.notify_all()
                if letter is None:
                    return
                _write(pipe, letter)


def _write(pipe: IO[bytes], letter: object) -> None:
    """Write a letter: its pickle, and its arrays as they lie in memory."""
    buffers: list[pickle.PickleBuffer] = []
    text = pickle.dumps(letter, protocol=5, buffer_callback=buffers.append)
    arrays = [buffer.raw() for buffer in buffers]
    sizes = [len(text), *(array.nbytes for array in arrays)]
    pipe.write(LENGTH.pack(len(sizes)) + b"".join(LENGTH.pack(size) for size in sizes))
    pipe.write(text)
    for array in arrays:
        pipe.write(array)
    pipe.flush()


def letters(pipe: IO[bytes]) -> Iterator[Any]:
    """Yield what the parent process has put into its mailbox, until it closes it."""
    while head := pipe.read(LENGTH.size):
        count = LENGTH.unpack(head)[0]
        sizes = [LENGTH.unpack(pipe.read(LENGTH.size))[0] for _ in range(count)]
        text, *arrays = [pipe.read(size) for size in sizes]
        yield pickle.loads(text, buffers=arrays)
