"""From a candidate voxel to a centre: a robust sphere through the occupied parts about it.

The parts (2.5 cm at the default) about a candidate lie on the skull, the hair, the neck. A sphere of a head's size is
fitted to them by reweighted least squares (Cauchy weights), with weak priors on radius and place. Hair and hats raise
the surface that a sensor sees, so the centre of the skull lies ``HAIR_M`` below that of the sphere.
"""

from __future__ import annotations

import math

import numpy as np

from headvox.kernels import kernel, rule

REACH_M = 0.16
BELOW_M = 0.09
RADIUS_M = 0.093
RADIUS_SIGMA_M = 0.008
CENTRE_SIGMA_M = 0.05
SURFACE_SIGMA_M = 0.012
STEPS = 10
HAIR_M = 0.0135  # the median over 710 simulated heads, with one camera (553) and with several alike
MOST_PARTS = 8192


def cells_about(voxel_m: float) -> int:
    """Return how many cells about a voxel, to each side, :func:`fit_spheres` looks at."""
    return math.ceil(REACH_M / voxel_m)


@rule
def _gather(cells, x, y, z, voxel_m, subdivision, counting, points):  # type: ignore[no-untyped-def]
    """Write the parts near the voxel, in metres from its centre, to ``points`` (n, 3); return how many."""
    reach = int(np.ceil(REACH_M / voxel_m))
    part_m = voxel_m / subdivision
    found = 0
    for a in range(max(x - reach, 0), min(x + reach + 1, cells.shape[0])):
        for b in range(max(y - reach, 0), min(y + reach + 1, cells.shape[1])):
            for c in range(max(z - reach, 0), min(z + reach + 1, cells.shape[2])):
                value = cells[a, b, c]
                if value == 0:
                    continue
                bits = 1 if counting else int(value)
                for part in range(8):
                    if bits >> part & 1:
                        px = (a - x - 0.5) * voxel_m + ((part >> 2 & 1) + 0.5) * part_m
                        py = (b - y - 0.5) * voxel_m + ((part >> 1 & 1) + 0.5) * part_m
                        pz = (c - z - 0.5) * voxel_m + ((part & 1) + 0.5) * part_m
                        near = px * px + py * py + pz * pz <= REACH_M * REACH_M
                        if near and pz >= -BELOW_M and found < points.shape[0]:
                            points[found, 0] = px
                            points[found, 1] = py
                            points[found, 2] = pz
                            found += 1
    return found


@rule
def _solve(A, b):  # type: ignore[no-untyped-def]
    """Solve the 4x4 positive definite A x = b in place, by elimination; x is left in ``b``."""
    for i in range(4):
        for j in range(i + 1, 4):
            factor = A[j, i] / A[i, i]
            for k in range(i, 4):
                A[j, k] -= factor * A[i, k]
            b[j] -= factor * b[i]
    for i in range(3, -1, -1):
        for k in range(i + 1, 4):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]


@kernel
def fit_spheres(cells, peaks, voxel_m, subdivision, counting, points, spheres):  # type: ignore[no-untyped-def]
    """Fit a sphere about each of ``peaks`` (N, 3); write x, y, z (m, from the voxel's centre), radius, rms and count.

    Gauss-Newton on the residuals |p - c| - r, weighted 1 / (1 + (residual / sigma)²), with Gaussian priors.
    """
    A = np.empty((4, 4))
    b = np.empty(4)
    for i in range(peaks.shape[0]):
        count = _gather(cells, peaks[i, 0], peaks[i, 1], peaks[i, 2], voxel_m, subdivision, counting, points)
        cx = cy = cz = 0.0
        r = RADIUS_M
        rms = 0.0
        sigma2 = SURFACE_SIGMA_M * SURFACE_SIGMA_M
        for _ in range(STEPS):
            A[:] = 0.0
            centre_prior = sigma2 / (CENTRE_SIGMA_M * CENTRE_SIGMA_M)
            radius_prior = sigma2 / (RADIUS_SIGMA_M * RADIUS_SIGMA_M)
            A[0, 0] = A[1, 1] = A[2, 2] = centre_prior
            A[3, 3] = radius_prior
            b[0], b[1], b[2] = -centre_prior * cx, -centre_prior * cy, -centre_prior * cz
            b[3] = radius_prior * (RADIUS_M - r)
            squares = weights = 0.0
            for k in range(count):
                dx, dy, dz = points[k, 0] - cx, points[k, 1] - cy, points[k, 2] - cz
                distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
                residual = distance - r
                weight = 1.0 / (1.0 + residual * residual / sigma2)
                jx, jy, jz, jr = -dx / distance, -dy / distance, -dz / distance, -1.0
                A[0, 0] += weight * jx * jx
                A[0, 1] += weight * jx * jy
                A[0, 2] += weight * jx * jz
                A[0, 3] += weight * jx * jr
                A[1, 1] += weight * jy * jy
                A[1, 2] += weight * jy * jz
                A[1, 3] += weight * jy * jr
                A[2, 2] += weight * jz * jz
                A[2, 3] += weight * jz * jr
                A[3, 3] += weight * jr * jr
                b[0] -= weight * jx * residual
                b[1] -= weight * jy * residual
                b[2] -= weight * jz * residual
                b[3] -= weight * jr * residual
                squares += weight * residual * residual
                weights += weight
            for row in range(4):
                for column in range(row):
                    A[row, column] = A[column, row]
            _solve(A, b)
            cx += b[0]
            cy += b[1]
            cz += b[2]
            r += b[3]
            rms = np.sqrt(squares / max(weights, 1e-9))
        spheres[i, 0], spheres[i, 1], spheres[i, 2] = cx, cy, cz
        spheres[i, 3], spheres[i, 4], spheres[i, 5] = r, rms, count
