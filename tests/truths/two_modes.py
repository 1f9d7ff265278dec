"""Steady states of two coupled modes by a harmonic balance of its own: NumPy and SciPy alone."""

import numpy as np
from scipy.optimize import fsolve

import snrmjax as sj

OMEGA, ZETA = np.array([100.0, 302.0]), np.array([0.004, 0.003])
SHAPE, PUSH = np.array([[1.0, 0.8], [0.7, -1.1]]), np.array([1.0, 0.6])
ORDER = 5
STORED = (2, 3, 5)


def gradient(q, terms):
    """∂V/∂q of V = Σ c q₁^a q₂^b, for terms {(a, b): c}."""
    g = np.zeros_like(q)
    for (a, b), value in terms.items():
        g[0] += value * a * q[0] ** max(a - 1, 0) * q[1] ** b
        g[1] += value * b * q[0] ** a * q[1] ** max(b - 1, 0)
    return g


def balanced(terms, force, omega, start=None, modes=OMEGA):
    """Displacement phasors (mode, order 0…) of the steady state near another one."""
    orders, tau = np.arange(ORDER + 1), 2 * np.pi * np.arange(32) / 32
    turn = np.exp(1j * np.outer(orders, tau))
    load = np.zeros((2, ORDER + 1))
    load[:, 1] = PUSH * force
    linear = modes[:, None] ** 2 - (orders * omega) ** 2
    linear = linear + 2j * (ZETA * modes)[:, None] * orders * omega

    def left(parts):
        q = parts.reshape(2, 2, -1)
        q = q[0] + 1j * q[1]
        inside = np.fft.fft(gradient((q @ turn).real, terms), axis=1)[:, : ORDER + 1] / 16
        inside[:, 0] /= 2
        missed = (linear * q + inside - load) / 1e4
        missed[:, 0] = missed[:, 0].real + 1j * q[:, 0].imag
        return np.stack([missed.real, missed.imag]).reshape(-1)

    first = load / linear if start is None else start
    found, _, good, said = fsolve(
        left, np.stack([first.real, first.imag]).reshape(-1), full_output=True, xtol=1e-13
    )
    assert good == 1 or np.abs(left(found)).max() < 1e-12, said
    real, imaginary = found.reshape(2, 2, -1)
    return real + 1j * imaginary


def phasors(terms, modes=OMEGA, forces=(1.5, 3.0)):
    """Level, Ω, force and velocity phasors (state, sensor, order) of two levels."""
    rows = []
    for level, force in enumerate(forces):
        q = None
        for omega in np.linspace(0.993, 1.004, 7) * modes[0]:
            q = balanced(terms, force, omega, q, modes)
            rows.append((level + 1, omega, force, 1j * np.arange(ORDER + 1) * omega * (SHAPE @ q)))
    return tuple(map(np.array, zip(*rows, strict=True)))


def steady_states(
    terms, *, noise=1e-6, seed=None, sensors=("a", "b"), modes=OMEGA, forces=(1.5, 3.0)
):
    """The same as a table, with noise of relative size where a seed is given."""
    level, omega, force, velocity = phasors(terms, modes, forces)
    n, orders = len(sensors), np.array([1, *STORED])
    seen = velocity[:, :n][:, :, orders]
    floor = noise * 0.05 * np.abs(seen[..., 0]).max()
    if seed is not None:
        rng = np.random.default_rng(seed)
        gain, turn = noise * rng.normal(size=(2, *seen.shape[:2], 1))
        seen = seen * np.exp(gain + 1j * orders * turn)
        seen[..., 1:] += (
            floor / np.sqrt(2) * (rng.normal(size=(2, *seen[..., 1:].shape)).T @ [1, 1j]).T
        )
    return sj.measure.steady_states(
        *(level, omega, force, seen[..., 0]),
        velocity_std=noise * np.abs(seen[..., 0]),
        phase_std=np.full(seen.shape[:2], noise),
        harmonics=seen[..., 1:],
        harmonic_std=np.full(seen.shape[:2], floor),
        harmonic_order=STORED,
        sensors=sensors,
    )


def structure(keys=(), sensors=("a", "b"), modes=OMEGA):
    """The two linear modes, with some monomials of coefficient zero."""
    linear = sj.model.linear_modes(modes, ZETA, SHAPE[: len(sensors)], PUSH, sensors=sensors)
    potential = sj.model.polynomial_potential(dict.fromkeys(keys, 0.0), 2)
    return sj.model.structure(linear, potential)
