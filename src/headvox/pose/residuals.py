"""What a state of the template costs, and how each point and each ray would move it: a column each.

A column begins as a place in the template, becomes what the template says there, and ends as the derivatives of its
residual, times the root of its weight. Every step is a loop of its own over all columns, which the compiler makes
vectors of; only what brings a voxel's words from memory goes column by column.
"""

from __future__ import annotations

import numpy as np

from headvox.machine.kernels import bare_kernel, rule
from headvox.machine.simd import LANES, add, load, total
from headvox.pose.template import DISTANCE_AT, GRADIENT_AT, MODES, MODES_AT, SIGMA_AT

PARAMETERS = 7 + MODES  # a shift and a turn in the head's axes, log scale, modes
RESIDUAL = PARAMETERS  # the row of the Jacobian that belongs to the residual
# Further rows: a column's place in voxels from the head's centre, the number of its voxel, what the template says there
# (the gradient is where the derivatives by the shift will be), two variances, the root of its weight, and its cost.
X, Y, Z, VOXEL, DISTANCE, SIGMA, NOISE, HIDDEN, ROOT, LOST, LOST_MORE = range(RESIDUAL + 1, RESIDUAL + 12)
ROWS = LOST_MORE + 1
STATE = 13 + MODES  # centre (3), rotation (9) row by row, log scale, modes
COST, ON_SURFACE, CROSSED, EVIDENCE = 0, 1, 2, 3  # what is told of a fit
TOLD = 4

# So many points at most count in full: how a head differs from the template, neighbours share.
INDEPENDENT = 120.0
RAY_WEIGHT = 8.0
FACING_AWAY = 0.2  # the cosine from which a surface faces away: the template's normals are only so good
BREADTH_M = 0.18  # of the ball whose chords these are, and
CHORD_SIGMA_M = 0.03  # how far those of a head are from its, beside the noise
LEAST_DAMPING = 0.05  # points that count less do not move the fit at all


@rule
def weight_of_each(n):
    """Return how much each of ``n`` points counts."""
    return min(1.0, INDEPENDENT / max(n, 1))


@rule
def weigh(points, n, each, rays, m, modes, k, steps, template, state, J, words, told):
    """Return twice what the first ``n`` points and ``m`` rays cost in ``state``, and how many columns they have.

    ``each`` point has this weight. ``J`` (ROWS, columns) receives the derivatives, if it ``steps``: points that would
    not move the fit have columns of zeros, and rays that cross nothing have none. ``words`` (WORDS, columns) is scrap.
    ``told`` receives what the points cost with a weight of 1 and whatever way they face, how many lie on the surface,
    and how many rays cross it.
    """
    voxel_m, scale, behind = template.voxel_m, np.exp(state[12]), whole_vectors(n)
    place_points(points, n, state, template, J)
    outside = look_up(0, n, modes, template, J, words)
    unpack(0, n, modes, template, words, J)
    add_shape(0, n, state, modes, template, J)
    add_noise(points, n, state, J)
    clear(n, behind, modes, J)
    place_rays(rays, m, behind, state, template, J)
    look_up(behind, behind + m, modes, template, J, words)
    unpack(behind, behind + m, modes, template, words, J)
    add_shape(behind, behind + m, state, modes, template, J)
    crossed = keep_crossing(behind, m, modes, J)
    after = whole_vectors(behind + crossed)
    clear(behind + crossed, after, modes, J)
    on = weigh_columns(0, n, each, k, scale, J) - outside
    weigh_columns(behind, behind + crossed, RAY_WEIGHT, k, scale, J)
    if steps:
        differentiate(after, modes, scale, voxel_m, J)
    points_cost = sum_of(J[LOST], 0, behind) + outside * k * k
    hidden_cost, rays_cost = sum_of(J[LOST_MORE], 0, behind), sum_of(J[LOST], behind, after)
    told[COST], told[ON_SURFACE], told[CROSSED] = 0.5 * points_cost, on, crossed
    return each * (points_cost + hidden_cost) + RAY_WEIGHT * rays_cost, after


@rule
def whole_vectors(count):
    """Return the next multiple of LANES."""
    return (count + LANES - 1) // LANES * LANES


@rule
def in_registers(state):
    """Return centre, rotation and log scale of ``state``: nothing that a loop writes can change these."""
    return (
        state[0], state[1], state[2], state[3], state[4], state[5], state[6], state[7], state[8], state[9], state[10],
        state[11], state[12],
    )  # fmt: skip


@rule
def corner(template):
    """Return where the template begins, in voxels from the head's centre, as :func:`in_registers`."""
    low, voxel_m = template.low, template.voxel_m
    return low[0] / voxel_m, low[1] / voxel_m, low[2] / voxel_m


@rule
def place(px, py, pz, s, state, low, template, J):
    """Write to column ``s`` where px, py, pz (m, from the head's centre) lie, in voxels, and in which."""
    shrink, shape = 1.0 / (np.exp(state[12]) * template.voxel_m), template.shape
    x = (state[3] * px + state[6] * py + state[9] * pz) * shrink
    y = (state[4] * px + state[7] * py + state[10] * pz) * shrink
    z = (state[5] * px + state[8] * py + state[11] * pz) * shrink
    fx, fy, fz = np.floor(x - low[0]), np.floor(y - low[1]), np.floor(z - low[2])
    inside = (fx >= 0.0) & (fy >= 0.0) & (fz >= 0.0) & (fx < shape[0]) & (fy < shape[1]) & (fz < shape[2])
    J[X, s], J[Y, s], J[Z, s] = x, y, z
    outside = float(shape[0] * shape[1] * shape[2])
    J[VOXEL, s] = (fx * shape[1] + fy) * shape[2] + fz if inside else outside


@bare_kernel
def place_points(points, n, state, template, J):
    """Write where the first ``n`` points lie in the template."""
    state, low = in_registers(state), corner(template)
    for s in range(np.uint64(n)):
        px, py, pz = points[0, s] - state[0], points[1, s] - state[1], points[2, s] - state[2]
        place(px, py, pz, s, state, low, template, J)


@bare_kernel
def place_rays(rays, m, first, state, template, J):
    """Write where the first ``m`` rays are nearest to the head's centre, in columns from ``first`` on."""
    state, low = in_registers(state), corner(template)
    for k in range(np.uint64(m)):
        px, py, pz = rays[0, k] - state[0], rays[1, k] - state[1], rays[2, k] - state[2]
        dx, dy, dz = rays[3, k], rays[4, k], rays[5, k]
        along = px * dx + py * dy + pz * dz
        px, py, pz = px - along * dx, py - along * dy, pz - along * dz
        place(px, py, pz, np.uint64(first) + k, state, low, template, J)


@bare_kernel
def look_up(first, after, modes, template, J, words):
    """Bring what the template says of columns ``first`` to ``after``; return how many of them lie outside of it."""
    used, outside, nowhere = 2 + (MODES_AT + modes - 1) // 8, 0, template.voxels.shape[0] - 1
    for s in range(np.uint64(first), np.uint64(after)):
        at = np.uint64(J[VOXEL, s])
        for word in range(np.uint64(used)):
            words[word, s] = template.voxels[at, word]
        outside += at == nowhere
    return outside


@rule
def short(word, at):
    """Return one of the four numbers of 16 bits in a ``word``."""
    return float(word << (48 - 16 * at) >> 48)


@rule
def byte(word, at):
    """Return one of the eight numbers of 8 bits in a ``word``."""
    return float(word << (56 - 8 * at) >> 56)


@bare_kernel
def unpack(first, after, modes, template, words, J):
    """Write what the template says, in metres, of columns ``first`` to ``after``, whose ``words`` these are."""
    distance, gradient, sigma = template.distance_unit_m, template.gradient_unit, template.sigma_unit_m
    for s in range(np.uint64(first), np.uint64(after)):
        word = words[0, s]
        J[DISTANCE, s] = distance * short(word, DISTANCE_AT)
        J[0, s] = gradient * short(word, GRADIENT_AT)
        J[1, s] = gradient * short(word, GRADIENT_AT + 1)
        J[2, s] = gradient * short(word, GRADIENT_AT + 2)
        J[SIGMA, s] = sigma * byte(words[1, s], SIGMA_AT)
    for i in range(modes):
        unit, at = template.mode_units_m[i], MODES_AT + i
        for s in range(np.uint64(first), np.uint64(after)):
            J[7 + i, s] = unit * byte(words[1 + at // 8, s], at % 8)


@rule
def off_middle(x, low):
    """Return how far ``x`` lies from the middle of its voxel, in voxels; ``low`` is where these begin."""
    return x - low - np.floor(x - low) - 0.5


@bare_kernel
def add_shape(first, after, state, modes, template, J):
    """Add to the distances of columns what their place in the voxel makes of it, and the modes of shape."""
    (lx, ly, lz), voxel_m = corner(template), template.voxel_m
    for s in range(np.uint64(first), np.uint64(after)):
        ax, ay, az = off_middle(J[X, s], lx), off_middle(J[Y, s], ly), off_middle(J[Z, s], lz)
        J[DISTANCE, s] += voxel_m * (J[0, s] * ax + J[1, s] * ay + J[2, s] * az)
    for i in range(modes):
        much = state[13 + i]
        for s in range(np.uint64(first), np.uint64(after)):
            J[DISTANCE, s] += much * J[7 + i, s]


@bare_kernel
def keep_crossing(first, m, modes, J):
    """Keep those of ``m`` columns from ``first`` on that cross the template, side by side; return how many do."""
    kept = first
    for s in range(first, first + m):
        if J[DISTANCE, s] < 0.0:
            for i in range(3):
                J[i, kept], J[X + i, kept] = J[i, s], J[X + i, s]
            for i in range(modes):
                J[7 + i, kept] = J[7 + i, s]
            J[DISTANCE, kept], J[SIGMA, kept] = J[DISTANCE, s], J[SIGMA, s]
            J[NOISE, kept], J[HIDDEN, kept] = 0.0, 0.0
            kept += 1
    return kept - first


@bare_kernel
def add_noise(points, n, state, J):
    """Write the variance of ``n`` points across the surface, and what adds to r² of those that face away."""
    _, _, _, r00, r01, r02, r10, r11, r12, r20, r21, r22, _ = in_registers(state)
    for s in range(np.uint64(n)):
        dx, dy, dz = points[3, s], points[4, s], points[5, s]
        toward = J[0, s] * (r00 * dx + r10 * dy + r20 * dz)
        toward += J[1, s] * (r01 * dx + r11 * dy + r21 * dz)
        toward += J[2, s] * (r02 * dx + r12 * dy + r22 * dz)
        along, across = points[6, s], points[7, s]
        J[NOISE, s] = along * toward * (along * toward) + across * across
        chord = BREADTH_M * max(toward - FACING_AWAY, 0.0)
        J[HIDDEN, s] = chord * chord / (CHORD_SIGMA_M * CHORD_SIGMA_M + along * along)


@bare_kernel
def weigh_columns(first, after, weight, k, scale, J):
    """Write what columns cost, and the root of how much each counts; return how many lie on the surface."""
    k2, scale2, on = k * k, scale * scale, 0
    for s in range(np.uint64(first), np.uint64(after)):
        e = scale * J[DISTANCE, s]
        variance = scale2 * J[SIGMA, s] * J[SIGMA, s] + J[NOISE, s]
        squared, bound = e * e, k2 * variance
        share = k2 / (bound + squared)
        more = squared + J[HIDDEN, s] * variance
        J[LOST, s] = share * squared
        J[LOST_MORE, s] = k2 / (bound + more) * more - share * squared
        damp = share * variance
        J[ROOT, s] = np.sqrt(weight * damp * share) if damp >= LEAST_DAMPING else 0.0
        J[RESIDUAL, s] = J[ROOT, s] * e
        on += squared < bound
    return on


@bare_kernel
def differentiate(count, modes, scale, voxel_m, J):
    """Turn what the template says of ``count`` columns into the derivatives of their residuals, times the roots."""
    metres = scale * voxel_m
    for s in range(np.uint64(count)):
        gx, gy, gz, x, y, z, root = J[0, s], J[1, s], J[2, s], J[X, s], J[Y, s], J[Z, s], J[ROOT, s]
        bend = root * metres
        J[0, s], J[1, s], J[2, s] = -root * gx, -root * gy, -root * gz
        J[3, s] = bend * (gy * z - gz * y)
        J[4, s] = bend * (gz * x - gx * z)
        J[5, s] = bend * (gx * y - gy * x)
        J[6, s] = root * scale * (J[DISTANCE, s] - voxel_m * (gx * x + gy * y + gz * z))
    for i in range(modes):
        for s in range(np.uint64(count)):
            J[7 + i, s] *= J[ROOT, s] * scale


@rule
def clear(first, after, modes, J):
    """Let columns count for nothing."""
    for i in range(ROWS):
        if i < 7 + modes or i >= RESIDUAL:
            for s in range(first, after):
                J[i, s] = 0.0


@rule
def sum_of(row, first, after):
    """Return the sum of whole vectors of a ``row``: side by side, in an order that no processor changes."""
    if after <= first:
        return 0.0
    sums = load(row, first)
    for at in range(first + LANES, after, LANES):
        sums = add(sums, load(row, at))
    return total(sums)
