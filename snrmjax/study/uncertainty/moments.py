"""Mean, deviation and 95 % range: from derivatives, and from members with their standard errors."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.study.uncertainty.quantities import Expansion

STATISTICS = ("mean", "std", "lower", "upper")  # lower, upper: 2.5 and 97.5 % points
ERRORS = ("mean", "std", "range")
_TAILS = (0.025, 0.975)
_POINTS: Literal["hazen"] = (
    "hazen"  # member k of n stands for the share (k − ½)/n, as in a stratified sample
)
_MEMBERS = 2**14  # of a quadratic, whose percentage points are read from them
_SCALES = np.geomspace(1e-3, 1e3, 121)

Statistics = Float[np.ndarray, "statistic quantity"]


class Sampled(NamedTuple):
    """Statistics of members, and 1σ of each."""

    statistics: Statistics
    standard_error: Statistics


def first_order(expansion: Expansion, scale: float = 1.0) -> Statistics:
    """Statistics of f₀ + gᵀz, z standard normal numbers times `scale`: normal."""
    from scipy import stats

    spread = scale * np.linalg.norm(expansion.gradient, axis=1)
    reach = float(stats.norm.ppf(_TAILS[1])) * spread
    value = np.asarray(expansion.value)
    return np.stack([value, spread, value - reach, value + reach])


def second_order(expansion: Expansion, scale: float = 1.0) -> Statistics:
    """Statistics of f₀ + gᵀz + ½ zᵀHz, z standard normal numbers times `scale`.

    The mean f₀ + ½ tr H and the variance gᵀg + ½ tr H² are exact; the percentage points are
    those of 2^14 members of a Sobol' sequence.
    """
    linear, quadratic = _quadratic_members(expansion)
    curvature = scale**2 * np.asarray(expansion.hessian)
    mean = expansion.value + 0.5 * np.trace(curvature, axis1=1, axis2=2)
    square = scale**2 * np.sum(expansion.gradient**2, axis=1) + 0.5 * np.sum(
        curvature**2, axis=(1, 2)
    )
    members = scale * linear + scale**2 * quadratic
    lower, upper = expansion.value + np.quantile(members, _TAILS, axis=0)
    return np.stack([mean, np.sqrt(square), lower, upper])


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


def scatter_limit(expansion: Expansion, error: float = 0.1) -> Float[np.ndarray, "error q"]:
    """The scale of all inputs' scatter from which first order errs by `error`, by second order.

    1 is the stated scatter; a row of `ERRORS` each. Found by Brent's method where the error first
    passes the value; infinite where it does not up to a scale of 1000.
    """
    from scipy import optimize

    linear, quadratic = _quadratic_members(expansion)
    result = np.full((len(ERRORS), len(expansion.value)), np.inf)
    for q in range(len(expansion.value)):
        alone = Expansion(*(np.asarray(part)[q : q + 1] for part in expansion))

        def excess(log_scale: float, row: int, q: int = q, alone: Expansion = alone) -> float:
            scale = float(np.exp(log_scale))
            mine, reference = first_order(alone, scale), second_order_alone(scale, q, alone)
            return float(first_order_error(mine, reference)[row, 0]) - error

        def second_order_alone(scale: float, q: int, alone: Expansion) -> Statistics:
            # As `second_order`, with members that are computed once. First order is sampled with
            # the same ones, so that the sequence's own error does not count.
            spread = np.linalg.norm(alone.gradient[0])
            curvature = alone.hessian[0]
            mean = alone.value + 0.5 * scale**2 * np.trace(curvature)
            square = scale**2 * spread**2 + 0.5 * scale**4 * np.sum(curvature**2)
            parts = scale * linear[:, q], scale**2 * quadratic[:, q]
            normal = first_order(alone, scale)[2:, 0] - np.quantile(parts[0], _TAILS)
            ends = normal + np.quantile(parts[0] + parts[1], _TAILS)
            return np.array([mean, [np.sqrt(square)], *ends[:, None]])

        for row in range(len(ERRORS)):
            values = [excess(float(s), row) for s in np.log(_SCALES)]
            above = np.flatnonzero(np.array(values) > 0)
            if above.size and above[0] > 0:
                k = above[0]
                bracket = np.log(_SCALES[k - 1 : k + 1]).tolist()
                result[row, q] = np.exp(optimize.brentq(excess, *bracket, args=(row,), xtol=1e-4))
            elif above.size:
                result[row, q] = 0.0  # no gradient: first order errs at any scatter
    return result


def members_statistics(values: Float[np.ndarray, "member quantity"]) -> Statistics:
    """Statistics of members; NaN where fewer than two have a value."""
    columns = []
    for column in np.asarray(values).T:
        known = column[np.isfinite(column)]
        if known.size < 2:
            columns.append(np.full(len(STATISTICS), np.nan))
            continue
        ends = np.quantile(known, _TAILS, method=_POINTS)
        columns.append(np.array([known.mean(), known.std(ddof=1), *ends]))
    return np.array(columns).T


def monte_carlo(values: Float[np.ndarray, "member quantity"]) -> Sampled:
    """Statistics of independent members.

    The standard errors are s/√n of the mean, that by the fourth moment of the standard deviation,
    and Maritz and Jarrett's of the percentage points.
    """
    from scipy import stats

    found = members_statistics(values)
    errors = np.full_like(found, np.nan)
    for k, column in enumerate(np.asarray(values).T):
        known = column[np.isfinite(column)]
        if known.size > 3:
            spread, n = known.std(ddof=1), known.size
            kurtosis = float(stats.kurtosis(known)) if spread > 0 else 0.0
            of_std = spread * np.sqrt(max(kurtosis + 2, 0.0) / (4 * n))
            ends = stats.mstats.mjci(known, prob=list(_TAILS))
            errors[:, k] = [spread / np.sqrt(n), of_std, *ends]
    return Sampled(found, errors)


def quasi_monte_carlo(values: Float[np.ndarray, "scrambling member quantity"]) -> Sampled:
    """Statistics of a Sobol' sequence, with standard errors from its independent scramblings.

    Percentage points are the means of those of the scramblings.
    """
    each = np.stack([members_statistics(one) for one in values])
    error = np.std(each, axis=0, ddof=1) / np.sqrt(len(values))
    together = members_statistics(values.reshape(-1, values.shape[-1]))
    # Together the members are no longer one to an interval: points of each scrambling are better.
    together[2:] = np.mean(each[:, 2:], axis=0)
    return Sampled(together, error)


def normal_members(n: int, n_inputs: int, seed: int) -> Float[np.ndarray, "member input"]:
    """Independent standard normal numbers."""
    return np.random.default_rng([seed, 0]).standard_normal((n, n_inputs))


def sobol_members(
    n: int, n_inputs: int, n_scramblings: int, seed: int
) -> Float[np.ndarray, "scrambling member input"]:
    """Standard normal numbers of a Sobol' sequence, `n` in each of independent scramblings."""
    from scipy.stats import qmc

    seeds = np.random.SeedSequence([seed, 1]).spawn(n_scramblings)
    normal = (
        qmc.MultivariateNormalQMC(
            np.zeros(n_inputs), engine=qmc.Sobol(n_inputs, seed=np.random.default_rng(own))
        )
        for own in seeds
    )
    return np.stack([sequence.random(n) for sequence in normal])


def expanded_members(
    expansion: Expansion, z: Float[np.ndarray, "member input"]
) -> tuple[Float[np.ndarray, "member quantity"], Float[np.ndarray, "member quantity"]]:
    """First and second order of every member: f₀ + gᵀz, and with ½ zᵀHz."""
    first = expansion.value + z @ np.asarray(expansion.gradient).T
    bends = [0.5 * np.einsum("mi,ij,mj->m", z, h, z, optimize=True) for h in expansion.hessian]
    return first, first + np.stack(bends, axis=1)


def _quadratic_members(expansion: Expansion) -> tuple[np.ndarray, np.ndarray]:
    """Linear and quadratic part of members of the quadratic, of unit scatter."""
    (z,) = sobol_members(_MEMBERS, expansion.gradient.shape[1], 1, seed=0)
    first, second = expanded_members(expansion, z)
    return first - expansion.value, second - first
