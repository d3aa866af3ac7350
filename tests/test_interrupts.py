import ctypes
import signal
import sys
import time

import pytest

from headvox.machine.interrupts import AGAIN_S, Terminated, heeded, terminable


@pytest.fixture(autouse=True)
def _in_the_foreground():
    """Undo what a shell does to its background jobs, should the tests be one: they ignore interrupts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class Finalized:
    def __del__(self):
        raise KeyboardInterrupt


def finalizer():
    Finalized()


@ctypes.CFUNCTYPE(None)
def callback():
    raise KeyboardInterrupt


@pytest.mark.parametrize("swallows", [finalizer, callback], ids=["finalizer", "callback"])
def test_an_interrupt_that_is_swallowed_comes_again(swallows, capsys):
    began = time.monotonic()

    def work():
        with heeded():
            swallows()
            time.sleep(60)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert time.monotonic() - began < 30.0  # it does not sleep to its end
    assert capsys.readouterr().err == ""


def test_other_errors_are_told_as_before(monkeypatch):
    told = []
    monkeypatch.setattr(sys, "unraisablehook", lambda unraisable: told.append(unraisable.exc_type))
    before = sys.unraisablehook

    @ctypes.CFUNCTYPE(None)
    def fails():
        raise ValueError

    with heeded():
        fails()
    assert told == [ValueError]
    assert sys.unraisablehook is before


def test_what_breaks_down_because_of_it_was_interrupted():
    def work():
        with heeded():
            finalizer()
            raise ValueError

    with pytest.raises(KeyboardInterrupt):
        work()
    time.sleep(3 * AGAIN_S)  # and no second one comes


def test_sigterm_ends_as_ctrl_c_does_even_where_that_is_ignored_and_it_is_swallowed(capsys):
    class Ended:
        def __del__(self):
            signal.raise_signal(signal.SIGTERM)

    began = time.monotonic()

    def work():
        with heeded():
            Ended()
            time.sleep(60)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    before = signal.getsignal(signal.SIGTERM)
    with terminable() as came, pytest.raises(Terminated):
        work()
    assert came == [signal.SIGTERM, signal.SIGTERM]
    assert time.monotonic() - began < 30.0  # it does not sleep to its end
    assert signal.getsignal(signal.SIGTERM) is before
    assert capsys.readouterr().err == ""
