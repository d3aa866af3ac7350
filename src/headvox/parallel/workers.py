"""Work spread over processes, or over machines: the same results in the same order, however many there are."""

from __future__ import annotations

import argparse
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any, TypeVar

from headvox.errors import HeadvoxError
from headvox.machine.interrupts import heeded, terminable

Item = TypeVar("Item")
Made = TypeVar("Made")

MOST = 256

_job: Callable[[Any], Any]  # of a worker process


@dataclass(frozen=True, slots=True)
class Workers:
    """Who does the work: ``count`` processes of this machine, or a Dask ``scheduler``.

    ``scheduler`` is "local", a Dask cluster of ``count`` processes on this machine that is made for the occasion, or
    the address of one that runs already, such as ``tcp://10.0.0.5:8786``, with as many workers as it has.

    Raises:
        HeadvoxError: a count below 1.
    """

    count: int = 1
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.count < 1:
            raise HeadvoxError(
                f"Expected at least 1 worker, got {self.count}.", "Give a whole number from 1 on."
            )

    def map(self, job: Callable[[Item], Made], items: Sequence[Item]) -> Iterator[Made]:
        """Yield ``job(item)`` for all items, in order.

        ``job`` and what it returns have to be picklable. When the caller stops early, what was begun is broken
        off and the rest is not begun.

        Raises:
            HeadvoxError: the scheduler cannot be used (see :mod:`headvox.parallel.cluster`), or ``job`` raised it.
        """
        if self.scheduler is not None:
            from headvox.parallel.cluster import on_cluster

            yield from on_cluster(job, items, self.scheduler, self.count)
        else:
            yield from _in_processes(job, items, min(self.count, len(items)))


ALONE = Workers()
"""The work is done right here."""


def add_flags(parser: argparse.ArgumentParser, usual: int | None = None) -> None:
    """Add the flags that say who does the work; ``usual`` is the count without a flag (None: one for each core)."""
    told = "one for each core" if usual is None else str(usual)
    parser.add_argument(
        "--workers", type=_count, default=usual or os.cpu_count() or 1, metavar="N",
        help=f"processes; the results are the same ({told})",
    )  # fmt: skip
    parser.add_argument(
        "--scheduler", metavar="ADDRESS",
        help='spread the work by Dask: "local" for N processes here, tcp://HOST:PORT for a cluster that runs',
    )  # fmt: skip


def of_flags(args: argparse.Namespace) -> Workers:
    """Return whom the flags ask for."""
    return Workers(args.workers, args.scheduler)


def _count(text: str) -> int:
    value = int(text)
    if not 1 <= value <= MOST:
        raise argparse.ArgumentTypeError(f"expected 1 to {MOST}, got {text!r}")
    return value


def _in_processes(job: Callable[[Item], Made], items: Sequence[Item], count: int) -> Iterator[Made]:
    if count < 2:
        yield from map(job, items)
        return
    context = get_context("spawn")
    theirs, ours = context.Pipe(duplex=False)
    with theirs, ours, ProcessPoolExecutor(count, context, _start, (job, theirs)) as pool:
        try:
            yield from pool.map(_do, items)
        except BaseException:  # Ctrl-C, too: nobody wants what they are at
            ours.close()
            raise


def _start(job: Callable[[Any], Any], parent: Connection) -> None:
    global _job
    _job = job
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all: the parent alone answers
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Connection) -> None:
    """End this process when the other end is closed: its parent wants no more of it, or is gone."""
    with suppress(EOFError, OSError):
        parent.recv_bytes()
    os.kill(os.getpid(), signal.SIGTERM)


def _do(item: Any) -> Any:
    try:
        with terminable(), heeded():  # so that what is half done can be taken away
            return _job(item)
    except KeyboardInterrupt:  # which the pool would take for a result, and go on
        os._exit(1)
