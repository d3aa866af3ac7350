"""The loops of the pose fit: a template of signed distances is aligned to points by Gauss-Newton steps.

The state is a centre, a rotation, a log scale and the template's modes of shape. A step lowers

    sum over points of rho(e / sigma)  +  rays that cross the template  +  priors,

where e is the distance of a point to the surface, rho(r) = r² / (1 + r² / k²) is Geman and McClure's, and sigma adds up
the template's own spread and the sensor's noise along and across its ray.
"""

from __future__ import annotations

import numpy as np

from headvox.kernels import bare_kernel, kernel, rule
from headvox.template import MODES

PARAMETERS = 7 + MODES  # a shift and a turn in the head's axes, log scale, modes
RESIDUAL = PARAMETERS  # where a row of the Jacobian has the residual
STATE = 13 + MODES  # centre (3), rotation (9) row by row, log scale, modes
COST, ON_SURFACE, CROSSED, EVIDENCE = 0, 1, 2, 3  # what is told of a fit
TOLD = 4

COARSE_STEPS, FINE_STEPS = 4, 5
COARSE_SAMPLES, FINE_SAMPLES, FINE_RAYS = 120, 200, 160
COARSE_MODES = 3
COARSE_K, FINE_K, LAST_K = (
    6.0,
    4.0,
    2.5,
)  # of the first coarse step (1 less each step), the first and last fine one
MOST_REFINED = 6
MARGIN = 40.0  # a start that costs more than the best one by this is not refined, but for the second best
ALIKE = 2.88  # trace of the turn between two starts that are one: 20 degrees apart

RAY_WEIGHT = 20.0
CENTRE_SIGMA_M = 0.05
SCALE_SIGMA = 0.05
PITCH_SIGMA, ROLL_SIGMA = 0.32, 0.2  # of the angles' sines: a lying head pays a little, not without end
SIGMA_WEIGHT = 0.5  # of log sigma in the cost: points are as likely as their surface is well known
SIGMA_UNIT_M = 0.02
LEAST_DAMPING = 0.05  # points that count less do not move the fit at all
LONGEST_STEP_M, LARGEST_TURN_RAD = 0.03, 0.5
LARGEST_LOG_SCALE = 0.35


@rule
def _add(A, J, w, size):  # type: ignore[no-untyped-def]
    """Add w J Jᵀ to the upper half of A, and w J e to its column RESIDUAL."""
    for i in range(size):
        a = w * J[i]
        for j in range(i, size):
            A[i, j] += a * J[j]
        A[i, RESIDUAL] += a * J[RESIDUAL]


@bare_kernel
def linearise(samples, n, rays, m, most, modes, k, upright, rows, low, voxel_m, state, A, J, told):  # type: ignore[no-untyped-def]
    """Return the cost of ``state``; write the normal equations to ``A`` (PARAMETERS, PARAMETERS + 1).

    Of the ``n`` samples and ``m`` rays at most ``most`` (2,) are used, evenly over all. ``modes`` are fitted,
    ``k`` is the scale of rho, ``upright`` says whether the priors on pitch and roll hold. ``J`` is scrap; ``told``
    receives the samples' share of the cost, how many lie on the surface, and how many rays cross it.
    """
    cx, cy, cz = state[0], state[1], state[2]
    r00, r01, r02 = state[3], state[4], state[5]
    r10, r11, r12 = state[6], state[7], state[8]
    r20, r21, r22 = state[9], state[10], state[11]
    scale = np.exp(state[12])
    shrink = 1.0 / (scale * voxel_m)
    lx, ly, lz = low[0] / voxel_m, low[1] / voxel_m, low[2] / voxel_m
    nx, ny, nz = rows.shape[0], rows.shape[1], rows.shape[2]
    size = 7 + modes
    for i in range(size):
        for j in range(PARAMETERS + 1):
            A[i, j] = 0.0
    k2 = k * k
    cost = 0.0
    on = 0
    crossed = 0
    for kind in range(2):
        is_point = kind == 0
        there = n if is_point else m
        used = min(there, most[kind])
        if not is_point:
            told[COST] = 0.5 * cost
        for s in range(used):
            at = (2 * s + 1) * there // (2 * used)
            if is_point:
                px, py, pz = samples[at, 0] - cx, samples[at, 1] - cy, samples[at, 2] - cz
                dx, dy, dz = samples[at, 3], samples[at, 4], samples[at, 5]
            else:  # the point of the ray that is nearest to the head's centre
                px, py, pz = rays[at, 0] - cx, rays[at, 1] - cy, rays[at, 2] - cz
                dx, dy, dz = rays[at, 3], rays[at, 4], rays[at, 5]
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
                    cost += k2
                continue
            row = rows[int(fx), int(fy), int(fz)]
            gx, gy, gz = np.float64(row[1]), np.float64(row[2]), np.float64(row[3])
            ax, ay, az = x - lx - fx - 0.5, y - ly - fy - 0.5, z - lz - fz - 0.5
            value = row[0] + voxel_m * (gx * ax + gy * ay + gz * az)
            for i in range(modes):
                value += state[13 + i] * row[5 + i]
            e = scale * value
            variance = scale * scale * row[4] * row[4]
            if is_point:
                toward = gx * (r00 * dx + r10 * dy + r20 * dz)
                toward += gy * (r01 * dx + r11 * dy + r21 * dz)
                toward += gz * (r02 * dx + r12 * dy + r22 * dz)
                noise = samples[at, 6] * toward
                variance += noise * noise + samples[at, 7] * samples[at, 7]
                weight = 1.0
            elif e >= 0.0:
                continue
            else:
                weight = RAY_WEIGHT
                crossed += 1
            squared = e * e / variance
            damp = 1.0 / (1.0 + squared / k2)
            cost += weight * squared * damp
            if is_point:
                cost += SIGMA_WEIGHT * damp * np.log(variance / (SIGMA_UNIT_M * SIGMA_UNIT_M))
                on += squared < k2
            if damp < LEAST_DAMPING:
                continue
            metres = scale * voxel_m
            J[0], J[1], J[2] = -gx, -gy, -gz
            J[3] = metres * (gy * z - gz * y)
            J[4] = metres * (gz * x - gx * z)
            J[5] = metres * (gx * y - gy * x)
            J[6] = scale * (value - voxel_m * (gx * x + gy * y + gz * z))
            for i in range(modes):
                J[7 + i] = scale * row[5 + i]
            J[RESIDUAL] = e
            _add(A, J, weight * damp * damp / variance, size)
    told[ON_SURFACE], told[CROSSED] = on, crossed
    w = 1.0 / (CENTRE_SIGMA_M * CENTRE_SIGMA_M)
    cost += w * (cx * cx + cy * cy + cz * cz)
    for i in range(3):
        A[i, i] += w
        A[i, RESIDUAL] += w * (state[3 + i] * cx + state[6 + i] * cy + state[9 + i] * cz)
    w = 1.0 / (SCALE_SIGMA * SCALE_SIGMA)
    cost += w * state[12] * state[12]
    A[6, 6] += w
    A[6, RESIDUAL] += w * state[12]
    for i in range(modes):
        cost += state[13 + i] * state[13 + i]
        A[7 + i, 7 + i] += 1.0
        A[7 + i, RESIDUAL] += state[13 + i]
    if upright:  # r20 r21 r22 is the world's up in the head's axes
        for i in range(size):
            J[i] = 0.0
        w = 1.0 / (PITCH_SIGMA * PITCH_SIGMA)
        cost += w * r20 * r20
        J[4], J[5], J[RESIDUAL] = -r22, r21, r20
        _add(A, J, w, size)
        w = 1.0 / (ROLL_SIGMA * ROLL_SIGMA)
        cost += w * r21 * r21
        J[3], J[4], J[5], J[RESIDUAL] = r22, 0.0, -r20, r21
        _add(A, J, w, size)
    return 0.5 * cost


@rule
def _solve(A, x, size):  # type: ignore[no-untyped-def]
    """Leave the Cholesky factor in the lower half of A, and the step -A⁻¹ (column RESIDUAL) in x; return ½ log det."""
    half_log_det = 0.0
    for i in range(size):
        for j in range(i + 1):
            v = A[j, i]
            for q in range(j):
                v -= A[i, q] * A[j, q]
            if i == j:
                v = np.sqrt(max(v, 1e-12))
                half_log_det += np.log(v)
                A[i, i] = v
            else:
                A[i, j] = v / A[j, j]
    for i in range(size):
        v = -A[i, RESIDUAL]
        for q in range(i):
            v -= A[i, q] * x[q]
        x[i] = v / A[i, i]
    for i in range(size - 1, -1, -1):
        v = x[i]
        for q in range(i + 1, size):
            v -= A[q, i] * x[q]
        x[i] = v / A[i, i]
    return half_log_det


@rule
def _invert(A, x, covariance):  # type: ignore[no-untyped-def]
    """Write the first 6x6 of (L Lᵀ)⁻¹ to ``covariance``, L the lower half of A: shift and turn, all else unknown."""
    for c in range(6):
        for i in range(PARAMETERS):
            v = 1.0 if i == c else 0.0
            for q in range(i):
                v -= A[i, q] * x[q]
            x[i] = v / A[i, i]
        for i in range(PARAMETERS - 1, -1, -1):
            v = x[i]
            for q in range(i + 1, PARAMETERS):
                v -= A[q, i] * x[q]
            x[i] = v / A[i, i]
        for i in range(6):
            covariance[i, c] = x[i]


@rule
def _move(state, x, size):  # type: ignore[no-untyped-def]
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


@kernel
def align(samples, n, rays, m, starts, upright, rows, low, voxel_m, coarse, fine, told, covariances):  # type: ignore[no-untyped-def]
    """Try all ``starts`` (S, 9), refine the best; return how many were refined.

    The states go to ``fine`` (MOST_REFINED, STATE), what they cost to ``told`` (.., TOLD), the covariances of shift and
    turn, in the head's axes, to ``covariances`` (.., 6, 6). ``coarse`` (S, STATE) is scrap. A single start is refined
    at once.
    """
    A = np.empty((PARAMETERS, PARAMETERS + 1))
    J = np.empty(PARAMETERS + 1)
    x = np.empty(PARAMETERS)
    scrap = np.empty(TOLD)
    most = np.empty(2, np.int64)
    most[0], most[1] = COARSE_SAMPLES, 0
    costs = np.zeros(starts.shape[0])
    size = 7 + COARSE_MODES
    least = np.inf
    for i in range(starts.shape[0]):
        state = coarse[i]
        for j in range(STATE):
            state[j] = starts[i, j - 3] if 3 <= j < 12 else 0.0
        if starts.shape[0] > 1:
            for step in range(COARSE_STEPS + 1):
                k = COARSE_K - min(step, COARSE_STEPS - 1)
                costs[i] = linearise(
                    samples,
                    n,
                    rays,
                    m,
                    most,
                    COARSE_MODES,
                    k,
                    upright,
                    rows,
                    low,
                    voxel_m,
                    state,
                    A,
                    J,
                    scrap,
                )
                if step < COARSE_STEPS:
                    _solve(A, x, size)
                    _move(state, x, size)
        least = min(least, costs[i])
    most[0], most[1] = FINE_SAMPLES, FINE_RAYS
    refined = 0
    while refined < fine.shape[0]:
        best = 0
        for i in range(starts.shape[0]):
            if costs[i] < costs[best]:
                best = i
        if costs[best] == np.inf or (refined >= 2 and costs[best] > least + MARGIN):
            break
        costs[best] = np.inf
        known = False
        for j in range(refined):
            trace = 0.0
            for q in range(3, 12):
                trace += coarse[best, q] * fine[j, q]
            known = known or trace > ALIKE
        if known:
            continue
        state = fine[refined]
        for j in range(STATE):
            state[j] = coarse[best, j]
        cost = 0.0
        for step in range(FINE_STEPS + 1):
            k = FINE_K + (LAST_K - FINE_K) * min(step, FINE_STEPS - 1) / (FINE_STEPS - 1)
            cost = linearise(
                samples, n, rays, m, most, MODES, k, upright, rows, low, voxel_m, state, A, J, told[refined]
            )
            told[refined, EVIDENCE] = cost + _solve(A, x, PARAMETERS)
            if step < FINE_STEPS:
                _move(state, x, PARAMETERS)
        _invert(A, x, covariances[refined])
        refined += 1
    return refined
