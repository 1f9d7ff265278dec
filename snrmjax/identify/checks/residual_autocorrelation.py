"""Autocorrelation of the residuals along a resonance, and what it adds to a band.

Independent noise averages out over many states, correlated residuals do not. They are left by a
curve that the data do not follow, or by a motion that was not steady.
"""

import numpy as np
from jaxtyping import Float, Int

_CORRELATION_STDS = (
    4.0  # standard deviations of white noise's correlation, beyond which one is real
)
_FAR_BELOW_NOISE = 0.1  # of the noise: the correlation of smaller residuals does not count
_LARGEST = 0.98  # correlation: an estimate may exceed what a band can be widened by


def states_of_levels(
    level: Int[np.ndarray, " state"], by: Float[np.ndarray, " state"]
) -> list[Int[np.ndarray, " place"]]:
    """The states of every level, in the order of their frequencies, or of what else is given."""
    order = np.argsort(by, kind="stable")
    return [order[level[order] == number] for number in np.unique(level)]


def residual_autocorrelation(
    residuals: Float[np.ndarray, "state part"], levels: list[Int[np.ndarray, " place"]]
) -> Float[np.ndarray, " part"]:
    """Autocorrelation at lag one of the residuals along their level, of both parts.

    Under noise of its own, slow misfits have a smaller correlation at lag one than at larger lags:
    that of a first-order process with the same sum of correlations counts if it is larger.
    Zero where white noise may well have it, or residuals are far below the noise.
    Arguments: whitened `residuals`; `levels` from `states_of_levels`.
    Reference: for the sum up to the first negative one, Geyer, Stat. Sci. 7 (1992) 473,
    doi:10.1214/ss/1177011137.
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


def fraction_told_by(
    residuals: Float[np.ndarray, "state part"],
    level: Int[np.ndarray, " state"],
    frequency: Float[np.ndarray, " state"],
) -> float:
    """Share of the states that tell something of their own, by what a fit leaves of them.

    n values of a first-order process with correlation ρ tell its mean as well as n(1 − ρ)/(1 + ρ)
    independent ones; the mean of both parts counts, whatever the size of the residuals is.
    """
    size = np.sqrt(np.mean(residuals**2, axis=0))
    levels = states_of_levels(level, frequency)
    correlation = residual_autocorrelation(residuals / size, levels)
    return float(np.mean((1 - correlation) / (1 + correlation)))


def _correlation(
    residuals: Float[np.ndarray, " state"], levels: list[Int[np.ndarray, " place"]], lag: int
) -> tuple[float, int]:
    """Correlation of residuals so many states apart, and the pairs that tell it.

    The sum is divided by all states, as is usual: few pairs far apart weigh little.
    """
    pairs = sum(max(len(some) - lag, 0) for some in levels)
    product = sum(float(residuals[a[:-lag]] @ residuals[a[lag:]]) for a in levels)
    square = float(residuals @ residuals)
    return (product / square if square > 0 else 0.0), pairs
