"""The nonlinear normal mode at given amplitudes, against time integration and closed forms."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import snrmjax as sj

OMEGA, SHAPE = 3.0, -2.0  # the sensor has the opposite sign


def oscillator(quadratic=0.0, cubic=1.0):
    modes = sj.model.linear_modes([OMEGA], [0.02], [[SHAPE]], [1.0])
    terms = {"111": quadratic / 3, "1111": cubic / 4}
    return sj.model.structure(modes, sj.model.polynomial_potential(terms, 1))


def integrated(start, quadratic, cubic):
    """Frequency and velocity fundamental at the sensor of a motion that starts from rest."""

    def slope(_, y):
        return [y[1], -(OMEGA**2) * y[0] - quadratic * y[0] ** 2 - cubic * y[0] ** 3]

    def at_rest(_, y):
        return y[1]

    at_rest.direction = -1.0  # at the same side again
    whole = {"rtol": 1e-12, "atol": 1e-12, "events": at_rest, "dense_output": True}
    path = solve_ivp(slope, (0, 3 * 2 * np.pi / OMEGA), [start, 0.0], **whole)
    period = next(t for t in path.t_events[0] if t > 1e-3)
    speed = path.sol(np.arange(256) * period / 256)[1]
    return 2 * np.pi / period, abs(SHAPE) * 2 * abs(np.fft.fft(speed)[1]) / 256


def test_frequencies_at_velocities_are_those_of_free_motions():
    truth = np.array([integrated(start, 2.0, 1.5) for start in (1.2, 0.1, 2.0)])
    model = oscillator(2.0, 1.5)
    found = sj.simulate.normal_mode_at_velocities(model, truth[:, 1], harmonic_order=15)
    assert found.converged.all()
    # Fifteen harmonics of a motion whose harmonics fall by ten each.
    np.testing.assert_allclose(found.frequency, truth[:, 0], rtol=1e-9)
    np.testing.assert_allclose(found.amplitude, truth[:, 1], rtol=1e-12)
    together = eqx.filter_vmap(
        lambda c: (
            sj.simulate.normal_mode_at_velocities(
                dataclasses.replace(
                    model, potential=dataclasses.replace(model.potential, coefficient=c)
                ),
                truth[:, 1],
                harmonic_order=15,
            ).frequency
        )
    )(jnp.stack([model.potential.coefficient] * 2))
    np.testing.assert_allclose(together, [found.frequency] * 2, rtol=1e-12)


def test_derivatives_are_those_of_the_closed_form():
    velocity = jnp.array([2.0, 5.0])

    def frequency_of(cubic, velocity):
        model = oscillator()
        where = model.potential.coefficient * jnp.array([1.0, cubic])
        model = eqx.tree_at(lambda m: m.potential.coefficient, model, where)
        return sj.simulate.normal_mode_at_velocities(model, velocity, harmonic_order=1).frequency

    # One harmonic: Ω⁴ − ω²Ω² − ¾ γ (v/φ)² = 0.
    omega = frequency_of(1.0, velocity)
    np.testing.assert_allclose(omega**4, OMEGA**2 * omega**2 + 0.75 * (velocity / SHAPE) ** 2)
    by_omega = 4 * omega**3 - 2 * OMEGA**2 * omega
    by_cubic = 0.75 * (velocity / SHAPE) ** 2 / by_omega
    by_velocity = 1.5 * velocity / SHAPE**2 / by_omega
    np.testing.assert_allclose(jax.jacfwd(frequency_of)(1.0, velocity), by_cubic, rtol=1e-10)
    slopes = jax.jacrev(frequency_of, 1)(1.0, velocity)
    np.testing.assert_allclose(slopes, np.diag(by_velocity), rtol=1e-10, atol=1e-14)


def test_beyond_the_end_of_a_softening_mode_nothing_is_found():
    # With −q³ the well ends at q = ω: no free motion is larger.
    found = sj.simulate.normal_mode_at_velocities(oscillator(cubic=-1.0), [30.0, 1.0, 4.0])
    assert found.converged.tolist() == [False, True, True]
    assert np.isnan(found.frequency).tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"velocities": [1.0, -2.0]}, "`velocities` must be positive and finite, but is -2"),
        ({"velocities": np.nan}, "but is nan"),
        ({"velocities": 1.0, "steps": 0}, "`steps` must be at least 1"),
    ],
)
def test_wrong_arguments_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        sj.simulate.normal_mode_at_velocities(oscillator(), **settings)


def test_a_sensor_at_a_node_is_refused():
    blind = eqx.tree_at(lambda m: m.modes.mode_shape, oscillator(), jnp.zeros((1, 1)))
    with pytest.raises(ValueError, match="first sensor does not see the mode"):
        sj.simulate.normal_mode_at_velocities(blind, 1.0)
