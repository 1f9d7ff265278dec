"""Fractions of variance against functions whose indices are known in closed form."""

import numpy as np
import pytest

from snrmjax.study.uncertainty.sensitivity import FEWEST, correlated_pairs, main_effect

A, B = 7.0, 0.1


def ishigami(x):
    """Ishigami & Homma (1990): sin x₁ + a sin² x₂ + b x₃⁴ sin x₁ on (-π, π)³."""
    return np.sin(x[0]) + A * np.sin(x[1]) ** 2 + B * x[2] ** 4 * np.sin(x[0])


# Its variance and first-order parts in closed form (Saltelli et al., Global Sensitivity Analysis,
# 2008, section 4.8).
PARTS = np.array([0.5 * (1 + B * np.pi**4 / 5) ** 2, A**2 / 8, 0.0])
VARIANCE = A**2 / 8 + B * np.pi**4 / 5 + B**2 * np.pi**8 / 18 + 0.5


def test_the_fractions_of_ishigamis_function():
    x = np.random.default_rng(1).uniform(-np.pi, np.pi, (3, 20_000))
    found = [main_effect(one, ishigami(x)) for one in x]
    fractions = np.array([one.fraction for one in found])
    # Three standard errors of a sample of 20000 are below 0.02 (as the intervals state).
    np.testing.assert_allclose(fractions, PARTS / VARIANCE, atol=0.02)
    assert all(one.half_width < 0.015 for one in found)
    # E[y | x₁] = sin x₁ (1 + b π⁴/5) + a/2, within the curve's own 95 % band, nearly everywhere.
    truth = np.sin(found[0].at) * (1 + B * np.pi**4 / 5) + A / 2
    assert np.mean(np.abs(found[0].mean - truth) < 1.5 * found[0].error) > 0.95


def test_intervals_have_their_nominal_coverage():
    random, inside = np.random.default_rng(2), 0
    n_trials, coefficients = 100, np.array([1.0, 0.6, 0.3])
    truth = coefficients**2 / np.sum(coefficients**2)
    for _ in range(n_trials):
        x = random.standard_normal((3, 300))
        found = main_effect(x[1], coefficients @ x)
        inside += abs(found.fraction - truth[1]) < found.half_width
    # 95 of 100 with three standard deviations of a binomial; a jackknife is a little short.
    assert 87 <= inside <= 99


def test_an_inactive_quantity_has_no_fraction_on_average():
    random = np.random.default_rng(3)
    fractions = [
        main_effect(random.random(200), random.standard_normal(200)).fraction for _ in range(100)
    ]
    # Without the correction for its freedom the curve would explain 6/200 = 3 % of pure noise.
    assert abs(np.mean(fractions)) < 3 * np.std(fractions) / np.sqrt(100) < 0.012


def test_few_values_have_a_mean_each():
    grid = np.meshgrid([1.0, 2.0, 4.0], np.linspace(0, 1, 30), indexing="ij")
    x, z = (one.ravel() for one in grid)
    found = main_effect(x, x**2 + z)
    np.testing.assert_array_equal(found.at, [1.0, 2.0, 4.0])
    np.testing.assert_allclose(found.mean, [1.5, 4.5, 16.5], rtol=1e-12)
    between, within = np.var([1.0, 4.0, 16.0]), np.var(np.linspace(0, 1, 30))
    assert found.fraction == pytest.approx(between / (between + within), abs=0.001)


def test_units_do_not_matter():
    random = np.random.default_rng(4)
    x, y = random.standard_normal(300), random.standard_normal(300)
    one = main_effect(x, x**2 + y)
    other = main_effect(4.7e12 * (1 + 0.01 * x), 1e-6 * (x**2 + y) + 3e-4)
    assert other.fraction == pytest.approx(one.fraction, abs=1e-9)
    np.testing.assert_allclose(other.mean, 1e-6 * one.mean + 3e-4, rtol=1e-9)


def test_members_without_a_value_are_left_out():
    x = np.linspace(0, 1, 2 * FEWEST)
    y = np.where(x > 0.5, x, np.nan)
    assert main_effect(x, y).fraction == pytest.approx(1.0, abs=1e-9)
    assert main_effect(x[1:], y[1:]) is not None
    assert main_effect(x[:-1], y[:-1]) is None  # one member too few
    assert main_effect(x, np.ones_like(x)) is None
    assert main_effect(np.ones_like(x), x) is None


def test_quantities_that_vary_together_are_reported():
    z = np.random.default_rng(5).standard_normal((3, 400))
    assert correlated_pairs({"a": z[0], "b": z[1], "c": z[2]}) == []
    assert correlated_pairs({"a": z[0], "b": z[1], "c": 0.5 * z[0] + z[2]}) == [("a", "c")]
