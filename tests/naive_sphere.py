"""The slow and obvious twin of the sphere that is fitted to a head."""

from __future__ import annotations

import math

import numpy as np


def parts_near(cells: np.ndarray, peak, voxel: float, subdivision: int) -> np.ndarray:
    """Return the middles of the occupied parts within 16 cm of a voxel's centre, and not 9 cm below it, from there."""
    points = []
    part = voxel / subdivision
    for cell in np.argwhere(cells):
        corner = (cell - np.array(peak) - 0.5) * voxel
        if np.abs(cell - np.array(peak)).max() > math.ceil(0.16 / voxel):
            continue
        for a in range(subdivision):
            for b in range(subdivision):
                for c in range(subdivision):
                    occupied = cells.dtype != np.uint8 or int(cells[tuple(cell)]) >> (4 * a + 2 * b + c) & 1
                    p = corner + (np.array([a, b, c]) + 0.5) * part
                    if occupied and p[0] * p[0] + p[1] * p[1] + p[2] * p[2] <= 0.16 * 0.16 and p[2] >= -0.09:
                        points.append(p)
    return np.array(points, np.float64).reshape(-1, 3)


def fit_sphere(points: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return centre, radius and rms: ten Gauss-Newton steps with Cauchy weights and Gaussian priors."""
    sigma, prior = 0.012, np.array([0.0, 0.0, 0.0, 0.093])
    stiffness = np.diag([(sigma / 0.05) ** 2] * 3 + [(sigma / 0.008) ** 2])
    x, rms = prior.copy(), 0.0
    for _ in range(10):
        away = points - x[:3]
        distance = np.maximum(np.sqrt((away**2).sum(axis=1)), 1e-6)
        residual = distance - x[3]
        weight = 1.0 / (1.0 + (residual / sigma) ** 2)
        J = np.column_stack([-away / distance[:, None], -np.ones(len(points))])
        A = stiffness + J.T @ (weight[:, None] * J)
        b = stiffness @ (prior - x) - J.T @ (weight * residual)
        x = x + np.linalg.solve(A, b)
        rms = math.sqrt((weight * residual**2).sum() / max(weight.sum(), 1e-9))
    return x[:3], x[3], rms


def fit_spheres(cells: np.ndarray, peaks, voxel: float, subdivision: int) -> np.ndarray:
    rows = []
    for peak in peaks:
        points = parts_near(cells, peak, voxel, subdivision)
        centre, radius, rms = fit_sphere(points)
        rows.append([*centre, radius, rms, len(points)])
    return np.array(rows, np.float64).reshape(-1, 6)
