"""From heads to tracks: who is who, where everybody is now, and how fast.

A frame is five steps: predict, associate, correct, age, bear (:meth:`Tracker.update`). The filters are in
``kalman.py``. What keeps a track alive is in :meth:`Tracker._age`: it dies fast where its place is seen to be empty,
later where it is hidden.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from headvox.config import TrackerConfig
from headvox.data import F64, I64, Cloud, Expected, Frame, Heads, State, Tracks
from headvox.errors import HeadvoxError
from headvox.kalman import (
    FIRST_RATE_RAD_S,
    MOVING,
    STILL,
    STILL_SPEED_M_S,
    combine,
    compare,
    correct_places,
    correct_turns,
    predict_places,
    predict_turns,
)
from headvox.visibility import BEHIND, NO_RETURN, OUT_OF_VIEW, SEEN_EMPTY, SURFACE, see_places

STILL_S, MOVING_S = 1.0, 2.0  # mean times that a head rests and moves
FIRST_SPEED_M_S = np.array([0.7, 0.7, 0.3])  # standard deviations of the velocity of a head that is new
UPRIGHT = np.array([1.0, 1.0, 0.4])  # heads move along the floor more than up and down
WANDER_M2_S = 1e-6  # a head at rest sways by a millimetre in a second
TURN_GATE = 16.3  # squared Mahalanobis distance: one in a thousand is farther
FIRST_TURN_RAD = 0.35  # standard deviation of an orientation whose detector states none
SLACK_M = (
    0.03  # errors of a detector that stay for a while (hair, view): no noise to a filter, but room for a gate
)
NEAR_M, WALK_M_S, FARTHEST_M = 0.35, 1.2, 1.2  # a head is never sought farther than this from its prediction
UP_M = 0.15  # nor farther than this above or below, nor from the height it was last seen at
SAME_HEAD_M = 0.18  # two heads are not closer: what is found so near to a head is that head, however it moved
KNOWN_M = 0.1  # a place is seen to be empty only where it is known as well as this
BACK_M, BACK_M_S, BACK_FARTHEST_M = (
    0.4,
    1.0,
    2.0,
)  # a lost head is not farther than this from the way it was lost on
BACK_HEIGHT_M = 0.1
LEAST_REACH_M, MOST_REACH_M = 0.12, 0.4  # about an expected place
EXPECTED_DIGITS = (
    3  # of a quaternion that a fit starts from: its rounding errors must not grow from frame to frame
)
FIRST_TRUST = 0.3
MOST_DRAIN = 0.5  # of its life a track loses in one frame, however long: one miss never ends it
NOT_A_PAIR = 1e6

TRACK = np.dtype(
    [
        ("id", np.int64),  # 0 until confirmed
        ("born_ns", np.int64),
        ("seen_ns", np.int64),
        ("hits", np.int64),  # a bit a frame, the last frame lowest
        ("life", np.float64),  # 1 when seen, dies at 0
        (
            "trust",
            np.float64,
        ),  # grows while it is seen, shrinks while its place is in plain view without it; so too
        ("lost", np.bool_),  # dead, but remembered
        ("place", np.float64, 3),  # where it was last seen, and how fast
        ("velocity", np.float64, 3),
        ("radius", np.float64),
        ("score", np.float64),
        ("x", np.float64, (2, 6)),
        ("P", np.float64, (2, 6, 6)),
        ("weight", np.float64, 2),
        ("q", np.float64, 4),
        ("rate", np.float64, 3),
        ("C", np.float64, (6, 6)),
        ("rejected", np.int64),
    ],
    align=True,
)
Table = npt.NDArray[np.void]


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
        self._table: Table = np.empty(0, TRACK)

    # ------------------------------------------------------------------------------------------- the public calls

    def update(self, heads: Heads, frame: Frame) -> Tracks:
        """Take the heads found in ``frame``, and return every track at its stamp.

        The images of the frame tell where a head that was not found may be hidden; a frame without any will do. A
        frame whose stamp is not after the last one's is not tracked: its heads come back as tentative tracks.
        """
        if not self._is_next(frame.stamp_ns):
            return _tentative(heads, frame.stamp_ns)
        R_centre, R_turn = measurement_noise(heads, frame)
        dt = self._predict(frame.stamp_ns)
        tracks, found = self._associate(heads, R_centre)
        self._correct(heads, R_centre, R_turn, tracks, found)
        self._age(frame, dt, tracks, heads.sure[found])
        new = heads.sure.copy()
        new[found] = False
        self._bear(heads, R_centre, R_turn, np.flatnonzero(new))
        return self._report(self._table, frame.stamp_ns)

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
        return self._report(self._predicted(~self._table["lost"], stamp_ns), stamp_ns)

    def expected(self, stamp_ns: int) -> Expected:
        """Return where confirmed heads are expected at ``stamp_ns``, for :meth:`Detector.detect_frame`.

        Orientations are rounded to a tenth of a degree. A fit that starts from one may end degrees away from that which
        starts beside it, where the points say little of the yaw, and the next frame starts from there: without this,
        poses of a camera that differ by 1e-16 made heads differ by centimetres 50 frames later.
        """
        if self.stamp_ns is None or stamp_ns < self.stamp_ns:
            return Expected(np.empty((0, 3)), np.empty((0, 4)), np.empty(0))
        table = self._predicted((self._table["id"] > 0) & ~self._table["lost"], stamp_ns)
        mean, cov = _combined(table)
        reaches_m = np.clip(3.0 * _widest(cov), LEAST_REACH_M, MOST_REACH_M)
        return Expected(mean[:, :3], np.round(table["q"], EXPECTED_DIGITS), reaches_m)

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
            self._table = np.empty(0, TRACK)
            self.stamp_ns = None
        return True

    def _predict(self, stamp_ns: int) -> float:
        """Move every track on to ``stamp_ns``; return the seconds since the last frame."""
        dt = 0.0 if self.stamp_ns is None else (stamp_ns - self.stamp_ns) * 1e-9
        self.stamp_ns = stamp_ns
        self._keep(stamp_ns - self._table["seen_ns"] <= self._longest_s() * 1e9)
        self._table["hits"] = (self._table["hits"] << 1) & (2**self.config.confirm_frames - 1)
        self._move(self._table, dt)
        return dt

    def _associate(self, heads: Heads, R: F64) -> tuple[I64, I64]:
        """Return the pairs of tracks and heads, by index, that are likeliest as a whole."""
        table = self._table
        if len(table) == 0 or len(heads) == 0:
            return np.empty(0, np.int64), np.empty(0, np.int64)
        mean, cov = _combined(table)
        squared, log_det = np.empty((2, len(table), len(heads)))
        compare(mean, cov, heads.centres, R + SLACK_M**2 * np.eye(3), squared, log_det)
        away = heads.centres - mean[:, None, :3]
        far = np.linalg.norm(away, axis=2)
        up = np.abs(heads.centres[:, 2] - table["place"][:, 2, None])
        np.minimum(up, np.abs(away[:, :, 2]), out=up)
        unseen_s = (self._now() - table["seen_ns"])[:, None] * 1e-9
        possible = (squared <= self.config.gate_sigmas**2) | (far <= SAME_HEAD_M)
        possible &= far <= np.minimum(NEAR_M + WALK_M_S * unseen_s, FARTHEST_M)
        possible &= up <= UP_M
        possible &= ~table["lost"][:, None]
        possible &= (table["id"] > 0)[:, None] | heads.sure
        tracks, found = linear_sum_assignment(np.where(possible, squared + log_det, NOT_A_PAIR))
        paired = possible[tracks, found]
        return tracks[paired], found[paired]

    def _correct(self, heads: Heads, R_centre: F64, R_turn: F64, tracks: I64, found: I64) -> None:
        table = self._table
        with _in_one_piece(table, "x", "P", "weight") as columns:
            correct_places(*columns, tracks, found, heads.centres, R_centre)
        with _in_one_piece(table, "q", "rate", "C", "rejected") as columns:
            correct_turns(*columns, tracks, found, heads.quaternions, R_turn, TURN_GATE)
        table["seen_ns"][tracks] = self._now()
        table["radius"][tracks] = heads.radii[found]
        table["score"][tracks] = heads.scores[found]
        mean, _ = _combined(table[tracks])
        table["place"][tracks], table["velocity"][tracks] = mean[:, :3], mean[:, 3:]
        table["hits"][tracks] |= heads.sure[found]

    def _age(self, frame: Frame, dt: float, tracks: I64, sure: npt.NDArray[np.bool_]) -> None:
        """Let the tracks that were not surely seen lose life, by what the sensors saw of their places; end the dead."""
        config, table = self.config, self._table
        lasts_s = np.full(len(table), np.inf)
        trusted_s = np.full(len(table), np.inf)
        missed = ~table["lost"]
        missed[tracks] = False
        if missed.any():
            limits = np.full(5, np.inf)
            limits[[OUT_OF_VIEW, BEHIND, SEEN_EMPTY]] = config.out_of_view_s, config.hidden_s, config.empty_s
            mean, cov = _combined(table[missed])
            seen = look_for(frame, mean[:, :3], config.sight_m)
            seen[(seen == SEEN_EMPTY) & (_widest(cov) > KNOWN_M)] = SURFACE
            lasts_s[missed] = limits[seen]
            trusted_s[missed] = np.where((seen == OUT_OF_VIEW) | (seen == BEHIND), np.inf, config.missed_s)
        lasts_s[tracks[~sure]] = trusted_s[tracks[~sure]] = config.weak_s
        trusted_s[tracks[sure]] = -config.missed_s
        table["life"] -= np.minimum(dt / lasts_s, MOST_DRAIN)
        table["life"][tracks[sure]] = 1.0
        table["trust"] = np.minimum(table["trust"] - np.minimum(dt / trusted_s, MOST_DRAIN), 1.0)
        dead = (np.minimum(table["life"], table["trust"]) <= 0.0) & ~table["lost"]
        table["lost"] |= dead
        self._keep(~(dead & (table["id"] == 0)) & self._may_be_confirmed())

    def _may_be_confirmed(self) -> npt.NDArray[np.bool_]:
        """Confirm what was seen often enough; return False for what can no longer be."""
        table, config = self._table, self.config
        seen = sum((table["hits"] >> k) & 1 for k in range(config.confirm_frames))
        for n in np.flatnonzero((table["id"] == 0) & (seen >= config.confirm_hits)):
            table["id"][n] = self._identify(int(n))
        return (table["id"] > 0) | (table["hits"] > 0)

    def _identify(self, n: int) -> int:
        """Return the id of the lost head that the new track ``n`` is, or else a new id."""
        table = self._table
        lost = np.flatnonzero((table["id"] > 0) & (table["seen_ns"] < table["born_ns"][n]))
        if len(lost):
            unseen_s = (table["seen_ns"][n] - table["seen_ns"][lost]) * 1e-9
            away = table["place"][n] - table["place"][lost]
            path = (
                table["velocity"][lost] * unseen_s[:, None]
            )  # if it went on, or stopped anywhere on the way
            share = np.clip((away * path).sum(axis=1) / np.maximum((path**2).sum(axis=1), 1e-9), 0.0, 1.0)
            away -= share[:, None] * path
            reach = np.minimum(BACK_M + BACK_M_S * unseen_s, BACK_FARTHEST_M)
            unlike = np.linalg.norm(
                away / np.stack([reach, reach, np.full(len(lost), BACK_HEIGHT_M)], 1), axis=1
            )
            best = int(np.argmin(unlike))
            if unlike[best] <= 1.0:
                table["hits"][lost[best]] = 0
                known = int(table["id"][lost[best]])
                table["id"][lost[best]] = 0  # dies now: its head goes on as the new track
                table["born_ns"][n] = table["born_ns"][lost[best]]
                return known
        self._last_id += 1
        return self._last_id

    def _bear(self, heads: Heads, R_centre: F64, R_turn: F64, new: I64) -> None:
        """Begin a track for each head of index ``new``."""
        if len(new) == 0:
            return
        born: Table = np.zeros(len(new), TRACK)
        born["born_ns"] = born["seen_ns"] = self._now()
        born["hits"], born["life"], born["trust"] = 1, 1.0, FIRST_TRUST
        born["place"] = heads.centres[new]
        born["radius"], born["score"] = heads.radii[new], heads.scores[new]
        born["x"][:, :, :3] = heads.centres[new, None]
        born["P"][:, :, :3, :3] = R_centre[new, None]
        born["P"][:, MOVING, 3:, 3:] = np.diag(FIRST_SPEED_M_S**2)
        born["P"][:, STILL, 3:, 3:] = STILL_SPEED_M_S**2 * np.eye(3)
        born["weight"] = 0.5
        born["q"] = heads.quaternions[new]
        born["C"][:, :3, :3] = R_turn[new]
        born["C"][:, 3:, 3:] = FIRST_RATE_RAD_S**2 * np.eye(3)
        self._table = np.concatenate([self._table, born])
        if self.config.confirm_hits == 1:
            self._may_be_confirmed()

    # ---------------------------------------------------------------------------------------------------- the rest

    def _now(self) -> int:
        assert self.stamp_ns is not None
        return self.stamp_ns

    def _keep(self, rows: npt.NDArray[np.bool_]) -> None:
        if not rows.all():  # a table of many fields is slow to copy
            self._table = self._table[rows]

    def _longest_s(self) -> float:
        """How long any track may be unseen and still be something."""
        config = self.config
        return max(config.remember_s, config.hidden_s, config.missed_s, config.out_of_view_s, config.empty_s)

    def _move(self, table: Table, dt: float) -> None:
        config = self.config
        density = (config.speed_change_m_s * UPRIGHT) ** 2
        turn_density = np.full(3, np.radians(config.turn_change_deg_s) ** 2)
        with _in_one_piece(table, "x", "P", "weight") as columns:
            predict_places(*columns, dt, STILL_S, MOVING_S, WANDER_M2_S, density)
        with _in_one_piece(table, "q", "rate", "C") as columns:
            predict_turns(*columns, dt, turn_density)

    def _predicted(self, rows: npt.NDArray[np.bool_], stamp_ns: int) -> Table:
        table = self._table[rows]
        if self.stamp_ns is not None:
            self._move(table, (stamp_ns - self.stamp_ns) * 1e-9)
        return table

    def _report(self, table: Table, stamp_ns: int) -> Tracks:
        """Return the living rows of ``table`` as tracks, those with an id first."""
        order = np.argsort(np.where(table["id"] > 0, table["id"], np.iinfo(np.int64).max), kind="stable")
        table = table[order[~table["lost"][order]]]
        mean, cov = _combined(table)
        unseen_s = (stamp_ns - table["seen_ns"]) * 1e-9
        states = np.where(table["seen_ns"] == self.stamp_ns, State.CONFIRMED, State.COASTING)
        states[table["id"] == 0] = State.TENTATIVE
        unknown = np.isnan(table["q"][:, 3])
        rates, turns = table["rate"].copy(), table["C"][:, :3, :3].copy()
        rates[unknown], turns[unknown] = np.nan, np.nan
        return Tracks(
            stamp_ns, table["id"].copy(), states, mean[:, :3], mean[:, 3:], table["q"].copy(), rates,
            table["radius"].copy(), table["score"].copy(), cov, turns,
            (stamp_ns - table["born_ns"]) * 1e-9, unseen_s,
        )  # fmt: skip


def _combined(table: Table) -> tuple[F64, F64]:
    """Return mean (N, 6) and covariance (N, 6, 6) of position and velocity."""
    mean, cov = np.empty((len(table), 6)), np.empty((len(table), 6, 6))
    with _in_one_piece(table, "x", "P", "weight") as columns:
        combine(*columns, mean, cov)
    return mean, cov


@contextmanager
def _in_one_piece(table: Table, *names: str) -> Iterator[list[npt.NDArray[Any]]]:
    """Lend columns of ``table`` as contiguous arrays, and put back what was written to them.

    The column of a table with one row is contiguous, that of a longer one is not: the loops would be compiled for both.
    """
    columns = [np.ascontiguousarray(table[name]) for name in names]
    yield columns
    for name, column in zip(names, columns, strict=True):
        table[name] = column


def _widest(cov: F64) -> F64:
    """Return the standard deviation of each place, over all axes together [m]."""
    widest: F64 = np.sqrt(np.trace(cov[:, :3, :3], axis1=1, axis2=2))
    return widest


def measurement_noise(heads: Heads, frame: Frame) -> tuple[F64, F64]:
    """Return the covariances of centres [m²] and orientations [rad²], both (N, 3, 3): the detector's, or a guess.

    The guess for a centre grows with the square of the distance from the nearest sensor, as the noise of a depth
    camera does.
    """
    R_centre, R_turn = heads.centre_covariances, heads.rotation_covariances
    unknown = np.isnan(R_centre[:, 0, 0])
    if unknown.any():
        places = [T[:3, 3] for T in _sensor_poses(frame)]
        away = np.linalg.norm(heads.centres[:, None] - np.reshape(places, (-1, 3)), axis=2)
        nearest = away.min(axis=1, initial=2.0 if not places else np.inf)
        sigma = 0.003 + 0.002 * nearest**2
        R_centre = np.where(unknown[:, None, None], sigma[:, None, None] ** 2 * np.eye(3), R_centre)
    unknown = np.isnan(R_turn[:, 0, 0])
    if unknown.any():
        R_turn = np.where(unknown[:, None, None], FIRST_TURN_RAD**2 * np.eye(3), R_turn)
    return np.ascontiguousarray(R_centre), np.ascontiguousarray(R_turn)


def _sensor_poses(frame: Frame) -> list[F64]:
    poses = [image.T_world_camera for image in frame.depths]
    return poses + [cloud.T_world_sensor for cloud in frame.clouds if cloud.T_world_sensor is not None]


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
