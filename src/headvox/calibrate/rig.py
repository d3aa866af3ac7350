"""Two cameras and people who walk about: what both see at the same time says where one stands for the other.

Either camera has found its floor, so what is missing is a turn about the vertical and a shift on the floor. Each frame
gives the heads that either sees; nobody says which are the same. Turns and shifts are tried from two pairs of heads
each, the one that explains most is fitted to all of them (Kabsch, 1976, in the plane).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from headvox.data import F64
from headvox.errors import HeadvoxError

NEAR_M = 0.15  # between what two cameras make of one head
HEIGHT_M = 0.12
LEAST_APART_M = 0.6  # between two heads, to tell a turn
LEAST_PAIRS = 6
TRIES = 3000
REFITS = 5


@dataclass(frozen=True, slots=True)
class Placed:
    """``T`` (4, 4) brings the second camera's level frame to the first's; ``pairs`` heads say so, to ``rms_m``.

    ``spread_m`` is how far apart the heads were: the turn is as good as rms / spread.
    """

    T: F64
    pairs: int
    rms_m: float
    spread_m: float
    drop_m: float
    """How much higher the second camera has the heads, in the mean: what the two floors differ by."""


def place(first: Sequence[F64], second: Sequence[F64], names: str = "the cameras", seed: int = 0) -> Placed:
    """Return where the second camera is for the first, from heads (N, 3) in their level frames, a frame each.

    ``names`` says in errors which two they are.

    Raises:
        HeadvoxError: too few heads were seen by both, people stood still, or no turn and shift explains them.
    """
    frames, here, there = _candidates(first, second)
    if len(np.unique(frames)) < LEAST_PAIRS:
        raise HeadvoxError(
            f"{names}: heads of like height are seen by both in {len(np.unique(frames))} frames only, "
            f"expected at least {LEAST_PAIRS}.",
            "Record somebody who walks about where both cameras look.",
        )
    best, most = None, 0
    for turn, shift in _guesses(frames, here, there, seed):
        on = _explained(frames, here, there, turn, shift)
        if len(on) > most:
            best, most = (turn, shift), len(on)
    if best is None:
        raise HeadvoxError(
            f"{names}: no two heads that both see are {LEAST_APART_M:g} m apart.",
            "Record somebody who walks about, and does not stand on one spot.",
        )
    if most < LEAST_PAIRS:
        raise HeadvoxError(
            f"{names}: no place of the second explains more than {most} heads, expected at least {LEAST_PAIRS}.",
            "Do the cameras record at the same time? Record one person who walks about.",
        )
    turn, shift = best
    for _ in range(REFITS):
        on = _explained(frames, here, there, turn, shift)
        turn, shift = _fit(here[on, :2], there[on, :2])
    on = _explained(frames, here, there, turn, shift)
    off = here[on, :2] - (there[on, :2] @ _matrix(turn).T + shift)
    T = np.eye(4)
    T[:2, :2] = _matrix(turn)
    T[:2, 3] = shift
    spread = float(np.sqrt(((here[on, :2] - here[on, :2].mean(axis=0)) ** 2).sum(axis=1).mean()))
    return Placed(
        T, len(on), float(np.sqrt((off**2).sum(axis=1).mean())), spread,
        float((there[on, 2] - here[on, 2]).mean()),
    )  # fmt: skip


def _candidates(first: Sequence[F64], second: Sequence[F64]) -> tuple[F64, F64, F64]:
    """Return every pair of heads that may be one: its frame (P,), and both places (P, 3)."""
    frames, here, there = [], [], []
    for number, (ours, theirs) in enumerate(zip(first, second, strict=True)):
        for a in ours:
            for b in theirs:
                if abs(a[2] - b[2]) < HEIGHT_M:
                    frames.append(number)
                    here.append(a)
                    there.append(b)
    return np.array(frames), np.array(here).reshape(-1, 3), np.array(there).reshape(-1, 3)


def _guesses(frames: F64, here: F64, there: F64, seed: int) -> list[tuple[float, F64]]:
    """Return turns and shifts that bring two pairs together."""
    rng = np.random.default_rng(seed)
    a, b = rng.integers(0, len(frames), (2, TRIES))
    ours, theirs = here[b, :2] - here[a, :2], there[b, :2] - there[a, :2]
    apart, apart_there = np.hypot(*ours.T), np.hypot(*theirs.T)
    fit = (apart > LEAST_APART_M) & (np.abs(apart - apart_there) < NEAR_M)
    guesses = []
    for k in np.flatnonzero(fit):
        turn = float(np.arctan2(ours[k, 1], ours[k, 0]) - np.arctan2(theirs[k, 1], theirs[k, 0]))
        middle, middle_there = (
            0.5 * (here[[a[k], b[k]], :2]).sum(axis=0),
            0.5 * there[[a[k], b[k]], :2].sum(axis=0),
        )
        guesses.append((turn, middle - _matrix(turn) @ middle_there))
    return guesses


def _explained(frames: F64, here: F64, there: F64, turn: float, shift: F64) -> F64:
    """Return which pairs come together, the nearest first; each head of a frame at most once."""
    off = np.hypot(*(here[:, :2] - (there[:, :2] @ _matrix(turn).T + shift)).T)
    near = np.flatnonzero(off < NEAR_M)
    near = near[np.argsort(off[near], kind="stable")]
    used: set[tuple[object, ...]] = set()
    kept = []
    for k in near:
        mine, other = (frames[k], 0, *here[k]), (frames[k], 1, *there[k])
        if mine not in used and other not in used:
            used |= {mine, other}
            kept.append(k)
    return np.sort(np.array(kept, np.int64))


def _fit(here: F64, there: F64) -> tuple[float, F64]:
    """Return the turn and shift of least squares that bring ``there`` (N, 2) to ``here``."""
    ours, theirs = here - here.mean(axis=0), there - there.mean(axis=0)
    turn = float(
        np.arctan2((theirs[:, 0] * ours[:, 1] - theirs[:, 1] * ours[:, 0]).sum(), (theirs * ours).sum())
    )
    return turn, here.mean(axis=0) - _matrix(turn) @ there.mean(axis=0)


def _matrix(turn: float) -> F64:
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
