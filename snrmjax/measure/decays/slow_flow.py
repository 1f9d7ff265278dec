"""The smooth decay of one mode: rates of amplitude and phase as functions of the amplitude alone.

d ln A/dt = Σ d_j A^j and dφ/dt = Σ w_j A^j, j = −1…: dry friction (−1), viscous damping (0),
damping by v|v| (1), cubic and quintic forces (2, 4) and what lies between. Integrated along the
decay they are columns of a linear least squares for ln A and φ, and Schwarz' criterion says how
many. One mode can follow few other curves: a beat, at which frequency and amplitude swing while
the amplitude falls, is not among them, so that what they leave is company, noise and error of the
reading.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from numpy.polynomial import chebyshev
from scipy.interpolate import CubicSpline

_FEWEST, _MOST = 3, 9  # functions of the amplitude: the first is 1/A
_ROUNDS = 5
_LEAST = 0.02  # of the largest amplitude, below which 1/A is held


class SlowFlow(NamedTuple):
    """The smooth decay at the instants of a reading."""

    level: Complex[np.ndarray, " k"]  # ln amplitude + i phase
    rate: Complex[np.ndarray, " k"]  # −decay + iω
    bend: Complex[np.ndarray, " k"]  # its derivative
    off: Complex[np.ndarray, " k"]  # reading over smooth decay, less one


def slow_flow(
    time: Float[np.ndarray, " k"],
    level: Complex[np.ndarray, " k"],
    weight: Float[np.ndarray, " k"],
    independent: float,
) -> SlowFlow:
    """Fit the smooth decay to readings `level` with weights (1/σ of ln A and φ).

    `independent` is how many of the readings are, for the criterion.
    """
    away = (time - time.mean()) / max(float(np.ptp(time)), 1e-300)
    start = np.polyval(np.polyfit(away, level.real, min(3, len(time) - 1), w=weight), away)
    best, least = None, np.inf
    for terms in range(_FEWEST, _MOST + 1):
        if terms + 1 > independent and best is not None:
            break
        flow, square = _fitted(time, level, weight, start, terms)
        score = 2 * independent * np.log(square) + 2 * (terms + 1) * np.log(2 * independent)
        if score < least:
            best, least = flow, score
    if best is None:
        raise ValueError("the decay is too short for a smooth curve.")
    return best


def _fitted(
    time: np.ndarray, level: np.ndarray, weight: np.ndarray, smooth: np.ndarray, terms: int
) -> tuple[SlowFlow, float]:
    """The smooth decay of some functions of the amplitude, and what it leaves."""
    target = np.stack([level.real, level.imag], axis=1) * weight[:, None]
    for _ in range(_ROUNDS):
        size = np.exp(smooth - smooth.max())
        held = np.maximum(size, _LEAST)
        smoothly = chebyshev.chebvander(2 * size - 1, terms - 2)
        rates = np.concatenate([1 / held[:, None], smoothly], axis=1)
        grown = CubicSpline(time, rates).antiderivative()(time)
        design = np.concatenate([np.ones((len(time), 1)), grown], axis=1) * weight[:, None]
        length = np.linalg.norm(design, axis=0)
        solved = np.linalg.lstsq(design / length, target, rcond=1e-9)[0] / length[:, None]
        fitted = design / weight[:, None] @ solved
        smooth = np.minimum(fitted[:, 0], fitted[0, 0] + 1.0)
    flow = fitted[:, 0] + 1j * fitted[:, 1]
    rate = rates @ (solved[1:, 0] + 1j * solved[1:, 1])
    bend = CubicSpline(time, rate).derivative()(time)
    left = float(np.mean((design @ solved - target) ** 2))
    return SlowFlow(flow, rate, bend, np.exp(level - flow) - 1), left
