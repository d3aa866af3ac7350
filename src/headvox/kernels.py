"""The one way a loop is compiled, and the threads that run it.

Every kernel is a module-level function with ``@kernel``: compiled once, cached on disk beside its source file.
Loops release the GIL, so a frame is split over plain threads: the same compiled loop runs on a part of the rows,
whatever the number of threads, and integer results make the split invisible in the output.

Kernels and rules have no type hints, and say so to the type checker: one serves arrays of several integer types, and
Numba infers them. The public function beside each has them.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any
from weakref import finalize

import numba
import numpy as np
import numpy.typing as npt


def _source_stamp() -> tuple[str, int]:
    """Return a stamp that changes when any file of the package does."""
    check = 0
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        check = zlib.crc32(path.read_bytes(), check)
    return ("headvox", check)


STAMP = _source_stamp()


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile ``function``: cached, without the GIL, IEEE arithmetic (no contraction, no reordering)."""
    return _compiled(function)


def bare_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """As :func:`kernel`, for a ``function`` that allocates nothing: its arrays are not reference-counted.

    A count is a call, which the compiler can neither move nor keep a vector in a register across.
    """
    return _compiled(function, _nrt=False)


def _compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    njit: Any = numba.njit
    compiled: Any = njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    # Numba's cache looks at the date of the kernel's own file only: it would run on with an old rule when a rule of
    # another file is edited, or when a new version is installed with equal dates.
    cache_file = getattr(compiled._cache, "_cache_file", None)
    if cache_file is not None:
        cache_file._source_stamp = STAMP
    loop: Callable[..., Any] = compiled
    return loop


def rule(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a scalar rule that kernels of the same file inline."""
    compiled: Callable[..., Any] = numba.njit(inline="always", error_model="numpy")(function)
    return compiled


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a view of ``array`` (a C-contiguous copy, if it is not) that cannot be written to.

    Numba compiles a loop anew for arrays that must not be written, such as lie in a file or in a camera's buffer.
    Whatever comes from outside goes through this, so each loop is compiled once.
    """
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view


@rule
def product(a, b):  # type: ignore[no-untyped-def]
    """Return a * b, rounded, of two floating-point numbers whose product is added to something.

    It has a name because a compiler for GPUs would make a * b + c one operation that rounds once: there, and only
    there, another function stands for it (see :mod:`headvox.cuda.lanes`), and the bits are the same everywhere.
    """
    return a * b


class Threads:
    """A fixed number of threads that run one call each; with one thread it runs in the caller and costs nothing."""

    def __init__(self, count: int) -> None:
        self.count = count
        # A plain queue wakes a thread in a few microseconds, a pool of the standard library in tens of them.
        self._calls: _Calls = SimpleQueue()
        self._others = [
            Thread(target=_serve, args=(self._calls,), name="headvox", daemon=True) for _ in range(count - 1)
        ]
        for thread in self._others:
            thread.start()
        self._end = finalize(self, _end, self._calls, count - 1)

    def run(self, function: Callable[..., None], calls: Sequence[tuple[Any, ...]]) -> None:
        """Call ``function`` with each of ``calls``; returns, or raises, when all have ended."""
        ends: SimpleQueue[BaseException | None] = SimpleQueue()
        own = 1 if self._others else len(calls)
        for arguments in calls[own:]:
            self._calls.put((partial(function, *arguments), ends))
        try:
            for arguments in calls[:own]:
                function(*arguments)
        finally:
            errors = [ends.get() for _ in calls[own:]]  # nobody may still write when the caller goes on
        for error in errors:
            if error is not None:
                raise error

    def close(self) -> None:
        """End the threads."""
        self._end()
        for thread in self._others:
            thread.join()
        self._others = []


_Calls = SimpleQueue[tuple[Callable[[], None], SimpleQueue[BaseException | None]] | None]


def _serve(calls: _Calls) -> None:
    while call := calls.get():
        function, ends = call
        ends.put(_error_of(function))
        del call, function, ends  # what they refer to may be large


def _error_of(function: Callable[[], None]) -> BaseException | None:
    try:
        function()
    except BaseException as error:
        return error
    return None


def _end(calls: _Calls, threads: int) -> None:
    for _ in range(threads):
        calls.put(None)
