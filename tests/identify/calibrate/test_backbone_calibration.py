"""Parameters of a structure from its backbone, against closed forms and SciPy's least squares."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import curve_fit

import snrmjax as sj

SHAPE, OMEGA, CUBIC = 2.0, 3.0, 1.5
VELOCITY = np.linspace(0.5, 6.0, 9)
START = {"omega": 2.5, "cubic": 1.0}


def duffing(values):
    modes = sj.model.linear_modes([1.0], [0.02], [[SHAPE]], [1.0])
    modes = dataclasses.replace(modes, natural_frequency=jnp.stack([values["omega"] * 1.0]))
    potential = sj.model.polynomial_potential({"1111": 1.0}, 1)
    own = dataclasses.replace(potential, coefficient=jnp.stack([values["cubic"] / 4]))
    return sj.model.structure(modes, own)


def closed_form(velocity, omega, cubic):
    """One harmonic: Ω⁴ − ω²Ω² − ¾ γ (v/φ)² = 0."""
    return np.sqrt(0.5 * (omega**2 + np.sqrt(omega**4 + 3 * cubic * (velocity / SHAPE) ** 2)))


def points(frequency_std=None, velocity_std=None, seed=0):
    noise = np.random.default_rng(seed).normal(size=VELOCITY.size)
    std = 1e-3 * np.ones(VELOCITY.size)
    measured = closed_form(VELOCITY, OMEGA, CUBIC) + noise * std
    return sj.identify.MeasuredBackbone(VELOCITY, measured, frequency_std, velocity_std)


def calibrated(measured, **settings):
    return sj.identify.calibrate_to_backbone(
        duffing, settings.pop("start", START), measured, harmonic_order=1, **settings
    )


@pytest.mark.parametrize("stated", [True, False])
def test_values_and_covariance_are_those_of_scipy(stated):
    std = 1e-3 * np.ones(VELOCITY.size) if stated else None
    measured = points(std)
    fit = calibrated(measured)
    values, covariance = curve_fit(
        closed_form, VELOCITY, measured.frequency, [2.5, 1.0], std, absolute_sigma=stated
    )
    assert fit.converged
    # The sum of squares settles to 1e-6: values to a thousandth of 1σ.
    assert np.all(np.abs(fit.values - values) < 2e-3 * fit.std)
    # SciPy's derivatives are differences of 1e-8.
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-3)
    np.testing.assert_allclose(fit.fitted, closed_form(VELOCITY, *fit.values), rtol=1e-10)
    assert fit.to_xarray().sizes["parameter"] == 2


def test_velocity_errors_are_weighted_by_the_slope():
    across = 0.01 * VELOCITY
    fit = calibrated(points(1e-3 * np.ones(VELOCITY.size), across))
    step = 1e-6
    slope = closed_form(VELOCITY + step, *fit.values) - closed_form(VELOCITY - step, *fit.values)
    sigma = np.hypot(1e-3, slope / (2 * step) * across)
    measured = fit.measured.frequency
    np.testing.assert_allclose(fit.residuals, (measured - fit.fitted) / sigma, rtol=1e-3, atol=1e-6)


def test_a_prior_fixes_what_the_backbone_does_not_determine():
    velocity = np.full(9, 3.0)  # one point of the backbone cannot determine two parameters
    one = sj.identify.MeasuredBackbone(
        velocity, closed_form(velocity, OMEGA, CUBIC), 1e-3 * np.ones(9)
    )
    fit = calibrated(one, start={"omega": 2.9, "cubic": CUBIC}, prior_std={"cubic": 0.1})
    # At the prior mean the point is matched exactly, and the posterior 1σ is that of the prior.
    np.testing.assert_allclose(fit.values, [OMEGA, CUBIC], rtol=1e-4)
    assert fit.std[1] == pytest.approx(0.1, rel=1e-2)


def test_a_stated_prior_is_not_advised():
    velocity = np.full(9, 3.0)
    one = sj.identify.MeasuredBackbone(
        velocity, closed_form(velocity, OMEGA, CUBIC), 1e-3 * np.ones(9)
    )
    for prior_std, advice in (
        ({}, "state `prior_std`"),
        ({"omega": 1e3, "cubic": 1e3}, "fit fewer"),
    ):
        fit = calibrated(one, start={"omega": 2.9, "cubic": CUBIC}, prior_std=prior_std)
        notes = [str(note) for note in fit.notes if note.kind == "parameters_hardly_known"]
        assert any(advice in note for note in notes), fit.notes


BAD = [
    ({"start": {"omega": 0.0}}, points(), "`start` of omega must be positive, but is 0"),
    ({"prior_std": {"mass": 1.0}}, points(), "`prior_std` names 'mass'"),
    ({"prior_std": {"omega": -1.0}}, points(), "`prior_std` of omega must be positive"),
    ({}, points()._replace(frequency=VELOCITY[:2]), "`frequency` has 2 values for 9 velocities"),
    ({}, points(np.zeros(9)), "`frequency_std` must be positive, but point 0 has 0"),
    ({}, points()._replace(velocity=-VELOCITY), "`velocity` must be positive, but point 0"),
    (
        {},
        sj.identify.MeasuredBackbone(VELOCITY[:1], VELOCITY[:1]),
        "2 parameters need more than the 1 points",
    ),
]


@pytest.mark.parametrize(("settings", "measured", "words"), BAD)
def test_what_cannot_be_fitted_is_refused(settings, measured, words):
    with pytest.raises(ValueError, match=words.replace("(", r"\(")):
        calibrated(measured, **settings)
