import threading
import time

from headvox.machine.latest import Latest


def test_the_newest_wins_and_the_others_are_counted():
    mailbox = Latest()
    for item in range(5):
        mailbox.put(item)
    assert mailbox.take(0.0) == 4
    assert mailbox.replaced == 4
    assert mailbox.take(0.0) is None


def test_a_slow_reader_never_gets_what_is_old():
    """Whatever the reader takes, nothing newer was there when it took it."""
    mailbox, newest, done = Latest(), [0], threading.Event()

    def write():
        for item in range(1, 2000):
            newest[0] = item
            mailbox.put(item)
            if item % 50 == 0:
                time.sleep(0.001)
        done.set()

    writer = threading.Thread(target=write)
    writer.start()
    taken = []
    while not (done.is_set() and (item := mailbox.take(0.0)) is None):
        before = newest[0]
        item = mailbox.take(0.01)
        if item is not None:
            assert item >= before - 1  # the one that is just being put may not have arrived
            taken.append(item)
    writer.join()
    assert taken == sorted(set(taken))
    assert len(taken) > 5


def test_close_wakes_who_waits():
    mailbox = Latest()
    begun = time.monotonic()
    threading.Timer(0.05, mailbox.close).start()
    assert mailbox.take(10.0) is None
    assert time.monotonic() - begun < 5.0
    mailbox.put(1)
    assert mailbox.take(10.0) is None
