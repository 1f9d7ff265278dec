"""Estimates of unrecorded phases from smooth curves with the recorded amplitudes.

A state without a phase still has the magnitude of its dynamic stiffness, |Z| = FA/|X|. Curves of
stiffness and damping that deviate smoothly from the model's are fitted to all magnitudes, with
states of similar amplitude at several frequencies; their phases are those of the states.
"""

import numpy as np
from jaxtyping import Complex, Float
from scipy.optimize import least_squares

_POWERS = (1.0, 2.0, 4.0)  # of the amplitude over the largest, basis of the curves
_STIFFNESS, _DAMPING = 0.3, 1.0  # 1σ of their coefficients: relative, and of the logarithm
_LINEAR = 0.02  # 1σ of the linear stiffness, relative
_ERROR = 0.01  # of a magnitude, relative
_STARTS = (0.0, -0.1, 0.1, -0.02, 0.02)  # relative change of stiffness at the largest amplitude


def likely_dynamic_stiffness(
    magnitude: Float[np.ndarray, " state"],
    model: Complex[np.ndarray, " state"],
    amplitude: Float[np.ndarray, " state"],
    natural_frequency: float,
) -> Complex[np.ndarray, " state"]:
    """Dynamic stiffness of states with known magnitude and estimated phase.

    Arguments: `magnitude`: |Z|; `model`: the model's Z at the states' amplitudes and frequencies,
    both in 1/s²; `amplitude`: in any unit; `natural_frequency`: in rad/s.
    Returns Z in 1/s² with the phase of the curves of best fit.
    """
    x = amplitude / np.max(amplitude)
    powers = np.array([x**power for power in _POWERS]).T
    n = len(_POWERS)

    def curves(unknown: np.ndarray) -> np.ndarray:
        stiffness = unknown[0] + powers @ unknown[1 : n + 1]
        damping = np.exp(unknown[n + 1] + powers @ unknown[n + 2 :])
        return model.real + natural_frequency**2 * stiffness + 1j * model.imag * damping

    std = np.array([_LINEAR, *[_STIFFNESS] * n, *[_DAMPING] * (n + 1)])

    def rows(unknown: np.ndarray) -> np.ndarray:
        residual = np.log(np.abs(curves(unknown)) / magnitude) / _ERROR
        return np.concatenate([residual, unknown / std])

    fits = []
    for change in _STARTS:
        start = np.zeros(2 * n + 2)
        start[2] = change
        fits.append(least_squares(rows, start, x_scale=std))
    best = curves(min(fits, key=lambda fit: fit.cost).x)
    return magnitude * best / np.abs(best)
