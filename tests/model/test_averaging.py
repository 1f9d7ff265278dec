"""Averages over a cycle against the closed formulas of the field, and the paper's Eq. (9b)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from snrmjax.model.effect_base import AbstractMemoryless
from snrmjax.model.effect_shape import averaged_effect
from snrmjax.model.effects import make_effect

AMPLITUDE = np.array([0.3, 0.5, 0.9, 4.0])
FREQUENCY = np.array([2.0, 3.0, 0.7, 5.0])
SAMPLES = 1024
# The trapezoidal rule is exact for polynomials; a corner costs about h²/12 times the jump of the
# slope over the average itself, a jump (which lies midway between samples) h²/24.
EXACT = 1e-12
NONSMOOTH_POINT = (2 * np.pi / SAMPLES) ** 2


def engaged(amplitude, gap=0.4):
    """1 − (2/π)(asin a + a√(1−a²)), a = gap/Q: the fraction of a spring beyond ±gap."""
    a = np.minimum(gap / amplitude, 1.0)
    return 1 - 2 / np.pi * (np.arcsin(a) + a * np.sqrt(1 - a**2))


def of_kind(kind, **parameters):
    return make_effect(kind, parameters)


class Law(AbstractMemoryless):
    """Any law f(q, q̇)."""

    law: Callable

    def force(self, displacement, velocity):
        return self.law(displacement, velocity)


# name: force, Δ(ω̃²)(Q, Ω), Δ(2ζ̃ω̃)(Q, Ω), tolerance. The formulas are those of DIAGNOSIS.md.
FORMULAS = {
    "linear stiffness": (Law(lambda q, v: 1.7 * q), lambda Q, W: 1.7, lambda Q, W: 0.0, EXACT),
    # DESIGN.md item 4: the paper's (9b) gives −ζΩ here, its Eq. (8) needs the coefficient itself.
    "linear damping": (Law(lambda q, v: 0.3 * v), lambda Q, W: 0.0, lambda Q, W: 0.3, EXACT),
    "constant": (Law(lambda q, v: 0.0 * q + 1.0), lambda Q, W: 0.0, lambda Q, W: 0.0, EXACT),
    "cubic": (
        of_kind("cubic_stiffness", coefficient=1.3),
        lambda Q, W: 0.75 * 1.3 * Q**2,
        lambda Q, W: 0.0,
        EXACT,
    ),
    "quadratic": (
        of_kind("quadratic_stiffness", coefficient=1.3),
        lambda Q, W: 0.0,
        lambda Q, W: 0.0,
        EXACT,
    ),
    "quintic": (
        of_kind("quintic_stiffness", coefficient=1.3),
        lambda Q, W: 0.625 * 1.3 * Q**4,
        lambda Q, W: 0.0,
        EXACT,
    ),
    "bilinear": (
        of_kind("bilinear_stiffness", stiffness=1.3),
        lambda Q, W: 0.0,
        lambda Q, W: 0.0,
        EXACT,
    ),
    "quadratic damping": (
        of_kind("quadratic_damping", coefficient=1.3),
        lambda Q, W: 0.0,
        lambda Q, W: 8 * 1.3 * W * Q / (3 * np.pi),
        NONSMOOTH_POINT,
    ),
    "cubic damping": (
        of_kind("cubic_damping", coefficient=1.3),
        lambda Q, W: 0.0,
        lambda Q, W: 0.75 * 1.3 * W**2 * Q**2,
        EXACT,
    ),
    "van der Pol": (
        of_kind("van_der_pol_damping", coefficient=1.3),
        lambda Q, W: 0.0,
        lambda Q, W: 1.3 * Q**2 / 4,
        EXACT,
    ),
    "preload": (
        of_kind("static_preload", constant_force=1.3),
        lambda Q, W: 0.0,
        lambda Q, W: 0.0,
        EXACT,
    ),
}


@pytest.mark.parametrize("name", FORMULAS)
def test_averages_follow_the_closed_formulas(name):
    effect, stiffness, damping, tolerance = FORMULAS[name]
    average = averaged_effect(
        effect, jnp.asarray(AMPLITUDE), jnp.asarray(FREQUENCY), n_samples=SAMPLES
    )
    # Relative to the force at the turning points: where the answer is 0, it cancels from there.
    largest = max(abs(float(effect.force(jnp.array(4.0), jnp.array(20.0)))), 1.0)
    wanted = np.broadcast_to(stiffness(AMPLITUDE, FREQUENCY), AMPLITUDE.shape)
    np.testing.assert_allclose(average.stiffness, wanted, rtol=tolerance, atol=EXACT * largest)
    wanted = np.broadcast_to(damping(AMPLITUDE, FREQUENCY), AMPLITUDE.shape)
    np.testing.assert_allclose(average.damping, wanted, rtol=tolerance, atol=EXACT * largest)


def test_amplitudes_and_frequencies_broadcast():
    effect = of_kind("van_der_pol_damping", coefficient=1.3)
    amplitude, frequency = jnp.asarray(AMPLITUDE)[:, None], jnp.asarray(FREQUENCY[:2])
    damping = averaged_effect(effect, amplitude, frequency).damping
    assert damping.shape == (4, 2)
    np.testing.assert_allclose(damping[:, 1], 1.3 * AMPLITUDE**2 / 4, rtol=EXACT)


@pytest.mark.parametrize(("kind", "corners"), [("gap_stiffness", 2), ("one_sided_stop", 1)])
def test_contacts_are_sharp_and_exact_between_samples(kind, corners):
    stiffness, gap = 1.3, 0.4
    effect = make_effect(kind, {"stiffness": stiffness, "gap": gap})
    amplitude = np.array([0.3, 0.4001, 0.5, 0.9, 4.0])
    average = averaged_effect(effect, jnp.asarray(amplitude), jnp.array(2.0), n_samples=256)
    wanted = 0.5 * corners * stiffness * engaged(amplitude)
    np.testing.assert_allclose(average.stiffness, wanted, rtol=0, atol=1e-7)
    np.testing.assert_allclose(average.damping, 0.0, atol=1e-8)


def test_averages_of_a_law_without_a_formula_against_adaptive_quadrature():
    amplitude, omega = 0.8, 2.5

    def law(q, v):  # stiffness and damping mixed, not odd
        return np.tanh(3 * q + 0.2 * v) + 0.1 * np.exp(q) * v

    def integrand(beta, weight):
        return law(amplitude * np.cos(beta), -amplitude * omega * np.sin(beta)) * weight(beta)

    cosine = quad(integrand, 0, 2 * np.pi, args=(np.cos,), epsabs=1e-12, limit=200)[0]
    sine = quad(integrand, 0, 2 * np.pi, args=(np.sin,), epsabs=1e-12, limit=200)[0]
    average = averaged_effect(
        Law(lambda q, v: jnp.tanh(3 * q + 0.2 * v) + 0.1 * jnp.exp(q) * v),
        jnp.array(amplitude),
        jnp.array(omega),
    )
    # Analytic law: exponential convergence, so only quadrature's own 1e-11 remains.
    assert float(average.stiffness) == pytest.approx(cosine / (np.pi * amplitude), abs=1e-10)
    assert float(average.damping) == pytest.approx(-sine / (np.pi * amplitude * omega), abs=1e-10)


def test_a_kink_converges_with_the_square_of_the_step():
    sharp = Law(of_kind("gap_stiffness", stiffness=1.0, gap=0.4).force)
    errors = [
        abs(
            float(averaged_effect(sharp, jnp.array(0.9), jnp.array(1.0), n_samples=n).stiffness)
            - engaged(0.9)
        )
        for n in (64, 1024)
    ]
    # 16 times the samples: a factor of 256 up to where the corner lies between two samples (a
    # factor of about 12 either way); first-order convergence would leave 16.
    assert errors[1] < errors[0] / 20


def test_jit_vmap_and_gradient():
    effect = make_effect("cubic_stiffness", {"coefficient": 1.3})
    traces = []

    @jax.jit
    def compiled(amplitude, frequency):
        traces.append(1)
        return jax.vmap(lambda a, f: averaged_effect(effect, a, f))(amplitude, frequency)

    amplitude, frequency = jnp.asarray(AMPLITUDE), jnp.asarray(FREQUENCY)
    np.testing.assert_allclose(
        compiled(amplitude, frequency).stiffness, 0.75 * 1.3 * AMPLITUDE**2, rtol=EXACT
    )
    compiled(2 * amplitude, frequency)
    assert len(traces) == 1
    slope = jax.grad(lambda a: averaged_effect(effect, a, jnp.array(2.0)).stiffness)
    assert float(slope(jnp.array(0.5))) == pytest.approx(1.5 * 1.3 * 0.5, rel=EXACT)
