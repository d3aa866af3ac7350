"""Numbers from text, for the ASCII kinds of files."""

from __future__ import annotations

import warnings

import numpy as np

from headvox.data import F64
from headvox.errors import HeadvoxError


def parse_numbers(text: bytes, name: str) -> F64:
    """Return all numbers of a text that are separated by white space; nan and inf count as numbers.

    Raises:
        HeadvoxError: something in the text is not a number.
    """
    text = text.strip()  # NumPy makes a number of nothing but white space
    if not text:
        return np.empty(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # how older NumPy reports what newer raises
        try:
            numbers: F64 = np.fromstring(text, dtype=np.float64, sep=" ")
        except (ValueError, DeprecationWarning):
            raise HeadvoxError(
                f"{name}: the body holds something that is not a number, expected ASCII numbers.",
                "The file is damaged or not ASCII.",
            ) from None
    return numbers


def too_many_numbers(name: str, numbers: int, promised: int) -> HeadvoxError:
    """Say that a text has more numbers than its header promises: with a column more all would be read shifted."""
    return HeadvoxError(
        f"{name}: the header promises {promised} numbers, the body has {numbers}.",
        "Is a column, or a point, missing in the header?",
    )
