"""From refined states to a stated pose, compiled: which is the best, and how sure it is, knowing of the others."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from headvox.data import F64
from headvox.machine.kernels import bare_kernel, rule
from headvox.machine.threads import take
from headvox.pose.residuals import COST, CROSSED, EVIDENCE, ON_SURFACE
from headvox.pose.template import MODES
from headvox.pose.trials import MORE_POINTS, MORE_RAYS, STANDS, TRIED, best_of, polish

SURE_YAW_RAD = np.radians(45.0)  # an orientation that is less sure is not stated


class Refined(NamedTuple):
    """States of one head that are refined."""

    states: F64
    """(S, STATE)"""
    told: F64
    """(S, TOLD)"""
    covariance: F64
    """(6, 6) of shift and turn of the best, in its axes"""


@bare_kernel
def finish_all(work, trials, heads, taken, centres, template, poses):
    """Polish the best of what was tried of each of the first ``heads``, and write it to ``poses``.

    Others do so too: they count the heads that are ``taken`` (1,).
    """
    while True:
        i = take(taken, 0)
        if i >= heads:
            return
        counts = trials.counts[i]
        best = best_of(trials.told[i], counts[TRIED])
        if best >= 0:
            polish(work, trials, i, best, template)
            refined = Refined(trials.states[i], trials.told[i], trials.covariances[i])
            assess(trials.told[i, best], counts[MORE_POINTS], counts[MORE_RAYS], poses, i)
            settle(refined, counts[TRIED], best, centres[i], template, poses, i)
            if not counts[STANDS]:
                recentre(trials.states[i, best], template, poses, i)


@rule
def assess(told, points, rays, poses, i):
    """Write to row ``i`` of ``poses`` how well a head fits, from what is ``told`` of so many points and rays."""
    poses.misfits[i] = told[COST] / points
    poses.coverages[i] = told[ON_SURFACE] / points
    poses.crossings[i] = told[CROSSED] / max(rays, 1)


@bare_kernel
def settle(refined, count, best, centre, template, poses, i):
    """Write the ``best`` of ``count`` states to row ``i`` of ``poses``, with covariances that know of the others.

    The states are a mixture: each is as probable as its evidence says, and stands as far from the best as it does. An
    orientation whose yaw is less sure than ``SURE_YAW_RAD`` is not written.
    """
    state = refined.states[best]
    far, turn = poses.centre_covariances[i], poses.rotation_covariances[i]
    covariance = refined.covariance
    for a in range(3):
        poses.centres[i, a] = centre[a] + state[a]
        for b in range(3):
            # the shift is in the head's axes: R C Rᵀ
            far[a, b] = 0.0
            for c in range(3):
                for d in range(3):
                    far[a, b] += state[3 + 3 * a + c] * covariance[c, d] * state[3 + 3 * b + d]
            far[a, b] *= template.shift_factor
            turn[a, b] = template.turn_factor * covariance[3 + a, 3 + b]
    poses.radii[i] = template.radius_m * np.exp(state[12])
    whole = 0.0
    for s in range(count):
        whole += odds(refined.told, s, best, template.temperature)
    for s in range(count):
        share = odds(refined.told, s, best, template.temperature) / whole
        other = refined.states[s]
        if s == best or not share > 0.0:
            continue
        wx, wy, wz = turn_between(state, other)
        w = (wx, wy, wz)
        for a in range(3):
            for b in range(3):
                far[a, b] += share * (other[a] - state[a]) * (other[b] - state[b])
                turn[a, b] += share * w[a] * w[b]
    if turn[2, 2] < SURE_YAW_RAD * SURE_YAW_RAD:
        q = quaternion_of(
            state[3], state[4], state[5], state[6], state[7], state[8], state[9], state[10], state[11]
        )  # fmt: skip
        for a in range(4):
            poses.quaternions[i, a] = q[a]
    else:
        for a in range(3):
            for b in range(3):
                turn[a, b] = np.nan


@rule
def recentre(state, template, poses, i):
    """Move the centre in row ``i`` of ``poses`` to where a head of the shape in ``state`` has it."""
    scale = np.exp(state[12])
    for c in range(3):
        away = template.centre_of_shape[c, 0]
        for k in range(1 + MODES):
            away += template.centre_of_shape[c, 1 + k] * state[12 + k]
        for a in range(3):
            poses.centres[i, a] += scale * away * state[3 + 3 * a + c]


@rule
def odds(told, s, best, temperature):
    """Return how probable state ``s`` is, the best being 1; 0 for one whose evidence is not a number."""
    odds = np.exp((told[best, EVIDENCE] - told[s, EVIDENCE]) / temperature)
    return odds if np.isfinite(odds) else 0.0


@bare_kernel
def turn_between(one, other):
    """Return the rotation vector, in the axes of state ``one``, that turns its rotation to that of ``other``."""
    # R1ᵀ R2: column c of R1 times column d of R2
    x, y, z, w = quaternion_of(
        column(one, 0, other, 0), column(one, 0, other, 1), column(one, 0, other, 2),
        column(one, 1, other, 0), column(one, 1, other, 1), column(one, 1, other, 2),
        column(one, 2, other, 0), column(one, 2, other, 1), column(one, 2, other, 2),
    )  # fmt: skip
    sine = np.sqrt(x * x + y * y + z * z)
    if sine < 1e-9:
        return 2.0 * x, 2.0 * y, 2.0 * z
    factor = 2.0 * np.arctan2(sine, abs(w)) / sine
    if w < 0.0:
        factor = -factor
    return factor * x, factor * y, factor * z


@rule
def column(one, c, other, d):
    """Return the product of two columns of the rotations in two states."""
    return one[3 + c] * other[3 + d] + one[6 + c] * other[6 + d] + one[9 + c] * other[9 + d]


@bare_kernel
def quaternion_of(r00, r01, r02, r10, r11, r12, r20, r21, r22):
    """Return x, y, z, w of a rotation matrix, by its greatest component (Shepperd, 1978)."""
    trace = r00 + r11 + r22
    if trace >= r00 and trace >= r11 and trace >= r22:
        x, y, z, w = r21 - r12, r02 - r20, r10 - r01, 1.0 + trace
    elif r00 >= r11 and r00 >= r22:
        x, y, z, w = 1.0 - trace + 2.0 * r00, r10 + r01, r20 + r02, r21 - r12
    elif r11 >= r22:
        x, y, z, w = r01 + r10, 1.0 - trace + 2.0 * r11, r21 + r12, r02 - r20
    else:
        x, y, z, w = r02 + r20, r12 + r21, 1.0 - trace + 2.0 * r22, r10 - r01
    length = np.sqrt(x * x + y * y + z * z + w * w)
    return x / length, y / length, z / length, w / length


@bare_kernel
def expect_turns(centres, places, quaternions, reaches, turns):
    """Write to ``turns`` (N, 9) the rotation of the nearest of ``places`` (M, 3) in reach of each of ``centres``.

    A row stays as it is where there is none; a place whose quaternion is not known counts for nothing.
    """
    for i in range(centres.shape[0]):
        nearest = np.inf
        for p in range(places.shape[0]):
            x, y, z, w = quaternions[p, 0], quaternions[p, 1], quaternions[p, 2], quaternions[p, 3]
            squared = 0.0
            for a in range(3):
                squared += (places[p, a] - centres[i, a]) ** 2
            length = np.sqrt(squared)
            if not (length <= reaches[p] and length < nearest and np.isfinite(x + y + z + w)):
                continue
            nearest = length
            s = 2.0 / (x * x + y * y + z * z + w * w)
            turns[i, 0], turns[i, 1], turns[i, 2] = (
                1.0 - s * (y * y + z * z),
                s * (x * y - z * w),
                s * (x * z + y * w),
            )
            turns[i, 3], turns[i, 4], turns[i, 5] = (
                s * (x * y + z * w),
                1.0 - s * (x * x + z * z),
                s * (y * z - x * w),
            )
            turns[i, 6], turns[i, 7], turns[i, 8] = (
                s * (x * z - y * w),
                s * (y * z + x * w),
                1.0 - s * (x * x + y * y),
            )
