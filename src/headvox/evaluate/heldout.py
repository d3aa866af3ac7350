"""The held-out rule: which frames a cascade was tuned on, by what its file says."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

EVERY_OTHER = re.compile(r"every other (labelled )?frame from the first$")


def tuned_frames(tuned_on: Sequence[str], recording: str, labelled: int) -> npt.NDArray[np.bool_]:
    """Return which of the ``labelled`` frames of a recording a cascade was tuned on, (labelled,).

    An entry of ``tuned_on`` that has the words "recording NAME" speaks of all labelled frames; one that ends with
    "every other labelled frame from the first" (or without "labelled") of the first, third, fifth ...
    """
    used = np.zeros(labelled, bool)
    for entry in tuned_on:
        if re.search(rf"\brecording {re.escape(recording)}(?![\w-])", entry):
            used[:: 2 if EVERY_OTHER.search(entry) else 1] = True
    return used


def word(used: npt.NDArray[np.bool_], tuned_on: Sequence[str], synthetic: bool) -> str:
    """Return what the table says of frames of which those ``used`` set the detector."""
    if not tuned_on:
        return "not told"
    if used.any():
        return "yes" if used.all() else "partly"
    return "alike" if synthetic and any("synthetic" in entry for entry in tuned_on) else "no"
