"""Phases that a test did not record: those of smooth curves that have the recorded amplitudes.

A state without a phase still has the size of its dynamic stiffness, |Z| = FA/|X|. Curves of
stiffness and damping that depart smoothly from the model's explain all sizes at once, for states of
one amplitude at several frequencies; they give every state the phase that it must have had.
"""

import numpy as np
from jaxtyping import Complex, Float
from scipy.optimize import least_squares

_POWERS = (1.0, 2.0, 4.0)  # of the amplitude over the largest, that curves are made of
_STIFFNESS, _DAMPING = 0.3, 1.0  # 1σ of their coefficients: relative, and of the logarithm
_LINEAR = 0.02  # 1σ of the linear stiffness, relative
_ERROR = 0.01  # of a size, relative
_STARTS = (0.0, -0.1, 0.1, -0.02, 0.02)  # relative change of stiffness at the largest amplitude


def likely_dynamic_stiffness(
    size: Float[np.ndarray, " state"],
    model: Complex[np.ndarray, " state"],
    amplitude: Float[np.ndarray, " state"],
    natural_frequency: float,
) -> Complex[np.ndarray, " state"]:
    """Dynamic stiffness of states of which its size is known.

    Arguments: `size` |Z|, `model` the model's Z at the states' amplitudes and frequencies, both in
    1/s²; `amplitude` in any unit; `natural_frequency` in rad/s.
    Returns Z in 1/s² with the phase of the curves that explain all sizes best.
    """
    x = amplitude / np.max(amplitude)
    powers = np.array([x**power for power in _POWERS]).T
    n = len(_POWERS)

    def curves(unknown: np.ndarray) -> np.ndarray:
        stiffer = unknown[0] + powers @ unknown[1 : n + 1]
        lossier = np.exp(unknown[n + 1] + powers @ unknown[n + 2 :])
        return model.real + natural_frequency**2 * stiffer + 1j * model.imag * lossier

    spread = np.array([_LINEAR, *[_STIFFNESS] * n, *[_DAMPING] * (n + 1)])

    def rows(unknown: np.ndarray) -> np.ndarray:
        missed = np.log(np.abs(curves(unknown)) / size) / _ERROR
        return np.concatenate([missed, unknown / spread])

    fits = []
    for change in _STARTS:
        start = np.zeros(2 * n + 2)
        start[2] = change
        fits.append(least_squares(rows, start, x_scale=spread))
    best = curves(min(fits, key=lambda fit: fit.cost).x)
    return size * best / np.abs(best)
