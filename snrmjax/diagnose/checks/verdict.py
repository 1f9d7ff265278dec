"""The verdict on an answer: the one place where it is decided, by a list of rules.

Noise that is stated too small makes every misfit larger by one factor, everywhere and without
order. What grows with the level, or what neighbours along the resonance share, is physics.
"""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.diagnose.checks.cross_validation import HeldOut, HeldOutLevels
from snrmjax.diagnose.checks.damping_asymmetry import acts_both_ways
from snrmjax.diagnose.checks.doubts import WIDER, Doubt, doubts, grows, part_of, wider_than_measured
from snrmjax.diagnose.checks.patterns import UNLIKELY, along, left_curve, pattern
from snrmjax.diagnose.checks.probabilities import (
    NOISE_REJECTED,
    UNKNOWN,
    considered_answers,
    probabilities_of,
    without_effects,
)
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.diagnose.search.locating import Located, power_of_answer
from snrmjax.diagnose.search.model_search import FoundEffects

_MISSED = 0.05  # probability of a held-out level below which a doubted answer is refuted
_MISSED_BY_ONE = 0.01  # and below which one of several effects that fit equally well is
_AS_NOISE = 1.3  # times the noise, by which a doubted answer may miss a level at most
_FAR = 2.0  # times the noise, by which the top level is missed where nothing proves the law
_TOLERATED = 1.7  # variance over the stated one that neighbouring states may show
_MORE_THAN_ALL_ELSE = 0.5  # probability
# Probabilities of a law outside the library: from which on there is no answer, and up to which an
# answer may be named. An answer that is wrong costs more than one that is called ambiguous.
_NO_ANSWER, _NO_DOUBT = 0.9, 0.1
_SMOOTH = "what is left is small, but smoother than noise."
_LOUD = 2.0  # times the noise that neighbouring states scatter, from which on it is mentioned


class Verdict(StrEnum):
    """What a diagnosis says as a whole."""

    NOTHING_MISSING = "none"
    NAMED = "named"
    AMBIGUOUS = "ambiguous"
    DRAWN = "drawn"
    UNKNOWN = "unknown"
    NOISE_REJECTED = "noise_rejected"

    @property
    def is_answer(self) -> bool:
        """Whether effects are given as an answer."""
        return self in (Verdict.NAMED, Verdict.AMBIGUOUS, Verdict.DRAWN)


def verdict_sentence(
    verdict: Verdict, classes: Sequence[Sequence[str]], before: float, after: float
) -> str:
    """A verdict in one plain sentence.

    Arguments: `classes` has every effect of the answer with those that fit as well, or drawn laws
    in words; misfits before and after it in units of noise.
    """
    found = _listed([group[0] for group in classes], "and")
    falls = f"the misfit falls from {_times(before)} to {_times(after)} times the noise"
    with_it = "with them" if len(classes) > 1 else "with it"
    if verdict is Verdict.NOTHING_MISSING:
        return (
            "Nothing is missing that these data could show: the model as given fits them to "
            f"{_times(after)} times the noise."
        )
    if verdict is Verdict.NOISE_REJECTED:
        return (
            "The stated noise does not fit the scatter of these data, so no effect is named: state "
            "the noise of a repeated test, or none, and diagnose again."
        )
    if verdict is Verdict.UNKNOWN:
        start = "Something is missing that no effect of the library explains reliably"
        return f"{start}; the best attempt is {found}: {falls}." if found else f"{start}."
    if verdict is Verdict.DRAWN:
        names = "; beside it ".join(group[0] for group in classes)
        return (
            f"The model lacks a force that no effect of the library explains, drawn from the data: "
            f"{names}. With it {falls}."
        )
    if verdict is Verdict.NAMED:
        return f"The model lacks {found}: {with_it} {falls}, and nothing else explains as much."
    if any(len(group) > 1 for group in classes):
        rivals = " and ".join(_listed(group, "or") for group in classes)
        return f"The model lacks {rivals}, and these data cannot tell which: {with_it} {falls}."
    return (
        f"The model probably lacks {found}: {with_it} {falls}, but something else could have the "
        "same effect (see the notes)."
    )


def _times(misfit: float) -> str:
    return f"{misfit:.1f}" if misfit < 10 else f"{misfit:.0f}"


def _listed(names: Sequence[str], word: str) -> str:
    """Names as in a sentence: "a, b and c"."""
    *others, last = names or [""]
    return f"{', '.join(others)} {word} {last}" if others else last


class NeighbourNoise(NamedTuple):
    """Noise that neighbouring states show."""

    variance: float  # over the stated one
    std: float  # 1σ of the variance


class Judgement(NamedTuple):
    """A verdict, its reasons, and what stays open."""

    verdict: Verdict
    reasons: tuple[str, ...] = ()
    open_questions: tuple[Doubt, ...] = ()
    probabilities: Mapping[str, float] = MappingProxyType({})


def judge(
    found: FoundEffects,
    neighbours: NeighbourNoise,
    located: tuple[Located, ...],
    levels: HeldOutLevels | None,
) -> Judgement:
    """The verdict on what a search found. The first rule that applies decides.

    1. `noise_rejected`: noise of another size than stated is more probable than all else, and
       what is left has no pattern.
    2. `unknown`: a law outside the library has a probability of 0.9 or more (`probabilities`).
    3. `none`: no effect was needed.
    4. `unknown`: a doubt refutes the law, as a contradicting power of amplitude does (`doubts`).
    5. `unknown`: a level that was left out of the fit is missed (`refuted_by_levels`).
    6. `ambiguous`: the top level, left out, proves nothing; or a law outside the library has a
       probability above 0.1, as with one that could do the same (`doubts`); or several effects fit
       about equally well.
    7. `named`: none of these.

    Answers that rules 4 and 5 refute leave their probability to `unknown`.

    Arguments: `located` are the parts of the misfit before any effect was named; `levels` are
    None where there are too few to leave one out.
    """
    open_questions = _doubts(found, located)
    probabilities = probabilities_of(considered_answers(found, len(open_questions)))
    judgement = judge_fit(found, neighbours, probabilities)
    verdict, reasons = judgement.verdict, tuple(doubt.reason for doubt in open_questions)
    if judgement.reasons or not found.fit.kinds:
        return judgement
    if not open_questions and probabilities[UNKNOWN] > _NO_DOUBT:
        open_questions = [_outside(found, probabilities[UNKNOWN])]
        reasons = (open_questions[0].reason,)
    if verdict.is_answer and open_questions:
        refuted = any(doubt.refutes for doubt in open_questions)
        verdict = Verdict.UNKNOWN if refuted else Verdict.AMBIGUOUS
        probabilities = without_effects(probabilities) if refuted else probabilities
    if levels is None or not verdict.is_answer:
        return Judgement(verdict, reasons, tuple(open_questions), probabilities)
    missed = refuted_by_levels(
        levels,
        doubted=not all(doubt.identical for doubt in open_questions),
        unclear=any(len(group) > 1 for group in found.classes),
        parts_missing=bool(found.misfit.predictions.chosen.phase_unknown[:, 0].any()),
    )
    if missed is not None:
        reasons, left = (missed, *reasons), without_effects(probabilities)
        return Judgement(Verdict.UNKNOWN, reasons, tuple(open_questions), left)
    unproved = unproved_beyond(levels.outer)
    if unproved is not None:
        verdict, reasons = Verdict.AMBIGUOUS, (*reasons, unproved.reason)
        open_questions = [*open_questions, unproved]
    return Judgement(verdict, reasons, tuple(open_questions), probabilities)


def judge_fit(
    found: FoundEffects, neighbours: NeighbourNoise, probabilities: Mapping[str, float]
) -> Judgement:
    """The verdict by what the fit leaves alone: rules 1 to 3 of `judge`, else 6 or 7.

    Where no noise is stated, the probabilities take what the answer leaves for it, and decide by
    the same rules: a misfit with a pattern is no noise of any size.
    """
    improbable = found.p_value < UNLIKELY
    structure = pattern(found.misfit, found.fit) if improbable else None
    of_noise = probabilities.get(NOISE_REJECTED, 0.0)
    if structure is None and of_noise > _MORE_THAN_ALL_ELSE:
        reason = _of_noise(found, neighbours)
        return Judgement(Verdict.NOISE_REJECTED, (reason,), (), probabilities)
    # Of misfits with a pattern the size is not that of noise.
    wrong = probabilities.get(UNKNOWN, 0.0) + (of_noise if structure is not None else 0.0)
    if wrong >= _NO_ANSWER:
        reasons = _of_misfit(found, neighbours, structure)
        return Judgement(Verdict.UNKNOWN, reasons, (), probabilities)
    if not found.fit.kinds:
        return Judgement(Verdict.NOTHING_MISSING, (), (), probabilities)
    unclear = any(len(group) > 1 for group in found.classes)
    verdict = Verdict.AMBIGUOUS if unclear else Verdict.NAMED
    return Judgement(verdict, (), (), probabilities)


def _of_noise(found: FoundEffects, neighbours: NeighbourNoise) -> str:
    """Why the noise is not as stated, in words."""
    n = found.misfit.n_rows - len(found.fit.values)
    times = np.sqrt(found.fit.chi_square / n)
    if times < 1:
        return (
            f"the misfit is {times:.2g} times the stated noise: the noise is overstated, and "
            "smaller effects may be hidden by it."
        )
    scatter = np.sqrt(max(neighbours.variance, 1.0))
    return (
        f"the misfit is {times:.2g} times the stated noise and has no pattern, and neighbouring "
        f"states scatter {scatter:.2g} times as much as it allows: the noise is understated; state "
        "it correctly before an effect is named."
    )


def _of_misfit(
    found: FoundEffects, neighbours: NeighbourNoise, structure: str | None
) -> tuple[str, ...]:
    """What is left that no effect explains, in words; nothing where doubts alone say so."""
    stated = found.misfit.predictions.chosen.noise_stated
    curve = structure or left_curve(found.misfit, found.fit)
    if found.p_value >= UNLIKELY:
        smooth = () if found.fit.kinds else (_SMOOTH,)
        return smooth if curve is None else (curve,)
    reasons = ["no effect of the library explains what is left."]
    if curve is not None:
        reasons.append(curve)
    if neighbours.variance > _LOUD**2:
        taken, or_not = ("stated noise", ", or leave that column out,")
        if not stated:
            taken, or_not = ("misfit that is taken as noise", "")
        reasons.append(
            f"from point to point the data scatter {np.sqrt(neighbours.variance):.2g} times more "
            f"than the {taken}: put the scatter of a repeated test into velocity_std_m_s{or_not} "
            "and diagnose again."
        )
    return tuple(reasons)


def _outside(found: FoundEffects, probability: float) -> Doubt:
    """The doubt that a misfit leaves which is small, but smooth as that of another law."""
    curve = left_curve(found.misfit, found.fit)
    return Doubt(
        f"a law outside the library has a probability of {100 * probability:.0f} %: "
        f"{_SMOOTH if curve is None else curve}",
        WIDER,
        identical=True,
    )


def _doubts(found: FoundEffects, located: tuple[Located, ...]) -> list[Doubt]:
    """Reasons to doubt an answer that fits."""
    misfit, fit = found.misfit, found.fit
    part = part_of(fit.kinds)
    stepped = np.asarray(misfit.predictions.chosen.states.frequency)
    return doubts(
        fit.kinds,
        located,
        misfit.predictions.chosen.orders,
        frozenset(kind for kind in fit.kinds if acts_both_ways(misfit, fit, kind)),
        power_of_answer(misfit, found.baseline, fit, part) if part else None,
        frozenset(k for k in fit.kinds if grows(k) and fit.of_kind(k)[0] < 0),
        frozenset(k for k in fit.kinds if wider_than_measured(k, fit.of_kind(k)[1:], stepped)),
    )


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


def refuted_by_levels(
    levels: HeldOutLevels,
    *,
    doubted: bool,
    unclear: bool = False,
    parts_missing: bool = False,
) -> str | None:
    """Why levels that were left out of the fit refute an answer; None where they do not.

    A level is missed by more than the uncertainty of the parameters allows; or the level between
    others is predicted worse than without the effects; or it is missed although a law that was
    not tried may act alike (`doubted`), or although several effects fit (`unclear`), each of
    which should predict a level between those it was fitted to. With `parts_missing`, where of
    some forces the size alone is compared, fewer levels leave parameters open, and worse than
    without the effects counts beyond that uncertainty only.
    """
    inner, outer = levels
    for held in (inner, outer):
        if held.uncertain_p_value < UNLIKELY / 2:
            return (
                f"fitted without level {held.level}, the model misses level {held.level} by "
                f"{held.after:.2g} times the noise, more than the parameter errors explain: the "
                "law is not the true one."
            )
    chance = inner.uncertain_p_value if parts_missing else inner.p_value
    if inner.after > inner.before and chance < UNLIKELY:
        return (
            f"level {inner.level}, left out of the fit, is predicted worse than without the "
            f"effects: {inner.after:.2g} times the noise, {inner.before:.2g} before."
        )
    if doubted and (inner.p_value < _MISSED or inner.after > _AS_NOISE):
        return (
            f"another law may act alike, and level {inner.level}, left out of the fit, is missed "
            f"by {inner.after:.2g} times the noise."
        )
    if unclear and inner.uncertain_p_value < _MISSED_BY_ONE:
        return (
            "several models fit, and the true law may be outside the library: level "
            f"{inner.level}, left out of the fit, is missed by {inner.after:.2g} times the noise."
        )
    return None


def unproved_beyond(outer: HeldOut) -> Doubt | None:
    """The doubt that stays where the top level is missed, for want of certain parameters.

    A miss that the uncertainty of the parameters allows refutes no answer, and proves none:
    beyond the levels that determine the parameters the law may be another one, as that of a
    contact that stiffens further after it has closed.
    """
    if outer.after < _FAR or outer.p_value >= UNLIKELY:
        return None
    return Doubt(
        f"level {outer.level}, left out of the fit, is missed by {outer.after:.2g} times the "
        "noise, which the uncertainty of the parameters from the other levels allows: nothing "
        "proves the law there.",
        f"measure levels between level {outer.level} and the one below it, or above it",
        identical=True,
    )
