"""Probabilities of the answers that a diagnosis considered, `none` and `unknown` among them.

Bayes' rule on the evidence of every answer (`search.evidence`), with priors that are stated here.
They were learnt from generated tests (`benchmarks/blind_sets`, half `development`) and are proved
on others by `benchmarks/blind_sets/reliability.py`.
"""

from collections.abc import Iterable, Mapping
from math import comb
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from snrmjax.diagnose.checks.discrepancy import SIZES, discrepancies
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.diagnose.search.evidence import FittedAnswer, Marginal, fitted_answer
from snrmjax.diagnose.search.model_search import FoundEffects
from snrmjax.model.effects import EFFECTS

NONE, UNKNOWN, NOISE_REJECTED = "none", "unknown", "noise_rejected"

# Prior odds, of so many effects of the library to none; each kind is as probable as any other.
_EFFECTS = (1.0, 0.44, 0.033, 0.0034)
# Of a misfit beside an answer that no effect of the library explains, to none.
_DISCREPANCY = 0.1
# Of a law outside the library that acts like an answer, to that answer: for every doubt that names
# one, and without any.
_IMITATION, _UNNAMED = 0.4, 0.004
# Of noise that is stated wrong by more than `_TOLERATED`, to noise stated right.
_WRONG_NOISE = 0.5

_STATED = 0.1  # 1σ of the logarithm of noise over stated noise, where it is stated right
_TOLERATED, _MOST = 0.25, np.log(4.0)  # of that logarithm, where it is stated wrong
_ANSWERS = 8  # that are compared with themselves beside a discrepancy


class ConsideredAnswer(NamedTuple):
    """An answer with the logarithm of its prior odds times its evidence.

    The evidence is that of `log_evidence`, of the same data under the same errors for all answers.
    """

    name: str
    log_weight: float


def answer_name(kinds: Iterable[str]) -> str:
    """The name of an answer: its effects in alphabetic order, joined by `+`; `none` without any."""
    return "+".join(sorted(kinds)) or NONE


def probabilities_of(answers: Iterable[ConsideredAnswer]) -> dict[str, float]:
    """Probabilities by name, the largest first; weights of the same name add up.

    >>> probabilities_of([ConsideredAnswer("none", 0.0), ConsideredAnswer("unknown", -np.inf)])
    {'none': 1.0, 'unknown': 0.0}
    """
    weights: dict[str, float] = {}
    for name, weight in answers:
        weights[name] = float(np.logaddexp(weights.get(name, -np.inf), weight))
    total = logsumexp(list(weights.values()))
    order = sorted(weights, key=lambda name: -weights[name])
    return {name: float(np.exp(weights[name] - total)) for name in order}


def without_effects(probabilities: Mapping[str, float]) -> dict[str, float]:
    """Probabilities where no effect can be an answer: theirs are those of `unknown`.

    >>> without_effects({"an_effect": 0.75, "none": 0.25, "unknown": 0.0})
    {'none': 0.25, 'unknown': 0.75}
    """
    others = {name: probabilities.get(name, 0.0) for name in (NONE, NOISE_REJECTED)}
    kept = {name: value for name, value in others.items() if name in probabilities}
    return {**kept, UNKNOWN: 1.0 - sum(kept.values())}


def log_evidence(model: Marginal) -> float:
    """ln p of the data under a model, for noise as stated to within a tenth or so."""
    logs = np.linspace(-2 * _STATED, 2 * _STATED, 9)
    weights = -0.5 * (logs / _STATED) ** 2
    likelihood = model.log_likelihood(np.exp(logs)) + weights - logsumexp(weights)
    return float(logsumexp(likelihood))


def considered_answers(found: FoundEffects, doubts: int) -> list[ConsideredAnswer]:
    """All answers that a search compared under the errors of the one that it found.

    `unknown` has the weight of all answers beside a discrepancy of unknown size, and of laws that
    act like the answer found: more of them for every one of its `doubts` (`checks.doubts`).
    `noise_rejected` has that of all answers with noise of another size, where noise is stated.
    """
    fitted = _fitted(found)
    models = {kinds: one.marginal() for kinds, one in fitted.items()}
    priors = {kinds: _log_prior(len(kinds)) for kinds in fitted}
    logs = {kinds: log_evidence(one) + priors[kinds] for kinds, one in models.items()}
    answers = [ConsideredAnswer(answer_name(kinds), one) for kinds, one in logs.items()]
    if found.misfit.predictions.chosen.noise_stated:
        wrong = [_with_wrong_noise(one) + priors[kinds] for kinds, one in models.items()]
        answers.append(ConsideredAnswer(NOISE_REJECTED, _log(_WRONG_NOISE) + logsumexp(wrong)))
    first = sorted(logs, key=lambda kinds: -logs[kinds])[:_ANSWERS]
    beside = _beside_discrepancies(found.misfit, [fitted[kinds] for kinds in first])
    unknown = [_log(_DISCREPANCY) + priors[k] + one for k, one in zip(first, beside, strict=True)]
    unknown += [_log(_UNNAMED) + one for kinds, one in logs.items() if kinds]
    mine = frozenset(found.fit.kinds)
    if doubts and mine in logs:
        unknown.append(_log(doubts * _IMITATION) + logs[mine])
    return [*answers, ConsideredAnswer(UNKNOWN, float(logsumexp(unknown)))]


def _fitted(found: FoundEffects) -> dict[frozenset[str], FittedAnswer]:
    """Of every answer the fit with the largest evidence."""
    best: dict[frozenset[str], tuple[float, FittedAnswer]] = {}
    for fit in (found.baseline, found.fit, *found.considered):
        one = fitted_answer(found.misfit, fit)
        if one is None:
            continue
        kinds, evidence = frozenset(fit.kinds), log_evidence(one.marginal())
        if kinds not in best or evidence > best[kinds][0]:
            best[kinds] = evidence, one
    return {kinds: one for kinds, (_, one) in best.items()}


def _beside_discrepancies(misfit: WeightedMisfit, answers: list[FittedAnswer]) -> list[float]:
    """Of every answer ln p beside discrepancies of all kinds and sizes, each as probable."""
    found: list[list[float]] = [[] for _ in answers]
    for _, directions in discrepancies(misfit):
        for logs, one in zip(found, answers, strict=True):
            logs += [log_evidence(each) for each in one.with_discrepancy(directions, SIZES)]
    return [float(logsumexp(logs)) - _log(len(logs)) for logs in found]


def _with_wrong_noise(model: Marginal) -> float:
    """ln p for noise that is stated wrong, by a factor whose logarithm is equally distributed."""
    size = np.linspace(_TOLERATED, _MOST, 16)
    logs = np.concatenate([-size, size])
    return float(logsumexp(model.log_likelihood(np.exp(logs)))) - _log(len(logs))


def _log_prior(n_effects: int) -> float:
    """ln of the prior odds of one answer with so many effects to none."""
    return _log(_EFFECTS[n_effects]) - _log(comb(len(EFFECTS), n_effects))


def _log(value: float) -> float:
    return float(np.log(value))
