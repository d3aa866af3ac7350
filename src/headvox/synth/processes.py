"""Work spread over processes: the same results in the same order for any number of them."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, TypeVar

Item = TypeVar("Item")
Made = TypeVar("Made")

_job: Callable[[Any], Any]  # of a worker process


def in_processes(job: Callable[[Item], Made], items: Sequence[Item], workers: int) -> Iterator[Made]:
    """Yield ``job(item)`` for all items, in order. With one worker the work is done right here.

    ``job`` goes to each process once and has to be picklable. When the caller stops early, what was begun is
    ended and the rest is not begun.
    """
    workers = min(workers, len(items))
    if workers < 2:
        yield from map(job, items)
        return
    with ProcessPoolExecutor(workers, get_context("spawn"), _start, (job,)) as pool:
        yield from pool.map(_do, items)


def _start(job: Callable[[Any], Any]) -> None:
    global _job
    _job = job
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all: the parent alone answers


def _do(item: Any) -> Any:
    return _job(item)
