"""The loops of the pose fit: a template of signed distances is aligned to points by Gauss-Newton steps.

The state is a centre, a rotation, a log scale and the template's modes of shape. A step lowers

    sum over points of rho(e / sigma)  +  rays that cross the template  +  priors,

where e is the distance of a point to the surface, rho(r) = r² / (1 + r² / k²) is Geman and McClure's, and sigma adds up
the template's own spread and the sensor's noise along and across its ray. What makes a head differ from the
template is the same for points that are near to each other, so that many points do not say more than INDEPENDENT of
them would. What a state costs, though not where a step goes, knows of one thing more: a point on a surface that faces
away from its sensor should have been seen a chord before it. Its r² is greater by the square of that chord over its
sigma.
"""

from __future__ import annotations

import numpy as np

from headvox.machine.cholesky import factor, substitute, substitute_back
from headvox.machine.kernels import bare_kernel, rule
from headvox.machine.simd import LANES, add, fill, load, mul, total
from headvox.pose.residuals import PARAMETERS, RESIDUAL, weigh, weight_of_each

CENTRE_SIGMA_M = 0.05
SCALE_SIGMA = 0.05
PITCH_SIGMA, ROLL_SIGMA = 0.32, 0.2  # of the angles' sines: a lying head pays a little, not without end
LONGEST_STEP_M, LARGEST_TURN_RAD = 0.03, 0.5
LARGEST_LOG_SCALE = 0.35


@rule
def _accumulate(J, count, size, A):
    """Set the upper half of A to J Jᵀ over ``count`` columns, whole vectors, and its last column to J e.

    Many columns are summed side by side, always in the same order, whatever the processor's vectors hold. Two rows are
    multiplied by two at once: it is loading them that is slow. ``size`` is odd, so that the residual's row makes pairs.
    """
    flat, width = J.reshape(-1), J.shape[1]
    for i in range(0, size, 2):
        after_i = i + 1 if i + 1 < size else RESIDUAL
        for j in range(i, size, 2):
            after_j = j + 1 if j + 1 < size else RESIDUAL
            a, b, c, d = i * width, after_i * width, j * width, after_j * width
            ac = ad = bc = bd = fill(0.0)
            for at in range(0, count, LANES):
                p, q = load(flat, a + at), load(flat, b + at)
                r, s = load(flat, c + at), load(flat, d + at)
                ac, ad, bc, bd = (
                    add(ac, mul(p, r)),
                    add(ad, mul(p, s)),
                    add(bc, mul(q, r)),
                    add(bd, mul(q, s)),
                )
            A[i, j], A[i, after_j] = total(ac), total(ad)
            if after_i < size:
                A[after_i, after_j] = total(bd)
                if j > i:
                    A[after_i, j] = total(bc)


@rule
def add_turn(A, wx, wy, wz, e, weight):
    """Add to A what one more row with the residual ``e`` says, which knows of the turn alone."""
    A[3, 3] += weight * wx * wx
    A[3, 4] += weight * wx * wy
    A[3, 5] += weight * wx * wz
    A[4, 4] += weight * wy * wy
    A[4, 5] += weight * wy * wz
    A[5, 5] += weight * wz * wz
    A[3, RESIDUAL] += weight * wx * e
    A[4, RESIDUAL] += weight * wy * e
    A[5, RESIDUAL] += weight * wz * e


@rule
def add_prior_cost(cost, state, modes, upright):
    """Return ``cost`` and twice what the priors make ``state`` cost; with those on pitch and roll, if ``upright``."""
    for i in range(3):
        cost += state[i] * state[i] / (CENTRE_SIGMA_M * CENTRE_SIGMA_M)
    cost += state[12] * state[12] / (SCALE_SIGMA * SCALE_SIGMA)
    for i in range(modes):
        cost += state[13 + i] * state[13 + i]
    if upright:  # r20 r21 r22 is the world's up in the head's axes
        r20, r21 = state[9], state[10]
        cost += r20 * r20 / (PITCH_SIGMA * PITCH_SIGMA) + r21 * r21 / (ROLL_SIGMA * ROLL_SIGMA)
    return cost


@bare_kernel
def linearise(points, n, rays, m, modes, k, upright, steps, template, state, J, words, A, told):
    """Return the cost of ``state``; write the normal equations to ``A`` (PARAMETERS, PARAMETERS + 1), if it ``steps``.

    The first ``n`` points and ``m`` rays count. ``modes`` are fitted, ``k`` is the scale of rho, ``upright`` says
    whether the priors on pitch and roll hold. ``J`` and ``words`` are scrap; for ``told`` see :func:`weigh`.
    """
    size = 7 + modes
    each = weight_of_each(n)
    cost, count = weigh(points, n, each, rays, m, modes, k, steps, template, state, J, words, told)
    cost = add_prior_cost(cost, state, modes, upright)
    if steps:
        _accumulate(J, count, size, A)
        add_priors(state, modes, upright, A)
    return 0.5 * cost


@rule
def add_priors(state, modes, upright, A):
    """Add the priors on place, size, shape and, if ``upright``, on pitch and roll."""
    w = 1.0 / (CENTRE_SIGMA_M * CENTRE_SIGMA_M)
    for i in range(3):
        A[i, i] += w
        A[i, RESIDUAL] += w * (state[3 + i] * state[0] + state[6 + i] * state[1] + state[9 + i] * state[2])
    w = 1.0 / (SCALE_SIGMA * SCALE_SIGMA)
    A[6, 6] += w
    A[6, RESIDUAL] += w * state[12]
    for i in range(modes):
        A[7 + i, 7 + i] += 1.0
        A[7 + i, RESIDUAL] += state[13 + i]
    if upright:
        ux, uy, uz = state[9], state[10], state[11]
        add_turn(A, 0.0, -uz, uy, ux, 1.0 / (PITCH_SIGMA * PITCH_SIGMA))
        add_turn(A, uz, 0.0, -ux, uy, 1.0 / (ROLL_SIGMA * ROLL_SIGMA))


@bare_kernel
def solve(A, x, size):
    """Leave the Cholesky factor in the upper half of A, and the step -A⁻¹ (column RESIDUAL) in x."""
    factor(A, size)
    for i in range(size):
        x[i] = -A[i, RESIDUAL]
    substitute_back(A, x, size)


@rule
def invert_column(A, x, c):
    """Leave column ``c`` of (Uᵀ U)⁻¹ in ``x``, U the upper half of A."""
    for i in range(PARAMETERS):
        x[i] = 1.0 if i == c else 0.0
    substitute(A, x, PARAMETERS)
    substitute_back(A, x, PARAMETERS)


@rule
def invert(A, x, covariance):
    """Write the first 6x6 of the inverse to ``covariance``: of shift and turn, all else unknown."""
    for c in range(6):
        invert_column(A, x, c)
        for i in range(6):
            covariance[i, c] = x[i]


@rule
def move(state, x, size):
    """Take the step ``x``, cut to a bearable length."""
    step = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    turn = np.sqrt(x[3] * x[3] + x[4] * x[4] + x[5] * x[5])
    share = 1.0 / max(1.0, step / LONGEST_STEP_M, turn / LARGEST_TURN_RAD)
    turn *= share
    wx, wy, wz = share * x[3], share * x[4], share * x[5]
    a = np.sin(turn) / turn if turn > 1e-9 else 1.0
    b = (1.0 - np.cos(turn)) / (turn * turn) if turn > 1e-9 else 0.5
    for i in range(3):
        p, q, r = state[3 + 3 * i], state[4 + 3 * i], state[5 + 3 * i]
        state[i] += share * (p * x[0] + q * x[1] + r * x[2])
        # the row times exp([w]), Rodrigues
        ux, uy, uz = q * wz - r * wy, r * wx - p * wz, p * wy - q * wx
        state[3 + 3 * i] = p + a * ux + b * (uy * wz - uz * wy)
        state[4 + 3 * i] = q + a * uy + b * (uz * wx - ux * wz)
        state[5 + 3 * i] = r + a * uz + b * (ux * wy - uy * wx)
    for i in range(6, size):
        state[6 + i] += share * x[i]
    state[12] = min(max(state[12], -LARGEST_LOG_SCALE), LARGEST_LOG_SCALE)
