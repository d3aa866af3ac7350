import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from headvox.machine.kernels import bare_kernel
from headvox.machine.threads import Threads, take


@bare_kernel
def take_all(counts, taken):
    """Count each of ``taken`` (N,) that is taken."""
    i = take(counts, 0)
    while i < taken.shape[0]:
        taken[i] += 1
        i = take(counts, 0)


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("calls", [0, 1, 2, 5])
def test_every_call_is_made_once(count, calls):
    threads = Threads(count)
    done = []
    threads.run(lambda k: done.append(k), [(k,) for k in range(calls)])
    assert sorted(done) == list(range(calls))
    threads.close()


def test_one_thread_is_the_callers():
    threads = Threads(1)
    seen = set()
    threads.run(lambda: seen.add(threading.current_thread()), [(), (), ()])
    assert seen == {threading.current_thread()}
    threads.close()


def test_two_threads_run_side_by_side():
    threads = Threads(2)
    both = threading.Barrier(2, timeout=30)
    threads.run(both.wait, [(), ()])
    assert not both.broken
    threads.close()


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("bad", [0, 1])
def test_an_error_in_any_call_reaches_the_caller_after_all_have_ended(count, bad):
    threads = Threads(count)
    ended = []

    def work(k):
        if k == bad:
            raise ValueError(f"call {k}")
        time.sleep(0.05)
        ended.append(k)

    with pytest.raises(ValueError, match=f"call {bad}"):
        threads.run(work, [(0,), (1,)])
    if count > 1:
        assert ended == [1 - bad]
    threads.run(work, [(2,), (3,)])
    assert set(ended) >= {2, 3}
    threads.close()


def test_threads_that_nobody_holds_end_by_themselves():
    threads = Threads(3)
    threads.run(lambda k: None, [(0,), (1,), (2,)])
    others = threads._others
    assert all(thread.is_alive() for thread in others)
    del threads
    for thread in others:
        thread.join(timeout=30)
    assert not any(thread.is_alive() for thread in others)


def test_calls_after_closing_are_the_callers():
    threads = Threads(2)
    threads.close()
    seen = []
    threads.run(lambda: seen.append(threading.current_thread()), [(), ()])
    assert seen == [threading.current_thread()] * 2


@pytest.mark.parametrize("count", [2, 3])
def test_waking_and_sleeping_in_quick_turns_loses_no_call(count):
    threads = Threads(count)
    done = []
    for frame in range(300):
        with threads.awake():
            for loop in range(frame % 4):
                threads.run(lambda k, n: done.append((k, n)), [(k, (frame, loop)) for k in range(count)])
    threads.close()
    wanted = [(k, (frame, loop)) for frame in range(300) for loop in range(frame % 4) for k in range(count)]
    assert sorted(done, key=lambda call: call[::-1]) == sorted(wanted, key=lambda call: call[::-1])


def test_an_idle_thread_takes_no_time():
    threads = Threads(2)
    with threads.awake():
        threads.run(lambda k: None, [(0,), (1,)])
    time.sleep(0.05)
    before = time.process_time()
    time.sleep(0.3)
    assert time.process_time() - before < 0.1
    threads.close()


def test_after_an_interrupt_all_goes_on():
    threads = Threads(2)
    done = []

    def interrupted(k):
        if k == 0:
            raise KeyboardInterrupt
        time.sleep(0.02)
        done.append(k)

    with pytest.raises(KeyboardInterrupt), threads.awake():
        threads.run(interrupted, [(0,), (1,)])
    assert done == [1]
    threads.run(done.append, [(2,), (3,)])
    assert sorted(done) == [1, 2, 3]
    threads.close()


FORK = """
import os
from headvox.machine.threads import Threads

threads, done = Threads(2), []
threads.run(done.append, [(0,), (1,)])
child = os.fork()
threads.run(done.append, [(2,), (3,)])
if child == 0:
    os._exit(7 if sorted(done) == [0, 1, 2, 3] else 1)
assert sorted(done) == [0, 1, 2, 3], done
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
threads.close()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_process_makes_threads_of_its_own():
    subprocess.run([sys.executable, "-c", FORK], check=True, timeout=100)


END = """
from headvox.machine.threads import Threads

threads, seen = Threads(3), []
frame = threads.awake()
{}
threads.run(seen.append, [(0,), (1,), (2,)])
print(*sorted(seen))
"""


@pytest.mark.parametrize("midway", ["", "frame.__enter__()"])
def test_a_process_ends_whatever_its_threads_wait_for(midway):
    done = subprocess.run(
        [sys.executable, "-c", END.format(midway)], capture_output=True, text=True, check=True, timeout=100
    )
    assert done.stdout == "0 1 2\n"
    assert done.stderr == ""


def test_what_is_taken_is_taken_once():
    threads, counts, taken = Threads(2), np.zeros(1, np.int64), np.zeros(1_000_000, np.int64)
    threads.run(take_all, [(counts, taken), (counts, taken)])
    threads.close()
    assert (taken == 1).all()
    assert counts[0] == len(taken) + 2


def test_the_caller_does_not_wait_for_a_thread_that_gets_no_core():
    threads, seen = Threads(2), []
    alarms = threads._shared.alarms[:]
    threads._shared.alarms.clear()  # nobody wakes it
    threads.run(lambda: seen.append(threading.current_thread()), [(), (), ()])
    assert seen == [threading.current_thread()] * 3
    threads._shared.alarms.extend(alarms)
    threads.close()
