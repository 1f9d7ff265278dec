"""Residual autocorrelation, against simulated processes and repeated fits."""

import numpy as np
import pytest
from scipy.signal import lfilter
from truths.exact_states import LEVELS, NOISE, TRUE, exact, modes, stated, truth_at
from truths.sizes import repeats

import snrmjax as sj
from snrmjax.identify.checks.residual_autocorrelation import (
    residual_autocorrelation,
    states_of_levels,
)
from snrmjax.identify.joint.joint_fit import fit_jointly


def correlated_noise(rng, rho, *shape):
    """Unit noise whose neighbours along the last axis are correlated."""
    white = rng.normal(size=shape)
    white[..., 1:] *= np.sqrt(1 - rho**2)
    return lfilter([1.0], [1.0, -rho], white, axis=-1)


def test_states_of_a_level_are_sorted_by_frequency():
    level, frequency = np.array([1, 0, 1, 0, 1]), np.array([3.0, 2.0, 1.0, 1.0, 2.0])
    found = states_of_levels(level, frequency)
    assert [some.tolist() for some in found] == [[3, 1], [2, 4, 0]]


@pytest.mark.parametrize("rho", [0.5, 0.8, 0.95])
def test_the_correlation_of_a_process_is_estimated(rho):
    rng, levels = np.random.default_rng(1), list(np.arange(30000).reshape(10, 3000))
    found = residual_autocorrelation(
        correlated_noise(rng, rho, 2, 10, 3000).reshape(2, -1).T, levels
    )
    np.testing.assert_allclose(found, rho, atol=0.03)


def test_a_slow_misfit_under_noise_counts_by_its_summed_correlations():
    rng, levels = np.random.default_rng(2), list(np.arange(8000).reshape(20, 400))
    slow = (correlated_noise(rng, 0.9, 20, 400) + rng.normal(size=(20, 400))) / np.sqrt(2)
    (found,) = residual_autocorrelation(slow.reshape(-1, 1), levels)
    # Its mean scatters as that of a process with half the sum of correlations: 10 instead of 19.
    assert (1 + found) / (1 - found) == pytest.approx(10.0, rel=0.2)


def test_white_noise_is_seldom_correlated():
    rng, levels = np.random.default_rng(3), states_of_levels(np.arange(80) % 4, np.arange(80.0))
    parts = residual_autocorrelation(rng.normal(size=(80, 2000)), levels)
    # 4 standard deviations: one in 30 000 of a long series.
    assert np.sum(parts > 0) <= 2


def test_tiny_residuals_of_exact_states_are_ignored():
    levels = [np.arange(60)]
    slow = correlated_noise(np.random.default_rng(7), 0.95, 1, 60).T
    assert residual_autocorrelation(slow, levels) > 0
    assert residual_autocorrelation(1e-6 * slow, levels) == 0


@pytest.mark.long
def test_bands_cover_curves_whose_neighbouring_residuals_are_correlated():
    level, omega, force, velocity = exact(per_level=25)
    speeds = np.linspace(0.3, 0.9, 4)
    natural, modal_damping = truth_at(speeds)
    want = np.stack([np.sqrt(natural), modal_damping])
    rng, scores, notes = np.random.default_rng(5), [], 0
    tests = repeats(8, 30)
    for _ in range(tests):
        error = correlated_noise(rng, 0.9, 2, LEVELS, 25).reshape(2, -1)
        own = np.exp(NOISE["velocity"] * error[0] + 1j * NOISE["phase"] * error[1])
        fit = fit_jointly(stated(level, omega, force, velocity * own), modes(), **TRUE)
        values = sj.identify.fitted_values(fit, speeds)
        found = np.stack([values.natural_frequency, values.modal_damping])
        std = np.stack([values.natural_frequency_std, values.modal_damping_std])
        scores.append(np.abs(found - want) / std)
        notes += any(note.kind == "residuals_correlated" for note in fit.notes)
    assert notes == tests
    # Treated as independent states, 85 % would be inside, although the fits absorb some as level
    # errors.
    assert np.mean(np.array(scores) < 1.96) > 0.9
