"""Autocorrelation of the residuals along a resonance, and the loss of independent states.

Independent noise averages out over many states, correlated residuals do not. They indicate a curve
that misses the data, or unsteady motion.
"""

import numpy as np
from jaxtyping import Float, Int

_CORRELATION_STDS = 4.0  # significance threshold, in 1σ of white noise's correlation
_FAR_BELOW_NOISE = 0.1  # of the noise: the correlation of smaller residuals is ignored
_LARGEST = 0.98  # upper bound of the correlation: (1 + ρ)/(1 − ρ) must stay finite


def states_of_levels(
    level: Int[np.ndarray, " state"], by: Float[np.ndarray, " state"]
) -> list[Int[np.ndarray, " index"]]:
    """Indices of the states of every level, sorted by frequency or any other values `by`."""
    order = np.argsort(by, kind="stable")
    return [order[level[order] == number] for number in np.unique(level)]


def residual_autocorrelation(
    residuals: Float[np.ndarray, "state part"], levels: list[Int[np.ndarray, " index"]]
) -> Float[np.ndarray, " part"]:
    """Autocorrelation at lag one of the residuals along their level, of both parts.

    Slow misfits under white noise have a small correlation at lag one but a long tail: the
    correlation of a first-order process with the same sum of correlations is used if larger.
    Zero where it is not significant, or where residuals are far below the noise.
    Arguments: whitened `residuals`; `levels` from `states_of_levels`.
    Reference: for truncating the sum at the first negative correlation, Geyer, Stat. Sci. 7 (1992)
    473, doi:10.1214/ss/1177011137.
    """
    correlations = []
    for part in residuals.T:
        neighbours, pairs = _correlation(part, levels, 1)
        if (
            neighbours * np.sqrt(pairs) <= _CORRELATION_STDS
            or np.mean(part**2) < _FAR_BELOW_NOISE**2
        ):
            correlations.append(0.0)
            continue
        total, lag, correlation = 1.0, 1, neighbours
        while correlation > 0:
            total, lag = total + 2 * correlation, lag + 1
            correlation = _correlation(part, levels, lag)[0]
        correlations.append(min(max(neighbours, (total - 1) / (total + 1)), _LARGEST))
    return np.array(correlations)


def independent_fraction(
    residuals: Float[np.ndarray, "state part"],
    level: Int[np.ndarray, " state"],
    frequency: Float[np.ndarray, " state"],
) -> float:
    """Effective fraction of independent states, from the residuals of a fit.

    n values of a first-order process with correlation ρ determine its mean as well as
    n(1 − ρ)/(1 + ρ) independent ones; mean over both parts, each scaled to unit variance.
    """
    rms = np.sqrt(np.mean(residuals**2, axis=0))
    levels = states_of_levels(level, frequency)
    correlation = residual_autocorrelation(residuals / rms, levels)
    return float(np.mean((1 - correlation) / (1 + correlation)))


def _correlation(
    residuals: Float[np.ndarray, " state"], levels: list[Int[np.ndarray, " index"]], lag: int
) -> tuple[float, int]:
    """Correlation of residuals at a lag, and the number of pairs.

    The sum is divided by that of all states, as usual (biased estimate): few pairs weigh little.
    """
    pairs = sum(max(len(some) - lag, 0) for some in levels)
    product = sum(float(residuals[a[:-lag]] @ residuals[a[lag:]]) for a in levels)
    square = float(residuals @ residuals)
    return (product / square if square > 0 else 0.0), pairs
