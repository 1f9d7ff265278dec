"""Noise and scatter of levels by restricted likelihood, against drawn samples and closed forms."""

import numpy as np
import pytest
from truths.sizes import repeats

from snrmjax.identify.joint.force_balance import LEVEL_ERRORS
from snrmjax.identify.joint.initial_guess import levels_apart
from snrmjax.identify.joint.notes import notes_on_noise
from snrmjax.identify.joint.variance_components import (
    Linearised,
    _Likelihood,
    estimated_components,
    few_levels_factor,
    level_columns,
)

N_LEVELS, PER_LEVEL = 12, 20


def sample(seed, noise=1.0, shared=0.0):
    """A mean, a slope and two kinds of level error on rows of unit noise."""
    rng = np.random.default_rng(seed)
    level = np.repeat(np.arange(N_LEVELS), PER_LEVEL)
    n = len(level)
    curve = np.column_stack([np.ones(n), level / N_LEVELS])
    by_state = np.zeros((n, 1, 2))
    by_state[:, 0, 0] = 50.0
    by_state[:, 0, 1] = 5.0 * rng.normal(size=n)
    levels = level_columns(by_state, level, N_LEVELS)
    own = shared * rng.normal(size=N_LEVELS)
    residuals = noise * rng.normal(size=n) + 50.0 * own[level] + curve @ [3.0, -2.0]
    std = np.concatenate([np.full(2, np.inf), np.zeros(2 * N_LEVELS)])
    problem = Linearised(residuals, np.column_stack([curve, levels]), std, np.zeros(len(std)))
    return problem, 2 + np.arange(2 * N_LEVELS).reshape(N_LEVELS, 2)


def test_noise_without_scatter_is_the_residual_of_least_squares():
    problem, index = sample(0, noise=0.3)
    found = estimated_components(problem, index)
    curve = problem.slopes[:, :2]
    left = problem.residuals - curve @ np.linalg.lstsq(curve, problem.residuals, rcond=None)[0]
    # Restricted likelihood without scatter is the unbiased estimate; its search ends at 1e-2.
    assert found.noise == pytest.approx(np.sqrt(left @ left / (len(left) - 2)), rel=1e-2)
    assert found.level == (0.0, 0.0)
    assert found.noise_std == pytest.approx(found.noise / np.sqrt(2 * (len(left) - 2)), rel=1e-12)


def test_scatter_that_is_there_is_found_without_bias():
    found = [estimated_components(*sample(seed, shared=0.02)) for seed in range(1, 25)]
    first = np.array([f.level[0] for f in found])
    # 12 levels, noise of a mean 1/sqrt(20)/50 = 0.0045: each is known to a quarter.
    assert abs(np.mean(first) / 0.02 - 1) < 3 * 0.25 / np.sqrt(24)
    # The other kind moves nothing: at 5 % each, four of 24 would be a rare draw.
    assert sum(f.level[1] > 0 for f in found) <= 4
    assert np.mean([f.noise for f in found]) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("copies", [2, 4])
def test_rows_that_are_repeated_tell_nothing_more(copies):
    problem, index = sample(5, shared=0.02)
    alone = estimated_components(problem, index)
    repeated = problem._replace(
        residuals=np.repeat(problem.residuals, copies),
        slopes=np.repeat(problem.slopes, copies, axis=0),
    )
    found = estimated_components(repeated, index, independent=1 / copies)
    # The search ends at 1e-2; the two unknowns of the curve are two of 240 rows, or of more.
    assert found.level == pytest.approx(alone.level, rel=2e-2)
    assert found.noise == pytest.approx(alone.noise, rel=2e-2)
    assert found.noise_std == pytest.approx(alone.noise_std, rel=2e-2)
    assert found.unit == pytest.approx(np.sqrt(copies) * alone.noise, rel=2e-2)


def test_stated_scatter_is_kept_and_one_level_says_nothing():
    problem, index = sample(3, shared=0.02)
    problem.prior_std[index[:, 0]] = 0.05
    assert estimated_components(problem, index).level[0] == 0.05
    problem, index = sample(3, shared=0.02)
    assert estimated_components(problem, index[:1]).level == (0.0, 0.0)


@pytest.mark.long
@pytest.mark.parametrize("n_levels", [2, 3, 4, 8])
def test_few_levels_widen_the_band_of_their_mean_as_students_t_does(n_levels):
    level = np.repeat(np.arange(n_levels), PER_LEVEL)
    n = len(level)
    levels = level_columns(np.full((n, 1, 1), 50.0), level, n_levels)
    slopes = np.column_stack([np.ones(n), levels])
    std = np.concatenate([[np.inf], np.zeros(n_levels)])
    index = 1 + np.arange(n_levels)[:, None]
    inside, sizes = [], []
    tests = repeats(150, 300)
    for seed in range(tests):
        rng = np.random.default_rng(seed)
        residuals = rng.normal(size=n) + 50.0 * 0.1 * rng.normal(size=n_levels)[level]
        problem = Linearised(residuals, slopes, std, np.zeros(len(std)))
        found = estimated_components(problem, index)
        # The mean of balanced levels, whose noise is small beside what they differ by.
        band = np.hypot(few_levels_factor(n_levels) * 50.0 * found.level[0], found.noise / 4.5)
        inside.append(abs(residuals.mean()) < 1.96 * band / np.sqrt(n_levels))
        sizes.append(found.level[0])
    # The size of one difference is that of one draw: squares are right in the mean.
    assert np.sqrt(np.mean(np.square(sizes))) == pytest.approx(0.1, rel=0.2)
    # With two degrees of freedom a band ends at t = 4.303; with one it holds what Cauchy says.
    wanted = 2 / np.pi * np.arctan(4.303) if n_levels == 2 else 0.95
    assert np.mean(inside) == pytest.approx(wanted, abs=3 * np.sqrt(0.05 / tests))


def test_a_scatter_that_no_test_has_is_none_and_is_said():
    # Levels of one structure do not differ by their whole size: something else is moving them.
    found = estimated_components(*sample(2, shared=2.0))
    assert found.level == (0.0, 0.0)
    assert found.unbounded == (0,)
    of_a_fit = found._replace(level=(0.0,) * len(LEVEL_ERRORS))
    given = (0.0, np.zeros(len(LEVEL_ERRORS)), N_LEVELS)
    (note,) = notes_on_noise(of_a_fit, *given, stated=False, alike=False)
    assert "differ in gain cannot be told" in note


def test_levels_that_differ_by_as_much_as_they_can_are_believed():
    found = [estimated_components(*sample(seed, shared=0.3)) for seed in range(8)]
    # Each is known to a quarter, and counts as 0.3 at most.
    assert np.mean([one.level[0] for one in found]) == pytest.approx(0.26, rel=0.2)
    assert all(one.unbounded == () for one in found)
    assert np.mean([one.noise for one in found]) == pytest.approx(1.0, abs=0.05)


def test_slopes_of_the_likelihood_are_those_of_differences():
    problem, index = sample(1, noise=0.7, shared=0.02)
    likelihood = _Likelihood.of(problem, tuple(index.T))
    at = np.log([0.8, 0.03, 0.01])

    def value(point):
        noise, *level = np.exp(point)
        return likelihood.value_and_slopes(noise, np.array(level))[0]

    slopes = likelihood.value_and_slopes(0.8, np.array([0.03, 0.01]))[1]
    step = 1e-4 * np.eye(3)
    wanted = [(value(at + row) - value(at - row)) / 2e-4 for row in step]
    np.testing.assert_allclose(slopes, wanted, rtol=1e-5, atol=1e-5)


def test_levels_that_share_half_of_their_amplitudes_are_not_apart():
    level = np.repeat([0, 1], 2)
    # On a logarithmic scale: 1 to 2 beside 1.8 to 3.6, then beside 1.2 to 2.4.
    assert levels_apart(np.array([1.0, 2.0, 1.8, 3.6]), level)
    assert not levels_apart(np.array([1.0, 2.0, 1.2, 2.4]), level)
