"""The hyperparameters of a test, and where its unknowns stand: sizes of noise, levels, curves.

Curves that bend and levels that differ often explain a test alike: the sizes of the bends are then
known to a factor of ten only, and the most likely ones say nothing of what curves the others give.
`averaged` weighs them.
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

_STRAIGHT = 1e-4  # size of bends, below which no test sees them
_SMALLEST_SIZE = 1e-4  # over a prior's scale, that a size is at least
_FARTHEST = 5.0  # 1σ, of a change of the bends' size
_MOST = 0.5  # 1σ of a level's error, relative or rad: beyond it levels are not one structure's
_LEAST = 4.0  # nats below the likeliest, from which on sizes are left out
ALONG = 14  # functions of phase and amplitude of a discrepancy, for each part


# Where the unknowns stand that all states share: the last two are the exponents of frequency.
MASS, PHASE, OFFSET, TREND, WITH_FREQUENCY = 0, 1, 2, 3, slice(4, 6)


class Hyper(NamedTuple):
    """The hyperparameters, by what they are of."""

    noise: float  # over the stated one, or relative where none is
    roughness: tuple[float, float]  # size of both curves' bends, over the curves' units
    level_std: tuple[float, float, float, float]  # of `LEVEL_ERRORS`
    along: Float[np.ndarray, " direction"]  # how the logarithm of the bends' size changes
    discrepancy: tuple[float, float]  # of both parts, over Ωδ


class Places(NamedTuple):
    """Where the unknowns stand, and the squared frequency that stiffness is counted from.

    The modal mass comes first, then the instruments' phase, the offset of the force, a trend of
    the stiffness, and how both curves go with the forcing frequency.
    """

    stiffness: slice
    damping: slice
    levels: np.ndarray  # (level, error)
    discrepancy: tuple[slice, slice]  # in phase with the motion and in quadrature
    reference: float
    others: slice  # linear parameters of the other modes, in their own 1σ

    @property
    def beside(self) -> slice:
        """Both parts of a discrepancy."""
        return slice(self.discrepancy[0].start, self.discrepancy[1].stop)


Pair = tuple[CurveTerms, CurveTerms]


def places_of(
    terms: Pair, n_levels: int, discrepancy: bool, reference: float, n_others: int = 0
) -> Places:
    """The places for so many levels and parameters of others, with or without a discrepancy."""
    start = WITH_FREQUENCY.stop
    middle = start + terms[0].n_functions
    first = middle + terms[1].n_functions
    levels = first + np.arange(4 * n_levels).reshape(n_levels, 4)
    end, wide = first + 4 * n_levels, ALONG * discrepancy
    two = slice(end, end + wide), slice(end + wide, end + 2 * wide)
    others = slice(end + 2 * wide, end + 2 * wide + n_others)
    return Places(slice(start, middle), slice(middle, first), levels, two, reference, others)


# In the order of a point of hyperparameters: noise, bends of two curves, four errors of levels,
# change of the bends' size along the curves, and two discrepancies where there are any.
NOISE, ROUGHNESS, LEVELS, FIRST_ALONG = 0, slice(1, 3), slice(3, 7), 7


def end_of_along(terms: Pair) -> int:
    """Where in a point the numbers end that say how the bends' size changes."""
    return FIRST_ALONG + terms[0].basis.directions.shape[1]


def hyper_at(point: np.ndarray, terms: Pair) -> Hyper:
    """The hyperparameters of a point: logarithms of sizes, and how those of bends change."""
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
    """The point of these hyperparameters, without a discrepancy."""
    sizes = np.log([hyper.noise, *hyper.roughness, *hyper.level_std])
    return np.concatenate([sizes, hyper.along])


def starting_point(states: TestStates, terms: Pair, discrepancy: bool) -> np.ndarray:
    """The point from which the most likely one is looked for."""
    noise = priors.STATED_NOISE if states.stated else priors.UNSTATED_NOISE
    levels = [
        std if std > 0 else 0.3 * prior.scale
        for std, prior in zip(states.level_std, priors.LEVELS, strict=True)
    ]
    more = [0.3 * priors.DISCREPANCY.scale] * (2 * discrepancy)
    sizes = np.log([noise.median, *[priors.CURVE_ROUGHNESS.median] * 2, *levels])
    return np.concatenate([sizes, np.zeros(end_of_along(terms) - FIRST_ALONG), np.log(more)])


def bounds_of(states: TestStates, terms: Pair, point: np.ndarray) -> list[tuple[float, float]]:
    """Between which points lie; what is stated is held, and so is the size of no bends."""
    low = np.log(_STRAIGHT)
    sizes = [(np.log(1e-7), np.log(2.0)) if one.smooth else (low, low) for one in terms]
    noise = (np.log(0.02), np.log(1e6)) if states.stated else (np.log(1e-5), np.log(1.0))
    levels = []
    for stated, prior in zip(states.level_std, priors.LEVELS, strict=True):
        held = np.log(stated) if stated > 0 else None
        wide = (np.log(_SMALLEST_SIZE * prior.scale), np.log(_MOST))
        levels.append(wide if held is None else (held, held))
    n = end_of_along(terms) - FIRST_ALONG
    left = len(point) - FIRST_ALONG - n
    more = [(np.log(_SMALLEST_SIZE * priors.DISCREPANCY.scale), 0.0)] * left
    return [noise, *sizes, *levels, *[(-_FARTHEST, _FARTHEST)] * n, *more]


class PriorVariances(NamedTuple):
    """Prior variances of all unknowns: their logarithms are linear in a point of hyperparameters.

    What is held at zero has −∞.
    """

    constant: Float[np.ndarray, " unknown"]
    slopes: Float[np.ndarray, "unknown hyper"]

    def __call__(self, point: Float[np.ndarray, " hyper"]) -> Float[np.ndarray, " unknown"]:
        """The variances at a point."""
        return np.exp(self.constant + self.slopes @ point)


def prior_variances(terms: Pair, places: Places, states: TestStates) -> PriorVariances:
    """Those of a test's unknowns."""
    n, end = places.others.stop, end_of_along(terms)
    with_more = places.discrepancy[0].stop > places.discrepancy[0].start
    constant, slopes = np.zeros(n), np.zeros((n, end + 2 * with_more))
    held = (states.mass_std, states.phase_std, states.offset_std, states.trend_std)
    with np.errstate(divide="ignore"):
        constant[: WITH_FREQUENCY.stop] = 2 * np.log([*held, *states.off_resonance_std])
    for k, functions in enumerate((places.stiffness, places.damping)):
        constant[functions], by = terms[k].log_variances()
        slopes[functions, ROUGHNESS.start + k], slopes[functions, FIRST_ALONG:end] = (
            by[:, 0],
            by[:, 1:],
        )
    for k in range(4):
        slopes[places.levels[:, k], LEVELS.start + k] = 2.0
    for k in range(2 * with_more):
        slopes[places.discrepancy[k], end + k] = 2.0
    return PriorVariances(constant, slopes)


def objective_of(
    equations: LinearRows,
    states: TestStates,
    terms: Pair,
    places: Places,
    *,
    flat: bool = False,
    drawn: tuple[bool, bool] = (True, True),
) -> Objective:
    """Likelihood times prior; with `flat` that of levels' errors alone is left out, and that of
    bends that are not `drawn`.
    """
    noise = priors.STATED_NOISE if states.stated else priors.UNSTATED_NOISE
    variances = prior_variances(terms, places, states)
    n = variances.slopes.shape[1]
    of_levels = [
        None if stated > 0 or flat else prior
        for stated, prior in zip(states.level_std, priors.LEVELS, strict=True)
    ]
    along = [priors.ROUGHNESS_VARIES] * (end_of_along(terms) - FIRST_ALONG)
    roughness = [
        priors.CURVE_ROUGHNESS if one.smooth and kept else None
        for one, kept in zip(terms, drawn, strict=True)
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
    """What is said of the unknowns."""

    mean: Float[np.ndarray, " unknown"]
    covariance: Float[np.ndarray, "unknown unknown"]
    told: float  # how many unknowns the states, and not their priors, tell
    level_std: Float[np.ndarray, " error"]  # 1σ of levels' errors that the covariance has


class SizedPoint(NamedTuple):
    """Hyperparameters, likeliest for some sizes of the bends."""

    log_evidence: float  # integrated over the others
    point: Float[np.ndarray, " hyper"]


def roughness_stds(
    objective: Objective,
    likeliest: Float[np.ndarray, " hyper"],
    bounds: list[tuple[float, float]],
) -> list[SizedPoint]:
    """The points of a grid about the likeliest: from neighbour to neighbour, while they count."""
    step, low = priors.CURVE_ROUGHNESS.spread, np.log(_STRAIGHT)
    middle, high = np.maximum(likeliest[ROUGHNESS], low), np.transpose(bounds[ROUGHNESS])[1]
    sized: dict[tuple[int, int], SizedPoint] = {}
    queue = [((0, 0), likeliest)]
    while queue:
        (a, b), start = queue.pop(0)
        sizes = middle + step * np.array([a, b])
        if (a, b) in sized or np.any((sizes < low - step / 2) | (sizes > high)):
            continue
        held, start = list(bounds), start.copy()
        start[ROUGHNESS] = np.maximum(sizes, low)
        held[ROUGHNESS] = [(size, size) for size in start[ROUGHNESS]]
        point = maximised(objective, start, held)
        here = SizedPoint(laplace_evidence(objective, point, held), point)
        sized[a, b] = here
        if here.log_evidence > max(other.log_evidence for other in sized.values()) - _LEAST:
            queue += [((a + i, b + j), point) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    return list(sized.values())


def averaged(
    points: list[SizedPoint], posterior: Callable[[np.ndarray], Gaussian]
) -> tuple[Float[np.ndarray, " hyper"], Gaussian]:
    """The mean of the points, and mean and covariance of what each says of the unknowns."""
    weight = np.array([point.log_evidence for point in points])
    weight = np.exp(weight - weight.max())
    weight = weight / weight.sum()
    each = [posterior(point.point) for point in points]
    means = np.array([one.mean for one in each])
    mean = weight @ means
    within = np.einsum("k,kij->ij", weight, np.array([one.covariance for one in each]))
    off = means - mean
    point = weight @ np.array([point.point for point in points])
    effective = float(weight @ np.array([one.told for one in each]))
    level_std = weight @ np.array([one.level_std for one in each])
    return point, Gaussian(mean, within + (off * weight[:, None]).T @ off, effective, level_std)


def remainders(
    equations: LinearRows,
    states: TestStates,
    terms: Pair,
    places: Places,
    point: Float[np.ndarray, " hyper"],
) -> tuple[bool, bool]:
    """Which families leave a remainder that noise does not explain: where none has a probability
    below `priors.REMAINDER_BY_CHANCE`, whatever the other curve has.
    """
    named = [one.family is not None and one.smooth for one in terms]
    if not any(named):
        return True, True
    log_odds = np.log(1 / priors.NO_REMAINDER - 1)
    weights: dict[tuple[bool, bool], float] = {}
    either = [(False, True) if own else (True,) for own in named]
    for drawn in itertools.product(either[0], either[1]):
        bounds = bounds_of(states, terms, point)
        for k, kept in enumerate(drawn):
            if not kept:
                bounds[ROUGHNESS.start + k] = (bounds[ROUGHNESS.start + k][0],) * 2
        objective = objective_of(equations, states, terms, places, drawn=drawn)
        best = maximised(objective, point, bounds)
        weights[drawn] = laplace_evidence(objective, best, bounds) + log_odds * sum(drawn)
    total = np.logaddexp.reduce(list(weights.values()))
    first, second = (
        np.logaddexp.reduce(
            [weight for drawn, weight in weights.items() if not drawn[k]] or -np.inf
        )
        - total
        < np.log(priors.REMAINDER_BY_CHANCE)
        for k in range(2)
    )
    return bool(first), bool(second)


def differing_levels(
    objective: Objective, point: np.ndarray, bounds: list[tuple[float, float]], states: TestStates
) -> tuple[bool, bool, bool, bool]:
    """Which unstated errors of levels the likelihood asks for: the others are left out in turn."""
    kept = [k for k, std in enumerate(states.level_std) if not std > 0]
    if states.n_levels < 2:
        kept = []
    point = maximised(objective, point, bounds)
    value = objective(point)[0]
    while kept:
        trials = []
        for kind in kept:
            held = list(bounds)
            for k in range(4):
                if not states.level_std[k] > 0 and (k == kind or k not in kept):
                    low = bounds[LEVELS.start + k][0]
                    held[LEVELS.start + k] = (low, low)
            without = maximised(objective, point, held)
            trials.append((objective(without)[0], kind, without))
        least, kind, without = max(trials, key=lambda trial: trial[0])
        if value - least > 0.5 * priors.LEVELS_DIFFER:
            break
        kept.remove(kind)
        point, value = without, least
    return 0 in kept, 1 in kept, 2 in kept, 3 in kept
