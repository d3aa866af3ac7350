import threading
import time

import pytest

from headvox.kernels import Threads


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
