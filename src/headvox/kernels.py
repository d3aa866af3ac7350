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
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import numba


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


class Threads:
    """A fixed pool that runs one call a thread; with one thread it runs in the caller and costs nothing."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool = ThreadPoolExecutor(count - 1, "headvox") if count > 1 else None

    def run(self, function: Callable[..., None], calls: Sequence[tuple[Any, ...]]) -> None:
        """Call ``function`` with each of ``calls``; returns, or raises, when all have ended."""
        if self._pool is None or len(calls) < 2:
            for arguments in calls:
                function(*arguments)
            return
        others = [self._pool.submit(function, *arguments) for arguments in calls[1:]]
        try:
            function(*calls[0])
        finally:
            wait(others)  # nobody may still write when the caller goes on
        for other in others:
            other.result()

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()
