"""The filters of a track in plain matrix algebra, as a textbook has them: twin of headvox.tracking.kalman."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

H = np.hstack([np.eye(3), np.zeros((3, 3))])


def transition(dt):
    return np.block([[np.eye(3), dt * np.eye(3)], [np.zeros((3, 3)), np.eye(3)]])


def white_noise(dt, density):
    q = np.diag(density)
    return np.block([[q * dt**3 / 3, q * dt**2 / 2], [q * dt**2 / 2, q * dt]])


def mixture(weights, means, covs):
    """Return mean and covariance of a sum of Gaussians."""
    mean = sum(w * m for w, m in zip(weights, means, strict=True))
    cov = sum(w * (P + np.outer(m - mean, m - mean)) for w, m, P in zip(weights, means, covs, strict=True))
    return mean, cov


def update(x, P, d, R):
    """Return the corrected state and covariance (in Joseph's form) for a measured difference ``d``."""
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    rest = np.eye(6) - K @ H
    return x + K @ d, rest @ P @ rest.T + K @ R @ K.T


def slowing(dt, fade_s):
    """Return what a speed that fades within ``fade_s`` (3,) does: the transition of position and velocity."""
    left = np.exp(-dt / fade_s)
    return np.block([[np.eye(3), np.diag(fade_s * (1 - left))], [np.zeros((3, 3)), np.diag(left)]])


def predict_place(x, P, weight, seen, dt, still_s, moving_s, wander, density, fade_s, still_speed):
    """Return models, covariances and weights of one track ``dt`` later."""
    rise, halt = 1 - np.exp(-dt / still_s), (1 - np.exp(-dt / moving_s)) * seen
    change = np.array([[1 - rise, rise], [halt, 1 - halt]])  # from the row to the column
    after = weight @ change
    mixed = [mixture(change[:, j] * weight / after[j], x, P) for j in range(2)]
    (still, P_still), (moving, P_moving) = mixed
    F = np.diag([1.0, 1, 1, 0, 0, 0])
    Q = np.diag([wander * dt] * 3 + [still_speed**2] * 3)
    still, P_still = F @ still, F @ P_still @ F.T + Q
    F = transition(dt) if seen else slowing(dt, fade_s)
    moving, P_moving = F @ moving, F @ P_moving @ F.T + white_noise(dt, density)
    return np.array([still, moving]), np.array([P_still, P_moving]), after


def surprise(x, P, weight, centre, R):
    """Return -2 ln of the density of a measured centre."""
    likely = [multivariate_normal.pdf(centre, m[:3], C[:3, :3] + R) for m, C in zip(x, P, strict=True)]
    return -2 * np.log(weight @ likely)


def correct_place(x, P, weight, centre, R):
    """Return models, covariances and weights of one track after it was measured."""
    likely = [multivariate_normal.pdf(centre, m[:3], C[:3, :3] + R) for m, C in zip(x, P, strict=True)]
    done = [update(m, C, centre - m[:3], R) for m, C in zip(x, P, strict=True)]
    after = weight * likely / np.sum(weight * likely)
    return np.array([m for m, _ in done]), np.array([C for _, C in done]), after


def predict_turn(q, rate, C, dt, density, fade_s):
    """Return orientation, turn rate and covariance ``dt`` later."""
    F = slowing(dt, np.full(3, fade_s))
    step = Rotation.from_rotvec(F[:3, 3:] @ rate)
    axes = np.eye(6)
    axes[:3, :3] = step.as_matrix().T  # the small turn, told in the axes of the head as it stands then
    F_axes = F @ axes
    C = F_axes @ C @ F_axes.T + white_noise(dt, density)
    return (Rotation.from_quat(q) * step).as_quat(), F[3:, 3:] @ rate, C


def correct_turn(q, rate, C, measured, R):
    """Return orientation, turn rate and covariance after it was measured, and the squared Mahalanobis distance."""
    d = (Rotation.from_quat(q).inv() * Rotation.from_quat(measured)).as_rotvec()
    squared = d @ np.linalg.inv(C[:3, :3] + R) @ d
    step, C = update(np.zeros(6), C, d, R)
    return (Rotation.from_quat(q) * Rotation.from_rotvec(step[:3])).as_quat(), rate + step[3:], C, squared
