"""The covariance of rows with shared errors, against dense matrices of all rows."""

import tracemalloc

import numpy as np
import pytest

from snrmjax.diagnose.misfit.noise_model import shared_covariance

N = 40


def errors_of(name):
    """Slopes of the rows by their shared errors."""
    rng = np.random.default_rng(3)
    shared = rng.normal(size=(N, 6))
    if name == "of levels":
        level = np.repeat(np.arange(4), N // 4)
        return np.concatenate([shared * (level[:, None] == k) for k in range(4)], axis=1)
    return {
        "none": shared[:, :0],
        "zero": 0.0 * shared,
        "some": shared,
        "large": shared * np.logspace(-4, 2, 6),
        "alike": shared[:, [0, 0, 1, 1, 2, 2]],
        "more than rows": rng.normal(size=(N, N + 5)),
    }[name]


NAMES = ("none", "zero", "some", "large", "alike", "of levels", "more than rows")
KEPT = np.random.default_rng(5).random(N) < 0.6
ROWS = np.random.default_rng(7).normal(size=(3, N))


@pytest.mark.parametrize("name", NAMES)
def test_products_are_those_of_the_dense_matrix(name):
    shared = errors_of(name)
    dense, one = np.eye(N) + shared @ shared.T, shared_covariance(shared)
    solved = np.linalg.solve(dense, ROWS.T).T
    assert one.solved(ROWS) == pytest.approx(solved, rel=1e-8, abs=1e-9)
    whole = one.decorrelated(ROWS)
    assert whole @ whole.T == pytest.approx(ROWS @ solved.T, rel=1e-10, abs=1e-10)
    root = one.decorrelated(np.eye(N))
    assert root @ dense @ root.T == pytest.approx(np.eye(N), abs=1e-7)
    # Shared errors as unknowns of their own, with unit priors.
    stacked = np.concatenate([shared, np.eye(shared.shape[1])])
    aim = np.concatenate([ROWS[0], np.zeros(shared.shape[1])])
    errors = np.linalg.lstsq(stacked, aim)[0]
    assert one.most_likely_errors(ROWS[0]) == pytest.approx(errors, rel=1e-10, abs=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_rows_given_others_are_those_of_the_normal_distribution(name):
    shared = errors_of(name)
    dense, one = np.eye(N) + shared @ shared.T, shared_covariance(shared)
    own = one.of_rows(KEPT).decorrelated(ROWS[0, KEPT])
    square = ROWS[0, KEPT] @ np.linalg.solve(dense[np.ix_(KEPT, KEPT)], ROWS[0, KEPT])
    assert own @ own == pytest.approx(square, rel=1e-10)
    # Conditional rows: the last ones after forward substitution with Cholesky factor.
    last = np.argsort(~KEPT, kind="stable")
    lower = np.linalg.cholesky(dense[np.ix_(last, last)])
    left = np.linalg.solve(lower, ROWS[:, last].T)[KEPT.sum() :]
    found = one.given_rows(KEPT).decorrelated(ROWS)
    assert found @ found.T == pytest.approx(left.T @ left, rel=1e-8, abs=1e-9)


def test_no_matrix_of_rows_by_rows_is_formed():
    n = 20000  # 3.2 GB if one were
    rng = np.random.default_rng(0)
    shared, rows = rng.normal(size=(n, 4)), rng.normal(size=n)
    known = rng.random(n) < 0.5
    tracemalloc.start()
    one = shared_covariance(shared)
    one.decorrelated(rows)
    one.given_rows(known).decorrelated(rows)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 30 * shared.nbytes
