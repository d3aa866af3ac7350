"""Small positive definite systems: A = Uᵀ U, by Cholesky, in place."""

from __future__ import annotations

import numpy as np

from headvox.machine.kernels import rule

LEAST_PIVOT = 1e-12


@rule
def factor(A, size):
    """Leave U in the upper half of A (size, >= size), and what solves Uᵀ y = b in place of each column b behind it.

    Of A the upper half is read; the lower is left as it is.
    """
    for q in range(size):
        pivot = np.sqrt(max(A[q, q], LEAST_PIVOT))
        A[q, q] = pivot
        for j in range(q + 1, A.shape[1]):
            A[q, j] /= pivot
        for i in range(q + 1, size):
            share = A[q, i]
            for j in range(i, A.shape[1]):
                A[i, j] -= share * A[q, j]


@rule
def half_log_determinant(A, size):
    """Return half the logarithm of the determinant of Uᵀ U, U the upper half of A."""
    half = 0.0
    for i in range(size):
        half += np.log(A[i, i])
    return half


@rule
def substitute(A, x, size):
    """Replace ``x`` (size,) by what solves Uᵀ y = x, U the upper half of A."""
    for i in range(size):
        x[i] /= A[i, i]
        for j in range(i + 1, size):
            x[j] -= A[i, j] * x[i]


@rule
def substitute_back(A, x, size):
    """Replace ``x`` (size,) by what solves U y = x, U the upper half of A."""
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            x[i] -= A[i, j] * x[j]
        x[i] /= A[i, i]
