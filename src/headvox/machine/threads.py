"""Threads that share a frame: they wait for the next loop awake while a frame is searched, and sleep between frames.

A frame is a chain of loops of a fraction of a millisecond each, and waking a thread that sleeps takes a tenth of one.
So the threads that help are woken when the frame begins, and look at a flag in memory until the next loop does; and the
caller so waits for them. All this waiting is in compiled code and without the GIL, which a thread asks for only when
there is a call for it to make. Both offer their core to whoever else wants it all the while. A call goes to whoever
is free: where there is no core for a second thread, the caller makes all calls and does not wait.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from threading import Thread
from typing import Any, NamedTuple
from weakref import finalize

import numpy as np
from llvmlite import ir
from numba import types

from headvox.data import I64
from headvox.machine.kernels import bare_kernel
from headvox.machine.simd import intrinsic

LINE = 8  # what different threads write is a cache line apart
BEGUN, RESTED = 0, LINE  # flags: the turn that goes on, the last one that sent the threads to sleep,
RUNG = 2 * LINE  # and the one that they were last woken after,
NEVERMORE = -1  # or this, when there will be none
TAKEN, ENDED = 0, LINE  # counts
LOOKS = 64  # at a flag, before the core is offered to others
GRACE = 45  # offers of the core, some 10 us, after which the caller is in its loop and has let go of the GIL
PATIENCE = 100_000  # offers of the core, some 30 ms
_offer_core = types.ExternalFunction("SwitchToThread" if os.name == "nt" else "sched_yield", types.int32())
# Python's own locks, as it has them for C: on every system, and without the GIL.
_new_lock: Any = types.ExternalFunction("PyThread_allocate_lock", types.intp())
_acquire: Any = types.ExternalFunction("PyThread_acquire_lock", types.intc(types.intp, types.intc))
_release: Any = types.ExternalFunction("PyThread_release_lock", types.void(types.intp))


@intrinsic
def _told(typingctx, flags, at):
    """Return ``flags[at]``, and see whatever was written before it was set."""

    def emit(context, builder, signature, arguments):
        return builder.load_atomic(_address(context, builder, signature, arguments), "acquire", 8)

    return types.int64(flags, at), emit


@intrinsic
def _tell(typingctx, flags, at, value):
    """Set ``flags[at]``, after everything that was written before."""

    def emit(context, builder, signature, arguments):
        builder.store_atomic(arguments[2], _address(context, builder, signature, arguments), "release", 8)
        return context.get_dummy_value()

    return types.void(flags, at, types.int64), emit


@intrinsic
def _add(typingctx, counts, at, number):
    """Return ``counts[at]`` and add to it, in one step, after everything that was written before."""

    def emit(context, builder, signature, arguments):
        return builder.atomic_rmw(
            "add", _address(context, builder, signature, arguments), arguments[2], "acq_rel"
        )

    return types.int64(counts, at, types.int64), emit


@bare_kernel
def take(counts, at):
    """Return ``counts[at]`` and count on, in one step: no two threads get the same."""
    return _add(counts, at, 1)


def new_blocks(things: int) -> I64:
    """Return how many blocks were taken of each of several things, for :func:`take`: (things, 1), still none."""
    return np.zeros((things, 1), np.int64)


def _address(context: Any, builder: Any, signature: Any, arguments: Any) -> ir.Value:
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    at = context.cast(builder, arguments[1], signature.args[1], types.intp)
    address: ir.Value = builder.gep(array.data, [at])
    return address


@bare_kernel
def new_alarm():
    """Return a lock that is held: who asks for it sleeps until it rings. It is never freed: it is some 40 bytes."""
    alarm = _new_lock()
    _acquire(alarm, 1)
    return alarm


@bare_kernel
def ring(alarm, flags, turn):
    """Wake a thread for what comes after ``turn``, or to end it (:data:`NEVERMORE`)."""
    _tell(flags, RUNG, turn)
    _release(alarm)


@bare_kernel
def begin(flags, turn, to_sleep):
    """Tell the others that it is their ``turn``, or that in this one they are to sleep."""
    if to_sleep:
        _tell(flags, RESTED, turn)
    _tell(flags, BEGUN, turn)


@bare_kernel
def wait_for_turn(flags, alarm, asleep, turn, counts, made):
    """Say that as many calls were ``made``, and wait for the caller to say that it is this ``turn``, or a later one.

    Who is ``asleep`` waits for its ``alarm`` first. Return False if there will be no more turns.
    """
    # One loop, so that the caller, who then goes on, finds the GIL free; and so does a frame that follows at once.
    _add(counts, ENDED, made)
    begun = False
    while not begun:
        while asleep:
            _acquire(alarm, 1)
            rung = _told(flags, RUNG)
            if rung == NEVERMORE:
                return False
            asleep = rung < turn - 1  # it was still awake when it was to be woken
        _wait(flags, BEGUN, turn)
        begun = _told(flags, RESTED) < _told(flags, BEGUN)
        if not begun:
            asleep, turn = True, _told(flags, RESTED) + 1
    for _ in range(GRACE):
        _offer_core()
    return True


@bare_kernel
def next_call(counts):
    """Return the number of a call that nobody has taken yet."""
    return take(counts, TAKEN)


@bare_kernel
def join(counts, calls):
    """Wait until the others have made as many ``calls``, but not for long; return whether they have."""
    for _ in range(PATIENCE):
        if _told(counts, ENDED) >= calls:
            return True
        _offer_core()
    return False


@bare_kernel
def _wait(flags, at, value):
    looks = 0
    while _told(flags, at) < value:
        looks += 1
        if looks % LOOKS == 0:
            _offer_core()


class _Task(NamedTuple):
    turn: int
    function: Callable[..., None] | None
    """None sends the threads to sleep."""
    calls: Sequence[tuple[Any, ...]]
    counts: I64
    """How many calls were taken, and how many others than the caller have made."""
    errors: list[BaseException]


def _task(turn: int, function: Callable[..., None] | None, calls: Sequence[tuple[Any, ...]]) -> _Task:
    return _Task(turn, function, calls, np.zeros(2 * LINE, np.int64), [])


class _Shared:
    """What the threads know of each other: they must not hold the :class:`Threads`, which end when nobody does."""

    def __init__(self, count: int) -> None:
        self.flags: I64 = np.zeros(3 * LINE, np.int64)
        self.task = _task(0, None, ())
        self.alarms: list[int] = [new_alarm() for _ in range(1, count)]


class Threads:
    """A fixed number of threads that run one call each; with one thread it runs in the caller and costs nothing."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._awake = False
        self._start()

    def __reduce__(self) -> tuple[Any, ...]:
        """Say how to make others: those of a copy are its own."""
        return Threads, (self.count,)

    def _start(self) -> None:
        self._process = os.getpid()
        self._shared = _Shared(self.count)
        self._others = [
            Thread(target=_serve, args=(self._shared, alarm), name="headvox", daemon=True)
            for alarm in self._shared.alarms
        ]
        for thread in self._others:
            thread.start()
        self._end = finalize(self, _ring, self._shared, NEVERMORE)

    @contextmanager
    def awake(self) -> Iterator[None]:
        """Have the threads wait awake for what they are to run; they sleep again at the end."""
        if self._awake or not self._others:
            yield
            return
        if self._process != os.getpid():  # a process that was forked has none of its parent's threads
            self._end.detach()
            self._start()
        self._awake = True
        try:
            _ring(self._shared, self._shared.task.turn)
            yield
        finally:
            self._awake = False
            begin(self._shared.flags, self._hand_out(None, ()).turn, True)

    def run(self, function: Callable[..., None], calls: Sequence[tuple[Any, ...]]) -> None:
        """Call ``function`` with each of ``calls``; returns, or raises, when all have ended."""
        if not self._others or len(calls) < 2:
            for arguments in calls:
                function(*arguments)
            return
        with self.awake():
            task = self._hand_out(function, calls)
            made = 0
            try:
                begin(self._shared.flags, task.turn, False)
                made = _do_share(task)
            finally:
                while not join(
                    task.counts, len(calls) - made
                ):  # nobody may still write when the caller goes on
                    pass  # but Ctrl-C is heard
        for error in task.errors:
            raise error

    def _hand_out(self, function: Callable[..., None] | None, calls: Sequence[tuple[Any, ...]]) -> _Task:
        """Say what is to be run next."""
        task = self._shared.task = _task(self._shared.task.turn + 1, function, calls)
        return task

    def close(self) -> None:
        """End the threads."""
        self._end()
        for thread in self._others:
            thread.join()
        self._others = []


def _ring(shared: _Shared, turn: int) -> None:
    for alarm in shared.alarms:
        ring(alarm, shared.flags, turn)


def _serve(shared: _Shared, alarm: int) -> None:
    done, counts, made, asleep = 0, np.zeros(2 * LINE, np.int64), 0, True
    while wait_for_turn(shared.flags, alarm, asleep, done + 1, counts, made):
        done, counts, made, asleep = _take_turn(shared.task)


def _take_turn(task: _Task) -> tuple[int, I64, int, bool]:
    """Do this thread's share of what was handed out last; return its turn, and whether that was to sleep.

    In between are the counts to which the calls that it made are to be added.
    """
    asleep = task.function is None
    return task.turn, task.counts, 0 if asleep else _do_share(task), asleep


def _do_share(task: _Task) -> int:
    """Make calls of the task until all are taken; return how many."""
    made = 0
    while (k := next_call(task.counts)) < len(task.calls):
        _make_call(task, k)
        made += 1
    return made


def _make_call(task: _Task, k: int) -> None:
    try:
        if task.function is not None:
            task.function(*task.calls[k])
    except BaseException as error:
        task.errors.append(error)
