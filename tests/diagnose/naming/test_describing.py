"""Describing functions against quadrature of the forces over a cycle."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from snrmjax.diagnose.naming import describing

X = np.array([0.2, 0.45, 0.8, 1.0])


def fundamental(force, x):
    """2/T ∫ f e^{-it} over a cycle of x cos t, over x."""
    t = (np.arange(40000) + 0.5) * 2 * np.pi / 40000
    return 2 * np.mean(force(x * np.cos(t), t) * np.exp(-1j * t)) / x


def test_a_gap_is_that_of_its_force():
    def force(q, _):
        return np.sign(q) * np.maximum(np.abs(q) - 0.3, 0.0)

    wanted = [fundamental(force, x).real for x in X]
    np.testing.assert_allclose(describing.gap(X, 0.3), wanted, atol=1e-6)


@pytest.mark.parametrize("stiffness", [0.1, 3.0])
def test_a_stop_moves_the_mean_until_the_contact_balances_it(stiffness):
    wanted = []
    for x in X:

        def contact(q):
            return np.maximum(q - 0.3, 0.0)

        def balance(mean, x=x):
            return (
                mean
                + stiffness * quad(lambda t: contact(mean + x * np.cos(t)), 0, np.pi)[0] / np.pi
            )

        mean = brentq(balance, -x, 0.0) if x > 0.3 else 0.0
        wanted.append(fundamental(lambda q, _, m=mean: contact(m + q), x).real)
    np.testing.assert_allclose(describing.stop(X, 0.3, stiffness), wanted, atol=1e-5)


def test_a_slider_is_that_of_its_hysteresis():
    """A block behind a spring of stiffness 1, dragged where the stretch exceeds the slip."""
    slip, wanted = 0.3, []
    for x in X:
        q = x * np.cos(np.arange(80000) * 2 * np.pi / 40000)
        block, force = 0.0, np.empty_like(q)
        for k, at in enumerate(q):
            block = min(max(block, at - slip), at + slip)
            force[k] = -block  # beside the stuck stiffness, which is the linear mode's
        t = np.arange(40000) * 2 * np.pi / 40000
        wanted.append(2 * np.mean(force[40000:] * np.exp(-1j * t)) / x)
    lost, damping = describing.slider(X, slip)
    np.testing.assert_allclose(lost + 1j * damping, wanted, atol=2e-3)


@pytest.mark.parametrize("exponent", [1.3, 2.0, 2.7])
def test_microslip_loses_what_the_literature_says(exponent):
    """Damping 4(p − 1)/(π(p + 1)) of Masing's loop on a power law (Segalman 2005)."""
    lost, damping = describing.masing(exponent, samples=4000)
    assert damping == pytest.approx(4 * (exponent - 1) / (np.pi * (exponent + 1)), rel=1e-5)
    assert -1.2 < lost < -0.7


def test_a_weak_quadratic_spring_softens_by_five_sixths():
    """Nayfeh & Mook, Nonlinear Oscillations (1979), eq. 4.1.19: −(5/6) α₂² a² at resonance."""
    change, second = describing.quadratic(X, np.ones_like(X), 0.0, 0.01)
    np.testing.assert_allclose(change.real, -(5 / 6) * 1e-4 * X**2, rtol=1e-3)
    np.testing.assert_allclose(second, 0.005 * X, rtol=1e-3)
