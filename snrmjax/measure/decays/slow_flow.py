"""The slow flow of one mode: rates of amplitude and phase as functions of the amplitude alone.

d ln A/dt = Σ d_j A^j and dφ/dt = Σ w_j A^j, j = −1…: dry friction (−1), viscous damping (0),
damping by v|v| (1), cubic and quintic forces (2, 4) and those in between. Integrated along the
decay they are columns of a linear least-squares problem for ln A and φ; Schwarz' criterion selects
their number. A beat, in which frequency and amplitude oscillate during the decay, is not in their
span, so that the residual contains interfering modes, noise and errors of the reading.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from numpy.polynomial import chebyshev
from scipy.interpolate import CubicSpline

from snrmjax.numerics.rules import InputError

_FEWEST, _MOST = 3, 9  # number of functions of the amplitude: the first is 1/A
_ROUNDS = 5
_LEAST = 0.02  # of the largest amplitude, below which 1/A is constant


class SlowFlow(NamedTuple):
    """The smooth decay at the times of a reading."""

    level: Complex[np.ndarray, " k"]  # ln amplitude + i phase
    rate: Complex[np.ndarray, " k"]  # −decay + iω
    rate_derivative: Complex[np.ndarray, " k"]
    deviation: Complex[np.ndarray, " k"]  # reading over smooth decay, minus one


def slow_flow(
    time: Float[np.ndarray, " k"],
    level: Complex[np.ndarray, " k"],
    weight: Float[np.ndarray, " k"],
    independent: float,
) -> SlowFlow:
    """Fit the smooth decay to readings `level` with weights (1/σ of ln A and φ).

    `independent` is the number of independent readings, for the criterion.
    """
    scaled = (time - time.mean()) / max(float(np.ptp(time)), 1e-300)
    start = np.polyval(np.polyfit(scaled, level.real, min(3, len(time) - 1), w=weight), scaled)
    best, least = None, np.inf
    for terms in range(_FEWEST, _MOST + 1):
        if terms + 1 > independent and best is not None:
            break
        flow, square = _fitted(time, level, weight, start, terms)
        score = 2 * independent * np.log(square) + 2 * (terms + 1) * np.log(2 * independent)
        if score < least:
            best, least = flow, score
    if best is None:
        raise InputError("the decay is too short for a smooth curve.")
    return best


def _fitted(
    time: np.ndarray, level: np.ndarray, weight: np.ndarray, smooth: np.ndarray, terms: int
) -> tuple[SlowFlow, float]:
    """The smooth decay with some functions of the amplitude, and its mean square residual."""
    target = np.stack([level.real, level.imag], axis=1) * weight[:, None]
    for _ in range(_ROUNDS):
        amplitude = np.exp(smooth - smooth.max())
        bounded = np.maximum(amplitude, _LEAST)
        polynomials = chebyshev.chebvander(2 * amplitude - 1, terms - 2)
        rates = np.concatenate([1 / bounded[:, None], polynomials], axis=1)
        integrals = CubicSpline(time, rates).antiderivative()(time)
        design = np.concatenate([np.ones((len(time), 1)), integrals], axis=1) * weight[:, None]
        norm = np.linalg.norm(design, axis=0)
        coefficients = np.linalg.lstsq(design / norm, target, rcond=1e-9)[0] / norm[:, None]
        fitted = design / weight[:, None] @ coefficients
        smooth = np.minimum(fitted[:, 0], fitted[0, 0] + 1.0)
    flow = fitted[:, 0] + 1j * fitted[:, 1]
    rate = rates @ (coefficients[1:, 0] + 1j * coefficients[1:, 1])
    derivative = CubicSpline(time, rate).derivative()(time)
    square = float(np.mean((design @ coefficients - target) ** 2))
    return SlowFlow(flow, rate, derivative, np.exp(level - flow) - 1), square
