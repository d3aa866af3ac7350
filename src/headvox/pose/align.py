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

from headvox.machine.cholesky import factor, substitute
from headvox.machine.kernels import bare_kernel, rule
from headvox.machine.simd import LANES, add, load, mul, store, total
from headvox.pose.template import MODES

PARAMETERS = 7 + MODES  # a shift and a turn in the head's axes, log scale, modes
RESIDUAL = PARAMETERS  # the row of the Jacobian, and the column of A, that belongs to the residual
WEIGHT, WEIGHTED = (
    RESIDUAL + 1,
    RESIDUAL + 2,
)  # further rows of the Jacobian: the weights, and room for a product
STATE = 13 + MODES  # centre (3), rotation (9) row by row, log scale, modes
COST, ON_SURFACE, CROSSED, EVIDENCE = 0, 1, 2, 3  # what is told of a fit
TOLD = 4

ROOM = 808  # a row of the Jacobian: all points and rays in whole vectors; an odd number of lines of the cache
# So many points at most count in full: how a head differs from the template, neighbours share.
INDEPENDENT = 120.0
RAY_WEIGHT = 8.0
FACING_AWAY = 0.2  # the cosine from which a surface faces away: the template's normals are only so good
BREADTH_M = 0.18  # of the ball whose chords these are, and
CHORD_SIGMA_M = 0.03  # how far those of a head are from its, beside the noise
CENTRE_SIGMA_M = 0.05
SCALE_SIGMA = 0.05
PITCH_SIGMA, ROLL_SIGMA = 0.32, 0.2  # of the angles' sines: a lying head pays a little, not without end
LEAST_DAMPING = 0.05  # points that count less do not move the fit at all
LONGEST_STEP_M, LARGEST_TURN_RAD = 0.03, 0.5
LARGEST_LOG_SCALE = 0.35


@rule
def _accumulate(J, count, size, A):
    """Set the upper half of A to J W Jᵀ over ``count`` columns, whole vectors, and its last column to J W e.

    Many columns are summed side by side, always in the same order, whatever the processor's vectors hold.
    """
    flat = J.reshape(-1)
    for i in range(size):
        for at in range(0, count, LANES):
            weighted = mul(load(flat, i * ROOM + at), load(flat, WEIGHT * ROOM + at))
            store(flat, WEIGHTED * ROOM + at, weighted)
        for j in range(i, size + 1):
            column = j if j < size else RESIDUAL
            sums = mul(load(flat, WEIGHTED * ROOM), load(flat, column * ROOM))
            for at in range(LANES, count, LANES):
                sums = add(sums, mul(load(flat, WEIGHTED * ROOM + at), load(flat, column * ROOM + at)))
            A[i, column] = total(sums)


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
def weight_of_each(n):
    """Return how much each of ``n`` points counts."""
    return min(1.0, INDEPENDENT / max(n, 1))


@rule
def weigh(points, n, each, rays, m, modes, k, steps, rows, low, voxel_m, state, J, told):
    """Return twice what the first ``n`` points and ``m`` rays cost in ``state``, and how many of them would move it.

    ``each`` point has this weight. They have a column in ``J`` each, if it ``steps``. ``told`` receives what the points
    cost with a weight of 1 and whatever way they face, how many lie on the surface, and how many rays cross it.
    """
    cx, cy, cz = state[0], state[1], state[2]
    r00, r01, r02 = state[3], state[4], state[5]
    r10, r11, r12 = state[6], state[7], state[8]
    r20, r21, r22 = state[9], state[10], state[11]
    scale = np.exp(state[12])
    shrink = 1.0 / (scale * voxel_m)
    metres = scale * voxel_m
    lx, ly, lz = low[0] / voxel_m, low[1] / voxel_m, low[2] / voxel_m
    nx, ny, nz = rows.shape[0], rows.shape[1], rows.shape[2]
    k2 = k * k
    points_cost = rays_cost = hidden_cost = 0.0
    count = on = crossed = 0
    for s in range(n + m):
        is_point = s < n
        if is_point:
            px, py, pz = points[s, 0] - cx, points[s, 1] - cy, points[s, 2] - cz
            dx, dy, dz = points[s, 3], points[s, 4], points[s, 5]
        else:  # the point of the ray that is nearest to the head's centre
            px, py, pz = rays[s - n, 0] - cx, rays[s - n, 1] - cy, rays[s - n, 2] - cz
            dx, dy, dz = rays[s - n, 3], rays[s - n, 4], rays[s - n, 5]
            along = px * dx + py * dy + pz * dz
            px -= along * dx
            py -= along * dy
            pz -= along * dz
        # in voxels of the template
        x = (r00 * px + r10 * py + r20 * pz) * shrink
        y = (r01 * px + r11 * py + r21 * pz) * shrink
        z = (r02 * px + r12 * py + r22 * pz) * shrink
        fx, fy, fz = np.floor(x - lx), np.floor(y - ly), np.floor(z - lz)
        if not ((fx >= 0.0) & (fy >= 0.0) & (fz >= 0.0) & (fx < nx) & (fy < ny) & (fz < nz)):
            if is_point:
                points_cost += k2
            continue
        row = rows[int(fx), int(fy), int(fz)]
        gx, gy, gz = np.float64(row[1]), np.float64(row[2]), np.float64(row[3])
        ax, ay, az = x - lx - fx - 0.5, y - ly - fy - 0.5, z - lz - fz - 0.5
        value = row[0] + voxel_m * (gx * ax + gy * ay + gz * az)
        for i in range(modes):
            value += state[13 + i] * row[5 + i]
        e = scale * value
        variance = scale * scale * row[4] * row[4]
        weight, hidden = each, 0.0
        if is_point:
            toward = gx * (r00 * dx + r10 * dy + r20 * dz)
            toward += gy * (r01 * dx + r11 * dy + r21 * dz)
            toward += gz * (r02 * dx + r12 * dy + r22 * dz)
            noise = points[s, 6] * toward
            variance += noise * noise + points[s, 7] * points[s, 7]
            if toward > FACING_AWAY:
                chord = BREADTH_M * (toward - FACING_AWAY)
                hidden = chord * chord / (CHORD_SIGMA_M * CHORD_SIGMA_M + points[s, 6] * points[s, 6])
        elif e >= 0.0:
            continue
        else:
            weight = RAY_WEIGHT
            crossed += 1
        squared, bound = e * e, k2 * variance
        share = k2 / (bound + squared)
        if is_point:
            cost = share * squared
            points_cost += cost
            on += squared < bound
            if hidden > 0.0:
                squared += hidden * variance
                hidden_cost += k2 / (bound + squared) * squared - cost
        else:
            rays_cost += share * squared
        damp = share * variance
        if damp < LEAST_DAMPING or not steps:
            continue
        J[0, count], J[1, count], J[2, count] = -gx, -gy, -gz
        J[3, count] = metres * (gy * z - gz * y)
        J[4, count] = metres * (gz * x - gx * z)
        J[5, count] = metres * (gx * y - gy * x)
        J[6, count] = scale * (value - voxel_m * (gx * x + gy * y + gz * z))
        for i in range(modes):
            J[7 + i, count] = scale * row[5 + i]
        J[RESIDUAL, count], J[WEIGHT, count] = e, weight * damp * share
        count += 1
    told[COST], told[ON_SURFACE], told[CROSSED] = 0.5 * points_cost, on, crossed
    return each * (points_cost + hidden_cost) + RAY_WEIGHT * rays_cost, count


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
def linearise(points, n, rays, m, modes, k, upright, steps, rows, low, voxel_m, state, J, A, told):
    """Return the cost of ``state``; write the normal equations to ``A`` (PARAMETERS, PARAMETERS + 1), if it ``steps``.

    The first ``n`` points and ``m`` rays count. ``modes`` are fitted, ``k`` is the scale of rho, ``upright`` says
    whether the priors on pitch and roll hold. ``J`` is scrap; for ``told`` see :func:`weigh`.
    """
    size = 7 + modes
    each = weight_of_each(n)
    cost, count = weigh(points, n, each, rays, m, modes, k, steps, rows, low, voxel_m, state, J, told)
    cost = add_prior_cost(cost, state, modes, upright)
    if steps:
        whole = max((count + LANES - 1) // LANES, 1) * LANES
        for i in range(WEIGHTED):
            for s in range(count, whole):
                J[i, s] = 0.0
        _accumulate(J, whole, size, A)
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
    """Leave the Cholesky factor in the lower half of A, and the step -A⁻¹ (column RESIDUAL) in x; return ½ log det."""
    half_log_det = factor(A, size)
    for i in range(size):
        x[i] = -A[i, RESIDUAL]
    substitute(A, x, size)
    return half_log_det


@rule
def invert_column(A, x, c):
    """Leave column ``c`` of (L Lᵀ)⁻¹ in ``x``, L the lower half of A."""
    for i in range(PARAMETERS):
        x[i] = 1.0 if i == c else 0.0
    substitute(A, x, PARAMETERS)


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
