"""One thread at a time: the others wait, or are refused."""

import copy
import pickle
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from headvox import HeadvoxError
from headvox.machine.turns import Turns


def enter(turns):
    with turns:
        return time.perf_counter()


def test_others_wait_where_nothing_refuses_them():
    turns = Turns()
    with ThreadPoolExecutor(1) as other:
        with turns:
            entered = other.submit(enter, turns)
            time.sleep(0.05)
            left = time.perf_counter()
        assert entered.result() >= left


def test_others_are_refused_and_who_is_in_may_enter_again():
    turns = Turns(("It is in use.", "Wait."))
    with ThreadPoolExecutor(1) as other:
        with turns, turns, pytest.raises(HeadvoxError, match=r"It is in use\. Wait\."):
            other.submit(enter, turns).result()
        other.submit(enter, turns).result()


def test_an_error_inside_lets_others_in():
    turns = Turns(("It is in use.", ""))
    with pytest.raises(ZeroDivisionError), turns:
        raise ZeroDivisionError
    with ThreadPoolExecutor(1) as other:
        other.submit(enter, turns).result()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda turns: pickle.loads(pickle.dumps(turns))])
def test_nobody_is_in_a_copy(copied):
    turns = Turns(("It is in use.", ""))
    with ThreadPoolExecutor(1) as other, turns:
        another = copied(turns)
        other.submit(enter, another).result()
        with another, pytest.raises(HeadvoxError, match="It is in use"):
            other.submit(enter, another).result()
