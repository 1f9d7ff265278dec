"""Evidence of answers: how probable each makes the data, whatever its parameters are.

Laplace's approximation about the best fit. The priors are, of a strength, a Cauchy distribution
about zero with the strength from which a fit begins as its scale, which changes the dynamic
stiffness by `VISIBLE_CHANGE`, and of every other parameter a flat one between its bounds. The
baseline's parameters, the errors of levels and a discrepancy are linear and marginalised exactly;
the sizes of noise, of levels' errors and of the discrepancy by their most likely values and
Laplace's approximation, each answer with its own.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from math import comb
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import logsumexp

from snrmjax.diagnose import priors
from snrmjax.diagnose.misfit.candidates import candidate, coordinates
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.predictions import scales_of
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.diagnose.search.locating import hat_functions
from snrmjax.diagnose.search.model_search import FoundEffects
from snrmjax.identify.calibrate.calibration_states import ASSUMED_ERROR
from snrmjax.identify.test_model.linear_gaussian import LinearRows, maximised, precision_at
from snrmjax.identify.test_model.priors import (
    LEVELS,
    UNSTATED_NOISE,
    FlatSize,
    HalfNormalSize,
    JointDensity,
)
from snrmjax.model.effect_metadata import MotionScales
from snrmjax.model.effects import EFFECTS, effect_parameters

Kinds = tuple[str, ...]
"""An answer: its effects in alphabetic order, or one of those without any."""

NONE: Kinds = ("none",)
UNKNOWN: Kinds = ("unknown",)
NOISE_REJECTED: Kinds = ("noise_rejected",)


class Weighed(NamedTuple):
    """An answer with the logarithm of its prior odds times its evidence."""

    kinds: frozenset[str]
    misfit: WeightedMisfit  # made straight at its own most likely errors, where it was refined
    fit: EffectFit
    log_weight: float  # for noise as stated
    if_noise_is_wrong: float = -np.inf  # and for noise stated wrong


class Weights(NamedTuple):
    """All answers that were considered, the most probable first, and what else there is."""

    answers: tuple[Weighed, ...]
    unknown: float  # logarithms of weights
    noise_rejected: float

    def with_imitations(self, n: int) -> "Weights":
        """With so many laws outside the library that are known to act like the best answer."""
        best = self.answers[0]
        if not n or not best.kinds:
            return self
        more = np.log(n * priors.IMITATION) + best.log_weight
        return self._replace(unknown=float(np.logaddexp(self.unknown, more)))

    def probabilities(self) -> dict[Kinds, float]:
        """Of every answer, the largest first; they add up to one."""
        logs = {answer_of(answer.kinds): answer.log_weight for answer in self.answers}
        logs |= {UNKNOWN: self.unknown, NOISE_REJECTED: self.noise_rejected}
        logs = {kinds: value for kinds, value in logs.items() if np.isfinite(value)}
        total = logsumexp(list(logs.values()))
        found = {kinds: float(np.exp(value - total)) for kinds, value in logs.items()}
        return dict(sorted(found.items(), key=lambda pair: -pair[1]))


def answer_of(effects: Iterable[str]) -> Kinds:
    """The answer of effects in any order, and of none."""
    return tuple(sorted(effects)) or NONE


class Marginal(NamedTuple):
    """An answer, linear about its best fit, by all that is unknown in units of its prior's 1σ.

    Rows are those of `WeightedMisfit`, each in units of its own state's noise.
    """

    rows: LinearRows
    group: Int[np.ndarray, " unknown"]  # whose size counts: of `_Sizes`, −1 where it is known
    penalty: float  # of a fit that had not ended


class _Sizes(NamedTuple):
    """Sizes over those of the misfit's noise: of levels' errors, of a discrepancy, of noise."""

    densities: tuple[HalfNormalSize | FlatSize | None, ...]  # of levels' four, of a discrepancy
    bounds: tuple[tuple[float, float], ...]
    noise: Float[np.ndarray, " noise"]  # logarithms, which are summed over
    right: Float[np.ndarray, " noise"]  # ln p of them, for noise as it is stated to be
    wrong: Float[np.ndarray, " noise"]  # and for noise stated wrong


def either(one: Weights, other: Weights, odds: float) -> Weights:
    """Weights where one of two descriptions of the same data holds, the other with log odds."""
    best = {answer.kinds: answer for answer in one.answers}
    for answer in other.answers:
        new = answer._replace(log_weight=answer.log_weight + odds)
        old = best.get(new.kinds, new._replace(log_weight=-np.inf))
        likelier = max(old, new, key=lambda each: each.log_weight)
        both = float(np.logaddexp(old.log_weight, new.log_weight))
        best[new.kinds] = likelier._replace(log_weight=both)
    return Weights(
        tuple(sorted(best.values(), key=lambda answer: -answer.log_weight)),
        float(np.logaddexp(one.unknown, other.unknown + odds)),
        float(np.logaddexp(one.noise_rejected, other.noise_rejected + odds)),
    )


Refined = Callable[[WeightedMisfit, EffectFit], tuple[WeightedMisfit, EffectFit]]


def weights_of(found: FoundEffects, refined: Refined | None = None) -> Weights:
    """All answers that a search considered, weighed.

    `unknown` has the weight of answers beside a discrepancy of unknown size, and of laws that act
    like one. `noise_rejected` has that of all answers with noise of another size, where noise is
    stated. The likeliest answers, and nothing at all, are `refined` before they are compared.
    """
    sizes = _sizes_of(found.misfit)
    fits = {id(fit): fit for fit in (found.baseline, found.fit, *found.considered)}
    fitted = [_weighed(found.misfit, fit, sizes) for fit in fits.values()]
    weighed = sorted((one for one in fitted if one is not None), key=lambda one: one.log_weight)
    best = {one.kinds: one for one in weighed}
    done: list[Weighed] = []
    # Nothing, the likeliest effects alone, and then the likeliest answers of any size.
    order = sorted(best, key=lambda kinds: -best[kinds].log_weight)
    alone = [kinds for kinds in order if len(kinds) <= 1][: priors.REFINED]
    for kinds in dict.fromkeys([*alone, frozenset[str](), *order[: priors.REFINED]]):
        if refined is None or _is_far_behind(best[kinds], done):
            continue
        misfit, fit = refined(best[kinds].misfit, best[kinds].fit)
        again = _weighed(misfit, fit, sizes)
        if again is not None:
            best[kinds] = again
            done.append(again)
    ranked = sorted(best.values(), key=lambda one: -one.log_weight)
    unknown = [np.log(priors.UNNAMED) + one.log_weight for one in ranked if one.kinds]
    for one in ranked[:6]:  # each beside a discrepancy too
        directions = list(discrepancies(one.misfit))
        prior = np.log(priors.DISCREPANCY / len(directions)) + _log_prior(len(one.kinds))
        for columns in directions:
            beside = marginal_of(one.misfit, one.fit, columns)
            if beside is not None:
                unknown.append(prior + log_evidence(beside, sizes).right)
    rejected = np.log(priors.WRONG_NOISE) + logsumexp([one.if_noise_is_wrong for one in ranked])
    return Weights(tuple(ranked), float(logsumexp(unknown)), float(rejected))


def _weighed(misfit: WeightedMisfit, fit: EffectFit, sizes: "_Sizes") -> Weighed | None:
    """A fit with its weight; None where it has no motion."""
    marginal = marginal_of(misfit, fit)
    if marginal is None:
        return None
    evidence, prior = log_evidence(marginal, sizes), _log_prior(len(fit.kinds))
    pair = prior + evidence.right, prior + evidence.wrong
    return Weighed(frozenset(fit.kinds), misfit, fit, *pair)


def _is_far_behind(one: Weighed, done: Sequence[Weighed]) -> bool:
    """Whether a refined answer makes this one, as it is, improbable."""
    if not done:
        return False
    best = max(done, key=lambda each: each.log_weight)
    # Where even the best one leaves more than noise, corrections move others so much further.
    left = 1.0
    if best.fit.p_value <= priors.REJECTED:
        left = best.fit.chi_square / max(best.misfit.n_rows - len(best.fit.values), 1)
    return one.log_weight < best.log_weight - priors.FAR_BEHIND * left


def marginal_of(
    misfit: WeightedMisfit, fit: EffectFit, beside: Float[np.ndarray, "row any"] | None = None
) -> Marginal | None:
    """A fit with the priors of its parameters; None where it has no motion.

    `beside` are directions of a discrepancy, of the size of noise for unit values.
    """
    noise, arms = misfit.noise, _arms(misfit, fit)
    if not (np.all(np.isfinite(fit.rows)) and np.all(np.isfinite(arms))):
        return None
    columns = np.zeros((misfit.n_rows, 0)) if beside is None else beside
    design = np.concatenate([arms, noise.shared, columns], axis=1)
    known, unknown = np.full(arms.shape[1], -1), np.full(columns.shape[1], len(LEVELS))
    group = np.concatenate([known, noise.shared_kind, unknown])
    left, slopes = noise.decorrelated(fit.rows), noise.decorrelated(arms.T).T
    promised = float(np.sum((slopes @ np.linalg.lstsq(slopes, left, rcond=1e-10)[0]) ** 2))
    # Of answers under other noise: at a fit that explains its records χ² is the square of their
    # distance from it, whatever its own slopes are, and these are no part of the units.
    units = -misfit.n_rows * float(np.log(misfit.predictions.error_scale))
    # The most likely parameters are the fit's; what more a linear step promises is not believed.
    return Marginal(LinearRows.of(design, fit.rows, units), group, 0.5 * promised)


class Evidence(NamedTuple):
    """ln p of the data, for noise as it is stated to be and for noise stated wrong."""

    right: float
    wrong: float


def log_evidence(model: Marginal, sizes: _Sizes) -> Evidence:
    """ln p of the data, whatever the sizes are, as far as the priors allow.

    Sizes of levels' errors and of a discrepancy by Laplace's approximation about the most likely
    ones, the noise by a sum over its logarithm there.
    """
    used = np.unique(model.group[model.group >= 0])
    member = model.group[:, None] == used
    prior_of_sizes = JointDensity.of([None, *(sizes.densities[place] for place in used)])

    def likelihood(point: np.ndarray) -> tuple[float, np.ndarray]:
        variance = np.exp(2 * (member @ point[1:]))
        value, by_scale, by_variance = model.rows.log_likelihood(np.exp(point[0]), variance)
        return value, np.append(by_scale, 2 * (by_variance @ member))

    def with_priors(point: np.ndarray) -> tuple[float, np.ndarray]:
        value, slopes = likelihood(point)
        prior, slope = prior_of_sizes.log_density(point)
        return value + prior, slopes + slope

    ends = float(sizes.noise[0]), float(sizes.noise[-1])
    bounds = [ends, *(sizes.bounds[place] for place in used)]
    found = maximised(with_priors, np.zeros(len(bounds)), bounds)
    others = precision_at(with_priors, found)[1:, 1:]
    volume = 0.5 * (len(others) * np.log(2 * np.pi) - np.linalg.slogdet(others)[1])
    top = prior_of_sizes.log_density(found)[0]
    variance = np.exp(2 * (member @ found[1:]))
    logs = _over_noise(model.rows, np.exp(sizes.noise), variance) + volume + top - model.penalty
    return Evidence(*(float(logsumexp(logs + prior)) for prior in (sizes.right, sizes.wrong)))


def _over_noise(
    rows: LinearRows, scale: Float[np.ndarray, " noise"], variance: Float[np.ndarray, " unknown"]
) -> Float[np.ndarray, " noise"]:
    """ln p of rows for several sizes of noise: in the principal directions of what is unknown."""
    directions, size, _ = np.linalg.svd(rows.triangle * np.sqrt(variance), full_matrices=False)
    noise, others = scale[:, None] ** 2, rows.n_rows - len(size)
    square = np.sum((rows.along @ directions) ** 2 / (noise + size**2), axis=1)
    square += rows.across / noise[:, 0]
    log_det = np.sum(np.log(noise + size**2), axis=1) + others * np.log(noise[:, 0])
    return rows.offset - 0.5 * (rows.n_rows * np.log(2 * np.pi) + log_det + square)


def discrepancies(misfit: WeightedMisfit) -> Iterator[Float[np.ndarray, "row any"]]:
    """Smooth misfits that a law outside the library may leave, one column a value of theirs.

    Stiffness and damping as functions of the amplitude; every harmonic as one; the stiffness as a
    function of the order of the test; any force that is smooth along a level. With unit normal
    values a set has the size of the noise.
    """
    chosen, noise = misfit.predictions.chosen, misfit.noise
    velocity = np.asarray(chosen.states.velocity)[:, 0]
    phase = np.angle(velocity)
    amplitude = hat_functions(np.log(np.abs(velocity)), 6)[noise.state]
    order = np.argsort(np.argsort(chosen.rows)).astype(float)
    of_test = hat_functions(order, 8)[noise.state]
    linear = misfit.by_linear
    yield _scaled(np.concatenate([linear[:, [k]] * amplitude for k in (0, 1)], axis=1))
    harmonics = []
    for place, number in enumerate(chosen.orders):  # both parts, that turn with the fundamental
        first = 2 * (len(chosen.sensors) + place)
        for turn in (1.0, 1j):
            unit, columns = turn * np.exp(1j * number * phase), np.zeros((1, *noise.known.shape))
            columns[0, :, first], columns[0, :, first + 1] = unit.real, unit.imag
            harmonics.append(noise.noise_units(columns)[0][:, None] * amplitude)
    if harmonics:
        yield _scaled(np.concatenate(harmonics, axis=1))
    yield _scaled(linear[:, [0]] * of_test)
    level, along = np.asarray(chosen.states.level), []
    for number in np.unique(level):
        of_level, curves = level == number, np.zeros((len(level), 4))
        curves[of_level] = hat_functions(phase[of_level], 4)
        along += [(noise.column == k)[:, None] * curves[noise.state] for k in (0, 1)]
    yield _scaled(np.concatenate(along, axis=1))


def _scaled(columns: np.ndarray) -> np.ndarray:
    """Columns that together have the size of the noise where they act."""
    size = np.sqrt(np.sum(columns**2, axis=1))
    acts = size > 0
    return columns / np.sqrt(np.mean(size[acts] ** 2)) if acts.any() else columns


def _sizes_of(misfit: WeightedMisfit) -> _Sizes:
    """Priors of the sizes, over what they are in the misfit's noise."""
    predictions = misfit.predictions
    free = predictions.unstated_levels
    levels = [
        HalfNormalSize(prior.scale / size) if is_free and size > 0 else None
        for prior, size, is_free in zip(LEVELS, predictions.level_sizes, free, strict=True)
    ]
    far = float(np.log(1e3))
    ends = [(-far, far) if density is not None else (0.0, 0.0) for density in levels]
    low, high = np.log(priors.DISCREPANCY_SIZES)
    reach = priors.MOST_NOISE if predictions.chosen.noise_stated else 2.5
    noise = np.linspace(-reach, reach, 57)
    if predictions.chosen.noise_stated:
        tolerated = (noise >= priors.TOLERATED_NOISE[0]) & (noise <= priors.TOLERATED_NOISE[1])
        right = np.where(tolerated, -0.5 * (noise / priors.RIGHT_NOISE) ** 2, -np.inf)
        wrong = np.where(tolerated, -np.inf, 0.0)
        wrong = wrong - logsumexp(wrong)
    else:
        taken = ASSUMED_ERROR * predictions.error_scale
        unstated = UNSTATED_NOISE._replace(median=UNSTATED_NOISE.median / taken)
        joint = JointDensity.of([unstated])
        right = np.array([joint.log_density(one)[0] for one in noise[:, None]])
        wrong = np.full(len(noise), -np.inf)
    right = right - logsumexp(right)
    known_and_free = (*levels, FlatSize(low, high)), (*ends, (low, high))
    return _Sizes(*known_and_free, noise, right, wrong)


def _log_prior(n_effects: int) -> float:
    """ln of the prior odds of one answer with so many effects to none."""
    return float(np.log(priors.EFFECTS[n_effects]) - np.log(comb(len(EFFECTS), n_effects)))


def _arms(misfit: WeightedMisfit, fit: EffectFit) -> Float[np.ndarray, "row parameter"]:
    """Slopes by an answer's parameters, times the width of their priors."""
    if not fit.kinds:
        return np.zeros((misfit.n_rows, 0))
    scales = scales_of(misfit.predictions)
    law = coordinates(fit.labels, scales.amplitude)
    width = np.zeros(len(fit.values))
    for kind in fit.kinds:
        places = [k for k, label in enumerate(fit.labels) if label.startswith(f"{kind}.")]
        width[places] = _widths(kind, law.inward(fit.values)[places], scales)
    return law.slopes(fit.values, fit.slopes) * width


def _widths(
    kind: str, at: Float[np.ndarray, " parameter"], scales: MotionScales
) -> Float[np.ndarray, " parameter"]:
    """1σ of normal priors about a fit that are as high there as the stated priors."""
    one = candidate(kind, scales)
    law = coordinates([f"{kind}.{name}" for name in effect_parameters(kind)], scales.amplitude)
    starts = np.abs(law.inward(np.array(one.starts)))
    lower, upper = np.array(one.lower), np.array(one.upper)
    scale = np.median(starts, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    sides = np.where(lower == 0, 2.0, 1.0)
    height = sides / (np.pi * scale * (1 + (at / scale) ** 2))
    flat = np.isfinite(upper - lower)
    flat[0] = False
    height[flat] = 1 / (upper - lower)[flat]
    return 1 / (np.sqrt(2 * np.pi) * height)
