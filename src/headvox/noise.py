"""How far measured heads may be off: what the detector states, or a guess, and how much they are seen to scatter."""

from __future__ import annotations

import numpy as np

from headvox.data import F64, Frame, Heads
from headvox.kernels import kernel

FIRST_TURN_RAD = 0.35  # standard deviation of an orientation whose detector states none
RUN_S = 0.25  # sightings that are farther apart say nothing of the noise: the head may have done anything
SHARE = 1.0 / 30.0  # of the newest sighting in what is thought of the noise


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
    return np.array(R_centre), np.ascontiguousarray(R_turn)


def _sensor_poses(frame: Frame) -> list[F64]:
    poses = [image.T_world_camera for image in frame.depths]
    return poses + [cloud.T_world_sensor for cloud in frame.clouds if cloud.T_world_sensor is not None]


@kernel
def widen(roster, tracks, found, now_ns, centres, R):  # type: ignore[no-untyped-def]
    """Add to the covariances ``R`` of the heads ``found`` (K,) how much the sightings of their ``tracks`` (K,) scatter.

    Three sightings in a row tell the noise from any motion but the strongest: the third from the line through the first
    two is off by e, whose covariance is that of the noise, (1 + (1 + r)² + r²) times, for steps of dt and r dt. What
    is stated also holds what is the same in every frame, so a filter of whose noise only half is stated follows it.
    """
    e = np.empty(3)
    for k in range(tracks.shape[0]):
        n, m = tracks[k], found[k]
        step = (now_ns - roster.last_ns[n, 0]) * 1e-9
        before = (roster.last_ns[n, 0] - roster.last_ns[n, 1]) * 1e-9
        if step < RUN_S and before < RUN_S:
            r = step / before
            share = SHARE / (1.0 + (1.0 + r) * (1.0 + r) + r * r)
            for a in range(3):
                e[a] = (
                    centres[m, a] - roster.last[n, 0, a] - r * (roster.last[n, 0, a] - roster.last[n, 1, a])
                )
            for a in range(3):
                for b in range(3):
                    roster.scatter[n, a, b] += share * e[a] * e[b] - SHARE * roster.scatter[n, a, b]
        for a in range(3):
            roster.last[n, 1, a] = roster.last[n, 0, a]
            roster.last[n, 0, a] = centres[m, a]
            for b in range(3):
                R[m, a, b] += roster.scatter[n, a, b]
        roster.last_ns[n, 1] = roster.last_ns[n, 0]
        roster.last_ns[n, 0] = now_ns
