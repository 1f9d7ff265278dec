"""Restoring-force surfaces of simulated motions with known forces."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

import snrmjax as sj
from snrmjax.methods.records.restoring_force import fit_restoring_force

REST, CUBIC = 2 * np.pi * 40.0, 6e9
VISCOUS, QUADRATIC = 1.0, 2.0  # 1/s, 1/m
MASS = 0.5  # kg at the sensor


def integrated(start, force=None, seconds=2.0):
    time = np.arange(0, seconds, 1 / 4000)
    load = force or (lambda t: 0.0 * t)

    def rate(t, state):
        q, v = state
        restoring_force = REST**2 * q + CUBIC * q**3 + VISCOUS * v + QUADRATIC * v * abs(v)
        return v, load(t) / MASS - restoring_force

    found = solve_ivp(rate, (0, seconds), start, t_eval=time, rtol=1e-9, atol=1e-13)
    return time, found.y[1], load(time)


def exact_backbone():
    """Fundamental velocity and natural frequency of the undamped Duffing oscillator: x = A cn."""
    amplitude = np.linspace(1e-6, 3e-3, 400)
    at_top = REST**2 + CUBIC * amplitude**2
    modulus = CUBIC * amplitude**2 / (2 * at_top)
    quarter = ellipk(modulus)
    natural = np.pi * np.sqrt(at_top) / (2 * quarter)
    nome = np.exp(-np.pi * ellipk(1 - modulus) / quarter)
    fundamental = amplitude * 2 * np.pi / (np.sqrt(modulus) * quarter) * np.sqrt(nome) / (1 + nome)
    return natural * fundamental, natural


@pytest.mark.parametrize("forced", [False, True])
def test_forces_and_mode_of_a_duffing_oscillator(forced):
    shape = 1 / np.sqrt(MASS)
    modes = sj.model.linear_modes([REST], [0.002], [[shape]], [shape])

    def sweep(t):
        return 4.0 * np.sin(2 * np.pi * (36 * t + 3 * t**2))

    start, load = ((0.0, 0.0), sweep) if forced else ((1.5e-3, 0.0), None)
    time, velocity, force = integrated(start, load)
    given = (force, modes) if forced else ()
    fitted = fit_restoring_force(time, velocity, *given)
    assert fitted.misfit < 5e-3
    np.testing.assert_allclose(fitted.elastic[0], REST**2, rtol=2e-3)
    np.testing.assert_allclose(fitted.elastic[2], CUBIC, rtol=0.05)
    result = sj.methods.restoring_force(time, velocity, *given)
    true = np.interp(result.velocity, *exact_backbone())
    np.testing.assert_allclose(result.natural_frequency, true, rtol=1e-3)
    modal = 2 * result.damping_ratio * result.natural_frequency
    lost = VISCOUS + 8 / (3 * np.pi) * QUADRATIC * result.velocity
    np.testing.assert_allclose(modal, lost, rtol=0.05)


def test_what_cannot_be_fitted_is_refused():
    time, velocity, force = integrated((1e-3, 0.0), seconds=0.5)
    with pytest.raises(ValueError, match="`degree` must be from 1 to 9"):
        fit_restoring_force(time, velocity, degree=0)
    with pytest.raises(ValueError, match="`modes` are needed with a force"):
        fit_restoring_force(time, velocity, force)
    with pytest.raises(ValueError, match="samples a cycle"):
        fit_restoring_force(time[::20], velocity[::20])
    modes = sj.model.linear_modes([REST], [0.002], [[1.0]], [1.0])
    with pytest.raises(ValueError, match="`force` must be finite"):
        fit_restoring_force(time, velocity, force[1:], modes)
