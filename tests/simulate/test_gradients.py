"""Documented derivatives: forward, reverse and differences agree; failures do not spread.

Every function of a batch has a member that cannot be solved: its value and its derivatives are NaN,
and those of the others are what they are.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.model.effects import make_effect
from snrmjax.model.modes import linear_modes
from snrmjax.model.potential import polynomial_potential
from snrmjax.model.structures import structure
from snrmjax.simulate.balance.prescribed_motion import prescribed_motion
from snrmjax.simulate.solutions.forced_response import forced_response
from snrmjax.simulate.solutions.periodic_motion import (
    periodic_motion,
)

FORCE = 0.12
NAMES = ("force", "cubic", "quartic", "natural frequency", "damping ratio", "drag")


def oscillator():
    drag = make_effect("quadratic_damping", {"coefficient": 0.002})
    potential = polynomial_potential({"111": 0.05, "1111": 0.3}, 1)
    return structure(linear_modes([2.0], [0.02], [[1.0]], [1.5]), potential, effects=(drag,))


@pytest.fixture(scope="module")
def curve():
    (found,) = forced_response(oscillator(), FORCE, 1.0, 4.0, harmonic_order=3, stability=False)
    return found


def changed(shifts):
    """The force and the oscillator, every number times one plus its shift."""
    model, fraction = oscillator(), 1 + shifts
    return FORCE * fraction[0], eqx.tree_at(
        lambda m: (
            *(m.potential.coefficient, m.modes.natural_frequency),
            *(m.modes.damping_ratio, m.effects[0].coefficient),
        ),
        model,
        (
            *(
                model.potential.coefficient * fraction[1:3],
                model.modes.natural_frequency * fraction[3],
            ),
            *(model.modes.damping_ratio * fraction[4], model.effects[0].coefficient * fraction[5]),
        ),
    )


def numbers_of(motions):
    """Frequency, velocity amplitude and both parts of the fundamental of every motion."""
    phasor = motions.velocity[..., 1, 0]
    parts = (motions.frequency, motions.amplitude, phasor.real, phasor.imag)
    return jnp.stack(parts, axis=-1)


def by_differences(function, step=2e-3):
    """Central differences of fourth order: the step to the fourth power, 2e-11, is left."""
    columns = []
    for k in range(len(NAMES)):
        at = [np.eye(len(NAMES))[k] * step * m for m in (-2, -1, 1, 2)]
        low, left, right, high = (np.asarray(function(shift)) for shift in at)
        columns.append((8 * (right - left) - (high - low)) / (12 * step))
    return np.stack(columns, axis=-1)


def assert_gradients(function, failed):
    """Forward, reverse and differences agree; failed members and their derivatives are NaN."""
    zero = np.zeros(len(NAMES))
    value = np.asarray(function(zero))
    good = ~np.isin(np.arange(len(value)), failed)
    assert np.isfinite(value).all(axis=1).tolist() == good.tolist()
    forward = np.asarray(jax.jit(jax.jacfwd(function))(zero))
    reverse = np.asarray(jax.jit(jax.jacrev(function))(zero))
    size = np.abs(value[good]).max() + np.abs(forward[good]).max()
    # One linear solve each, of the same matrix and of its transpose: rounding.
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-9 * size)
    np.testing.assert_allclose(
        forward[good], by_differences(function)[good], rtol=0, atol=1e-6 * size
    )
    assert np.isnan(forward[~good]).all()
    assert np.isnan(reverse[~good]).all()


def assert_second_derivatives(function):
    """Members left out of a sum do not affect its first and second derivatives."""
    zero, way = np.zeros(len(NAMES)), np.cos(1.0 + np.arange(len(NAMES)))

    @jax.jit
    def slope_and_bend(shifts):
        slope = jax.grad(lambda shifts: jnp.nansum(function(shifts)))
        return jax.jvp(slope, (shifts,), (way,))

    forward = np.asarray(jax.jit(jax.jacfwd(function))(zero))
    slope, bend = slope_and_bend(zero)
    total = np.nansum(forward, axis=(0, 1))
    np.testing.assert_allclose(slope, total, rtol=0, atol=1e-9 * np.abs(total).max())
    steps = (-2e-3, -1e-3, 1e-3, 2e-3)
    slopes = [np.asarray(slope_and_bend(step * way)[0]) for step in steps]
    by_slopes = (8 * (slopes[2] - slopes[1]) - (slopes[3] - slopes[0])) / 12e-3
    np.testing.assert_allclose(bend, by_slopes, rtol=0, atol=1e-6 * np.abs(bend).max())


def test_periodic_motion(curve):
    # The other conditions, without a member that fails: `solutions/test_periodic_motion.py`.
    coefficients, frequency = curve.point(int(curve.at_events("phase_resonance")[0]))
    # A start that is not finite between two that are: it does not converge.
    starts = np.stack([coefficients, np.full_like(coefficients, np.nan), 1.001 * coefficients])

    @jax.jit
    def motions(shifts):
        force, model = changed(shifts)

        def motion_from(start):
            return periodic_motion(model, force, (start, frequency), condition="phase_resonance")

        return numbers_of(jax.vmap(motion_from)(jnp.asarray(starts)))

    assert_gradients(motions, failed=[1])
    assert_second_derivatives(motions)
    found, _, real, imaginary = np.asarray(motions(np.zeros(len(NAMES))))[0]
    # The curve's own event: located with tangents off by 1e-6.
    assert found == pytest.approx(frequency, rel=1e-6)
    lost = jax.jacfwd(jax.grad(lambda shifts: motions(shifts)[1, 0]))(np.zeros(len(NAMES)))
    assert np.isnan(lost).all()
    assert np.angle(real + 1j * imaginary) == pytest.approx(0.0, abs=1e-12)


def test_periodic_motion_with_a_force_that_is_not_finite(curve):
    start = curve.point(len(curve.frequency) // 5)

    @jax.jit
    def motions(shifts):
        force, model = changed(shifts)
        value = 1.001 * start[1] * (1 + shifts[0])  # the frequency moves with the force

        def one(load):
            return periodic_motion(model, load, start, value=value)

        return numbers_of(jax.vmap(one)(jnp.stack([force, jnp.asarray(np.nan), 1.01 * force])))

    assert_gradients(motions, failed=[1])
    found = np.asarray(motions(np.zeros(len(NAMES))))
    assert found[0, 0] == pytest.approx(1.001 * start[1], rel=1e-14)


def test_prescribed_motion():
    velocity = 0.4 * np.exp(0.3j)

    @jax.jit
    def force_needed(shifts):
        force, model = changed(shifts)
        equations = prescribed_motion(
            *(model, jnp.asarray(2.1), force, jnp.asarray(velocity)),
            sensor=0,
            harmonic_order=3,
            scale=jnp.asarray(0.4),
        )
        point = equations.solved(jax.lax.stop_gradient(equations.grown()))
        needed, seen = equations.recorded(point)
        return jnp.stack([needed.real, needed.imag, seen[3, 0].real, seen[3, 0].imag])[None]

    assert_gradients(force_needed, failed=[])
