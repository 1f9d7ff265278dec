"""Decaying oscillations whose rates may depend on an amplitude, as columns of a separable fit.

A linear mode decays as e^{(−ζω + iω_d) t}. In a mode whose rates move with its own amplitude
A = e^u, one at the first sample, du/dt = −d(A) and dφ/dt = w(A) with d = ζω + Σ d_j A^{p_j} and
w = ω_d + Σ w_j A^{p_j}: cubic and quintic forces have p = 2 and 4, damping by v|v| has p = 1, dry
friction p = −1. Time and phase are then quadratures over u, t = ∫ du/d and φ = ∫ w/d du. Harmonics
of such a mode are columns A^p e^{ihφ} of their own.
Reference: Feldman, Mech. Syst. Signal Process. 25 (2011) 735, doi:10.1016/j.ymssp.2010.07.018.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.integrate import cumulative_simpson
from scipy.interpolate import CubicHermiteSpline

from snrmjax.identify.modal.separable_fit import TermColumns

_NODES = 401  # of the logarithm of the amplitude
_SLOWEST = 1e-3  # decay rate over the largest one: less is a motion that goes on for ever
_DEEPEST = 60.0  # fall of that logarithm, beyond which nothing is left
HARMONICS = ((0, 2), (2, 2), (3, 3), (3, 5), (4, 4), (5, 5), (5, 7), (1, 3))
"""Orders and powers of the amplitude: what quadratic, cubic and quintic forces make first.

The last is the shape of a mode that moves with the amplitude, where there are several channels.
"""


class WaveForm(NamedTuple):
    """What the unknowns are: ω and ζ of every mode, then all d_j and all w_j."""

    n_modes: int
    leading: int = 0  # the mode whose rates move with its amplitude, where there are powers
    powers: tuple[int, ...] = ()
    harmonics: tuple[tuple[int, int], ...] = ()  # of the leading mode: order, power


class _Flow(NamedTuple):
    """Logarithm of the amplitude and phase at the samples, and their derivatives."""

    log_amplitude: Float[np.ndarray, " sample"]
    phase: Float[np.ndarray, " sample"]
    log_by: Float[np.ndarray, "rate sample"]  # by d_0, d_j, then w_0, w_j
    phase_by: Float[np.ndarray, "rate sample"]


def decaying_columns(
    time: Float[np.ndarray, " sample"], unknowns: Float[np.ndarray, " unknown"], form: WaveForm
) -> TermColumns:
    """Columns Re and −Im of every mode's wave, an offset, then harmonics; not finite where a mode
    would not decay.
    """
    n, moving = form.n_modes, len(form.powers)
    omega, ratio = unknowns[:n], unknowns[n : 2 * n]
    root = np.sqrt(1 - ratio**2)
    pole = -ratio * omega + 1j * omega * root
    wave = np.exp(time[:, None] * pole)
    slopes = np.zeros((len(unknowns), len(time), n), dtype=complex)
    at = np.arange(n)
    slopes[at, :, at] = (time[:, None] * wave * (pole / omega)).T
    slopes[n + at, :, at] = (time[:, None] * wave * (-omega - 1j * omega * ratio / root)).T
    if moving or form.harmonics:
        k = form.leading
        flow = _flow(time, pole[k], unknowns[2 * n :], form.powers)
        # Of d_0 = ζω and w_0 = ω√(1 − ζ²) by ω and ζ.
        chain = np.zeros((2 + 2 * moving, 2 + 2 * moving))
        chain[0, 0], chain[0, 1 + moving] = ratio[k], root[k]
        chain[1, 0], chain[1, 1 + moving] = omega[k], -omega[k] * ratio[k] / root[k]
        chain[2 : 2 + moving, 1 : 1 + moving] = np.eye(moving)
        chain[2 + moving :, 2 + moving :] = np.eye(moving)
        log_by, phase_by = chain @ flow.log_by, chain @ flow.phase_by
        rows = np.concatenate([[k, n + k], np.arange(2 * n, len(unknowns))])

        falling, turning = np.exp(flow.log_amplitude), np.exp(1j * flow.phase)

        def turned(order: int, power: int) -> tuple[np.ndarray, np.ndarray]:
            column = falling**power * turning**order
            by = np.zeros((len(unknowns), len(time)), dtype=complex)
            by[rows] = (power * log_by + 1j * order * phase_by) * column
            return column, by

        wave[:, k], slopes[:, :, k] = turned(1, 1)
    columns = [wave.real, -wave.imag, np.ones((len(time), 1))]
    by = [slopes.real, -slopes.imag, np.zeros((len(unknowns), len(time), 1))]
    for order, power in form.harmonics:
        column, slope = turned(order, power)
        for part, part_by in ((column.real, slope.real), (-column.imag, -slope.imag))[
            : 2 if order else 1
        ]:
            columns.append(part[:, None])
            by.append(part_by[:, :, None])
    return TermColumns(np.concatenate(columns, axis=1), np.concatenate(by, axis=2))


def _flow(time: np.ndarray, pole: complex, terms: np.ndarray, powers: tuple[int, ...]) -> _Flow:
    """The decay of the moving mode; NaN where it stops before the record ends."""
    powered = np.array((0, *powers))
    decay = np.concatenate([[-pole.real], terms[: len(powers)]])
    turn = np.concatenate([[pole.imag], terms[len(powers) :]])
    span, count = float(time[-1]), 2 * len(powered)
    depth = 1.0 + 1.5 * max(decay[0], 0.0) * span
    none = np.full((count, len(time)), np.nan)
    nothing = _Flow(none[0], none[0], none, none)
    while True:
        fall = np.linspace(0.0, depth, _NODES)
        by_power = np.exp(-powered[:, None] * fall)
        rate, omega = decay @ by_power, turn @ by_power
        if not np.isfinite(rate).all() or rate.min() <= _SLOWEST * rate.max():
            return nothing
        when = cumulative_simpson(1 / rate, x=fall, initial=0)
        if np.any(np.diff(when) <= 0):
            return nothing
        if when[-1] >= span or depth > _DEEPEST:
            break
        depth = min(1.5 * depth * max(1.0, span / max(when[-1], span / 4)), 2 * _DEEPEST)
    over = cumulative_simpson(by_power / rate, x=fall, initial=0, axis=1)
    twice = cumulative_simpson(by_power / rate**2, x=fall, initial=0, axis=1)
    turning = cumulative_simpson(omega * by_power / rate**2, x=fall, initial=0, axis=1)
    inside = np.minimum(time, when[-1])

    def at_samples(values: np.ndarray, by_fall: np.ndarray) -> np.ndarray:
        return CubicHermiteSpline(when, values, by_fall * rate, axis=-1)(inside)

    slope = np.gradient(rate, fall)
    turn_slope = np.gradient(omega, fall)
    log_by = -twice * rate
    phase_by = -turning + omega * twice
    none = np.zeros_like(over)
    return _Flow(
        at_samples(-fall, -np.ones_like(fall)),
        at_samples(turn @ over, omega / rate),
        at_samples(
            np.concatenate([log_by, none]),
            np.concatenate([-by_power / rate - twice * slope, none]),
        ),
        at_samples(
            np.concatenate([phase_by, over]),
            np.concatenate([turn_slope * twice, by_power / rate]),
        ),
    )
