"""Bouc and Wen's law and contacts that slip and part, in motions, against time integration."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import snrmjax as sj
from snrmjax.model.attachment import between
from snrmjax.simulate.continuation.stability import floquet_multipliers

DAMPING, STIFFNESS = np.array([[0.1, -0.05], [-0.05, 0.1]]), np.array([[2.0, -1.0], [-1.0, 2.0]])


@pytest.fixture(scope="module")
def hysteretic():
    """Two masses with Bouc and Wen's spring between them, and a motion near their second mode."""
    values = {"stiffness": 0.5, "slip_force": 0.3, "exponent": 2.0, "unloading": 0.6}
    law = sj.model.make_effect("bouc_wen", values, at=between("x2", "x1"))
    model = sj.model.from_matrices(np.eye(2), DAMPING, STIFFNESS, force="x1", effects=law)
    curve = sj.forced_response(model, 0.3, 1.6, 1.8, harmonic_order=9, stability=False)[0]
    return model, curve, int(np.argmax(np.abs(np.asarray(curve.velocity)[:, 1, 0])))


def rates(t, y, omega):
    x, v, f = y[:2], y[2:4], y[4]
    way = v[1] - v[0]
    rate = 0.5 * way * (1 - (f / 0.3) ** 2 * (0.6 * np.sign(way * f) + 0.4))
    load = np.array([0.3 * np.cos(omega * t), 0.0]) - f * np.array([-1.0, 1.0])
    return np.concatenate([v, load - DAMPING @ v - STIFFNESS @ x, [rate]])


@pytest.fixture(scope="module")
def in_time(hysteretic):
    """The settled state and one period of it, by SciPy."""
    _, curve, index = hysteretic
    omega = float(curve.frequency[index])
    period = 2 * np.pi / omega
    options = {"args": (omega,), "rtol": 1e-8, "atol": 1e-10}
    begin = solve_ivp(rates, (0, 150 * period), np.zeros(5), **options).y[:, -1]
    times = period * np.arange(64) / 64
    return omega, begin, solve_ivp(rates, (0, period), begin, t_eval=times, **options).y[:2]


def test_the_balance_is_the_settled_motion(hysteretic, in_time):
    model, curve, index = hysteretic
    q = np.asarray(curve.coefficients[index]) @ np.asarray(model.modes.mode_shape).T
    wanted = np.fft.rfft(in_time[2], axis=1)[:, [1, 3]] / 32
    for order, of in ((1, 0), (3, 1)):
        found = q[2 * order - 1] - 1j * q[2 * order]
        np.testing.assert_allclose(found, wanted[:, of], atol=2e-4 * np.abs(wanted[:, 0]).max())


def test_multipliers_are_those_of_the_map_over_a_period(hysteretic, in_time):
    model, curve, index = hysteretic
    omega, begin, _ = in_time

    def after(y):
        return solve_ivp(rates, (0, 2 * np.pi / omega), y, args=(omega,), rtol=1e-10, atol=1e-12).y[
            :, -1
        ]

    step = 1e-5
    columns = [(after(begin + step * e) - after(begin - step * e)) / (2 * step) for e in np.eye(5)]
    wanted = np.linalg.eigvals(np.stack(columns, axis=1))
    wanted = wanted[np.argsort(-np.abs(wanted))][:4]
    found = floquet_multipliers(model, curve.coefficients[[index]], curve.frequency[[index]])[0]
    assert np.abs(np.sort(np.abs(found)) - np.sort(np.abs(wanted))).max() < 5e-4
    assert np.abs(found[:, None] - wanted).min(axis=1).max() < 1e-3


def surface(normal_force):
    """A mass on a surface, along and across it; a static load presses it, a force lifts it."""
    values = {"stiffness": 5.0, "normal_stiffness": 21.0, "friction": 0.85, "preload": 0.0}
    contact = sj.model.make_effect("friction_contact", values, at="x", normal_at="y")
    load = sj.model.make_effect("static_preload", {"constant_force": 100.0}, at="y")
    return sj.model.from_matrices(
        *(np.eye(2), np.diag([0.35, 2.0]), np.diag([12.0, 21.0]), ("x", "y")),
        force={"x": 1.0, "y": normal_force},
        effects=[contact, load],
    )


def stepped(force, omega, periods=40, steps=2000):
    """One period of the settled motion by Runge and Kutta's steps, the slider updated last.

    Python's own numbers: NumPy takes ten times longer for arrays of two.
    """
    h, state, z, kept = 2 * np.pi / omega / steps, [0.0] * 4, 0.0, []
    along, across = map(float, force)

    def pushed(z, x, y):
        reach = 0.85 * max(21 * y, 0.0) / 5
        return min(max(z, x - reach), x + reach)

    def rate(t, x, y, u, v):
        drive = math.cos(omega * t)
        slide = 5 * (x - pushed(z, x, y))
        lift = max(21 * y, 0.0) - 100
        return (
            *(u, v, along * drive - 0.35 * u - 12 * x - slide),
            across * drive - 2 * v - 21 * y - lift,
        )

    def moved(way, slope):
        return [a + way * b for a, b in zip(state, slope, strict=True)]

    for k in range(periods * steps):
        t = k * h
        a = rate(t, *state)
        b = rate(t + h / 2, *moved(h / 2, a))
        c = rate(t + h / 2, *moved(h / 2, b))
        d = rate(t + h, *moved(h, c))
        mean = [(p + 2 * q + 2 * r + s) / 6 for p, q, r, s in zip(a, b, c, d, strict=True)]
        state = moved(h, mean)
        z = pushed(z, *state[:2])
        if k >= (periods - 1) * steps:
            kept.append(state[:2])
    return np.fft.rfft(np.roll(kept, 1, axis=0), axis=0) / steps


@pytest.mark.parametrize(
    "normal_force",
    [pytest.param(0.1, id="pressed", marks=pytest.mark.long), pytest.param(1.5, id="parting")],
)
def test_a_contact_slips_with_its_normal_force_and_parts(normal_force):
    model, omega = surface(normal_force), 3.5
    force = 100.0
    curve = sj.forced_response(model, force, 3.0, 4.0, harmonic_order=21, stability=False)[0]
    near = int(np.argmin(np.abs(curve.frequency - omega)))
    motion = sj.simulate.periodic_motion(model, force, curve.point(near), value=omega)
    q = np.asarray(motion.coefficients) @ np.asarray(model.modes.mode_shape).T
    wanted = stepped(force * np.array([1.0, normal_force]), omega)
    largest = np.abs(2 * wanted[1]).max()
    np.testing.assert_allclose(q[0], wanted[0].real, atol=1e-3 * largest)
    for order in (1, 2, 3):
        found = q[2 * order - 1] - 1j * q[2 * order]
        np.testing.assert_allclose(found, 2 * wanted[order], atol=1e-3 * largest)
    parts = np.min(np.fft.irfft(wanted[:, 1] * 64, 64)) < 0
    assert parts == (normal_force > 1)
