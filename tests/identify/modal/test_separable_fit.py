"""The covariance of a separable fit, against the dense one of all unknowns together."""

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from snrmjax.identify.modal.separable_fit import ChannelRows, TermColumns, fit_separable

TIME = np.linspace(0, 3, 150)
RATE, OMEGA = 0.7, 5.0
FACTORS = np.array([[1.0, 0.3], [-0.5, 1.2], [0.8, 0.1]])
STD = np.array([0.02, 0.05, 0.03])


def basis_at(unknowns):
    rate, omega = unknowns
    wave = np.exp(-rate * TIME)
    columns = np.column_stack([wave * np.cos(omega * TIME), wave * np.sin(omega * TIME)])
    by_omega = TIME[:, None] * np.column_stack([-columns[:, 1], columns[:, 0]])
    return [TermColumns(columns, np.stack([-TIME[:, None] * columns, by_omega]))]


def residuals(every, values):
    unknowns, factors = every[:2], every[2:].reshape(3, 2)
    return ((values - factors @ basis_at(unknowns)[0].columns.T) / STD[:, None]).ravel()


@pytest.mark.parametrize("neighbours", [(1.0,), (1.0, 1.0, 1.0)], ids=["white", "correlated"])
def test_covariance_is_that_of_all_unknowns_together(neighbours):
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(3, len(TIME) + len(neighbours) - 1))
    noise = np.stack([np.convolve(row, neighbours, "valid") for row in noise])
    noise = noise / np.linalg.norm(neighbours) * STD[:, None]
    values = FACTORS @ basis_at([RATE, OMEGA])[0].columns.T + noise
    rows = ChannelRows(
        values, np.repeat(1 / STD[:, None], len(TIME), axis=1), np.zeros(3, dtype=int), 1
    )
    fit = fit_separable(
        basis_at, rows, np.array([0.5, 4.8]), (np.array([0.0, 1.0]), np.array([5.0, 9.0]))
    )
    start = np.concatenate([[RATE, OMEGA], FACTORS.ravel()])
    dense = scipy.optimize.least_squares(
        residuals, start, args=(values,), method="lm", xtol=1e-12, ftol=1e-12
    )
    assert np.allclose(fit.unknowns, dense.x[:2], rtol=1e-5)
    assert np.allclose(fit.coefficients.ravel(), dense.x[2:], rtol=1e-4, atol=1e-5)
    # The estimated correlation of residuals, in a matrix of all rows.
    lags = np.zeros(len(TIME))
    lags[0] = 1.0
    lags[1 : 1 + len(fit.correlation)] = fit.correlation
    one = scipy.linalg.toeplitz(lags)
    together = scipy.linalg.block_diag(one, one, one)
    gain = np.linalg.inv(dense.jac.T @ dense.jac) @ dense.jac.T
    covariance = gain @ together @ gain.T
    assert (len(fit.correlation) > 0) == (len(neighbours) > 1)
    assert np.allclose(fit.covariance, covariance[:2, :2], rtol=1e-3)
    for term in range(2):
        own = 2 + term + 2 * np.arange(3)
        scale = np.sqrt(np.outer(covariance[own, own], covariance[own, own]))
        assert np.all(
            np.abs(fit.term_covariance(term) - covariance[np.ix_(own, own)]) < 2e-3 * scale
        )
        cross = covariance[np.ix_([0, 1], own)]
        scale = np.sqrt(np.outer(np.diag(covariance)[:2], covariance[own, own]))
        assert np.all(np.abs(fit.cross_covariance(term) - cross) < 2e-3 * scale)
