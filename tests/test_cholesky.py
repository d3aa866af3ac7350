import numpy as np
import pytest

from headvox.machine.cholesky import factor, half_log_determinant, substitute, substitute_back


@pytest.mark.parametrize("size", [1, 4, 17])
def test_solves_what_numpy_solves(size):
    rng = np.random.default_rng(size)
    root = rng.normal(size=(size, size))
    wanted, b = root @ root.T + 0.1 * np.eye(size), rng.normal(size=size)
    A, x = np.full((size, size + 2), np.nan), b.copy()
    A[:, :size] = np.where(np.tri(size, k=-1, dtype=bool), np.nan, wanted)  # the lower half is not read
    A[:, size] = b
    factor(A, size)
    forward = A[:, size].copy()
    np.testing.assert_allclose(half_log_determinant(A, size), 0.5 * np.linalg.slogdet(wanted)[1], rtol=1e-9)
    np.testing.assert_allclose(np.triu(A[:, :size]), np.linalg.cholesky(wanted).T, atol=1e-9)
    assert np.isnan(A[:, :size][np.tri(size, k=-1, dtype=bool)]).all()
    substitute(A, x, size)
    np.testing.assert_allclose(x, forward, rtol=1e-9)
    substitute_back(A, x, size)
    np.testing.assert_allclose(x, np.linalg.solve(wanted, b), rtol=1e-7)


def test_what_is_not_definite_gives_finite_numbers():
    A, x = np.zeros((3, 3)), np.ones(3)
    factor(A, 3)
    substitute(A, x, 3)
    substitute_back(A, x, 3)
    assert np.isfinite(x).all()
