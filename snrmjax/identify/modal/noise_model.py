"""Errors of each line of a frequency response from the residuals of a fit."""

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from snrmjax.identify.modal.response_data import ResponseData

_FEWEST = 12  # numbers of a channel, below which its errors are one size
_SPREAD = 1e-4  # of the largest response: where the search for the errors' sizes begins
_SMALLEST = 1e-12  # of a channel's residuals: errors of responses without any


def std_from_residuals(
    data: ResponseData,
    residuals: Float[np.ndarray, "channel line"],
    fitted: Float[np.ndarray, "channel line"],
) -> Float[np.ndarray, "channel line"]:
    """1σ of each part by σ² = a² + b²|H|² of what was measured, a and b by maximum likelihood.

    Arguments: complex residuals and sizes of the fit, receptances; NaN where not measured.
    """
    size = data.measured_size
    found = np.full(residuals.shape, np.nan)
    for k in range(len(residuals)):
        good = np.isfinite(residuals[k])
        left = 0.5 * np.abs(residuals[k][good] * size[k][good]) ** 2
        model = (np.abs(fitted[k]) * size[k]) ** 2
        floor = max(_SMALLEST**2 * float(model[good].max()), float(np.mean(left)) * _SMALLEST)
        scale = float(np.mean(left)) + floor
        if 2 * good.sum() < _FEWEST:
            found[k] = np.sqrt(scale) / size[k]
            continue
        relative = model / np.mean(model[good])

        def unlikely(logs: np.ndarray, of: np.ndarray, at: np.ndarray) -> float:
            variance = np.exp(logs[0]) + np.exp(logs[1]) * at + _SPREAD**2
            return float(np.sum(np.log(variance) + of / variance))

        best = minimize(
            unlikely,
            np.log([0.5, 0.5]),
            args=(left / scale, relative[good]),
            method="L-BFGS-B",
            bounds=[(-20.0, 10.0)] * 2,
        )
        variance = np.exp(best.x[0]) + np.exp(best.x[1]) * relative + _SPREAD**2
        found[k] = np.sqrt(variance * scale) / size[k]
    return found
