"""From heads to tracks: who is who, where everybody is now, and how fast.

A frame is five steps: predict, associate, correct, look again and age, bear (:meth:`Tracker._take`). The filters are
in ``kalman.py``, what tells people apart in ``identity.py``, how far measured heads may be off in ``noise.py``. Where a
head may be that was not found is in ``unseen.py``, what keeps its track alive in ``lifetime.py``: it dies fast where
all is seen to be empty, later where it is hidden. What is known of each track is a row of a table (``roster.py``), what
is told of it is in ``report.py``.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from headvox.check import as_stamp, check_kind
from headvox.config import TrackerConfig, given_or_default
from headvox.data import F64, I64, Expected, Frame, Heads, Tracks
from headvox.errors import HeadvoxError
from headvox.machine.threads import Threads
from headvox.machine.turns import Turns
from headvox.organise import Organiser
from headvox.tracking.identity import MOST_STRENGTH, come_back, note_sightings, pairs, price
from headvox.tracking.kalman import (
    FIRST_RATE_RAD_S,
    MOVING,
    STILL,
    STILL_SPEED_M_S,
    correct_places,
    correct_turns,
    predict_places,
    predict_turns,
)
from headvox.tracking.lifetime import age, judge_new, turn_page
from headvox.tracking.noise import measurement_noise, widen
from headvox.tracking.report import expectations, report, tentative
from headvox.tracking.roster import ROW, Roster, blank
from headvox.tracking.unseen import search
from headvox.visibility import BEHIND, NO_RETURN, OUT_OF_VIEW, SEEN_EMPTY

STILL_S, MOVING_S = 8.0, 2.0  # mean times that a head rests and moves
FIRST_SPEED_M_S = np.array([0.7, 0.7, 0.3])  # standard deviations of the velocity of a head that is new
UPRIGHT = np.array([1.0, 1.0, 0.4])  # heads move along the floor more than up and down
FADE_S = np.array([2.0, 2.0, 0.3])  # how long a head that is not seen goes on: up and down not for long
TURN_FADE_S = 0.3  # how long a head turns on
WANDER_M2_S = 1e-6  # a head at rest sways by a millimetre in a second
TURN_GATE = 16.3  # squared Mahalanobis distance: one in a thousand is farther
FIRST_TRUST = 0.15


class Tracker:
    """Follows heads from frame to frame. Ids begin at 1 with each tracker and are never used again by it.

    A thread that asks where the tracks will be, while another one's frame is taken, waits for the end of that.

    >>> from headvox.data import Frame, Heads
    >>> import numpy as np
    >>> tracker = Tracker()
    >>> for k in range(15):
    ...     head = Heads(np.array([[0.0, 0.02 * k, 1.6]]), np.full((1, 4), np.nan), np.array([0.1]), np.array([5.0]))
    ...     tracks = tracker.update(head, Frame(stamp_ns=k * 33_000_000))
    >>> tracks.ids.tolist(), round(float(tracks.velocities[0, 1]), 1)
    ([1], 0.6)

    ``untracked`` counts the frames whose stamp did not go on: "repeated" (the same as the last), "late" (an earlier
    one), and "resets" (time jumped back so far that everything began anew, see ``TrackerConfig.reset_s``).
    """

    def __init__(self, config: TrackerConfig | None = None) -> None:
        self.untracked: Counter[str] = Counter()
        self.stamp_ns: int | None = None
        """Of the last frame that was tracked."""
        self._turns = Turns()
        self._organiser = Organiser(Threads(1))
        self._last_id = 0
        self._roster = blank(0)
        self._set(given_or_default(config, TrackerConfig))

    # ------------------------------------------------------------------------------------------- the public calls

    @property
    def config(self) -> TrackerConfig:
        """The settings. Others may be assigned at any time: from the next frame on the tracks there are go by them.

        Raises:
            HeadvoxError: something else is assigned.
        """
        return self._config

    @config.setter
    def config(self, config: TrackerConfig) -> None:
        with self._turns:
            self._set(given_or_default(config, TrackerConfig))

    def update(self, heads: Heads, frame: Frame) -> Tracks:
        """Take the heads found in ``frame``, world frame, and return every track at its stamp.

        The images of the frame tell where a head that was not found may be hidden; a frame without any will do. A
        frame whose stamp is not after the last one's is not tracked: its heads come back as tentative tracks.

        Raises:
            HeadvoxError: no heads, no frame, or a stamp that is not in whole nanoseconds.
        """
        check_kind(heads, Heads, "Tracker.update: heads")
        check_kind(frame, Frame, "Tracker.update: frame")
        stamp_ns = as_stamp(frame.stamp_ns)
        with self._turns:
            if not self._is_next(stamp_ns):
                return tentative(heads, stamp_ns)
            self._take(heads, frame, stamp_ns)
            return report(self._roster, stamp_ns, stamp_ns)

    def predict(self, stamp_ns: int) -> Tracks:
        """Return where the tracks will be at a stamp, in ns, that is not before the last frame's; nothing is changed.

        Raises:
            HeadvoxError: an earlier stamp, or one that is not in whole nanoseconds.
        """
        stamp_ns = as_stamp(stamp_ns)
        with self._turns:
            if self.stamp_ns is not None and stamp_ns < self.stamp_ns:
                raise HeadvoxError(
                    f"Expected a stamp from {self.stamp_ns} ns on, the last frame's, got {stamp_ns} ns.",
                    "Ask for the present or the future.",
                )
            last_ns = stamp_ns if self.stamp_ns is None else self.stamp_ns
            return report(self._predicted(stamp_ns), last_ns, stamp_ns)

    def expected(self, stamp_ns: int) -> Expected:
        """Return where confirmed heads are expected at ``stamp_ns``, for :meth:`Detector.detect_frame`.

        Raises:
            HeadvoxError: a stamp that is not in whole nanoseconds.
        """
        stamp_ns = as_stamp(stamp_ns)
        with self._turns:
            if self.stamp_ns is None or stamp_ns < self.stamp_ns:
                return Expected(np.empty((0, 3)), np.empty((0, 4)), np.empty(0))
            return expectations(self._predicted(stamp_ns))

    @property
    def ids_given(self) -> int:
        """How many heads were confirmed so far."""
        return self._last_id

    def _set(self, config: TrackerConfig) -> None:
        """Take settings, and what follows from them."""
        self._config = config
        self._density = (config.speed_change_m_s * UPRIGHT) ** 2
        self._turn_density = np.full(3, np.radians(config.turn_change_deg_s) ** 2)
        self._lasts_s = _lasts_s(config)
        self._longest_ns = _longest_s(config) * 1e9

    # -------------------------------------------------------------------------------------------------- the steps

    def _take(self, heads: Heads, frame: Frame, stamp_ns: int) -> None:
        """Go through the five steps with a frame that is after the last one."""
        R_centre, R_turn = measurement_noise(heads, frame)
        before_ns = stamp_ns if self.stamp_ns is None else self.stamp_ns
        self._predict(before_ns, stamp_ns)
        tracks, found = self._associate(heads, R_centre)
        self._correct(heads, R_centre, R_turn, tracks, found)
        self._age(heads.centres, frame, (stamp_ns - before_ns) * 1e-9)
        new = heads.sure.copy()
        new[found] = False
        self._bear(heads, R_centre, R_turn, np.flatnonzero(new))

    def _is_next(self, stamp_ns: int) -> bool:
        """Whether time goes on; counts where it does not, and starts anew when it jumped back far."""
        if self.stamp_ns is not None and stamp_ns <= self.stamp_ns:
            if self.stamp_ns - stamp_ns <= self._config.reset_s * 1e9:
                self.untracked["repeated" if stamp_ns == self.stamp_ns else "late"] += 1
                return False
            self.untracked["resets"] += 1
            self._roster = blank(0)
            self.stamp_ns = None
        return True

    def _predict(self, before_ns: int, stamp_ns: int) -> None:
        """Move every track on to ``stamp_ns``, and forget those that were not seen for too long."""
        kept = np.empty(len(self._roster), np.bool_)
        if not turn_page(self._roster, stamp_ns, self._longest_ns, self._config.confirm_frames, kept):
            self._roster = self._roster[kept]
        self._move(self._roster, before_ns, stamp_ns)
        self.stamp_ns = stamp_ns

    def _associate(self, heads: Heads, R: F64) -> tuple[I64, I64]:
        """Return the pairs of tracks and heads, by index, that are likeliest as a whole."""
        costs = np.empty((len(self._roster), len(heads)))
        gate = self._config.gate_sigmas**2
        price(self._roster, heads.centres, R, heads.sure, gate, self._now(), costs)
        return pairs(costs)

    def _correct(self, heads: Heads, R_centre: F64, R_turn: F64, tracks: I64, found: I64) -> None:
        roster, now_ns = self._roster, self._now()
        widen(roster, tracks, found, now_ns, heads.centres, R_centre)
        correct_places(roster, tracks, found, heads.centres, R_centre)
        correct_turns(roster, tracks, found, heads.quaternions, R_turn, TURN_GATE)
        note_sightings(
            roster,
            tracks,
            found,
            now_ns,
            heads.centres,
            heads.radii,
            heads.scores,
            heads.sure,
            self._config.strong_score,
        )

    def _age(self, centres: F64, frame: Frame, dt: float) -> None:
        """Let the tracks that were not surely seen lose life, by what the sensors saw of their places; end the dead.

        ``centres`` (M, 3) are those of the heads that were found.
        """
        config, roster = self._config, self._roster
        states = np.full(len(roster), OUT_OF_VIEW)
        missed = np.flatnonzero(~roster["lost"] & (roster["seen_ns"] != self._now()))
        if len(missed):
            seen = self._organiser.organised(frame)
            states[missed] = search(roster, missed, seen, config.sight_m, centres)
        age(roster, self._now(), dt, states, self._lasts_s, config.present_s, config.weak_s)
        self._confirm()

    def _confirm(self) -> None:
        """Give an id to what was seen often enough, its old one if it was known; let go of what no longer can be."""
        roster = self._roster
        ready, kept = np.empty((2, len(roster)), np.bool_)
        any_ready, all_kept = judge_new(
            roster, self._config.confirm_hits, self._config.confirm_frames, ready, kept
        )
        if any_ready:
            new = np.flatnonzero(ready)
            back, known = come_back(roster, new, np.flatnonzero(roster["id"] > 0))
            for name in ("id", "born_ns", "height", "sightings"):
                roster[name][back] = roster[name][known]
            kept[known] = False  # its head goes on as the new track
            unknown = np.setdiff1d(new, back)
            roster["id"][unknown] = self._last_id + 1 + np.arange(len(unknown))
            self._last_id += len(unknown)
        if any_ready or not all_kept:
            self._roster = roster[kept]

    def _bear(self, heads: Heads, R_centre: F64, R_turn: F64, new: I64) -> None:
        """Begin a track for each head of index ``new``."""
        if len(new) == 0:
            return
        born, centres = blank(len(new)), heads.centres[new]
        born["born_ns"] = born["seen_ns"] = self._now()
        born["hits"], born["life"], born["trust"], born["sightings"] = 1, 1.0, FIRST_TRUST, 1
        born["last"][:, 0], born["last_ns"][:, 0] = centres, self._now()
        born["place"], born["height"] = centres, centres[:, 2]
        born["radius"], born["score"] = heads.radii[new], heads.scores[new]
        born["strength"] = np.minimum(heads.scores[new] / self._config.strong_score, MOST_STRENGTH)
        born["x"][:, :, :3] = centres[:, None]
        born["P"][:, :, :3, :3] = R_centre[new, None]
        born["P"][:, MOVING, 3:, 3:] = np.diag(FIRST_SPEED_M_S**2)
        born["P"][:, STILL, 3:, 3:] = STILL_SPEED_M_S**2 * np.eye(3)
        born["weights"] = 0.5
        born["q"] = heads.quaternions[new]
        born["C"][:, :3, :3] = R_turn[new]
        born["C"][:, 3:, 3:] = FIRST_RATE_RAD_S**2 * np.eye(3)
        self._roster = np.concatenate((self._roster, born), dtype=ROW)
        if self._config.confirm_hits == 1:
            self._confirm()

    # ---------------------------------------------------------------------------------------------------- the rest

    def _now(self) -> int:
        assert self.stamp_ns is not None
        return self.stamp_ns

    def _move(self, roster: Roster, before_ns: int, stamp_ns: int) -> None:
        """Move tracks on from one stamp to another, in place."""
        dt = (stamp_ns - before_ns) * 1e-9
        predict_places(roster, before_ns, dt, STILL_S, MOVING_S, WANDER_M2_S, self._density, FADE_S)
        predict_turns(roster, dt, self._turn_density, TURN_FADE_S)

    def _predicted(self, stamp_ns: int) -> Roster:
        """Return a copy of the tracks, moved on to a stamp."""
        roster = self._roster.copy()
        if self.stamp_ns is not None:
            self._move(roster, self.stamp_ns, stamp_ns)
        return roster


def _lasts_s(config: TrackerConfig) -> F64:
    """Return how long a track lives (5,) for each thing that may be seen of its place."""
    lasts_s = np.full(SEEN_EMPTY + 1, np.inf)
    lasts_s[OUT_OF_VIEW], lasts_s[NO_RETURN] = config.out_of_view_s, config.missed_s
    lasts_s[BEHIND], lasts_s[SEEN_EMPTY] = config.hidden_s, config.empty_s
    return lasts_s


def _longest_s(config: TrackerConfig) -> float:
    """Return how long any track may be unseen and still be something."""
    limits_s = config.hidden_s, config.present_s, config.missed_s, config.out_of_view_s, config.empty_s
    return max(config.remember_s, *limits_s)
