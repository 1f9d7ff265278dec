"""Coordinates of fits against differences, and fits in them against SciPy's minimiser."""

import numpy as np
import pytest
from scipy.optimize import least_squares

import snrmjax as sj
from snrmjax.diagnose.misfit.candidates import candidate, coordinates, parameter_labels
from snrmjax.diagnose.misfit.effect_fit import fit_effect
from snrmjax.diagnose.misfit.predictions import predictions_of, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import weighted_misfit

OMEGA, ZETA, NOISE = 300.0, 0.01, 1e-4
LABELS = ("sensor_phase_error.phase_deg", "iwan_microslip.coefficient", "iwan_microslip.exponent")


def test_slopes_are_those_of_differences_and_outward_inverts_inward():
    law = coordinates(LABELS, 2e-4)
    values = np.array([3.0, 8e5, 2.1])

    def seen(values):
        """A function with a derivative by every parameter."""
        phase, c, p = values
        return np.array([np.sin(phase) + c * 1e-4 ** (p - 1), c * p * 1e-6, phase * p])

    def by(function, at):
        steps = 1e-6 * at * np.eye(3)
        return np.stack([(function(at + h) - function(at - h)) / (2 * h.sum()) for h in steps], 1)

    inner = law.inward(values)
    assert inner[1] == pytest.approx(8e5 * 2e-4**1.1)
    np.testing.assert_allclose(law.outward(inner), values, rtol=1e-14)
    expected = by(lambda u: seen(law.outward(u)), inner)
    np.testing.assert_allclose(law.slopes(values, by(seen, values)), expected, rtol=1e-6, atol=1e-9)
    other = coordinates(("quadratic_damping.coefficient",), 2e-4)
    np.testing.assert_array_equal(other.inward(np.array([2.0])), [2.0])


def joint_states():
    """A joint by its formula to first order: Δω̃² = −cQ^(p − 1), and its damping."""
    rng = np.random.default_rng(3)
    c, p = 4e5, 1.8
    level, phase = (x.ravel() for x in np.meshgrid(range(5), np.radians(np.linspace(-50, 50, 9))))
    x = np.geomspace(3e-5, 1e-3, 5)[level] * np.cos(phase)
    soft = c * x ** (p - 1)
    omega = OMEGA * (1 - ZETA * np.tan(phase)) - 0.5 * soft / OMEGA
    lag = 2 * ZETA * OMEGA * omega + 4 / np.pi * (p - 1) / (p + 1) * soft
    needed = OMEGA**2 - soft - omega**2 + 1j * lag
    own = NOISE * (rng.normal(size=len(x)) + 1j * rng.normal(size=len(x)))
    velocity = 1j * omega * x * np.exp(own - 1j * np.angle(needed))
    errors = {
        "velocity_std": NOISE * np.abs(velocity),
        "phase_std": np.full((len(x), 1), NOISE),
        "force_std": NOISE * np.abs(needed) * x,
    }
    return sj.measure.steady_states(level, omega, np.abs(needed) * x, velocity, **errors)


def test_a_law_is_found_along_the_narrow_valley_of_precise_data():
    modes = sj.model.linear_modes(
        [OMEGA], [ZETA], [[1.0]], [1.0],
        std=sj.model.LinearModesStd([1e-4 * OMEGA], [0.01 * ZETA]),
    )  # fmt: skip
    predictions = predictions_of(sj.model.structure(modes), joint_states(), 1.0)
    misfit, kind = weighted_misfit(predictions), "iwan_microslip"
    one = candidate(kind, scales_of(predictions))
    one = one._replace(starts=one.starts[:1])  # p = 1.2, a hundred of its 1σ away
    found = fit_effect(misfit, one)
    labels = parameter_labels(kind)
    at = float(scales_of(predictions).amplitude)

    def left(point):
        stiffness, p = point
        values = np.array([[stiffness * at ** (1 - p), p]])
        return misfit.noise.decorrelated(misfit.evaluated(labels, values)[0][0])

    c, p = one.starts[0]
    begin = [c * at ** (p - 1), p]
    truth = least_squares(left, begin, x_scale=begin, diff_step=1e-5, xtol=1e-10, ftol=1e-12)
    assert found.chi_square == pytest.approx(2 * truth.cost, rel=1e-4)
    assert found.values[1] == pytest.approx(truth.x[1], abs=1e-4)
