"""The posterior averaged over how much both curves bend.

Curves that bend and levels that differ often explain a test alike: the sizes of the bends are then
known to a factor of ten only, and the most likely ones say nothing of what curves the others give.
Reference: for a grid of hyperparameters about their mode, Rue, Martino & Chopin, J. R. Stat. Soc. B
71 (2009) 319, section 3.1, doi:10.1111/j.1467-9868.2008.00700.x.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.identify.test_model import priors
from snrmjax.identify.test_model.hyper import BENDS
from snrmjax.identify.test_model.linear_gaussian import Objective, laplace_evidence, maximised

_LEAST = 4.0  # nats below the likeliest, from which on sizes are left out


class Gaussian(NamedTuple):
    """What is said of the unknowns."""

    mean: Float[np.ndarray, " unknown"]
    covariance: Float[np.ndarray, "unknown unknown"]


class SizedPoint(NamedTuple):
    """Hyperparameters, likeliest for some sizes of the bends."""

    log_evidence: float  # integrated over the others
    point: Float[np.ndarray, " hyper"]


def sizes_of_bends(
    objective: Objective,
    likeliest: Float[np.ndarray, " hyper"],
    bounds: list[tuple[float, float]],
) -> list[SizedPoint]:
    """The points of a grid about the likeliest: from neighbour to neighbour, while they count."""
    step, (low, high) = priors.CURVE_BENDS.spread, np.transpose(bounds[BENDS])
    found: dict[tuple[int, int], SizedPoint] = {}
    queue = [((0, 0), likeliest)]
    while queue:
        (a, b), start = queue.pop(0)
        sizes = likeliest[BENDS] + step * np.array([a, b])
        if (a, b) in found or np.any((sizes < low - step / 2) | (sizes > high)):
            continue
        held, start = list(bounds), start.copy()
        start[BENDS] = np.maximum(sizes, low)
        held[BENDS] = [(size, size) for size in start[BENDS]]
        point = maximised(objective, start, held)
        one = SizedPoint(laplace_evidence(objective, point, held), point)
        found[a, b] = one
        if one.log_evidence > max(each.log_evidence for each in found.values()) - _LEAST:
            queue += [((a + i, b + j), point) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    return list(found.values())


def averaged(
    points: list[SizedPoint], posterior: Callable[[np.ndarray], Gaussian]
) -> tuple[Float[np.ndarray, " hyper"], Gaussian]:
    """The mean of the points, and mean and covariance of what each says of the unknowns."""
    weight = np.array([one.log_evidence for one in points])
    weight = np.exp(weight - weight.max())
    weight = weight / weight.sum()
    each = [posterior(one.point) for one in points]
    means = np.array([one.mean for one in each])
    mean = weight @ means
    within = np.einsum("k,kij->ij", weight, np.array([one.covariance for one in each]))
    off = means - mean
    point = weight @ np.array([one.point for one in points])
    return point, Gaussian(mean, within + (off * weight[:, None]).T @ off)
