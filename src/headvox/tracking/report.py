"""What is handed out of a table of tracks: the tracks of a moment, and where heads are expected."""

from __future__ import annotations

import numpy as np

from headvox.data import Expected, Heads, State, Tracks
from headvox.machine.kernels import kernel
from headvox.pose.settle import SURE_YAW_RAD
from headvox.tracking.kalman import combine, widest
from headvox.tracking.roster import Roster

TENTATIVE, CONFIRMED, COASTING = int(State.TENTATIVE), int(State.CONFIRMED), int(State.COASTING)
LEAST_REACH_M, MOST_REACH_M = 0.12, 0.4  # about an expected place
# Of a quaternion that a fit starts from: its rounding errors must not grow from frame to frame.
EXPECTED_DIGITS = 1e3
# A fit that starts from a yaw that is less sure than this looks at no other, and would confirm it, wrong or not.
EXPECTED_YAW_RAD = np.radians(10.0)


def report(roster: Roster, last_ns: int, stamp_ns: int) -> Tracks:
    """Return the living as tracks, those with an id first.

    One that is absent is not stated, and a tentative one only where it was seen at ``last_ns``. An orientation whose
    yaw is less sure than ``SURE_YAW_RAD`` is not stated either, as the detector has it.

    ``last_ns`` is the stamp of the last frame, ``stamp_ns`` the moment to which ``roster`` was predicted.
    """
    order = np.empty(len(roster), np.int64)
    order = order[: list_stated(roster, last_ns, order)]
    n = len(order)
    tracks = Tracks(
        stamp_ns, np.empty(n, np.int64), np.empty(n, np.int64), np.empty((n, 3)), np.empty((n, 3)),
        np.empty((n, 4)), np.empty((n, 3)), np.empty(n), np.empty(n), np.empty((n, 6, 6)), np.empty((n, 3, 3)),
        np.empty(n), np.empty(n),
    )  # fmt: skip
    copy_out(
        roster, order, last_ns, stamp_ns, tracks.ids, tracks.states, tracks.centres, tracks.velocities,
        tracks.quaternions, tracks.rates, tracks.radii, tracks.scores, tracks.covariances,
        tracks.rotation_covariances, tracks.ages_s, tracks.unseen_s,
    )  # fmt: skip
    return tracks


def expectations(roster: Roster) -> Expected:
    """Return where the living that have an id are expected, in rows that were predicted.

    Only an orientation whose yaw is sure to ``EXPECTED_YAW_RAD`` is expected, and to a tenth of a degree. A fit that
    starts from one may end degrees away from that which starts beside it, where the points say little of the yaw, and
    the next frame starts from there: without this, poses of a camera that differ by 1e-16 made heads differ by
    centimetres 50 frames later.
    """
    n = len(roster)
    expected = Expected(np.empty((n, 3)), np.empty((n, 4)), np.empty(n))
    count = expect(roster, expected.centres, expected.quaternions, expected.reaches_m)
    return Expected(expected.centres[:count], expected.quaternions[:count], expected.reaches_m[:count])


def tentative(heads: Heads, stamp_ns: int) -> Tracks:
    """Return bare detections as tracks without id and history."""
    count = len(heads)
    covariances = np.full((count, 6, 6), np.nan)
    covariances[:, :3, :3] = heads.centre_covariances
    none, nothing = np.zeros(count, np.int64), np.full((count, 3), np.nan)
    return Tracks(
        stamp_ns, none, np.full(count, TENTATIVE, np.int64), heads.centres, nothing, heads.quaternions, nothing,
        heads.radii, heads.scores, covariances, heads.rotation_covariances, np.zeros(count), np.zeros(count),
    )  # fmt: skip


@kernel
def list_stated(roster, last_ns, order):
    """Write to ``order`` (N,) which rows are stated: by id, then those without one. Return how many."""
    count = 0
    for n in range(roster.shape[0]):
        row = roster[n]
        if row.lost or row.absent or (row.id == 0 and row.seen_ns != last_ns):
            continue
        at = count
        while at > 0 and row.id > 0 and not 0 < roster[order[at - 1]].id < row.id:
            order[at] = order[at - 1]
            at -= 1
        order[at] = n
        count += 1
    return count


@kernel
def copy_out(
    roster, order, last_ns, stamp_ns,
    ids, states, centres, velocities, quaternions, rates, radii, scores, covariances, turns, ages_s, unseen_s,
):  # fmt: skip
    """Write the rows with the numbers ``order`` (K,) to the columns (K, ...) of :class:`headvox.data.Tracks`."""
    mean = np.empty(6)
    for k in range(order.shape[0]):
        row = roster[order[k]]
        combine(row, mean, covariances[k])
        ids[k], radii[k], scores[k] = row.id, row.radius, row.score
        states[k] = CONFIRMED if row.seen_ns == last_ns else COASTING
        if row.id == 0:
            states[k] = TENTATIVE
        ages_s[k] = (stamp_ns - row.born_ns) * 1e-9
        unseen_s[k] = (stamp_ns - row.seen_ns) * 1e-9
        known = row.C[2, 2] < SURE_YAW_RAD * SURE_YAW_RAD and not np.isnan(row.q[3])
        for a in range(3):
            centres[k, a], velocities[k, a] = mean[a], mean[3 + a]
            rates[k, a] = row.rate[a] if known else np.nan
            for b in range(3):
                turns[k, a, b] = row.C[a, b] if known else np.nan
        for a in range(4):
            quaternions[k, a] = row.q[a] if known else np.nan


@kernel
def expect(roster, centres, quaternions, reaches_m):
    """Write the columns (N, ...) of :class:`headvox.data.Expected`; return how many rows of them there are."""
    mean, cov = np.empty(6), np.empty((6, 6))
    count = 0
    for n in range(roster.shape[0]):
        row = roster[n]
        if row.lost or row.id == 0:
            continue
        combine(row, mean, cov)
        for a in range(3):
            centres[count, a] = mean[a]
        sure = row.C[2, 2] < EXPECTED_YAW_RAD * EXPECTED_YAW_RAD
        for a in range(4):
            quaternions[count, a] = np.rint(row.q[a] * EXPECTED_DIGITS) / EXPECTED_DIGITS if sure else np.nan
        reaches_m[count] = min(max(3.0 * widest(cov), LEAST_REACH_M), MOST_REACH_M)
        count += 1
    return count
