"""The filters of a track: two linear motion models that share a position, and an orientation on its own manifold.

Position: an interacting-multiple-model filter (Blom and Bar-Shalom, 1988) of two Kalman filters on position and
velocity. The *still* model lets the position wander a little and has no velocity; the *moving* one has a velocity with
white acceleration. The weight of each follows from how well it foretold what was measured, so a head at rest is
smoothed hard, and one that sets off is followed at once.

Orientation: an error-state (multiplicative) Kalman filter. The state is a quaternion q, world from head, and the turn
rate in head axes [rad/s], which fades; the covariance is that of the small turn d in R_true = R exp(d), and of the
rate.

In a row of a roster (``roster.py``), ``x`` (2, 6) are position and velocity by the models, ``P`` (2, 6, 6) their
covariances, ``weights`` (2,) those of still and moving; ``q`` (4,) x y z w; ``rate`` (3,); ``C`` (6, 6) the covariance
of turn and rate.
"""

from __future__ import annotations

import numpy as np

from headvox.machine.kernels import kernel, rule

STILL, MOVING = 0, 1
LN_2_PI = float(np.log(2.0 * np.pi))
LEAST_WEIGHT = 1e-6  # a model is never ruled out for good
FIRST_RATE_RAD_S = 1.0
STILL_SPEED_M_S = 0.01  # what the still model takes for rest
REJECTED_BEFORE_RESET = 5  # orientations in a row that contradict a track before they are believed


# --------------------------------------------------------------------------------------------------------------- rules


@rule
def _invert(S, out):
    """Write the inverse of the symmetric (3, 3) ``S`` to ``out``; return its determinant."""
    a = S[1, 1] * S[2, 2] - S[1, 2] * S[1, 2]
    b = S[0, 2] * S[1, 2] - S[0, 1] * S[2, 2]
    c = S[0, 1] * S[1, 2] - S[0, 2] * S[1, 1]
    det = S[0, 0] * a + S[0, 1] * b + S[0, 2] * c
    out[0, 0] = a / det
    out[0, 1] = out[1, 0] = b / det
    out[0, 2] = out[2, 0] = c / det
    out[1, 1] = (S[0, 0] * S[2, 2] - S[0, 2] * S[0, 2]) / det
    out[1, 2] = out[2, 1] = (S[0, 1] * S[0, 2] - S[0, 0] * S[1, 2]) / det
    out[2, 2] = (S[0, 0] * S[1, 1] - S[0, 1] * S[0, 1]) / det
    return det


@rule
def _squared(S_inverse, d):
    """Return dᵀ S⁻¹ d."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += d[i] * S_inverse[i, j] * d[j]
    return total


@rule
def _drift(P, dt, density):
    """Predict the (6, 6) covariance of a value and its rate: F P Fᵀ + Q, with white noise on the rate's rate."""
    for i in range(3):
        for j in range(3):
            P[i, j] += dt * (P[i, 3 + j] + P[3 + i, j]) + dt * dt * P[3 + i, 3 + j]
    for i in range(3):
        for j in range(3):
            P[i, 3 + j] += dt * P[3 + i, 3 + j]
    _stir(P, dt, density)


@rule
def _fade(dt, fade_s):
    """Return how far a rate of 1 that fades within ``fade_s`` goes on in ``dt``, and what is left of it then."""
    left = np.exp(-dt / fade_s)
    return fade_s * (1.0 - left), left


@rule
def _go_on(P, i, way, left):
    """Predict the (6, 6) covariance: value ``i`` goes on by ``way`` times its rate, of which this much is ``left``."""
    for j in range(6):
        P[i, j] += way * P[3 + i, j]
        P[3 + i, j] *= left
    for j in range(6):
        P[j, i] += way * P[j, 3 + i]
        P[j, 3 + i] *= left


@rule
def _slow_down(x, P, dt, fade_s):
    """Predict the (6,) state and its covariance of what slows down: a speed that fades within ``fade_s`` (3,)."""
    for i in range(3):
        way, left = _fade(dt, fade_s[i])
        x[i] += way * x[3 + i]
        x[3 + i] *= left
        _go_on(P, i, way, left)


@rule
def _stir(P, dt, density):
    """Add to the (6, 6) covariance of a value and its rate what white noise on the rate's rate does in ``dt``."""
    for i in range(3):
        P[i, i] += density[i] * dt * dt * dt / 3.0
        P[i, 3 + i] += density[i] * dt * dt / 2.0
        P[3 + i, 3 + i] += density[i] * dt
        for j in range(3):
            P[3 + j, i] = P[i, 3 + j]


@rule
def _exchange(x, P, still, moving):
    """Let each of the two models begin from a mixture: of its own state by the share given, else of the other's."""
    for a in range(6):
        for b in range(a, 6):
            apart = (x[0, a] - x[1, a]) * (x[0, b] - x[1, b])
            p, r = P[0, a, b], P[1, a, b]
            P[0, a, b] = P[0, b, a] = still * p + (1.0 - still) * r + still * (1.0 - still) * apart
            P[1, a, b] = P[1, b, a] = moving * r + (1.0 - moving) * p + moving * (1.0 - moving) * apart
    for a in range(6):
        u, v = x[0, a], x[1, a]
        x[0, a] = still * u + (1.0 - still) * v
        x[1, a] = moving * v + (1.0 - moving) * u


@rule
def _correct(P, S, S_inverse, d, gain, step):
    """Kalman update for a measured (3,) difference ``d`` of covariance ``S``.

    What is to be added to the state goes to ``step``. The (6, 6) ``P`` becomes P - K S Kᵀ, symmetric to the last bit.
    """
    for i in range(6):
        for j in range(3):
            gain[i, j] = P[i, 0] * S_inverse[0, j] + P[i, 1] * S_inverse[1, j] + P[i, 2] * S_inverse[2, j]
        step[i] = gain[i, 0] * d[0] + gain[i, 1] * d[1] + gain[i, 2] * d[2]
    for i in range(6):
        for j in range(i, 6):
            known = 0.0
            for a in range(3):
                for b in range(3):
                    known += gain[i, a] * S[a, b] * gain[j, b]
            P[i, j] -= known
            P[j, i] = P[i, j]


@rule
def _turn(vector, out):
    """Write the quaternion of the rotation vector in the first three of ``vector`` [rad] to ``out``."""
    x, y, z = vector[0], vector[1], vector[2]
    angle = np.sqrt(x * x + y * y + z * z)
    scale = np.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
    out[0], out[1], out[2], out[3] = scale * x, scale * y, scale * z, np.cos(0.5 * angle)


@rule
def _compose(a, b, out):
    """Write the quaternion product a b, of length 1, to ``out``."""
    x = a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1]
    y = a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0]
    z = a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3]
    w = a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2]
    length = np.sqrt(x * x + y * y + z * z + w * w)
    out[0], out[1], out[2], out[3] = x / length, y / length, z / length, w / length


@rule
def _between(a, b, out):
    """Write the rotation vector d of b = a exp(d), at most pi long, to ``out``."""
    x = a[3] * b[0] - a[0] * b[3] - a[1] * b[2] + a[2] * b[1]
    y = a[3] * b[1] + a[0] * b[2] - a[1] * b[3] - a[2] * b[0]
    z = a[3] * b[2] - a[0] * b[1] + a[1] * b[0] - a[2] * b[3]
    w = a[3] * b[3] + a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    half_sine = np.sqrt(x * x + y * y + z * z)
    scale = 2.0 * np.arctan2(half_sine, w) / half_sine if half_sine > 1e-9 else 2.0
    out[0], out[1], out[2] = scale * x, scale * y, scale * z


@rule
def _rotated(q, a, b):
    """Return the entry a, b of the rotation matrix of the quaternion ``q``."""
    if a == b:
        return 1.0 - 2.0 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] - q[a] * q[a])
    turn = q[3] * q[3 - a - b]
    return 2.0 * (q[a] * q[b] + (turn if (b - a) % 3 == 2 else -turn))


@rule
def _new_axes(C, q, half):
    """Write the covariance of a turn, in axes that have moved on by the quaternion ``q``, over the first of ``C``."""
    for i in range(3):
        for j in range(6):
            half[i, j] = 0.0
            for k in range(3):
                half[i, j] += _rotated(q, k, i) * C[k, j]
    for i in range(3):
        for j in range(3):
            C[i, j] = (
                half[i, 0] * _rotated(q, 0, j)
                + half[i, 1] * _rotated(q, 1, j)
                + half[i, 2] * _rotated(q, 2, j)
            )
            C[i, 3 + j] = C[3 + j, i] = half[i, 3 + j]


# ------------------------------------------------------------------------------------------------------------- kernels


@kernel
def predict_places(roster, before_ns, dt, still_s, moving_s, wander, density, fade_s):
    """Mix the models and predict each by ``dt`` seconds, in place.

    ``still_s`` and ``moving_s`` are the mean times between a change of model [s], ``wander`` the variance that a still
    position gains a second [m²/s], ``density`` (3,) that of the white acceleration along each axis [m²/s³]. Of one that
    was not seen last time, at ``before_ns``, the speed fades within ``fade_s`` (3,), and what is still stays where it
    was seen: it may set off, but what moves does not come to rest in it.
    """
    rises, stops = 1.0 - np.exp(-dt / still_s), 1.0 - np.exp(-dt / moving_s)
    for n in range(roster.shape[0]):
        x, P, weights, seen = roster[n].x, roster[n].P, roster[n].weights, roster[n].seen_ns == before_ns
        halts = stops if seen else 0.0
        rested, moved = weights[STILL], weights[MOVING]
        weights[STILL] = rested * (1.0 - rises) + moved * halts
        weights[MOVING] = rested * rises + moved * (1.0 - halts)
        still = rested * (1.0 - rises) / weights[STILL]  # share of those that rest now that rested before
        moving = moved * (1.0 - halts) / weights[MOVING]
        _exchange(x, P, still, moving)
        for a in range(3):
            x[STILL, 3 + a] = 0.0
            for b in range(6):
                P[STILL, 3 + a, b] = P[STILL, b, 3 + a] = 0.0
            P[STILL, 3 + a, 3 + a] = STILL_SPEED_M_S * STILL_SPEED_M_S
            P[STILL, a, a] += wander * dt
        if seen:
            for a in range(3):
                x[MOVING, a] += dt * x[MOVING, 3 + a]
            _drift(P[MOVING], dt, density)
        else:
            _slow_down(x[MOVING], P[MOVING], dt, fade_s)
            _stir(P[MOVING], dt, density)


@kernel
def predict_turns(roster, dt, density, fade_s):
    """Predict orientations by ``dt`` seconds, in place; ``density`` (3,) [rad²/s³] is of white turn acceleration.

    A turn fades within ``fade_s``. If its rate stayed, a track that is put right by a great angle would take that for a
    turn, and could spin on for good: by 120 degrees a frame, every third measurement agrees with it.
    """
    step, half, angle = np.empty(4), np.empty((3, 6)), np.empty(3)
    way, left = _fade(dt, fade_s)
    for n in range(roster.shape[0]):
        q, rate, C = roster[n].q, roster[n].rate, roster[n].C
        if np.isnan(q[3]):
            continue
        for a in range(3):
            angle[a] = way * rate[a]
            rate[a] *= left
        _turn(angle, step)
        _compose(q, step, q)
        _new_axes(C, step, half)
        for a in range(3):
            _go_on(C, a, way, left)
        _stir(C, dt, density)


@kernel
def combine(row, mean, cov):
    """Write the mean (6,) and the covariance (6, 6) of both models of a track together."""
    x, P, still, moving = row.x, row.P, row.weights[STILL], row.weights[MOVING]
    for a in range(6):
        mean[a] = still * x[0, a] + moving * x[1, a]
        for b in range(6):
            apart = (x[0, a] - x[1, a]) * (x[0, b] - x[1, b])
            cov[a, b] = still * P[0, a, b] + moving * P[1, a, b] + still * moving * apart


@kernel
def widest(cov):
    """Return the standard deviation of a place of covariance ``cov`` (6, 6), over all axes together [m]."""
    return np.sqrt(cov[0, 0] + cov[1, 1] + cov[2, 2])


@rule
def _surprise(x, P, weights, centre, R, S, S_inverse, d):
    """Return -2 ln of how likely a measured ``centre`` of covariance ``R`` is, of both models together [ln m⁻³]."""
    best, total = -np.inf, 0.0
    for i in range(2):
        for a in range(3):
            d[a] = centre[a] - x[i, a]
            for b in range(3):
                S[a, b] = P[i, a, b] + R[a, b]
        log_det = np.log(_invert(S, S_inverse))
        fit = np.log(weights[i]) - 0.5 * (_squared(S_inverse, d) + log_det)
        if fit > best:
            total = total * np.exp(best - fit) + 1.0
            best = fit
        else:
            total += np.exp(fit - best)
    return -2.0 * (best + np.log(total)) + 3.0 * LN_2_PI


@kernel
def compare(roster, mean, cov, centres, R, squared, surprise):
    """Write how well each of M measured ``centres`` fits to each of N tracks, both (N, M).

    ``squared`` is the squared Mahalanobis distance from ``mean`` and ``cov`` (of :func:`combine`), ``surprise`` -2 ln
    of the density [m⁻³] of finding it there, of both models: a head at rest is mostly found where it was, and
    anywhere about when it has set off. ``R`` (M, 3, 3) are the covariances of the centres.
    """
    S, S_inverse, d = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for n in range(mean.shape[0]):
        for m in range(centres.shape[0]):
            for a in range(3):
                d[a] = centres[m, a] - mean[n, a]
                for b in range(3):
                    S[a, b] = cov[n, a, b] + R[m, a, b]
            _invert(S, S_inverse)
            squared[n, m] = _squared(S_inverse, d)
            surprise[n, m] = _surprise(
                roster[n].x, roster[n].P, roster[n].weights, centres[m], R[m], S, S_inverse, d
            )


@kernel
def correct_places(roster, tracks, heads, centres, R):
    """Update the tracks with index ``tracks`` (K,) by the measured centres with index ``heads`` (K,), in place."""
    S, S_inverse, d = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    gain, step, fit = np.empty((6, 3)), np.empty(6), np.empty(2)
    for k in range(tracks.shape[0]):
        m = heads[k]
        x, P, weights = roster[tracks[k]].x, roster[tracks[k]].P, roster[tracks[k]].weights
        for i in range(2):
            for a in range(3):
                d[a] = centres[m, a] - x[i, a]
                for b in range(3):
                    S[a, b] = P[i, a, b] + R[m, a, b]
            det = _invert(S, S_inverse)
            fit[i] = -0.5 * (_squared(S_inverse, d) + np.log(det))
            _correct(P[i], S, S_inverse, d, gain, step)
            for a in range(6):
                x[i, a] += step[a]
        best = max(fit[0], fit[1])
        still, moving = weights[STILL] * np.exp(fit[0] - best), weights[MOVING] * np.exp(fit[1] - best)
        weights[STILL] = min(max(still / (still + moving), LEAST_WEIGHT), 1.0 - LEAST_WEIGHT)
        weights[MOVING] = 1.0 - weights[STILL]


@kernel
def correct_turns(roster, tracks, heads, measured, R, gate):
    """Update orientations by the ``measured`` quaternions, in place; rows of NaN are passed over.

    One that lies farther than ``gate`` (squared Mahalanobis distance) is taken for a flip and left out. After
    ``REJECTED_BEFORE_RESET`` of those in a row it is the track that is wrong, and it starts anew from the last.
    """
    S, S_inverse, d = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    gain, step, small = np.empty((6, 3)), np.empty(6), np.empty(4)
    for k in range(tracks.shape[0]):
        row, m = roster[tracks[k]], heads[k]
        if np.isnan(measured[m, 3]):
            continue
        q, rate, C, start = row.q, row.rate, row.C, np.isnan(row.q[3])
        if not start:
            _between(q, measured[m], d)
            for a in range(3):
                for b in range(3):
                    S[a, b] = C[a, b] + R[m, a, b]
            _invert(S, S_inverse)
            if _squared(S_inverse, d) > gate:
                row.rejected += 1
                start = row.rejected >= REJECTED_BEFORE_RESET
                if not start:
                    continue
        row.rejected = 0
        if start:
            for a in range(3):
                q[a] = measured[m, a]
                rate[a] = 0.0
                for b in range(3):
                    C[a, b] = R[m, a, b]
                    C[a, 3 + b] = C[3 + b, a] = C[3 + a, 3 + b] = 0.0
                C[3 + a, 3 + a] = FIRST_RATE_RAD_S * FIRST_RATE_RAD_S
            q[3] = measured[m, 3]
            continue
        _correct(C, S, S_inverse, d, gain, step)
        _turn(step, small)
        _compose(q, small, q)
        for a in range(3):
            rate[a] += step[3 + a]
