"""Errors on their way from another process."""

import copy
import pickle

import pytest

from headvox.errors import HeadvoxError, MissingExtra, Undecided
from headvox.ros.transforms import NoTransform

MADE = [
    HeadvoxError("It is torn.", "Mend it."),
    HeadvoxError("It is torn."),
    Undecided("There are several.", "Choose.", ["a", "b"]),
    MissingExtra("It needs rosbags.", "bag", "leave it"),
    NoTransform("No way from a to b.", "Wait.", hopeless=True),
]


@pytest.mark.parametrize("error", MADE, ids=lambda error: type(error).__name__)
def test_an_error_of_another_process_tells_the_same(error) -> None:
    copies = [pickle.loads(pickle.dumps(error, protocol)) for protocol in range(pickle.HIGHEST_PROTOCOL + 1)]
    for again in [*copies, copy.deepcopy(error)]:
        assert type(again) is type(error)
        assert (str(again), again.args, vars(again)) == (str(error), error.args, vars(error))
