"""Noise that neighbouring states show, whatever is wrong with the model."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.checks.patterns import along
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit

_TOLERATED = 1.7  # variance over the stated one that neighbouring states may show


class NeighbourNoise(NamedTuple):
    """Noise that neighbouring states show."""

    variance: float  # over the stated one
    std: float  # 1σ of the variance


def neighbour_noise(misfit: WeightedMisfit, fit: EffectFit) -> NeighbourNoise:
    """Variance of the force's misfit by second differences along every level.

    What varies smoothly from state to state, explained or not, does not enter; errors that states
    share are taken out first. Where phases are those of the fit, which may be wrong, the order of
    the test counts too: noise is smooth in neither.
    """
    left = misfit.noise.without_shared(fit.rows)
    unsure = misfit.predictions.chosen.phase_unknown.any()
    return min(_scatter(misfit, left, of_test=k) for k in ((False, True) if unsure else (False,)))


def _scatter(
    misfit: WeightedMisfit, left: Float[np.ndarray, " row"], *, of_test: bool
) -> NeighbourNoise:
    """Variance by second differences in one order of the states."""
    squares = [
        (some[:-2] - 2 * some[1:-1] + some[2:]) ** 2 / 6
        for some in along(misfit, left, of_test=of_test)
        if len(some) > 2
    ]
    if not squares:
        return NeighbourNoise(1.0, np.inf)
    every = np.concatenate(squares)
    # Jumps and kinks are not noise: beyond four times the median's 1σ they are cut off.
    limit = 16 * np.median(every) / 0.4549
    # Neighbouring differences share states: about half as many are independent.
    value = float(np.mean(np.minimum(every, limit)))
    return NeighbourNoise(value, value * float(np.sqrt(2 / (0.51 * len(every)))))


def tolerated(noise: float) -> float:
    """Variance that counts as noise: stated a little too small it is no sign of further physics."""
    return float(np.clip(noise, 1.0, _TOLERATED))
