"""The verdict: the one place where it is decided, from posteriors and predictive checks.

Probabilities are those of `evidence.weights_of`. Checks can refute what they cannot prove: a law
that contradicts a power of amplitude in the data, a level that was left out of the fit and missed,
a gain of the force that the data do not determine. What they refute keeps a small share of its
probability; the rest is that of a law outside the library.
"""

from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.alternative_laws import (
    WIDER,
    Doubt,
    acts_both_ways,
    doubts,
    grows,
    part_of,
    wider_than_measured,
)
from snrmjax.diagnose.checks.gains import LevelForces, doubts_on_gains
from snrmjax.diagnose.checks.residuals import HeldOutLevels, left_curve, missed_levels, pattern
from snrmjax.diagnose.evidence import NOISE_REJECTED, NONE, UNKNOWN, Kinds, Weights, answer_of
from snrmjax.diagnose.laws.law_answer import LawAnswer
from snrmjax.diagnose.misfit.effect_fit import baseline_fit
from snrmjax.diagnose.search.locating import Located, power_of_answer
from snrmjax.diagnose.search.model_search import FoundEffects
from snrmjax.numerics.facts import Fact


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


class Judgement(NamedTuple):
    """A verdict, its reasons, and what stays open."""

    verdict: Verdict
    reasons: tuple[Fact | str, ...]
    open_questions: tuple[Doubt, ...]
    probabilities: Mapping[Kinds, float]


def most_probable(found: FoundEffects, weights: Weights) -> FoundEffects:
    """What a search found, with the most probable answer, and of every effect its class.

    To the class of an effect belong those in its place in answers whose odds to the best one are
    `AS_GOOD` or better; answers of other sizes count for the effect that they lack, or for the
    first.
    """
    best = weights.answers[0]
    rivals = [
        answer
        for answer in weights.answers[1:]
        if answer.log_weight > best.log_weight + np.log(priors.AS_GOOD) and answer.kinds
    ]
    classes = [[kind] for kind in best.fit.kinds]
    for one in rivals if classes else ():
        lost = [k for k, kind in enumerate(best.fit.kinds) if kind not in one.kinds]
        for kind in sorted(one.kinds - best.kinds):
            group = classes[lost[0] if lost else 0]
            if kind not in group:
                group.append(kind)
    return found._replace(
        misfit=best.misfit,
        fit=best.fit,
        baseline=baseline_fit(best.misfit),
        classes=tuple(tuple(group) for group in classes),
    )


def decide(
    found: FoundEffects,
    weights: Weights,
    located: tuple[Located, ...],
    levels: HeldOutLevels | None,
    errors: Mapping[str, float],
    rival: LevelForces | None,
) -> Judgement:
    """The verdict. The first rule that applies decides.

    1. `noise_rejected`: noise of another size than stated is more probable than all else, and what
       is left has no pattern.
    2. `unknown`: a law outside the library has a probability of `NO_ANSWER` or more.
    3. `none`: that is the most probable answer.
    4. `unknown`: a check refutes the answer.
    5. `ambiguous`: several effects are as good, or a check leaves a question open.
    6. `named`.

    Arguments: `located` are the parts of the misfit before any effect was named; `levels` are None
    where there are too few to leave one out; `errors` are 1σ of the answer's parameters; `rival`
    are gains of the forces of levels that explain the data as well.
    """
    probabilities = weights.probabilities()
    misfit, fit = found.misfit, found.fit
    left = pattern(misfit, fit) if found.p_value < priors.REJECTED else None
    of_noise, outside = probabilities.get(NOISE_REJECTED, 0.0), probabilities.get(UNKNOWN, 0.0)
    if of_noise > 0.5 and left is None:
        times = float(np.sqrt(fit.chi_square / (misfit.n_rows - len(fit.values))))
        return Judgement(
            Verdict.NOISE_REJECTED, (Fact("noise_misstated", ratio=times),), (), probabilities
        )
    if outside + (of_noise if left is not None else 0.0) >= priors.NO_ANSWER:
        left = left if left is not None else left_curve(misfit, fit)
        reasons = [Fact("no_effect_explains"), *([left] if left is not None else [])]
        # What is left has a pattern, and so is no noise of any size.
        kept = {kinds: p for kinds, p in probabilities.items() if kinds != NOISE_REJECTED}
        return Judgement(Verdict.UNKNOWN, tuple(reasons), (), _else_unknown(kept))
    if not fit.kinds:
        return Judgement(Verdict.NOTHING_MISSING, (), (), probabilities)
    objections = imitations_of(found, located)
    objections += doubts_on_gains(misfit, fit, errors)
    objections += missed_levels(
        levels, found, doubted=any(not objection.identical for objection in objections)
    )
    if rival is not None:
        objections.append(rival.doubt)
    if not objections and outside > priors.NO_DOUBT:
        why = Fact("unknown_law", probability=outside, left=left_curve(misfit, fit))
        objections.append(Doubt(why, WIDER, identical=True))
    doubted = tuple(objection.reason for objection in objections)
    if any(objection.refutes for objection in objections):
        kept = {
            kinds: p if kinds in (NONE, NOISE_REJECTED) else priors.OPEN * p
            for kinds, p in probabilities.items()
        }
        return Judgement(Verdict.UNKNOWN, doubted, tuple(objections), _else_unknown(kept))
    unclear = objections or any(len(group) > 1 for group in found.classes)
    verdict = Verdict.AMBIGUOUS if unclear else Verdict.NAMED
    return Judgement(verdict, doubted, tuple(objections), probabilities)


def law_is_asked_for(judgement: Judgement, n_effects: int) -> bool:
    """Whether a drawn law may do better: nothing is named, or by so many effects that fit most."""
    return judgement.verdict is Verdict.UNKNOWN or n_effects > priors.FEW_EFFECTS


def with_law(judgement: Judgement, law: LawAnswer) -> Judgement:
    """The judgement where a law was drawn.

    It has its share of what is outside the library, and of the effects in whose place it stands.
    """
    apart = {
        kinds: p
        for kinds, p in judgement.probabilities.items()
        if kinds != UNKNOWN and len(kinds) <= priors.FEW_EFFECTS
    }
    outside = 1 - sum(apart.values())
    apart[answer_of(law.kinds)] = law.share * outside
    probabilities = _else_unknown(apart)
    return Judgement(Verdict.DRAWN, law.notes, (), probabilities)


def imitations_of(found: FoundEffects, located: tuple[Located, ...]) -> list[Doubt]:
    """What a law outside the library could do as well as the answer."""
    misfit, fit = found.misfit, found.fit
    if not fit.kinds:
        return []
    part = part_of(fit.kinds)
    stepped = np.asarray(misfit.predictions.chosen.states.frequency)
    own_power = power_of_answer(misfit, found.baseline, fit, part) if part else None
    # Where the answer itself is seen to follow no power of the amplitude the data need not either.
    if own_power is None and not misfit.predictions.chosen.phase_unknown.any():
        located = tuple(one for one in located if one.part != part)
    return doubts(
        fit.kinds,
        located,
        misfit.predictions.chosen.orders,
        frozenset(kind for kind in fit.kinds if acts_both_ways(misfit, fit, kind)),
        own_power,
        frozenset(k for k in fit.kinds if grows(k) and fit.of_kind(k)[0] < 0),
        frozenset(k for k in fit.kinds if wider_than_measured(k, fit.of_kind(k)[1:], stepped)),
    )


def _else_unknown(kept: Mapping[Kinds, float]) -> dict[Kinds, float]:
    """Probabilities of answers that are kept; the rest is that of a law outside the library."""
    found = {kinds: p for kinds, p in kept.items() if kinds != UNKNOWN}
    found[UNKNOWN] = 1.0 - sum(found.values())
    return dict(sorted(found.items(), key=lambda pair: -pair[1]))
