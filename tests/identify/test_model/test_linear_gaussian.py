"""Marginal likelihoods of linear rows, against dense normal distributions and integrals."""

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.stats import multivariate_normal

from snrmjax.identify.test_model.linear_gaussian import (
    LinearRows,
    laplace_evidence,
    maximised,
    precision_at,
)

N = 30
RNG = np.random.default_rng(1)
ROWS = 2 * RNG.normal(size=N)
DESIGNS = {
    "few": RNG.normal(size=(N, 4)),
    "more than rows": RNG.normal(size=(N, N + 7)),
    "alike": np.repeat(RNG.normal(size=(N, 2)), 2, axis=1),
    "none": np.zeros((N, 0)),
}
SCALE = 1.7


def prior_of(design):
    """Variances over ten powers of ten."""
    return np.logspace(-4, 6, design.shape[1])


@pytest.mark.parametrize("name", DESIGNS)
def test_a_likelihood_is_the_density_of_a_normal_distribution(name):
    design, offset = DESIGNS[name], 3.0
    variance = prior_of(design)
    found = LinearRows.of(design, ROWS, offset).log_likelihood(SCALE, variance)[0]
    covariance = SCALE**2 * np.eye(N) + (design * variance) @ design.T
    truth = multivariate_normal.logpdf(ROWS, cov=covariance) + offset
    # The dense covariance has a condition number of 1e6 to 1e7.
    assert found == pytest.approx(truth, rel=1e-6)


@pytest.mark.parametrize("name", DESIGNS)
def test_its_slopes_are_finite_differences(name):
    design, step = DESIGNS[name], 1e-5
    model, variance = LinearRows.of(design, ROWS), prior_of(design)

    def value(log_scale, log_variance):
        return model.log_likelihood(np.exp(log_scale), np.exp(log_variance))[0]

    _, by_scale, by_variance = model.log_likelihood(SCALE, variance)
    at, logs = np.log(SCALE), np.log(variance)
    ends = [value(at + sign * step, logs) for sign in (1, -1)]
    # Regularisation of 1e-12 of the diagonal over a step of 1e-5, times the condition number.
    assert by_scale == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=1e-4)
    for k, unit in enumerate(step * np.eye(len(logs))):
        ends = [value(at, logs + sign * unit) for sign in (1, -1)]
        assert by_variance[k] == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=1e-4)


@pytest.mark.parametrize("name", DESIGNS)
def test_a_posterior_is_that_of_regularised_least_squares(name):
    design = DESIGNS[name]
    variance = np.ones(design.shape[1])
    mean, covariance = LinearRows.of(design, ROWS).posterior(SCALE, variance)
    matrix = design.T @ design / SCALE**2 + np.eye(len(variance))
    assert covariance == pytest.approx(np.linalg.inv(matrix), abs=1e-10)
    assert mean == pytest.approx(np.linalg.solve(matrix, design.T @ ROWS / SCALE**2), abs=1e-9)


def test_wide_priors_and_small_noise_lose_no_digits():
    """Rows explained by the unknowns up to relative noise of 1e-6."""
    design, true = DESIGNS["few"], np.array([1e3, -2e3, 5e2, 1e2])
    left = 1e-6 * np.random.default_rng(2).normal(size=N)
    mean, covariance = LinearRows.of(design, design @ true + left).posterior(1e-6, np.full(4, 1e12))
    flat = np.linalg.inv(design.T @ design)
    assert covariance == pytest.approx(1e-12 * flat, rel=1e-6)
    # Regularisation is 1e-12 of 2e3: a hundredth of the errors of 2e-7.
    assert mean - true == pytest.approx(flat @ design.T @ left, abs=4e-9)


def quadratic_log_density(point):
    """ln of a normal density of two correlated numbers, and of a third that is flat."""
    matrix = np.array([[2.0, 0.6, 0.0], [0.6, 1.0, 0.0], [0.0, 0.0, 0.0]])
    step = point - np.array([0.3, -0.4, 0.0])
    return -0.5 * float(step @ matrix @ step), -matrix @ step


def test_what_is_normal_is_integrated_exactly():
    bounds = [(-9.0, 9.0)] * 3
    found = maximised(quadratic_log_density, np.zeros(3), bounds)
    assert found[:2] == pytest.approx([0.3, -0.4], abs=1e-3)  # of a slope of 1e-3
    grid = np.linspace(-8, 8, 401)
    values = [[quadratic_log_density(np.array([a, b, 0.0]))[0] for b in grid] for a in grid]
    volume = np.log(trapezoid(trapezoid(np.exp(values), grid), grid))
    # A flat direction counts as a prior with 1σ of 10.
    wide = volume + np.log(10 * np.sqrt(2 * np.pi))
    assert laplace_evidence(quadratic_log_density, found, bounds) == pytest.approx(wide, abs=1e-3)
    assert laplace_evidence(
        quadratic_log_density, found, [*bounds[:2], (0.0, 0.0)]
    ) == pytest.approx(volume, abs=1e-3)
    matrix = np.array([[2.0, 0.6], [0.6, 1.0]])
    assert precision_at(quadratic_log_density, found)[:2, :2] == pytest.approx(matrix, rel=1e-4)


def test_repeated_rows_count_once_with_half_the_power():
    """A likelihood to the power of a half, of rows that all stand twice, is that of one copy."""
    rng = np.random.default_rng(5)
    design, rows = rng.normal(size=(30, 4)), rng.normal(size=30)
    once = LinearRows.of(design, rows)
    twice = LinearRows.of(np.vstack([design, design]), np.append(rows, rows))._replace(fraction=0.5)
    variance = np.array([1.0, 0.3, 2.0, 0.1])
    for scale in (0.7, 1.3):
        one, other = (each.log_likelihood(scale, variance) for each in (once, twice))
        assert other[0] == pytest.approx(one[0], rel=1e-10)
        assert other[1] == pytest.approx(one[1], rel=1e-9)
        assert other[2] == pytest.approx(one[2], rel=1e-9)
        for first, second in zip(
            once.posterior(scale, variance), twice.posterior(scale, variance), strict=True
        ):
            assert second == pytest.approx(first, rel=1e-9, abs=1e-12)
