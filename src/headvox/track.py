"""From heads to tracks: who is who, where everybody is now, and how fast.

A frame is five steps: predict, associate, correct, age, bear (:meth:`Tracker.update`). The filters are in
``kalman.py``, what tells people apart in ``identity.py``, how far measured heads may be off in ``noise.py``. What keeps
a track alive is in ``lifetime.py``: it dies fast where its place is seen to be empty, later where it is hidden. What is
known of each track is a row of a :class:`Roster`.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import numpy.typing as npt

from headvox.config import TrackerConfig
from headvox.data import F64, I64, Cloud, Expected, Frame, Heads, State, Tracks
from headvox.errors import HeadvoxError
from headvox.identity import come_back, note_sightings, pairs, price
from headvox.kalman import (
    FIRST_RATE_RAD_S,
    MOVING,
    STILL,
    STILL_SPEED_M_S,
    combine,
    correct_places,
    correct_turns,
    predict_places,
    predict_turns,
)
from headvox.lifetime import age, judge_new
from headvox.noise import measurement_noise, widen
from headvox.roster import Roster
from headvox.visibility import BEHIND, NO_RETURN, OUT_OF_VIEW, SEEN_EMPTY, SURFACE, see_places

STILL_S, MOVING_S = 8.0, 2.0  # mean times that a head rests and moves
FIRST_SPEED_M_S = np.array([0.7, 0.7, 0.3])  # standard deviations of the velocity of a head that is new
UPRIGHT = np.array([1.0, 1.0, 0.4])  # heads move along the floor more than up and down
FADE_S = np.array([2.0, 2.0, 0.3])  # how long a head that is not seen goes on: up and down not for long
WANDER_M2_S = 1e-6  # a head at rest sways by a millimetre in a second
TURN_GATE = 16.3  # squared Mahalanobis distance: one in a thousand is farther
KNOWN_M = 0.1  # a place is seen to be empty only where it is known as well as this
LEAST_REACH_M, MOST_REACH_M = 0.12, 0.4  # about an expected place
EXPECTED_DIGITS = (
    3  # of a quaternion that a fit starts from: its rounding errors must not grow from frame to frame
)
FIRST_TRUST = 0.3


class Tracker:
    """Follows heads from frame to frame. Ids begin at 1 with each tracker and are never used again by it.

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
        self.config = config or TrackerConfig()
        self.untracked: Counter[str] = Counter()
        self.stamp_ns: int | None = None
        """Of the last frame that was tracked."""
        self._last_id = 0
        self._roster = Roster.blank(0)

    # ------------------------------------------------------------------------------------------- the public calls

    def update(self, heads: Heads, frame: Frame) -> Tracks:
        """Take the heads found in ``frame``, and return every track at its stamp.

        The images of the frame tell where a head that was not found may be hidden; a frame without any will do. A
        frame whose stamp is not after the last one's is not tracked: its heads come back as tentative tracks.
        """
        if not self._is_next(frame.stamp_ns):
            return _tentative(heads, frame.stamp_ns)
        R_centre, R_turn = measurement_noise(heads, frame)
        before_ns = frame.stamp_ns if self.stamp_ns is None else self.stamp_ns
        self._predict(before_ns, frame.stamp_ns)
        tracks, found = self._associate(heads, R_centre)
        self._correct(heads, R_centre, R_turn, tracks, found)
        self._age(frame, (frame.stamp_ns - before_ns) * 1e-9)
        new = heads.sure.copy()
        new[found] = False
        self._bear(heads, R_centre, R_turn, np.flatnonzero(new))
        return self._report(self._roster, frame.stamp_ns)

    def predict(self, stamp_ns: int) -> Tracks:
        """Return where the tracks will be at a stamp that is not before the last frame's; nothing is changed.

        Raises:
            HeadvoxError: an earlier stamp.
        """
        if self.stamp_ns is not None and stamp_ns < self.stamp_ns:
            raise HeadvoxError(
                f"Expected a stamp from {self.stamp_ns} ns on, the last frame's, got {stamp_ns} ns.",
                "Ask for the present or the future.",
            )
        return self._report(self._predicted(~self._roster.lost, stamp_ns), stamp_ns)

    def expected(self, stamp_ns: int) -> Expected:
        """Return where confirmed heads are expected at ``stamp_ns``, for :meth:`Detector.detect_frame`.

        Orientations are rounded to a tenth of a degree. A fit that starts from one may end degrees away from that which
        starts beside it, where the points say little of the yaw, and the next frame starts from there: without this,
        poses of a camera that differ by 1e-16 made heads differ by centimetres 50 frames later.
        """
        if self.stamp_ns is None or stamp_ns < self.stamp_ns:
            return Expected(np.empty((0, 3)), np.empty((0, 4)), np.empty(0))
        roster = self._predicted((self._roster.ids > 0) & ~self._roster.lost, stamp_ns)
        mean, cov = _combined(roster)
        reaches_m = np.minimum(np.maximum(3.0 * _widest(cov), LEAST_REACH_M), MOST_REACH_M)
        return Expected(mean[:, :3], np.round(roster.quaternions, EXPECTED_DIGITS), reaches_m)

    @property
    def ids_given(self) -> int:
        """How many heads were confirmed so far."""
        return self._last_id

    # -------------------------------------------------------------------------------------------------- the steps

    def _is_next(self, stamp_ns: int) -> bool:
        """Whether time goes on; counts where it does not, and starts anew when it jumped back far."""
        if self.stamp_ns is not None and stamp_ns <= self.stamp_ns:
            if self.stamp_ns - stamp_ns <= self.config.reset_s * 1e9:
                self.untracked["repeated" if stamp_ns == self.stamp_ns else "late"] += 1
                return False
            self.untracked["resets"] += 1
            self._roster = Roster.blank(0)
            self.stamp_ns = None
        return True

    def _predict(self, before_ns: int, stamp_ns: int) -> None:
        """Move every track on to ``stamp_ns``, and forget those that were not seen for too long."""
        self._keep(stamp_ns - self._roster.seen_ns <= self._longest_s() * 1e9)
        hits = self._roster.hits
        hits <<= 1
        hits &= 2**self.config.confirm_frames - 1
        self._move(self._roster, before_ns, stamp_ns)
        self.stamp_ns = stamp_ns

    def _associate(self, heads: Heads, R: F64) -> tuple[I64, I64]:
        """Return the pairs of tracks and heads, by index, that are likeliest as a whole."""
        costs = np.empty((self._roster.size, len(heads)))
        gate = self.config.gate_sigmas**2
        price(self._roster, heads.centres, R, heads.sure, gate, self._now(), costs)
        return pairs(costs)

    def _correct(self, heads: Heads, R_centre: F64, R_turn: F64, tracks: I64, found: I64) -> None:
        roster = self._roster
        widen(roster, tracks, found, self._now(), heads.centres, R_centre)
        correct_places(roster.x, roster.P, roster.weights, tracks, found, heads.centres, R_centre)
        correct_turns(
            roster.quaternions, roster.rates, roster.C, roster.rejected, tracks, found, heads.quaternions, R_turn,
            TURN_GATE,
        )  # fmt: skip
        note_sightings(
            roster, tracks, found, self._now(), heads.centres, heads.radii, heads.scores, heads.sure
        )

    def _age(self, frame: Frame, dt: float) -> None:
        """Let the tracks that were not surely seen lose life, by what the sensors saw of their places; end the dead."""
        config, roster = self.config, self._roster
        states = np.full(roster.size, OUT_OF_VIEW)
        missed = np.flatnonzero((roster.seen_ns != self.stamp_ns) & ~roster.lost)
        if len(missed):
            mean, cov = _combined(roster)
            seen = look_for(frame, mean[missed, :3], config.sight_m)
            seen[(seen == SEEN_EMPTY) & (_widest(cov[missed]) > KNOWN_M)] = SURFACE
            states[missed] = seen
        lasts_s = np.full(5, np.inf)
        lasts_s[[OUT_OF_VIEW, BEHIND, SEEN_EMPTY]] = config.out_of_view_s, config.hidden_s, config.empty_s
        age(roster, self._now(), dt, states, lasts_s, config.missed_s, config.weak_s)
        self._confirm()

    def _confirm(self) -> None:
        """Give an id to what was seen often enough, its old one if it was known; let go of what no longer can be."""
        roster = self._roster
        ready, kept = np.empty((2, roster.size), np.bool_)
        judge_new(roster, self.config.confirm_hits, ready, kept)
        if ready.any():
            new = np.flatnonzero(ready)
            back, known = come_back(roster, new, np.flatnonzero(roster.ids > 0))
            for column in (roster.ids, roster.born_ns, roster.heights, roster.sightings):
                column[back] = column[known]
            kept[known] = False  # its head goes on as the new track
            unknown = np.setdiff1d(new, back)
            roster.ids[unknown] = self._last_id + 1 + np.arange(len(unknown))
            self._last_id += len(unknown)
        self._keep(kept)

    def _bear(self, heads: Heads, R_centre: F64, R_turn: F64, new: I64) -> None:
        """Begin a track for each head of index ``new``."""
        if len(new) == 0:
            return
        born = Roster.blank(len(new))
        born.born_ns[:] = born.seen_ns[:] = self._now()
        born.hits[:], born.life[:], born.trust[:], born.sightings[:] = 1, 1.0, FIRST_TRUST, 1
        born.last[:, 0], born.last_ns[:, 0] = heads.centres[new], self._now()
        born.places[:], born.heights[:] = heads.centres[new], heads.centres[new, 2]
        born.radii[:], born.scores[:] = heads.radii[new], heads.scores[new]
        born.x[:, :, :3] = heads.centres[new, None]
        born.P[:, :, :3, :3] = R_centre[new, None]
        born.P[:, MOVING, 3:, 3:] = np.diag(FIRST_SPEED_M_S**2)
        born.P[:, STILL, 3:, 3:] = STILL_SPEED_M_S**2 * np.eye(3)
        born.weights[:] = 0.5
        born.quaternions[:] = heads.quaternions[new]
        born.C[:, :3, :3] = R_turn[new]
        born.C[:, 3:, 3:] = FIRST_RATE_RAD_S**2 * np.eye(3)
        self._roster = self._roster.and_also(born)
        if self.config.confirm_hits == 1:
            self._confirm()

    # ---------------------------------------------------------------------------------------------------- the rest

    def _now(self) -> int:
        assert self.stamp_ns is not None
        return self.stamp_ns

    def _keep(self, rows: npt.NDArray[np.bool_]) -> None:
        if not rows.all():
            self._roster = self._roster.rows(rows)

    def _longest_s(self) -> float:
        """How long any track may be unseen and still be something."""
        config = self.config
        return max(config.remember_s, config.hidden_s, config.missed_s, config.out_of_view_s, config.empty_s)

    def _move(self, roster: Roster, before_ns: int, stamp_ns: int) -> None:
        """Move tracks on from one stamp to another, in place."""
        config, dt = self.config, (stamp_ns - before_ns) * 1e-9
        density = (config.speed_change_m_s * UPRIGHT) ** 2
        turn_density = np.full(3, np.radians(config.turn_change_deg_s) ** 2)
        seen = roster.seen_ns == before_ns
        predict_places(
            roster.x, roster.P, roster.weights, seen, dt, STILL_S, MOVING_S, WANDER_M2_S, density, FADE_S
        )
        predict_turns(roster.quaternions, roster.rates, roster.C, dt, turn_density)

    def _predicted(self, rows: npt.NDArray[np.bool_], stamp_ns: int) -> Roster:
        roster = self._roster.rows(rows)
        if self.stamp_ns is not None:
            self._move(roster, self.stamp_ns, stamp_ns)
        return roster

    def _report(self, roster: Roster, stamp_ns: int) -> Tracks:
        """Return the living as tracks, those with an id first; a tentative one only in a frame where it is seen."""
        order = np.argsort(np.where(roster.ids > 0, roster.ids, np.iinfo(np.int64).max), kind="stable")
        stated = ~roster.lost & ((roster.ids > 0) | (roster.seen_ns == self.stamp_ns))
        roster = roster.rows(order[stated[order]])
        mean, cov = _combined(roster)
        states = np.where(roster.seen_ns == self.stamp_ns, State.CONFIRMED, State.COASTING)
        states[roster.ids == 0] = State.TENTATIVE
        unknown = np.isnan(roster.quaternions[:, 3])
        turns = roster.C[:, :3, :3].copy()
        roster.rates[unknown], turns[unknown] = np.nan, np.nan
        return Tracks(
            stamp_ns, roster.ids, states, mean[:, :3], mean[:, 3:], roster.quaternions, roster.rates,
            roster.radii, roster.scores, cov, turns,
            _seconds(roster.born_ns, stamp_ns), _seconds(roster.seen_ns, stamp_ns),
        )  # fmt: skip


def _combined(roster: Roster) -> tuple[F64, F64]:
    """Return mean (N, 6) and covariance (N, 6, 6) of position and velocity."""
    mean, cov = np.empty((roster.size, 6)), np.empty((roster.size, 6, 6))
    combine(roster.x, roster.P, roster.weights, mean, cov)
    return mean, cov


def _seconds(since_ns: I64, until_ns: int) -> F64:
    return np.asarray((until_ns - since_ns) * 1e-9, np.float64)


def _widest(cov: F64) -> F64:
    """Return the standard deviation of each place, over all axes together [m]."""
    widest: F64 = np.sqrt(cov[:, 0, 0] + cov[:, 1, 1] + cov[:, 2, 2])
    return widest


def look_for(frame: Frame, places: F64, sight_m: float) -> I64:
    """Return what the sensors saw of each of ``places`` (N, 3), see :func:`headvox.visibility.see_places`.

    Clouds do not tell which rays came back empty: near their sensor they count as NO_RETURN, and everywhere when nobody
    knows where that stood. So does a frame without any reading.
    """
    states = see_places(frame.depths, places, sight_m)
    if frame.depths and not frame.clouds:
        return states
    near = np.ones(len(places), np.bool_)
    if frame.clouds and all(cloud.T_world_sensor is not None for cloud in frame.clouds):
        origins = [_origin(cloud) for cloud in frame.clouds]
        near = (np.linalg.norm(places[:, None] - np.array(origins), axis=2) <= sight_m).any(axis=1)
    states[near] = np.maximum(states[near], NO_RETURN)
    return states


def _origin(cloud: Cloud) -> F64:
    assert cloud.T_world_sensor is not None
    return cloud.T_world_sensor[:3, 3]


def _tentative(heads: Heads, stamp_ns: int) -> Tracks:
    """Return bare detections as tracks without id and history."""
    count = len(heads)
    covariances = np.full((count, 6, 6), np.nan)
    covariances[:, :3, :3] = heads.centre_covariances
    none, nothing = np.zeros(count, np.int64), np.full((count, 3), np.nan)
    return Tracks(
        stamp_ns, none, np.full(count, State.TENTATIVE, np.int64), heads.centres, nothing, heads.quaternions, nothing,
        heads.radii, heads.scores, covariances, heads.rotation_covariances, np.zeros(count), np.zeros(count),
    )  # fmt: skip
