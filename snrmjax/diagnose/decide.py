"""The verdict: the one place where it is decided, from posteriors and predictive checks.

Probabilities are those of `evidence.weights_of`. Checks can refute what they cannot prove: a law
that contradicts a power of amplitude in the data, a level that was left out of the fit and missed,
a gain of the force that the data do not determine. What they refute keeps a small share of its
probability; the rest is that of a law outside the library.
"""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.doubts import (
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
from snrmjax.diagnose.evidence import NOISE_REJECTED, NONE, UNKNOWN, Weights
from snrmjax.diagnose.misfit.effect_fit import baseline_fit
from snrmjax.diagnose.search.locating import Located, power_of_answer
from snrmjax.diagnose.search.model_search import FoundEffects


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


class Judgement(NamedTuple):
    """A verdict, its reasons, and what stays open."""

    verdict: Verdict
    reasons: tuple[str, ...]
    open_questions: tuple[Doubt, ...]
    probabilities: Mapping[str, float]


def most_probable(found: FoundEffects, weights: Weights) -> FoundEffects:
    """What a search found, with the most probable answer, and of every effect its class.

    To the class of an effect belong those in its place in answers whose odds to the best one are
    `AS_GOOD` or better; answers of other sizes count for the effect that they lack, or for the
    first.
    """
    best = weights.answers[0]
    rivals = [
        one
        for one in weights.answers[1:]
        if one.log_weight > best.log_weight + np.log(priors.AS_GOOD) and one.kinds
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
    structure = pattern(misfit, fit) if found.p_value < priors.REJECTED else None
    of_noise, outside = probabilities.get(NOISE_REJECTED, 0.0), probabilities.get(UNKNOWN, 0.0)
    if of_noise > 0.5 and structure is None:
        times = float(np.sqrt(fit.chi_square / (misfit.n_rows - len(fit.values))))
        size = "overstated" if times < 1 else "understated"
        said = f"the misfit is {times:.2g} times the stated noise, without a pattern: it is {size}."
        return Judgement(Verdict.NOISE_REJECTED, (said,), (), probabilities)
    if outside + (of_noise if structure is not None else 0.0) >= priors.NO_ANSWER:
        left = structure or left_curve(misfit, fit)
        reasons = ("no effect of the library explains what is left.", *([left] if left else []))
        # What is left has a pattern, and so is no noise of any size.
        kept = {name: p for name, p in probabilities.items() if name != NOISE_REJECTED}
        return Judgement(Verdict.UNKNOWN, reasons, (), _else_unknown(kept))
    if not fit.kinds:
        return Judgement(Verdict.NOTHING_MISSING, (), (), probabilities)
    every = imitations_of(found, located)
    every += doubts_on_gains(misfit, fit, errors)
    every += missed_levels(levels, found, doubted=any(not one.identical for one in every))
    if rival is not None:
        every.append(rival.doubt)
    if not every and outside > priors.NO_DOUBT:
        said = left_curve(misfit, fit) or "what is left is small, but smoother than noise."
        every.append(
            Doubt(
                f"a law outside the library has a probability of {100 * outside:.0f} %: {said}",
                WIDER,
                identical=True,
            )
        )
    reasons = tuple(one.reason for one in every)
    if any(one.refutes for one in every):
        kept = {
            name: p if name in (NONE, NOISE_REJECTED) else priors.OPEN * p
            for name, p in probabilities.items()
        }
        return Judgement(Verdict.UNKNOWN, reasons, tuple(every), _else_unknown(kept))
    unclear = every or any(len(group) > 1 for group in found.classes)
    verdict = Verdict.AMBIGUOUS if unclear else Verdict.NAMED
    return Judgement(verdict, reasons, tuple(every), probabilities)


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


def _else_unknown(kept: Mapping[str, float]) -> dict[str, float]:
    """Probabilities of answers that are kept; the rest is that of a law outside the library."""
    found = {name: p for name, p in kept.items() if name != UNKNOWN}
    found[UNKNOWN] = 1.0 - sum(found.values())
    return dict(sorted(found.items(), key=lambda pair: -pair[1]))
