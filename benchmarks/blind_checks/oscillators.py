"""Steady states and time records of one nonlinear mode on a shaker, by this benchmark's own code.

NumPy alone: harmonic balance (alternating frequency-time, Newton's method) of many lanes at once,
and Runge-Kutta integration of stepped tests. Time is scaled with ω₀, displacement with its size at
the top level: w² y'' + 2ζ w y' + K y + a y³ + b y² + c |u|u + d tanh(u/ε) = V cos τ − β u, with
u = w y' and τ = w t. The right-hand side is the force on the structure: a shaker's back-EMF takes
β u from what a voltage V would give.
"""

from typing import NamedTuple

import numpy as np

ORDERS, SAMPLES = 5, 96
_ANGLE = 2 * np.pi * np.arange(SAMPLES) / SAMPLES
_COS = np.cos(np.arange(ORDERS + 1)[:, None] * _ANGLE)
_SIN = np.sin(np.arange(1, ORDERS + 1)[:, None] * _ANGLE)
_BASIS = np.concatenate([_COS, _SIN])  # coefficient, sample
_ORDER = np.concatenate([np.arange(ORDERS + 1), np.arange(1, ORDERS + 1)])
_N = ORDERS + 1
# d/dτ of cos is −k sin, of sin is k cos.
_SLOPES = np.concatenate([-np.arange(_N)[:, None] * np.sin(np.arange(_N)[:, None] * _ANGLE),
                          np.arange(1, _N)[:, None] * _COS[1:]])  # fmt: skip
_PROJECT = 2 * _BASIS / SAMPLES
_PROJECT[0] /= 2
_FRICTION_WIDTH = 0.02


class Lane(NamedTuple):
    """Numbers of every lane, arrays of one length."""

    damping: np.ndarray  # ζ
    cubic: np.ndarray  # a
    quadratic: np.ndarray  # b
    quadratic_damping: np.ndarray  # c
    friction: np.ndarray  # d
    feedback: np.ndarray  # β
    stiffness: np.ndarray  # K, 1 but where it drifts

    def of(self, rows) -> "Lane":
        """Some lanes."""
        return Lane(*(column[rows] for column in self))


def _nonlinear(lane: Lane, y, u):
    """Force beyond the linear ones, and its slopes by y and u."""
    a, b, c, d = (x[:, None] for x in lane[1:5])
    soft = np.tanh(u / _FRICTION_WIDTH)
    force = a * y**3 + b * y**2 + c * np.abs(u) * u + d * soft
    by_u = 2 * c * np.abs(u) + d * (1 - soft**2) / _FRICTION_WIDTH
    return force, 3 * a * y**2 + 2 * b * y, by_u


def balance(lane: Lane, w, voltage, start, rounds=60):
    """Newton's method from `start` (lane, coefficient); returns coefficients and what converged."""
    x = start.copy()
    linear = lane.stiffness[:, None] - (w[:, None] * _ORDER) ** 2
    rate = (2 * lane.damping + lane.feedback)[:, None] * w[:, None] * np.arange(1, _N)
    for _ in range(rounds):
        y, u = x @ _BASIS, w[:, None] * (x @ _SLOPES)
        force, by_y, by_u = _nonlinear(lane, y, u)
        residual = force @ _PROJECT.T + linear * x
        # 2ζ w y': cosine rows get k S, sine rows −k C.
        residual[:, 1:_N] += rate * x[:, _N:]
        residual[:, _N:] -= rate * x[:, 1:_N]
        residual[:, 1] -= voltage
        slope = by_y[:, None, :] * _BASIS + (w[:, None] * by_u)[:, None, :] * _SLOPES
        jacobian = np.einsum("ks,ljs->lkj", _PROJECT, slope)
        n = np.arange(len(_ORDER))
        jacobian[:, n, n] += linear
        k = np.arange(1, _N)
        jacobian[:, k, k + ORDERS] += rate
        jacobian[:, k + ORDERS, k] -= rate
        step = np.linalg.solve(jacobian, residual[..., None])[..., 0]
        size = np.maximum(np.abs(x).max(axis=1), 1e-3)
        limit = np.minimum(1.0, 0.5 * size / np.maximum(np.abs(step).max(axis=1), 1e-300))
        x -= limit[:, None] * step
    good = np.abs(step).max(axis=1) < 1e-9 * size
    return x, good


class Sweep(NamedTuple):
    """States of an upward sweep, lane by frequency."""

    w: np.ndarray
    force: np.ndarray  # phasor, harmonics 1…3: lane, frequency, harmonic
    velocity: np.ndarray  # relative to the same clock, harmonics 0…3
    good: np.ndarray


def sweep_up(lane: Lane, w, voltage, stiffness=None) -> Sweep:
    """Follow each lane upwards in frequency from its own last state; a fold makes it jump."""
    lanes, steps = w.shape
    x = np.zeros((lanes, len(_ORDER)))
    force, velocity, good = [], [], []
    for k in range(steps):
        now = lane if stiffness is None else lane._replace(stiffness=stiffness[:, k])
        x, fine = balance(now, w[:, k], voltage, x)
        lost = np.flatnonzero(~fine)
        if lost.size:
            again, fine_again = balance(
                now.of(lost), w[lost, k], voltage[lost], np.zeros((lost.size, len(_ORDER))), 150
            )
            x[lost], fine[lost] = again, fine_again
        phasor = x[:, :_N].astype(complex)
        phasor[:, 1:] -= 1j * x[:, _N:]
        u = 1j * w[:, k, None] * np.arange(_N) * phasor
        velocity.append(u[:, :4])
        f = -lane.feedback[:, None] * u[:, 1:4]
        f[:, 0] += voltage
        force.append(f)
        good.append(fine)
    return Sweep(w, np.stack(force, 1), np.stack(velocity, 1), np.stack(good, 1))


class Stepped(NamedTuple):
    """Samples of stepped tests: lane by sample, at a step of `dt` in ω₀t."""

    dt: float
    angle: np.ndarray  # of the drive
    force: np.ndarray
    velocity: np.ndarray


def stepped(lane: Lane, w, voltage, dwell, samples, per_cycle, harmonics) -> Stepped:
    """Integrate by Runge-Kutta while frequency and voltage step.

    `w` and `voltage` (lane, step); `dwell` samples of a step by lane; `harmonics` (lane, 2) are the
    second and third harmonic of the drive over its first.
    """
    dt = 2 * np.pi / per_cycle
    rows = np.arange(len(dwell))
    y, u, angle = np.zeros(len(dwell)), np.zeros(len(dwell)), np.zeros(len(dwell))
    kept = np.empty((3, len(dwell), samples))
    last = w.shape[1] - 1

    def drive(level, at):
        second, third = harmonics.T
        return level * (np.cos(at) + second * np.cos(2 * at) + third * np.cos(3 * at))

    def pull(y, u):
        force, _, _ = _nonlinear(lane, y[:, None], u[:, None])
        return force[:, 0] + 2 * lane.damping * u + lane.stiffness * y

    for n in range(samples):
        step = np.minimum(n // dwell, last)
        speed, level = w[rows, step], voltage[rows, step]
        push = drive(level, angle) - lane.feedback * u
        kept[:, :, n] = angle, push, u

        def slope(y, u, at, level=level):
            return u, drive(level, at) - lane.feedback * u - pull(y, u)

        h = dt
        half = angle + speed * h / 2
        a1 = slope(y, u, angle)
        a2 = slope(y + h / 2 * a1[0], u + h / 2 * a1[1], half)
        a3 = slope(y + h / 2 * a2[0], u + h / 2 * a2[1], half)
        a4 = slope(y + h * a3[0], u + h * a3[1], angle + speed * h)
        y = y + h / 6 * (a1[0] + 2 * a2[0] + 2 * a3[0] + a4[0])
        u = u + h / 6 * (a1[1] + 2 * a2[1] + 2 * a3[1] + a4[1])
        angle = angle + speed * h
    return Stepped(dt, *kept)
