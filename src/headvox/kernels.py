"""The one way a loop is compiled, and the threads that run it.

Every kernel is a module-level function with ``@kernel``: compiled once, cached on disk beside its source file.
Loops release the GIL, so a frame is split over plain threads: the same compiled loop runs on a part of the rows,
whatever the number of threads, and integer results make the split invisible in the output.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile ``function``: cached, without the GIL, IEEE arithmetic (no contraction, no reordering)."""
    compiled: Function = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    return compiled


def rule(function: Function) -> Function:
    """Compile a scalar rule that kernels of the same file inline."""
    compiled: Function = numba.njit(inline="always", error_model="numpy")(function)
    return compiled


class Threads:
    """A fixed pool that runs one call a thread; with one thread it runs in the caller and costs nothing."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool = ThreadPoolExecutor(count - 1, "headvox") if count > 1 else None

    def run(self, function: Callable[..., None], calls: Sequence[tuple[Any, ...]]) -> None:
        """Call ``function`` with each of ``calls``; returns when all have."""
        if self._pool is None or len(calls) < 2:
            for arguments in calls:
                function(*arguments)
            return
        others = [self._pool.submit(function, *arguments) for arguments in calls[1:]]
        function(*calls[0])
        for other in others:
            other.result()

    def close(self) -> None:
        """End the threads."""
        if self._pool is not None:
            self._pool.shutdown()
