"""Corners of a force over a cycle: crossings and sums against exact integrals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from snrmjax.model.effects import make_effect
from snrmjax.model.nonsmooth_points import NonsmoothPoints, crossings, with_nonsmooth_points

N = 256
TAU = 2 * np.pi * np.arange(N) / N


def motion(tau, shift=0.0):
    t = tau + shift
    return np.cos(t) + 0.6 * np.cos(2 * t + 0.3) + 0.25 * np.sin(5 * t)


def contact(x, threshold=0.4):
    return jnp.maximum(x - threshold, 0.0)


def coefficients(shift, order, threshold=0.4):
    """Fourier coefficients of a sampled contact, and by 2¹⁹ samples."""
    x = jnp.asarray(motion(TAU, shift))
    nonsmooth_points = NonsmoothPoints(jnp.array([threshold]), jnp.array([1.0]))
    sampled = np.asarray(with_nonsmooth_points(contact(x, threshold), x, nonsmooth_points))
    fine = 2 * np.pi * np.arange(2**19) / 2**19
    exact = np.maximum(motion(fine, shift) - threshold, 0.0)
    return np.mean(sampled * np.exp(1j * order * TAU)), np.mean(exact * np.exp(1j * order * fine))


@pytest.mark.parametrize(("order", "miss"), [(0, 3e-7), (1, 3e-7), (7, 3e-7), (20, 2e-6)])
def test_sums_are_integrals_wherever_the_kinks_lie(order, miss):
    for shift in np.linspace(0, 2 * np.pi / N, 5):
        result, wanted = coefficients(shift, order)
        assert abs(result - wanted) < miss  # without the correction 3e-5


def test_a_contact_shorter_than_a_sample_counts():
    """∮ max((1 + d) cos τ − 1, 0) dτ = 2 ((1 + d) sin τ₀ − τ₀) with cos τ₀ = 1/(1 + d)."""
    for depth, miss in ((2e-5, 1e-2), (1e-4, 1e-4), (1e-2, 1e-6)):
        end = np.arccos(1 / (1 + depth))
        wanted = 2 * ((1 + depth) * np.sin(end) - end)
        for shift in (0.0, 0.003, 0.012, 0.02):
            x = jnp.asarray((1 + depth) * np.cos(TAU + shift))
            nonsmooth_points = NonsmoothPoints(jnp.array([1.0]), jnp.array([1.0]))
            result = (
                float(jnp.sum(with_nonsmooth_points(contact(x, 1.0), x, nonsmooth_points)))
                * 2
                * np.pi
                / N
            )
            assert result == pytest.approx(wanted, rel=miss)


def test_the_derivative_is_that_of_the_integral():
    """d/dg ∮ max(x − g, 0) dτ is minus the time above g."""

    def whole(threshold):
        x = jnp.asarray(motion(TAU))
        nonsmooth_points = NonsmoothPoints(threshold[None], jnp.ones(1))
        return (
            jnp.sum(with_nonsmooth_points(contact(x, threshold), x, nonsmooth_points))
            * 2
            * jnp.pi
            / N
        )

    fine = 2 * np.pi * np.arange(2**19) / 2**19
    above = np.mean(motion(fine) > 0.4) * 2 * np.pi
    assert float(jax.grad(whole)(jnp.array(0.4))) == pytest.approx(-above, abs=2e-5)


def test_crossings_with_their_rates():
    result = crossings(jnp.asarray(motion(TAU)), jnp.array(0.4))
    used = np.asarray(result.valid)
    fine = 2 * np.pi * np.arange(2**19) / 2**19
    signs = np.diff((motion(fine) > 0.4).astype(int))
    wanted = np.flatnonzero(signs) * fine[1]
    phases = np.asarray(result.interval + result.fraction)[used] * TAU[1]
    np.testing.assert_allclose(phases, wanted, atol=2 * fine[1])
    assert np.all(np.sign(result.rate[used]) == np.sign(signs[signs != 0]))


def test_what_touches_nowhere_is_left_alone():
    x = jnp.asarray(motion(TAU))
    nonsmooth_points = NonsmoothPoints(jnp.array([5.0]), jnp.array([1.0]))
    np.testing.assert_array_equal(with_nonsmooth_points(x**3, x, nonsmooth_points), x**3)


@pytest.mark.parametrize("amplitude", [1.3, 3.0])
def test_second_derivatives_are_those_of_a_stop_in_closed_form(amplitude):
    gap, stiffness = 0.5, 2.0
    stop = make_effect("one_sided_stop", {"stiffness": stiffness, "gap": gap})
    time = 2 * np.pi * np.arange(256) / 256 + 0.003

    def fundamental(size):
        force = stop.cycle_force(size * jnp.cos(time), -size * jnp.sin(time))
        return 2 * jnp.mean(force * np.cos(time))

    # (k/π) (A (θ + sin θ cos θ) − 2 g sin θ) with cos θ = g/A.
    angle = np.arccos(gap / amplitude)
    exact = 2 * stiffness / np.pi * gap * np.cos(angle) ** 2 / (amplitude**2 * np.sin(angle))
    result = jax.jit(jax.grad(jax.grad(fundamental)))(amplitude)
    assert float(result) == pytest.approx(exact, rel=1e-4)  # cubics between samples of 2π/256
