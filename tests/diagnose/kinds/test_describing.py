"""Describing functions against quadrature of the forces over a cycle."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq, fsolve

from snrmjax.diagnose.kinds import describing
from snrmjax.diagnose.kinds.table import HYPOTHESES

X = np.array([0.2, 0.45, 0.8, 1.0])
OMEGA = np.array([0.97, 1.0, 1.02, 1.05])  # over the natural frequency
RATIO = 0.01
READINGS = SimpleNamespace(
    relative_amplitude=X,
    relative_frequency=OMEGA,
    frequency_over_level=OMEGA,
    damping_ratio=RATIO,
    dynamic_stiffness=np.ones(len(X), complex),
)


def fundamental(force, x):
    """2/T ∫ f e^{-it} over a cycle of x cos t, over x."""
    t = (np.arange(40000) + 0.5) * 2 * np.pi / 40000
    return 2 * np.mean(force(x * np.cos(t), t) * np.exp(-1j * t)) / x


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
    found = HYPOTHESES["one_sided_stop"].change(READINGS, 0.3, np.log(stiffness))
    np.testing.assert_allclose(found, wanted, atol=1e-4)


def test_a_slider_has_the_fundamental_of_its_hysteresis():
    """A block behind a spring of stiffness 1, dragged where the stretch exceeds the slip."""
    slip, wanted = 0.3, []
    for x in X:
        q = x * np.cos(np.arange(80000) * 2 * np.pi / 40000)
        block, force = 0.0, np.empty_like(q)
        for k, at in enumerate(q):
            block = min(max(block, at - slip), at + slip)
            force[k] = -block  # less the stuck stiffness, which is part of the linear mode
        t = np.arange(40000) * 2 * np.pi / 40000
        wanted.append(2 * np.mean(force[40000:] * np.exp(-1j * t)) / x)
    found = HYPOTHESES["jenkins_slider"].change(READINGS, np.log(slip))
    np.testing.assert_allclose(found, wanted, atol=2e-3)


@pytest.mark.parametrize("exponent", [1.3, 2.0, 2.7])
def test_microslip_loses_energy_as_published(exponent):
    """Damping 4(p − 1)/(π(p + 1)) of Masing's loop on a power law (Segalman 2005)."""
    largest = HYPOTHESES["iwan_microslip"].change(READINGS, exponent)[-1]
    wanted = 4 * (exponent - 1) / (np.pi * (exponent + 1))
    assert largest.imag == pytest.approx(wanted, rel=1e-3)
    assert -1.2 < largest.real < -0.7


def test_a_weak_quadratic_spring_softens_by_five_sixths():
    """Nayfeh & Mook, Nonlinear Oscillations (1979), eq. 4.1.19: −(5/6) α₂² a² at resonance."""
    change, second = describing.quadratic(X, np.ones_like(X), 0.0, 0.01)
    np.testing.assert_allclose(change.real, -(5 / 6) * 1e-4 * X**2, rtol=1e-3)
    np.testing.assert_allclose(second, 0.005 * X, rtol=1e-3)


def harmonics(force, orders=(1, 2, 3), samples=4000):
    """Harmonics of a force over the amplitude, of x cos Ωt: by the second of two cycles."""
    t = 2 * np.pi * np.arange(2 * samples) / samples
    found = []
    for x, omega in zip(X, OMEGA, strict=True):
        values = force(x * np.cos(t), -omega * x * np.sin(t))[samples:]
        found.append([2 * np.mean(values * np.exp(-1j * h * t[samples:])) / x for h in orders])
    return np.array(found).T


def dragged(limits, weights):
    """Blocks behind springs, dragged where a stretch exceeds its limit, less what sticks."""

    def force(q, _):
        block, found = np.zeros(len(limits)), np.empty_like(q)
        for k, at in enumerate(q):
            block = np.clip(block, at - limits, at + limits)
            found[k] = -weights @ block
        return found

    return force


def at_a_stop(width, stiffness):
    """A spring on one side, which moves the mean of the motion until it balances it."""

    def force(q, _):
        def balance(mean):
            return mean + stiffness * np.mean(np.maximum(mean + q - width, 0.0))

        return np.maximum(brentq(balance, -q.max(), 0.0) + q - width, 0.0)

    return force


def iwan(exponent, n=400):
    """Sliders whose limits have the density that loses stiffness as a power."""
    limits = ((np.arange(n) + 0.5) / n * 1.1 ** (exponent - 1)) ** (1 / (exponent - 1))
    return dragged(limits, np.full(n, exponent * 1.1 ** (exponent - 1) / n))


@pytest.mark.parametrize(
    ("kind", "shape", "force", "within"),
    [
        ("cubic_stiffness", (), lambda q, _: q**3, 1e-6),
        ("quintic_stiffness", (), lambda q, _: q**5, 1e-6),
        ("gap_stiffness", (0.3,), lambda q, _: q - np.clip(q, -0.3, 0.3), 2e-4),
        ("one_sided_stop", (0.3, np.log(2.0)), at_a_stop(0.3, 2.0), 2e-3),
        ("quadratic_damping", (), lambda _, v: v * np.abs(v), 1e-4),
        ("cubic_damping", (), lambda _, v: v**3, 1e-6),
        ("van_der_pol_damping", (), lambda q, v: q**2 * v, 1e-6),
        ("coulomb_friction", (), lambda _, v: np.sign(v), 2e-3),
        ("jenkins_slider", (np.log(0.3),), dragged(np.array([0.3]), np.ones(1)), 5e-3),
        ("iwan_microslip", (1.3,), iwan(1.3), 5e-3),
        ("iwan_microslip", (2.0,), iwan(2.0), 5e-3),
    ],
)
def test_ratios_of_harmonics_are_those_of_the_force(kind, shape, force, within):
    law = HYPOTHESES[kind]
    first, *others = harmonics(force)
    own = law.change(READINGS, *shape)
    seen = np.abs(own) > 1e-9
    scale = np.median(np.real(own[seen] / first[seen]))
    np.testing.assert_allclose(own, scale * first, atol=within * scale * np.max(np.abs(first)))
    for order, wanted in zip((2, 3), others, strict=True):
        found = law.higher(READINGS, SimpleNamespace(order=order), *shape)
        np.testing.assert_allclose(
            found, scale * wanted, atol=within * scale * np.max(np.abs(first)), err_msg=str(order)
        )


def of_even_spring(force, x, omega):
    """Fundamental and second harmonic of a force, by balance of mean and second harmonic."""
    t = 2 * np.pi * np.arange(4096) / 4096

    def values(unknown):
        mean, real, imaginary = unknown
        twice = np.real((real + 1j * imaginary) * np.exp(2j * t))
        return force(mean + x * np.cos(t) + twice)

    def left(unknown):
        found, second = values(unknown), unknown[1] + 1j * unknown[2]
        own = 1 - 4 * omega**2 + 4j * RATIO * omega
        rest = own * second + 2 * np.mean(found * np.exp(-2j * t))
        return [unknown[0] + np.mean(found), rest.real, rest.imag]

    found = values(fsolve(left, [0.0, 0.0, 0.0], xtol=1e-12))
    return [2 * np.mean(found * np.exp(-1j * h * t)) / x for h in (1, 2)]


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize(
    ("kind", "strength", "force"),
    [
        ("quadratic_stiffness", 0.1, lambda s, q: s * q**2),
        ("bilinear_stiffness", 0.03, lambda k, q: 0.5 * k * np.abs(q)),
    ],
)
def test_an_even_spring_has_the_second_harmonic_of_its_own_motion(kind, strength, force, side):
    law, shape = HYPOTHESES[kind], (np.log(strength), side)
    wanted = np.array(
        [
            of_even_spring(lambda q: force(side * strength, q), x, omega)
            for x, omega in zip(X, OMEGA, strict=True)
        ]
    ).T
    # Further harmonics act at the next order of the strength.
    np.testing.assert_allclose(law.change(READINGS, *shape).real, wanted[0].real, rtol=0.06)
    second = law.higher(READINGS, SimpleNamespace(order=2), *shape)
    np.testing.assert_allclose(second, wanted[1], rtol=0.06)
    assert not np.any(law.higher(READINGS, SimpleNamespace(order=3), *shape))
