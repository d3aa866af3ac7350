"""Small positive definite systems: A = L Lᵀ, by Cholesky, in place."""

from __future__ import annotations

import numpy as np

from headvox.machine.kernels import rule

LEAST_PIVOT = 1e-12


@rule
def factor(A, size):
    """Leave L in the lower half of A (size, >= size), whose upper half is read; return half the log determinant."""
    half_log_det = 0.0
    for i in range(size):
        for j in range(i + 1):
            v = A[j, i]
            for q in range(j):
                v -= A[i, q] * A[j, q]
            if i == j:
                v = np.sqrt(max(v, LEAST_PIVOT))
                half_log_det += np.log(v)
                A[i, i] = v
            else:
                A[i, j] = v / A[j, j]
    return half_log_det


@rule
def substitute(A, x, size):
    """Replace ``x`` (size,) by what solves L Lᵀ y = x, L the lower half of A: forward, then back substitution."""
    for i in range(size):
        for q in range(i):
            x[i] -= A[i, q] * x[q]
        x[i] /= A[i, i]
    for i in range(size - 1, -1, -1):
        for q in range(i + 1, size):
            x[i] -= A[q, i] * x[q]
        x[i] /= A[i, i]
