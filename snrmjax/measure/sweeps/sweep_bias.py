"""Bias of a resonance by a sweep: apparent frequency, height and width.

Near a lightly damped resonance the phasor of the displacement obeys ȧ = −(ζω + i(Ω − ω)) a + F/2iω.
At a constant sweep rate, Ω − ω = rt, the response is a Gaussian integral with a complex argument
(Faddeeva function); it depends only on the normalised rate η = Q² |df/dt| / f², Q = 1/(2ζ).

References: J. A. Lollock, AIAA 2002-1230 (normalised rate; lowered peak); G. Gloth & M. Sinapius,
Mech. Syst. Signal Process. 18 (2004) 1421 (apparent frequency and damping of swept modes).
"""

from typing import NamedTuple

import numpy as np

from snrmjax.numerics.rules import BETWEEN_ZERO_AND_ONE, POSITIVE, InputError, require

_REACH = 12.0  # half bandwidths about resonance, the range searched for the peak
_POINTS = 4001
_FASTEST = 10.0  # largest normalised rate with a half-power width


class SweepBias(NamedTuple):
    """Apparent resonance of a sweep against the steady one."""

    normalised_rate: float  # η, 1
    peak_ratio: float  # of amplitudes
    frequency_shift: float  # rad/s, in the direction of the sweep
    damping_ratio: float  # apparent, from the half-power width


def sweep_bias(natural_frequency: float, damping_ratio: float, rate: float) -> SweepBias:
    """Apparent height, frequency and half-power damping in a sweep through a linear resonance.

    Arguments: `natural_frequency` in rad/s; `rate` dΩ/dt in rad/s² at resonance, negative
    downwards (a logarithmic sweep of R octaves/s has Ω R ln 2).
    Returns `SweepBias`. Raises `ValueError` for numbers that are not positive, or a rate that is
    not finite, and for η above 10, where the half-power width is not defined.
    Validity: one linear mode, lightly damped; within 2 % of a time integration below η = 1.

    >>> found = sweep_bias(2 * np.pi * 20, 0.01, 2 * np.pi * 0.02)
    >>> round(found.normalised_rate, 3), round(found.peak_ratio, 4)
    (0.125, 0.9972)
    """
    require("`natural_frequency`", natural_frequency, POSITIVE)
    require("`damping_ratio`", damping_ratio, BETWEEN_ZERO_AND_ONE)
    require("`rate` (rad/s²)", rate)
    half = damping_ratio * natural_frequency
    curvature = abs(rate) / half**2
    normalised = np.pi / 2 * curvature
    if normalised > _FASTEST:
        raise InputError(
            f"the sweep of {rate:g} rad/s² is too fast for a resonance peak: its normalised rate "
            f"is {normalised:.3g}, more than {_FASTEST:g}."
        )
    detuning = np.linspace(-_REACH, _REACH * (1 + curvature), _POINTS)
    amplitude = np.abs(_response(detuning, curvature))
    top = int(np.argmax(amplitude))
    shift, peak = _parabola(detuning[top - 1 : top + 2], amplitude[top - 1 : top + 2])
    level = peak / np.sqrt(2)
    above = np.flatnonzero(amplitude >= level)
    rise, fall = above[above <= top], above[above >= top]
    # From the peak outwards to the first crossing: the beats of the ring-down are ignored.
    left = rise[np.flatnonzero(np.diff(rise, prepend=rise[0] - 2) > 1)[-1]]
    right = fall[np.flatnonzero(np.diff(fall, append=fall[-1] + 2) > 1)[0]]
    width = (
        _crossing(detuning, amplitude, left - 1, level),
        _crossing(detuning, amplitude, right, level),
    )
    return SweepBias(
        float(normalised),
        float(peak),
        float(np.sign(rate) * shift * half),
        float(damping_ratio * (width[1] - width[0]) / 2),
    )


def sweep_bias_where_slow(
    natural_frequency: float, damping_ratio: float, rate: float
) -> SweepBias | None:
    """`sweep_bias`, or None for a sweep that is too fast for a peak."""
    curvature = abs(rate) / (damping_ratio * natural_frequency) ** 2
    if not np.pi / 2 * curvature <= _FASTEST:
        return None
    return sweep_bias(natural_frequency, damping_ratio, rate)


def _response(detuning: np.ndarray, curvature: float) -> np.ndarray:
    """Phasor over its steady peak, ∫₀^∞ exp(−(1 + ix)σ + iκσ²/2) dσ."""
    from scipy.special import wofz

    decay = 1 + 1j * detuning
    if curvature < 1e-9:
        return 1 / decay
    root = np.sqrt(-0.5j * curvature)
    return np.sqrt(np.pi) / (2 * root) * wofz(1j * decay / (2 * root))


def _parabola(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    a, b, c = np.polyfit(x - x[1], y, 2)
    return float(x[1] - b / (2 * a)), float(c - b**2 / (4 * a))


def _crossing(x: np.ndarray, y: np.ndarray, k: int, level: float) -> float:
    return float(x[k] + (level - y[k]) / (y[k + 1] - y[k]) * (x[k + 1] - x[k]))
