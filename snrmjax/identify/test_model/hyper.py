"""Hyperparameters of a test (1σ of noise, level errors, roughness), and the layout of its unknowns.

Rough curves and differing levels often explain a test equally well: the 1σ of the roughness is then
known to a factor of ten only, and its most likely value alone gives too narrow bands. `averaged`
averages over a grid of it.
Reference: for a grid of hyperparameters about their mode, Rue, Martino & Chopin, J. R. Stat. Soc. B
71 (2009) 319, section 3.1, doi:10.1111/j.1467-9868.2008.00700.x.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.identify.test_model import priors
from snrmjax.identify.test_model.curve_terms import CurveTerms
from snrmjax.identify.test_model.linear_gaussian import (
    LinearRows,
    Objective,
    laplace_evidence,
    maximised,
)
from snrmjax.identify.test_model.states import TestStates

_STRAIGHT = 1e-4  # 1σ of the roughness: no test resolves less
_SMALLEST_STD = 1e-4  # of a prior's scale: lower bound of a 1σ
_FARTHEST = 5.0  # 1σ: bound of the variation of the roughness
_MOST = 0.5  # upper bound of 1σ of level errors, relative or rad: more is another structure
_LEAST = 4.0  # nats below the most likely grid point: points below are not expanded
ALONG = 14  # basis functions of a discrepancy, for each of the two parts


# Indices of the unknowns that all states share; the last two are the frequency exponents.
MASS, PHASE, OFFSET, TREND, WITH_FREQUENCY = 0, 1, 2, 3, slice(4, 6)


class Hyper(NamedTuple):
    """The hyperparameters of a test."""

    noise: float  # over the stated noise, or relative where none is stated
    roughness: tuple[float, float]  # 1σ of both curves' roughness, in the curves' units
    level_std: tuple[float, float, float, float]  # of `LEVEL_ERRORS`
    along: Float[np.ndarray, " direction"]  # variation of the log of that 1σ along the curve
    discrepancy: tuple[float, float]  # 1σ of both parts, over Ωδ


class Layout(NamedTuple):
    """Indices of the unknowns, and the squared frequency that stiffness is relative to.

    First the modal mass, the instruments' phase, the force offset, the trend of the stiffness, and
    the exponents of both curves in the forcing frequency.
    """

    stiffness: slice
    damping: slice
    levels: np.ndarray  # (level, error)
    discrepancy: tuple[slice, slice]  # in phase with the motion and in quadrature
    reference: float
    others: slice  # linear parameters of the other modes, in their own 1σ

    @property
    def both_discrepancies(self) -> slice:
        """Both parts of a discrepancy."""
        return slice(self.discrepancy[0].start, self.discrepancy[1].stop)


Pair = tuple[CurveTerms, CurveTerms]


def layout_of(
    terms: Pair, n_levels: int, discrepancy: bool, reference: float, n_others: int = 0
) -> Layout:
    """The layout for these numbers of levels and of parameters of other modes."""
    start = WITH_FREQUENCY.stop
    middle = start + terms[0].n_functions
    first = middle + terms[1].n_functions
    levels = first + np.arange(4 * n_levels).reshape(n_levels, 4)
    end, wide = first + 4 * n_levels, ALONG * discrepancy
    two = slice(end, end + wide), slice(end + wide, end + 2 * wide)
    others = slice(end + 2 * wide, end + 2 * wide + n_others)
    return Layout(slice(start, middle), slice(middle, first), levels, two, reference, others)


# Order of a vector of hyperparameters, all logarithms of 1σ: noise, roughness of both curves, four
# level errors, variation of the roughness along the curves, and two discrepancies where present.
NOISE, ROUGHNESS, LEVELS, FIRST_ALONG = 0, slice(1, 3), slice(3, 7), 7


def end_of_along(terms: Pair) -> int:
    """End of the entries for the variation of the roughness."""
    return FIRST_ALONG + terms[0].basis.directions.shape[1]


def hyper_at(point: np.ndarray, terms: Pair) -> Hyper:
    """The hyperparameters of a vector of their logarithms."""
    end = end_of_along(terms)
    noise, first, second, *levels = np.exp(point[:FIRST_ALONG]).tolist()
    more = np.exp(point[end:]).tolist() or (0.0, 0.0)
    return Hyper(
        noise,
        (first, second),
        (levels[0], levels[1], levels[2], levels[3]),
        point[FIRST_ALONG:end],
        (more[0], more[1]),
    )


def point_of(hyper: Hyper) -> np.ndarray:
    """The vector of these hyperparameters, without a discrepancy."""
    log_stds = np.log([hyper.noise, *hyper.roughness, *hyper.level_std])
    return np.concatenate([log_stds, hyper.along])


def starting_point(states: TestStates, terms: Pair, discrepancy: bool) -> np.ndarray:
    """Starting point of the maximisation."""
    noise = priors.STATED_NOISE if states.stated else priors.UNSTATED_NOISE
    levels = [
        std if std > 0 else 0.3 * prior.scale
        for std, prior in zip(states.level_std, priors.LEVELS, strict=True)
    ]
    more = [0.3 * priors.DISCREPANCY.scale] * (2 * discrepancy)
    log_stds = np.log([noise.median, *[priors.CURVE_ROUGHNESS.median] * 2, *levels])
    return np.concatenate([log_stds, np.zeros(end_of_along(terms) - FIRST_ALONG), np.log(more)])


def bounds_of(states: TestStates, terms: Pair, point: np.ndarray) -> list[tuple[float, float]]:
    """Bounds of the hyperparameters: stated ones are fixed, and so is the roughness of none."""
    low = np.log(_STRAIGHT)
    roughness = [(np.log(1e-7), np.log(2.0)) if one.smooth else (low, low) for one in terms]
    noise = (np.log(0.02), np.log(1e6)) if states.stated else (np.log(1e-5), np.log(1.0))
    levels = []
    for stated, prior in zip(states.level_std, priors.LEVELS, strict=True):
        fixed = np.log(stated) if stated > 0 else None
        wide = (np.log(_SMALLEST_STD * prior.scale), np.log(_MOST))
        levels.append(wide if fixed is None else (fixed, fixed))
    n = end_of_along(terms) - FIRST_ALONG
    n_more = len(point) - FIRST_ALONG - n
    more = [(np.log(_SMALLEST_STD * priors.DISCREPANCY.scale), 0.0)] * n_more
    return [noise, *roughness, *levels, *[(-_FARTHEST, _FARTHEST)] * n, *more]


class PriorVariances(NamedTuple):
    """Prior variances of all unknowns; their logarithms are linear in the hyperparameters.

    An unknown fixed at zero has −∞.
    """

    constant: Float[np.ndarray, " unknown"]
    slopes: Float[np.ndarray, "unknown hyper"]

    def __call__(self, point: Float[np.ndarray, " hyper"]) -> Float[np.ndarray, " unknown"]:
        """The variances at these hyperparameters."""
        return np.exp(self.constant + self.slopes @ point)


def prior_variances(terms: Pair, layout: Layout, states: TestStates) -> PriorVariances:
    """Prior variances of a test's unknowns."""
    n, end = layout.others.stop, end_of_along(terms)
    has_discrepancy = layout.discrepancy[0].stop > layout.discrepancy[0].start
    constant, slopes = np.zeros(n), np.zeros((n, end + 2 * has_discrepancy))
    stds = (states.mass_std, states.phase_std, states.offset_std, states.trend_std)
    with np.errstate(divide="ignore"):
        constant[: WITH_FREQUENCY.stop] = 2 * np.log([*stds, *states.off_resonance_std])
    for k, functions in enumerate((layout.stiffness, layout.damping)):
        constant[functions], by = terms[k].log_variances()
        slopes[functions, ROUGHNESS.start + k], slopes[functions, FIRST_ALONG:end] = (
            by[:, 0],
            by[:, 1:],
        )
    for k in range(4):
        slopes[layout.levels[:, k], LEVELS.start + k] = 2.0
    for k in range(2 * has_discrepancy):
        slopes[layout.discrepancy[k], end + k] = 2.0
    return PriorVariances(constant, slopes)


def objective_of(
    equations: LinearRows,
    states: TestStates,
    terms: Pair,
    layout: Layout,
    *,
    flat: bool = False,
    free_roughness: tuple[bool, bool] = (True, True),
) -> Objective:
    """Log of likelihood times prior; with `flat` without the priors of level errors, and without
    the roughness prior of curves that are not `free_roughness`.
    """
    noise = priors.STATED_NOISE if states.stated else priors.UNSTATED_NOISE
    variances = prior_variances(terms, layout, states)
    n = variances.slopes.shape[1]
    of_levels = [
        None if stated > 0 or flat else prior
        for stated, prior in zip(states.level_std, priors.LEVELS, strict=True)
    ]
    along = [priors.ROUGHNESS_VARIES] * (end_of_along(terms) - FIRST_ALONG)
    roughness = [
        priors.CURVE_ROUGHNESS if one.smooth and kept else None
        for one, kept in zip(terms, free_roughness, strict=True)
    ]
    densities = [noise, *roughness, *of_levels, *along, *[priors.DISCREPANCY] * 2]
    prior = priors.JointDensity.of(densities[:n])

    def value(point: np.ndarray) -> tuple[float, np.ndarray]:
        likelihood, by_noise, by_variance = equations.log_likelihood(
            np.exp(point[NOISE]), variances(point)
        )
        density, slopes = prior.log_density(point)
        slopes += by_variance @ variances.slopes
        slopes[NOISE] += by_noise
        return likelihood + density, slopes

    return value


class Gaussian(NamedTuple):
    """Gaussian posterior of the unknowns."""

    mean: Float[np.ndarray, " unknown"]
    covariance: Float[np.ndarray, "unknown unknown"]
    effective_unknowns: float  # number that the states, not the priors, determine
    level_std: Float[np.ndarray, " error"]  # 1σ of level errors in the covariance


class GridPoint(NamedTuple):
    """Most likely hyperparameters for fixed roughness of both curves."""

    log_evidence: float  # integrated over the other hyperparameters
    point: Float[np.ndarray, " hyper"]


def roughness_grid(
    objective: Objective,
    mode: Float[np.ndarray, " hyper"],
    bounds: list[tuple[float, float]],
) -> list[GridPoint]:
    """Points of a grid of roughness about the most likely, expanded while the evidence counts."""
    step, low = priors.CURVE_ROUGHNESS.spread, np.log(_STRAIGHT)
    middle, high = np.maximum(mode[ROUGHNESS], low), np.transpose(bounds[ROUGHNESS])[1]
    grid: dict[tuple[int, int], GridPoint] = {}
    queue = [((0, 0), mode)]
    while queue:
        (a, b), start = queue.pop(0)
        log_stds = middle + step * np.array([a, b])
        if (a, b) in grid or np.any((log_stds < low - step / 2) | (log_stds > high)):
            continue
        fixed, start = list(bounds), start.copy()
        start[ROUGHNESS] = np.maximum(log_stds, low)
        fixed[ROUGHNESS] = [(value, value) for value in start[ROUGHNESS]]
        point = maximised(objective, start, fixed)
        here = GridPoint(laplace_evidence(objective, point, fixed), point)
        grid[a, b] = here
        if here.log_evidence > max(other.log_evidence for other in grid.values()) - _LEAST:
            queue += [((a + i, b + j), point) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    return list(grid.values())


def averaged(
    points: list[GridPoint], posterior: Callable[[np.ndarray], Gaussian]
) -> tuple[Float[np.ndarray, " hyper"], Gaussian]:
    """The mean hyperparameters, and mean and covariance of the mixture of posteriors."""
    weight = np.array([point.log_evidence for point in points])
    weight = np.exp(weight - weight.max())
    weight = weight / weight.sum()
    each = [posterior(point.point) for point in points]
    means = np.array([one.mean for one in each])
    mean = weight @ means
    within = np.einsum("k,kij->ij", weight, np.array([one.covariance for one in each]))
    offset = means - mean
    point = weight @ np.array([point.point for point in points])
    effective = float(weight @ np.array([one.effective_unknowns for one in each]))
    level_std = weight @ np.array([one.level_std for one in each])
    return point, Gaussian(
        mean, within + (offset * weight[:, None]).T @ offset, effective, level_std
    )


def remainders(
    equations: LinearRows,
    states: TestStates,
    terms: Pair,
    layout: Layout,
    point: Float[np.ndarray, " hyper"],
) -> tuple[bool, bool]:
    """Which families leave a remainder that noise does not explain: where "no remainder" has a
    probability below `priors.REMAINDER_BY_CHANCE`, summed over both cases of the other curve.
    """
    named = [one.family is not None and one.smooth for one in terms]
    if not any(named):
        return True, True
    log_odds = np.log(1 / priors.NO_REMAINDER - 1)
    weights: dict[tuple[bool, bool], float] = {}
    either = [(False, True) if own else (True,) for own in named]
    for free_roughness in itertools.product(either[0], either[1]):
        bounds = bounds_of(states, terms, point)
        for k, kept in enumerate(free_roughness):
            if not kept:
                bounds[ROUGHNESS.start + k] = (bounds[ROUGHNESS.start + k][0],) * 2
        objective = objective_of(equations, states, terms, layout, free_roughness=free_roughness)
        best = maximised(objective, point, bounds)
        weights[free_roughness] = laplace_evidence(objective, best, bounds) + log_odds * sum(
            free_roughness
        )
    total = np.logaddexp.reduce(list(weights.values()))
    first, second = (
        np.logaddexp.reduce(
            [weight for free_roughness, weight in weights.items() if not free_roughness[k]]
            or -np.inf
        )
        - total
        < np.log(priors.REMAINDER_BY_CHANCE)
        for k in range(2)
    )
    return bool(first), bool(second)


def differing_levels(
    objective: Objective, point: np.ndarray, bounds: list[tuple[float, float]], states: TestStates
) -> tuple[bool, bool, bool, bool]:
    """Which unstated level errors the likelihood supports, by backward elimination."""
    kept = [k for k, std in enumerate(states.level_std) if not std > 0]
    if states.n_levels < 2:
        kept = []
    point = maximised(objective, point, bounds)
    value = objective(point)[0]
    while kept:
        trials = []
        for kind in kept:
            fixed = list(bounds)
            for k in range(4):
                if not states.level_std[k] > 0 and (k == kind or k not in kept):
                    low = bounds[LEVELS.start + k][0]
                    fixed[LEVELS.start + k] = (low, low)
            without = maximised(objective, point, fixed)
            trials.append((objective(without)[0], kind, without))
        least, kind, without = max(trials, key=lambda trial: trial[0])
        if value - least > 0.5 * priors.LEVELS_DIFFER:
            break
        kept.remove(kind)
        point, value = without, least
    return 0 in kept, 1 in kept, 2 in kept, 3 in kept
