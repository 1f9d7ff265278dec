"""Steady states of a chain with one element, by a harmonic balance of its own: NumPy and SciPy."""

import numpy as np
from scipy.optimize import fsolve

import snrmjax as sj

MASS, SPRING = np.array([1.0, 0.7, 1.3, 0.9]), np.array([1e4, 7e3, 1.2e4, 9e3, 0.0])
STIFFNESS = np.diag(SPRING[:-1] + SPRING[1:]) - np.diag(SPRING[1:-1], 1) - np.diag(SPRING[1:-1], -1)
DAMPING = 0.3 * np.diag(MASS) + 1e-4 * STIFFNESS
POINTS = ("x1", "x2", "x3", "x4")
ORDER, STORED = 7, (1, 2, 3, 4, 5)
FIRST = np.sqrt(np.linalg.eigvalsh(STIFFNESS / np.sqrt(np.outer(MASS, MASS)))[0])  # rad/s


def displacement(force, row, law, omega, start):
    """Phasors (point, order) of the steady state near another one; the force acts at x1."""
    orders, samples = np.arange(ORDER + 1), 96
    turn = np.exp(2j * np.pi * np.outer(orders, np.arange(samples)) / samples)
    load = np.zeros((4, ORDER + 1))
    load[0, 1] = force
    inertia = MASS[:, None] * (orders * omega) ** 2

    def left(parts):
        x = parts.reshape(2, 4, -1)
        x = x[0] + 1j * x[1]
        along = row @ x
        inside = np.fft.fft(law((along @ turn).real, (1j * orders * omega * along @ turn).real))
        inside = inside[: ORDER + 1] * 2 / samples
        inside[0] /= 2
        missed = STIFFNESS @ x - inertia * x + 1j * orders * omega * (DAMPING @ x)
        missed = (missed + row[:, None] * inside - load) / 1e4
        missed[:, 0] = missed[:, 0].real + 1j * x[:, 0].imag
        return np.stack([missed.real, missed.imag]).reshape(-1)

    begin = np.zeros((4, ORDER + 1), dtype=complex) if start is None else start
    found = fsolve(left, np.stack([begin.real, begin.imag]).reshape(-1), xtol=1e-12)
    assert np.abs(left(found)).max() < 1e-10
    real, imaginary = found.reshape(2, 4, -1)
    return real + 1j * imaginary


def steady_states(
    row,
    law,
    sensors,
    *,
    noise=3e-3,
    seed=1,
    forces=(0.5, 1.0, 1.5),
    span=(0.985, 1.01),
    stored=STORED,
):
    """A noisy table of three levels around the first resonance, or over another `span` of it."""
    rows, x = [], None
    for level, force in enumerate(forces):
        x = None
        for omega in np.linspace(*span, 6) * FIRST:
            x = displacement(force, np.asarray(row), law, omega, x)
            rows.append((level + 1, omega, force, 1j * np.arange(ORDER + 1) * omega * x))
    level, omega, force, velocity = map(np.array, zip(*rows, strict=True))
    orders = np.array(stored)
    seen = velocity[:, [POINTS.index(s) for s in sensors]][:, :, orders]
    rng = np.random.default_rng(seed)
    floor = 0.05 * noise * np.abs(seen[..., 0]).max()
    gain, turn = noise * rng.normal(size=(2, *seen.shape[:2], 1))
    seen = seen * np.exp(gain + 1j * orders * turn)
    white = floor / np.sqrt(2) * rng.normal(size=(2, *seen.shape))
    white[..., 0] = 0.0
    seen = seen + white[0] + 1j * white[1]
    return sj.measure.steady_states(
        *(level, omega, force, seen[..., 0]),
        velocity_std=noise * np.abs(seen[..., 0]),
        phase_std=np.full(seen.shape[:2], noise),
        harmonics=seen[..., 1:],
        harmonic_std=np.full(seen.shape[:2], floor),
        harmonic_order=stored[1:],
        sensors=sensors,
    )


def structure(sensors):
    """The chain without the element."""
    return sj.model.from_matrices(
        *(np.diag(MASS), DAMPING, STIFFNESS, POINTS), force="x1", sensors=sensors
    )
