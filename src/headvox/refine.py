"""From a candidate voxel to a centre: a robust sphere through the occupied parts about it.

The parts (2.5 cm at the default) about a candidate lie on the skull, the hair, the neck. A sphere of a head's size is
fitted to them by reweighted least squares (Cauchy weights), with weak priors on radius and place. Hair and hats raise
the surface that a sensor sees, so the centre of the skull lies ``HAIR_M`` below that of the sphere.
"""

from __future__ import annotations

import math

import numpy as np

from headvox.machine.cholesky import factor, substitute, substitute_back
from headvox.machine.kernels import bare_kernel, kernel, rule
from headvox.machine.simd import LANES, add, beginning, fill, load, mul, sub, total

REACH_M = 0.16
BELOW_M = 0.09
RADIUS_M = 0.093
RADIUS_SIGMA_M = 0.008
CENTRE_SIGMA_M = 0.05
SURFACE_SIGMA_M = 0.012
STEPS = 10
HAIR_M = 0.0135  # the median over 710 simulated heads, with one camera (553) and with several alike
ROWS, MOST_PARTS = 8, 8192  # of the working memory
RADIUS, RMS, COUNT = 3, 4, 5  # what a row says of a sphere, behind its centre


def cells_about(voxel_m: float) -> int:
    """Return how many cells about a voxel, to each side, :func:`fit_spheres` looks at."""
    return math.ceil(REACH_M / voxel_m)


# The sums of a step: the upper triangle of A, row by row, b, and the weighted squares and the weights.
TRIANGLE, RIGHT, SQUARES, WEIGHTS, SUMS = 0, 10, 14, 15, 16


@rule
def part_at(a, b, c, part, voxel_m, part_m):
    """Return where a part of the voxel ``a, b, c`` away lies, and whether it counts; metres from the voxel's centre."""
    px = (a - 0.5) * voxel_m + ((part >> 2 & 1) + 0.5) * part_m
    py = (b - 0.5) * voxel_m + ((part >> 1 & 1) + 0.5) * part_m
    pz = (c - 0.5) * voxel_m + ((part & 1) + 0.5) * part_m
    counts = px * px + py * py + pz * pz <= REACH_M * REACH_M and pz >= -BELOW_M
    return px, py, pz, counts


@rule
def _gather(grids, shape, x, y, z, voxel_m, subdivision, counting, room):
    """Write the parts near the voxel, in metres from its centre, to ``room``; return how many."""
    reach = int(np.ceil(REACH_M / voxel_m))
    part_m = voxel_m / subdivision
    found = 0
    for a in range(max(x - reach, 0), min(x + reach + 1, shape[0])):
        for b in range(max(y - reach, 0), min(y + reach + 1, shape[1])):
            column = (a * shape[1] + b) * shape[2]
            for c in range(max(z - reach, 0), min(z + reach + 1, shape[2])):
                at = np.uint64(column + c)  # a signed index costs a check for counting from the end
                value = np.int64(grids[0, at])
                for grid in range(1, grids.shape[0]):
                    value |= np.int64(grids[grid, at])
                if value == 0:
                    continue
                bits = 1 if counting else int(value)
                for part in range(8):
                    if bits >> part & 1:
                        px, py, pz, counts = part_at(a - x, b - y, c - z, part, voxel_m, part_m)
                        if counts and found < room.shape[1]:
                            room[0, found] = px
                            room[1, found] = py
                            room[2, found] = pz
                            found += 1
    return found


@rule
def add_priors(sphere, sums):
    """Add to ``sums`` what is known of a head's place and size; ``sphere`` is x, y, z and the radius."""
    centre = SURFACE_SIGMA_M * SURFACE_SIGMA_M / (CENTRE_SIGMA_M * CENTRE_SIGMA_M)
    radius = SURFACE_SIGMA_M * SURFACE_SIGMA_M / (RADIUS_SIGMA_M * RADIUS_SIGMA_M)
    sums[TRIANGLE] += centre
    sums[TRIANGLE + 4] += centre
    sums[TRIANGLE + 7] += centre
    sums[TRIANGLE + 9] += radius
    for i in range(3):
        sums[RIGHT + i] += -centre * sphere[i]
    sums[RIGHT + 3] += radius * (RADIUS_M - sphere[3])


@rule
def weigh_part(px, py, pz, sphere):
    """Return how a part's residual grows with the centre of ``sphere`` (x, y, z), the residual, and its weight."""
    dx, dy, dz = px - sphere[0], py - sphere[1], pz - sphere[2]
    distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
    residual = distance - sphere[3]
    weight = 1.0 / (1.0 + residual * residual / (SURFACE_SIGMA_M * SURFACE_SIGMA_M))
    inverse = -1.0 / distance
    return dx * inverse, dy * inverse, dz * inverse, residual, weight


@rule
def add_weighed(jx, jy, jz, residual, weight, sums):
    """Add to ``sums`` what a part says of a sphere; for its numbers see :func:`weigh_part`."""
    j = (jx, jy, jz, -1.0)
    at = TRIANGLE
    for row in range(4):
        for column in range(row, 4):
            sums[at] += weight * j[row] * j[column]
            at += 1
        sums[RIGHT + row] -= weight * j[row] * residual
    sums[SQUARES] += weight * residual * residual
    sums[WEIGHTS] += weight


@rule
def add_part(px, py, pz, sphere, sums):
    """Add to ``sums`` what a part says of ``sphere``."""
    jx, jy, jz, residual, weight = weigh_part(px, py, pz, sphere)
    add_weighed(jx, jy, jz, residual, weight, sums)


@rule
def take_step(sums, A, b, sphere):
    """Move ``sphere`` by what ``sums`` say, and return how far the parts lie from it (rms); A and b are scrap."""
    at = TRIANGLE
    for row in range(4):
        for column in range(row, 4):
            A[row, column] = A[column, row] = sums[at]
            at += 1
        b[row] = sums[RIGHT + row]
    factor(A, 4)
    substitute(A, b, 4)
    substitute_back(A, b, 4)
    for i in range(4):
        sphere[i] += b[i]
    return np.sqrt(sums[SQUARES] / max(sums[WEIGHTS], 1e-9))


@kernel
def fit_spheres(grids, shape, peaks, voxel_m, subdivision, counting, room, spheres):
    """Fit a sphere about each of ``peaks`` (N, 3); write x, y, z (m, from the voxel's centre), radius, rms and count.

    ``grids`` are the cells of a lattice of ``shape``, see :func:`headvox.integral.integrate`. Gauss-Newton on the
    residuals |p - c| - r, weighted 1 / (1 + (residual / sigma)²), with Gaussian priors. ``room`` (ROWS, parts) is
    working memory.
    """
    A, b, sums = np.empty((4, 4)), np.empty(4), np.empty(SUMS)
    for i in range(peaks.shape[0]):
        at = peaks[i]
        count = _gather(grids, shape, at[0], at[1], at[2], voxel_m, subdivision, counting, room)
        whole = -(-count // LANES) * LANES  # the last vector is a whole one
        room[:3, count:whole] = 0.0
        sphere = spheres[i]
        sphere[:] = 0.0
        sphere[RADIUS] = RADIUS_M
        for _ in range(STEPS):
            sums[:] = 0.0
            add_priors(sphere, sums)
            _weigh(room, whole, sphere)
            _add_all(room, count, sums)
            sphere[RMS] = take_step(sums, A, b, sphere)
        sphere[COUNT] = count


@bare_kernel
def _add_all(room, count, sums):
    """Add to ``sums`` what each of ``count`` parts in ``room`` says: as :func:`add_weighed`, LANES parts at a time."""
    flat, length = room.reshape(-1), room.shape[1]
    none = fill(0.0)
    # i stands for the derivative by the radius, -1, and r for the residual.
    xx = xy = xz = xi = yy = yz = yi = zz = zi = ii = xr = yr = zr = ir = rr = none
    for k in range(0, count, LANES):
        x, y, z = load(flat, 3 * length + k), load(flat, 4 * length + k), load(flat, 5 * length + k)
        r, w = load(flat, 6 * length + k), beginning(load(flat, 7 * length + k), count - k)
        wx, wy, wz, wr = mul(w, x), mul(w, y), mul(w, z), mul(w, r)
        xx, xy, xz, xi = add(xx, mul(wx, x)), add(xy, mul(wx, y)), add(xz, mul(wx, z)), sub(xi, wx)
        yy, yz, yi = add(yy, mul(wy, y)), add(yz, mul(wy, z)), sub(yi, wy)
        zz, zi, ii = add(zz, mul(wz, z)), sub(zi, wz), add(ii, w)
        xr, yr, zr, ir = sub(xr, mul(wx, r)), sub(yr, mul(wy, r)), sub(zr, mul(wz, r)), add(ir, wr)
        rr = add(rr, mul(wr, r))
    for at, lanes in enumerate((xx, xy, xz, xi, yy, yz, yi, zz, zi, ii, xr, yr, zr, ir, rr, ii)):
        sums[at] += total(lanes)


@bare_kernel
def _weigh(room, count, sphere):
    """Write what :func:`weigh_part` returns for each of ``count`` parts to the rows of ``room`` behind their places."""
    # By itself, so that the compiler makes vectors of it: roots and quotients are slow.
    for k in range(np.uint64(count)):
        jx, jy, jz, residual, weight = weigh_part(room[0, k], room[1, k], room[2, k], sphere)
        room[3, k], room[4, k], room[5, k], room[6, k], room[7, k] = jx, jy, jz, residual, weight
