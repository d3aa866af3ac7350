"""How far measured heads may be off: what the detector states, or a guess, and how much they are seen to scatter."""

from __future__ import annotations

import numpy as np

from headvox.data import F64, Frame, Heads
from headvox.machine.kernels import kernel, rule

FIRST_DISTANCE_M = 2.0  # from the nearest sensor, where nobody knows where any stands
FIRST_TURN_RAD = 0.35  # standard deviation of an orientation whose detector states none
RUN_S = 0.25  # sightings that are farther apart say nothing of the noise: the head may have done anything
SHARE = 1.0 / 30.0  # of the newest sighting in what is thought of the noise


@rule
def _be_round(R, sigma):
    """Write to ``R`` (3, 3) the covariance of what is off by ``sigma`` along each axis."""
    for a in range(3):
        for b in range(3):
            R[a, b] = sigma * sigma if a == b else 0.0


def measurement_noise(heads: Heads, frame: Frame) -> tuple[F64, F64]:
    """Return the covariances of centres [m²] and orientations [rad²], both (N, 3, 3): the detector's, or a guess.

    The guess for a centre grows with the square of the distance from the nearest sensor, as the noise of a depth
    camera does.
    """
    R_centre, R_turn = heads.centre_covariances.copy(), heads.rotation_covariances.copy()
    poses = [image.T_world_camera for image in frame.depths]
    poses += [cloud.T_world_sensor for cloud in frame.clouds if cloud.T_world_sensor is not None]
    eyes = np.array([T[:3, 3] for T in poses]) if poses else np.empty((0, 3))
    guess(heads.centres, eyes, R_centre, R_turn)
    return R_centre, R_turn


@kernel
def guess(centres, eyes, R_centre, R_turn):
    """Write a guess over the covariances (N, 3, 3) that are not known; ``eyes`` (S, 3) are where the sensors stand."""
    for n in range(centres.shape[0]):
        if np.isnan(R_centre[n, 0, 0]):
            nearest = np.inf if len(eyes) else FIRST_DISTANCE_M
            for eye in eyes:
                x, y, z = centres[n, 0] - eye[0], centres[n, 1] - eye[1], centres[n, 2] - eye[2]
                nearest = min(nearest, np.sqrt(x * x + y * y + z * z))
            _be_round(R_centre[n], 0.003 + 0.002 * (nearest * nearest))
        if np.isnan(R_turn[n, 0, 0]):
            _be_round(R_turn[n], FIRST_TURN_RAD)


@kernel
def widen(roster, tracks, found, now_ns, centres, R):
    """Add to the covariances ``R`` of the heads ``found`` (K,) how much the sightings of their ``tracks`` (K,) scatter.

    Three sightings in a row tell the noise from any motion but the strongest: the third from the line through the first
    two is off by e, whose covariance is that of the noise, (1 + (1 + r)² + r²) times, for steps of dt and r dt. What
    is stated also holds what is the same in every frame, so a filter of whose noise only half is stated follows it.
    """
    e = np.empty(3)
    for k in range(tracks.shape[0]):
        row, m = roster[tracks[k]], found[k]
        step = (now_ns - row.last_ns[0]) * 1e-9
        before = (row.last_ns[0] - row.last_ns[1]) * 1e-9
        if step < RUN_S and before < RUN_S:
            r = step / before
            share = SHARE / (1.0 + (1.0 + r) * (1.0 + r) + r * r)
            for a in range(3):
                e[a] = centres[m, a] - row.last[0, a] - r * (row.last[0, a] - row.last[1, a])
            for a in range(3):
                for b in range(3):
                    row.scatter[a, b] += share * e[a] * e[b] - SHARE * row.scatter[a, b]
        for a in range(3):
            row.last[1, a] = row.last[0, a]
            row.last[0, a] = centres[m, a]
            for b in range(3):
                R[m, a, b] += row.scatter[a, b]
        row.last_ns[1] = row.last_ns[0]
        row.last_ns[0] = now_ns
