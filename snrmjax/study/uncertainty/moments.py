"""Mean, deviation and 95 % range from derivatives, and how far first order can be trusted."""

import numpy as np
from jaxtyping import Float
from scipy import optimize, stats

from snrmjax.study.uncertainty.quantities import Quantities

STATISTICS = ("mean", "std", "lower", "upper")  # lower, upper: 2.5 and 97.5 % points
ERRORS = ("mean", "std", "range")
_TAILS = (0.025, 0.975)
_MEMBERS = 2**14  # of a quadratic, whose percentage points are read from them
_SCALES = np.geomspace(1e-3, 1e3, 121)

Statistics = Float[np.ndarray, "statistic quantity"]


def first_order(about: Quantities, scale: float = 1.0) -> Statistics:
    """Statistics of f₀ + gᵀz, z standard normal numbers times `scale`: normal."""
    spread = scale * np.linalg.norm(about.gradient, axis=1)
    reach = float(stats.norm.ppf(_TAILS[1])) * spread
    return np.stack([about.value, spread, about.value - reach, about.value + reach])


def second_order(about: Quantities) -> Statistics:
    """Statistics of f₀ + gᵀz + ½ zᵀHz, z standard normal numbers.

    The mean f₀ + ½ tr H and the variance gᵀg + ½ tr H² are exact; the percentage points are
    those of 2^14 members of a Sobol' sequence.
    """
    linear, quadratic = _members(about)
    ends = about.value + np.quantile(linear + quadratic, _TAILS, axis=0)
    return np.stack([*_exact(about, 1.0), *ends])


def first_order_error(first: Statistics, reference: Statistics) -> Float[np.ndarray, "error q"]:
    """By how much first order errs, relative to the reference's spread; a row of `ERRORS` each.

    Its mean in reference standard deviations; its standard deviation; and the farther end of its
    95 % range in half widths of the reference range.
    """
    spread, half_width = reference[1], 0.5 * (reference[3] - reference[2])
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.max(np.abs(first[2:] - reference[2:]), axis=0) / half_width
        mean = np.abs(first[0] - reference[0]) / spread
        return np.stack([mean, np.abs(first[1] / spread - 1), ends])


def scatter_limit(about: Quantities, error: float = 0.1) -> Float[np.ndarray, "error q"]:
    """The scale of all inputs' scatter from which first order errs by `error`, by second order.

    1 is the stated scatter; a row of `ERRORS` each. Found by Brent's method where the error first
    passes the value; infinite where it does not up to a scale of 1000.
    """
    linear, quadratic = _members(about)

    def excess(scale: float) -> Float[np.ndarray, "error q"]:
        mine = first_order(about, scale)
        # First order is sampled with the same members, so that the sequence's own error does not
        # count.
        ends = mine[2:] - np.quantile(scale * linear, _TAILS, axis=0)
        ends = ends + np.quantile(scale * linear + scale**2 * quadratic, _TAILS, axis=0)
        return first_order_error(mine, np.stack([*_exact(about, scale), *ends])) - error

    every = np.array([excess(float(scale)) for scale in _SCALES])
    result = np.full(every.shape[1:], np.inf)
    for row, q in np.argwhere((every > 0).any(axis=0)).tolist():
        k = int(np.argmax(every[:, row, q] > 0))
        if k == 0:
            result[row, q] = 0.0  # no gradient: first order errs at any scatter
            continue
        found = optimize.brentq(
            lambda log_scale, row=row, q=q: excess(float(np.exp(log_scale)))[row, q],
            *np.log(_SCALES[k - 1 : k + 1]).tolist(),
            xtol=1e-4,
        )
        result[row, q] = np.exp(found)
    return result


def _exact(about: Quantities, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the quadratic."""
    curvature = scale**2 * about.hessian
    mean = about.value + 0.5 * np.trace(curvature, axis1=1, axis2=2)
    square = scale**2 * np.sum(about.gradient**2, axis=1) + 0.5 * np.sum(curvature**2, axis=(1, 2))
    return mean, np.sqrt(square)


def _members(about: Quantities) -> tuple[np.ndarray, np.ndarray]:
    """Linear and quadratic part of members of the quadratic, of unit scatter."""
    n = about.gradient.shape[1]
    (seed,) = np.random.SeedSequence([0, 1]).spawn(1)
    sequence = stats.qmc.Sobol(n, rng=np.random.default_rng(seed))
    z = stats.qmc.MultivariateNormalQMC(np.zeros(n), engine=sequence).random(_MEMBERS)
    bends = [0.5 * np.einsum("mi,ij,mj->m", z, h, z, optimize=True) for h in about.hessian]
    return z @ about.gradient.T, np.stack(bends, axis=1)
