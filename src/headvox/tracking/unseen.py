"""Where a head may be that was not found: not where the sensors saw through, nor where another one is.

A track that is missed is spread over places, and what was seen of each of them is evidence, although no head was found
(Koch, "On exploiting 'negative' sensor evidence for target tracking and sensor data fusion", Information Fusion 8,
2007). Each of a track's two models is sampled on a grid along the floor, every sample is weighted by how likely it is
that a head there gave these readings and was missed, and what is left becomes the mean and the covariance of the model.
"""

from __future__ import annotations

import numpy as np

from headvox.data import F64, I64, Cloud, Frame
from headvox.machine.kernels import kernel, rule
from headvox.tracking.kalman import LEAST_WEIGHT, MOVING, STILL, combine
from headvox.tracking.roster import Roster
from headvox.visibility import NO_RETURN, OUT_OF_VIEW, SEEN_EMPTY, SURFACE, see_places

STEPS, STEP = 5, 0.5  # a grid of so many steps to each side, 2.5 standard deviations
SIDE = 2 * STEPS + 1
SAMPLES = 2 * SIDE * SIDE  # of a track: the still model's, then the moving one's
PRIOR = np.exp(-0.5 * (STEP * np.arange(-STEPS, STEPS + 1)) ** 2)
PRIOR /= PRIOR.sum()
# Of the samples, before any evidence.
VARIANCE = float((PRIOR * (STEP * np.arange(-STEPS, STEPS + 1)) ** 2).sum())

# How likely a reading is where a head is that was missed, over how likely it is where none is: near 0 where the sensors
# saw through, and less than elsewhere out of their view: most who are missed are not just walking out of it.
LIKELY = np.ones(SEEN_EMPTY + 1)
LIKELY[OUT_OF_VIEW], LIKELY[SEEN_EMPTY] = 0.15, 0.02
TAKEN_M = 0.2  # nearer than this to another head there is none
# How likely that is all the same: where one was found, and where one is missed, too.
TAKEN, DISPUTED = 0.02, 0.2
KNOWN_M = 0.4  # one that is missed claims its place only if it is known as well as this
GONE = 0.05  # so little left of a track: it is nowhere
RIGHT_M, LEAST_SURE = 0.3, 0.5  # a track is stated where it is likelier than not that its head is so near


def search(roster: Roster, rows: I64, frame: Frame, sight_m: float, centres: F64) -> I64:
    """Let the tracks ``rows`` (N,), which were missed, be where the sensors do not say that they are not.

    ``centres`` (M, 3) are the heads that were found. Returns what is seen of most of the places that are left to each:
    (N,), OUT_OF_VIEW to SEEN_EMPTY, this if none is left. A track that may be anywhere in view is marked as absent.
    """
    places, weights = np.empty((len(rows), SAMPLES, 3)), np.empty((len(rows), SAMPLES))
    spread(roster, rows, places)
    seen = look_for(frame, places.reshape(-1, 3), sight_m).reshape(weights.shape)
    weigh(roster, rows, places, seen, centres, weights)
    narrow(roster, rows, weights)
    states = np.empty(len(rows), np.int64)
    conclude(roster, rows, places, seen, weights, states)
    return states


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


@rule
def _root(P):
    """Return a, b, c of the lower triangular root (a, 0; b, c) of a covariance along the floor."""
    a = np.sqrt(P[0, 0])
    b = P[0, 1] / a
    return a, b, np.sqrt(max(P[1, 1] - b * b, 1e-12))


@rule
def _apart(places, at):
    """Return the squared distance of two places."""
    x, y, z = places[0] - at[0], places[1] - at[1], places[2] - at[2]
    return x * x + y * y + z * z


@kernel
def spread(roster, rows, places):
    """Write ``places`` (N, SAMPLES, 3) where the heads of the tracks ``rows`` (N,) may be."""
    for k in range(rows.shape[0]):
        s = 0
        for i in range(2):
            x = roster[rows[k]].x[i]
            a, b, c = _root(roster[rows[k]].P[i])
            for u in range(-STEPS, STEPS + 1):
                for v in range(-STEPS, STEPS + 1):
                    places[k, s, 0] = x[0] + STEP * a * u
                    places[k, s, 1] = x[1] + STEP * (b * u + c * v)
                    places[k, s, 2] = x[2]
                    s += 1


@kernel
def weigh(roster, rows, places, seen, centres, weights):
    """Write how likely each of the ``places`` (N, SAMPLES, 3) is: ``weights`` (N, SAMPLES).

    ``seen`` (N, SAMPLES) is what the sensors saw of them, ``centres`` (M, 3) are the heads that were found. Before any
    evidence, the weights of a track are 1 together.
    """
    count = rows.shape[0]
    means, cov, claims = np.empty((count, 6)), np.empty((6, 6)), np.empty(count, np.bool_)
    for k in range(count):
        combine(roster[rows[k]], means[k], cov)
        claims[k] = roster[rows[k]].id > 0 and cov[0, 0] + cov[1, 1] < KNOWN_M * KNOWN_M
    for k in range(count):
        for s in range(SAMPLES):
            grid = s % (SIDE * SIDE)
            weight = roster[rows[k]].weights[s // (SIDE * SIDE)] * PRIOR[grid // SIDE] * PRIOR[grid % SIDE]
            likely = LIKELY[seen[k, s]]
            for m in range(centres.shape[0]):
                if _apart(places[k, s], centres[m]) < TAKEN_M * TAKEN_M:
                    likely = min(likely, TAKEN)
            for n in range(count):
                if n != k and claims[n] and _apart(places[k, s], means[n]) < TAKEN_M * TAKEN_M:
                    likely *= DISPUTED
            weights[k, s] = weight * likely


@kernel
def narrow(roster, rows, weights):
    """Give the models of the tracks ``rows`` (N,) mean and covariance of their ``weights`` (N, SAMPLES), in place.

    With P_ff = L Lᵀ for the floor's part of a covariance, and mean m and covariance C of the samples in steps of L,
    A = P_·f L⁻ᵀ gives x + A m and P - A (I - C) Aᵀ: heights and velocities follow by what ties them to the place.
    """
    A, C, m, share = np.empty((6, 2)), np.empty((2, 2)), np.empty(2), np.empty(2)
    for k in range(rows.shape[0]):
        row = roster[rows[k]]
        for i in range(2):
            x, P = row.x[i], row.P[i]
            total = u_mean = v_mean = uu = uv = vv = 0.0
            s = i * SIDE * SIDE
            for u in range(-STEPS, STEPS + 1):
                for v in range(-STEPS, STEPS + 1):
                    weight = weights[k, s]
                    total += weight
                    u_mean += weight * u
                    v_mean += weight * v
                    uu += weight * u * u
                    uv += weight * u * v
                    vv += weight * v * v
                    s += 1
            u_mean /= total
            v_mean /= total
            m[0], m[1] = STEP * u_mean, STEP * v_mean
            scale = STEP * STEP / VARIANCE
            C[0, 0] = scale * (uu / total - u_mean * u_mean)
            C[0, 1] = C[1, 0] = scale * (uv / total - u_mean * v_mean)
            C[1, 1] = scale * (vv / total - v_mean * v_mean)
            a, b, c = _root(P)
            for j in range(6):
                A[j, 0] = P[j, 0] / a
                A[j, 1] = (P[j, 1] - b * A[j, 0]) / c
            for j in range(6):
                x[j] += A[j, 0] * m[0] + A[j, 1] * m[1]
                for n in range(j, 6):
                    for e in range(2):
                        for f in range(2):
                            P[j, n] -= A[j, e] * ((1.0 if e == f else 0.0) - C[e, f]) * A[n, f]
                    P[n, j] = P[j, n]
            share[i] = total
        still = share[STILL] / (share[STILL] + share[MOVING])
        row.weights[STILL] = min(max(still, LEAST_WEIGHT), 1.0 - LEAST_WEIGHT)
        row.weights[MOVING] = 1.0 - row.weights[STILL]


@kernel
def conclude(roster, rows, places, seen, weights, states):
    """Write to ``states`` (N,) what most that is left of each track was seen as; mark as absent who may be anywhere."""
    mean, cov = np.empty(6), np.empty((6, 6))
    mass = np.empty(SEEN_EMPTY + 1)
    for k in range(rows.shape[0]):
        combine(roster[rows[k]], mean, cov)
        mass[:] = 0.0
        near = 0.0
        for s in range(SAMPLES):
            mass[seen[k, s]] += weights[k, s]
            x, y = places[k, s, 0] - mean[0], places[k, s, 1] - mean[1]
            if x * x + y * y < RIGHT_M * RIGHT_M:
                near += weights[k, s]
        total = mass.sum()
        states[k] = SEEN_EMPTY if total < GONE else np.argmax(mass[:SEEN_EMPTY])
        roster[rows[k]].absent = states[k] >= SURFACE and near < LEAST_SURE * total
