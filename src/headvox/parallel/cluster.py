"""Work on a Dask cluster: pieces go out as there is room, results come back in order.

Few pieces are out at a time, so memory is bounded on both sides; a result is fetched as soon as it is there, so that it
is not lost with its worker. The pieces of a worker that died are given to another, by Dask.

Dask runs what its scheduler is sent: whoever can reach one can run anything on its workers. The local cluster listens
on the loopback interface alone, and shows no dashboard.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from headvox import __version__
from headvox.errors import HeadvoxError, MissingExtra

if TYPE_CHECKING:
    from distributed import Client, Future

Item = TypeVar("Item")
Made = TypeVar("Made")

ANSWER_S = 10.0  # a scheduler that has not answered by then is taken to be away
JOIN_S = 60.0  # a worker has to import headvox before it joins
OUT_PER_THREAD = 2  # pieces: one that is worked on, one that waits
AHEAD_PER_THREAD = 8  # results that may wait for an earlier one


def on_cluster(
    job: Callable[[Item], Made], items: Sequence[Item], scheduler: str, count: int
) -> Iterator[Made]:
    """Yield ``job(item)`` for all items, in order, from the workers of ``scheduler`` ("local": ``count`` processes).

    Raises:
        HeadvoxError: Dask is not installed, nobody answers, the workers have another headvox, a piece of work killed
            every worker that it was given to, or ``job`` raised it.
    """
    if not items:
        return
    with _client(scheduler, min(count, len(items))) as client:
        threads = sum(client.nthreads().values())
        shared = client.submit(_itself, job, pure=False)  # sent once; made anew if its worker dies
        waiting = list(enumerate(items))[::-1]
        out: dict[Future[Any], int] = {}
        done: dict[int, Made] = {}
        given = 0
        try:
            while given < len(items):
                while waiting and len(out) < OUT_PER_THREAD * threads:
                    if waiting[-1][0] >= given + AHEAD_PER_THREAD * threads:
                        break
                    number, item = waiting.pop()
                    out[client.submit(_apply, shared, item, pure=False)] = number
                for future in _first_done(list(out)):
                    done[out.pop(future)] = _result(future)
                while given in done:
                    yield done.pop(given)
                    given += 1
        finally:
            client.cancel(list(out), force=True)


def _itself(thing: Any) -> Any:
    return thing


def _apply(job: Callable[[Any], Any], item: Any) -> Any:
    return job(item)


def _first_done(futures: list[Future[Any]]) -> list[Future[Any]]:
    from distributed import wait

    return sorted(wait(futures, return_when="FIRST_COMPLETED").done, key=lambda future: str(future.key))


def _result(future: Future[Any]) -> Any:
    from distributed.scheduler import KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        raise HeadvoxError(
            f"One piece of work ended every worker that it was given to ({len(error.args)} told).",
            "Most often it needs more memory than a worker has: see the logs of the workers.",
        ) from None


@contextmanager
def _client(scheduler: str, count: int) -> Iterator[Client]:
    """Connect to a cluster whose workers can do the work; make one first if it is to be local."""
    try:
        import distributed
    except ImportError:
        raise MissingExtra("--scheduler needs Dask, which is not installed.", "cluster") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is raised
    with ExitStack() as stack:
        if scheduler == "local":
            made = distributed.LocalCluster(
                n_workers=count, threads_per_worker=1, host="127.0.0.1", dashboard_address=None,
                silence_logs=logging.CRITICAL,
            )  # fmt: skip
            address: Any = stack.enter_context(made)
        else:
            address = scheduler
        try:
            client = stack.enter_context(distributed.Client(address, timeout=ANSWER_S))
        except (OSError, ValueError) as error:
            raise HeadvoxError(
                f"--scheduler: no Dask scheduler answers at {scheduler} ({str(error).splitlines()[0]}).",
                'Start one with "dask scheduler", or give "local".',
            ) from None
        _check_workers(client, scheduler)
        yield client


def _check_workers(client: Client, scheduler: str) -> None:
    """See that there are workers, and that all have this very headvox: others would not give the same bytes."""
    try:
        client.wait_for_workers(1, timeout=JOIN_S)
    except TimeoutError:
        raise HeadvoxError(
            f"--scheduler: the scheduler at {scheduler} has no workers.",
            f'Start some: "dask worker {scheduler}".',
        ) from None
    try:
        versions = client.run(_version)
    except ImportError:
        raise HeadvoxError(
            "--scheduler: headvox is not installed where the workers are.",
            f"Install headvox {__version__} there.",
        ) from None
    others = sorted({version for version in versions.values() if version != __version__})
    if others:
        raise HeadvoxError(
            f"--scheduler: this is headvox {__version__}, and there are workers with {', '.join(others)}.",
            "Install the same version everywhere: the results are to be the same bytes.",
        )


def _version() -> str:
    from headvox import __version__ as version

    return version
