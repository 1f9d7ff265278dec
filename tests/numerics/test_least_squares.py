"""Penalised least squares against dense algebra and Monte Carlo."""

import numpy as np
import pytest

from snrmjax.numerics.least_squares import ErrorSizes, error_sizes, penalised_least_squares

RNG = np.random.default_rng(0)
POINTS, PARAMETERS, LEVELS = 40, 5, 8
DESIGN = RNG.normal(size=(POINTS, PARAMETERS))
STD = RNG.uniform(0.5, 2.0, POINTS)
LEVEL = np.sort(RNG.integers(0, LEVELS, POINTS))
MEMBERS = LEVEL[:, None] == np.arange(LEVELS)
TARGET = RNG.normal(size=POINTS)
PENALTY = 0.7 * np.diff(np.eye(PARAMETERS), n=2, axis=0)
PENALTY_TARGET = np.array([0.3, -0.1, 0.2])


def fit(target, penalty=PENALTY, penalty_target=PENALTY_TARGET):
    return penalised_least_squares(DESIGN, target, STD, MEMBERS, penalty, penalty_target)


def test_values_are_those_of_the_stacked_problem():
    stacked = np.concatenate([DESIGN / STD[:, None], PENALTY])
    right = np.concatenate([TARGET / STD, PENALTY_TARGET])
    best = np.linalg.lstsq(stacked, right, rcond=None)[0]
    # The normal equations square a condition number of about 3.
    np.testing.assert_allclose(fit(TARGET).values, best, rtol=1e-12)


def test_covariances_are_those_of_the_dense_estimator():
    # The estimate is linear in the target: its matrix, column by column, from the code's answers.
    zero = fit(np.zeros(POINTS)).values
    matrix = np.stack([fit(unit).values - zero for unit in np.eye(POINTS)], axis=1)
    result = fit(TARGET)
    unshared = matrix @ np.diag(STD**2) @ matrix.T
    shared = matrix @ (LEVEL[:, None] == LEVEL).astype(float) @ matrix.T
    np.testing.assert_allclose(result.unshared_covariance, unshared, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(result.shared_covariance, shared, rtol=1e-10, atol=1e-13)
    # And the textbook sandwich.
    weight = np.diag(1 / STD**2)
    bread = np.linalg.inv(DESIGN.T @ weight @ DESIGN + PENALTY.T @ PENALTY)
    np.testing.assert_allclose(matrix, bread @ DESIGN.T @ weight, rtol=1e-10, atol=1e-13)


def test_without_penalty_the_covariance_is_the_inverse_information():
    none = np.zeros((0, PARAMETERS))
    result = penalised_least_squares(DESIGN, TARGET, STD, MEMBERS, none, np.zeros(0))
    information = DESIGN.T @ np.diag(1 / STD**2) @ DESIGN
    np.testing.assert_allclose(result.unshared_covariance, np.linalg.inv(information), rtol=1e-11)


def test_covariance_against_monte_carlo():
    truth = np.array([1.0, -2.0, 0.5, 3.0, 0.2])
    rng, found = np.random.default_rng(1), []
    none = np.zeros((0, PARAMETERS))
    for _ in range(4000):
        error = 1.3 * STD * rng.normal(size=POINTS) + 0.8 * rng.normal(size=LEVELS)[LEVEL]
        target = DESIGN @ truth + error
        found.append(
            penalised_least_squares(DESIGN, target, STD, MEMBERS, none, np.zeros(0)).values
        )
    result = fit(TARGET, none, np.zeros(0))
    covariance = 1.3**2 * result.unshared_covariance + 0.8**2 * result.shared_covariance
    # 4000 draws know a standard deviation to 1.1 %.
    np.testing.assert_allclose(
        np.std(found, axis=0, ddof=1), np.sqrt(np.diag(covariance)), rtol=0.05
    )
    np.testing.assert_allclose(np.mean(found, axis=0), truth, atol=0.03)


def test_a_penalty_much_stiffer_than_the_points():
    # All values equal, by a penalty of 1e9: what is left is the weighted mean.
    ones = np.eye(PARAMETERS)[LEVEL % PARAMETERS]
    stiff = 1e9 * np.diff(np.eye(PARAMETERS), axis=0)
    zeros = np.zeros(PARAMETERS - 1)
    result = penalised_least_squares(ones, TARGET, STD, MEMBERS, stiff, zeros)
    weight = 1 / STD**2
    mean = np.sum(weight * TARGET) / np.sum(weight)
    # Rounding 1e-16 times 1e9: normal equations would have lost everything.
    np.testing.assert_allclose(result.values, mean, rtol=1e-6)
    np.testing.assert_allclose(result.unshared_covariance, 1 / np.sum(weight), rtol=1e-6)


def test_parameters_that_no_point_sees_stay_at_zero():
    design = DESIGN.copy()
    design[:, 2] = 0.0
    none = np.zeros((0, PARAMETERS))
    result = penalised_least_squares(design, TARGET, STD, MEMBERS, none, np.zeros(0))
    assert result.values[2] == pytest.approx(0.0, abs=1e-14)
    assert np.isfinite(result.unshared_covariance).all()


def drawn_levels(rng, s, tau, n_levels=10, n_points=6):
    """Errors of levels left out and predicted by their two neighbours, as the method supposes."""
    std = rng.uniform(0.5, 1.5, (n_levels + 2, n_points))
    error = s * std * rng.normal(size=std.shape) + tau * rng.normal(size=(n_levels + 2, 1))
    weight = 1 / std**2
    mean = np.sum(weight * error, axis=1) / np.sum(weight, axis=1)
    predicted = 0.5 * (mean[:-2] + mean[2:])
    return list(error[1:-1] - predicted[:, None]), list(std[1:-1])


def test_what_levels_are_known_to_share_is_not_found_again():
    rng = np.random.default_rng(4)
    both, on_top = [], []
    for _ in range(300):
        errors, std = drawn_levels(rng, 0.2, 0.5)
        both.append(error_sizes(errors, std).level_std)
        on_top.append(error_sizes(errors, std, [np.full((6, 1), 0.3)] * 10).level_std)
    # 0.5² is 0.3² and 0.4²; of the few draws in which nothing is left the rest is lost.
    gone = np.mean(np.square(both)) - np.mean(np.square(on_top))
    assert gone == pytest.approx(0.3**2, rel=0.1)


@pytest.mark.parametrize(("s", "tau"), [(1.0, 0.0), (1.0, 2.0), (0.2, 1.0), (3.0, 0.5)])
def test_error_sizes_on_synthetic_levels(s, tau):
    rng = np.random.default_rng(2)
    sizes = [error_sizes(*drawn_levels(rng, s, tau)) for _ in range(2000)]
    noise = np.array([one.noise_scale for one in sizes])
    level = np.array([one.level_std for one in sizes])
    # 50 degrees of freedom inside the levels and 2000 seeds: s² is known to 0.5 %.
    np.testing.assert_allclose(np.sqrt(np.mean(noise**2)), s, rtol=0.02)
    if tau == 2.0 or s == 0.2:
        # τ is the larger part of the means: its square is unbiased but for the cut at zero.
        np.testing.assert_allclose(np.sqrt(np.mean(level**2)), tau, rtol=0.03)
    else:
        # Lost in the noise of the means, 3 % to 40 % of which is left where the cut at zero acts.
        assert np.sqrt(np.mean(level**2)) < tau + 0.4 * s


def test_levels_of_one_point_and_few_levels():
    one = [np.array([1.0]), np.array([-2.0]), np.array([2.0])]
    # No scatter inside: all is the levels', ⟨mean²⟩/1.5 = 2.
    sizes = error_sizes(one, [np.ones(1)] * 3)
    assert sizes == ErrorSizes(0.0, pytest.approx(np.sqrt(2.0)))
    two = error_sizes([np.array([1.0, 3.0]), np.array([0.0, 2.0])], [np.ones(2)] * 2)
    # (1 + 1 + 1 + 1)/2 inside; two levels say nothing about τ.
    assert two == ErrorSizes(pytest.approx(np.sqrt(2.0)), 0.0)
