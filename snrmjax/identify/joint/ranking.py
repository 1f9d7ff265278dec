"""Ranking of families of curves by how well they predict left-out levels."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.identify.curves.family_base import AbstractFamily, Argument

_UNDECIDED = 2.0  # of log predictive density: what a term too many may cost
_DECISIVE = 4.0  # of log predictive density: what no scatter of scores from level to level excuses
_NEGLIGIBLE = 0.03  # weight of a curve that could not widen a band
_MOST_RIVALS = 4  # of a curve


class FamilyCandidate(NamedTuple):
    """One family tried, as the table of a report shows it."""

    curve: str  # "backbone" or "damping"
    family: str
    size: int
    argument: str
    parameters: int
    score: float  # log predictive density of left-out levels, relative to the best
    score_std: float  # of the difference to the best, from level to level
    prediction_error: float  # root mean square of left-out residuals, in units of their prediction
    chosen: bool
    weight: float = 0.0  # among all tried of this curve, by their scores; they sum to one
    converged: bool = True  # else its score is that of an unfinished fit, and a lower bound


class RivalCurve(NamedTuple):
    """A curve that was not taken, though it predicts left-out levels about as well."""

    curve: str  # "backbone" or "damping"
    weight: float
    family: AbstractFamily


class Compared(NamedTuple):
    """The curve to take, the table of all that were tried, and those that are about as good."""

    best: AbstractFamily
    table: list[FamilyCandidate]
    rivals: list[RivalCurve]


class Trial(NamedTuple):
    """One family of one size, fitted to the linearised balance."""

    kind: str
    size: int
    argument: Argument
    best: AbstractFamily
    scores: Float[np.ndarray, " fold"]  # log density of every left-out part
    prediction_error: float
    parameters: int
    converged: bool


def _weights(score: Float[np.ndarray, " family"]) -> Float[np.ndarray, " family"]:
    """How much each family is to be believed, by the log predictive density of what was left out.

    Reference: pseudo-Bayesian averaging, Yao et al., Bayesian Anal. 13 (2018) 917,
    doi:10.1214/17-BA1091.
    """
    known = np.isfinite(score)
    share = np.zeros(len(score))
    share[known] = np.exp(score[known] - np.max(score[known], initial=-np.inf))
    return share / max(np.sum(share), 1.0)


def ranked(name: str, trials: list[Trial]) -> Compared:
    """The trial to take, the table of all of them, and those that are about as good."""
    scores = np.array([one.scores for one in trials])
    total = scores.sum(axis=1)
    best = int(np.argmax(total))
    apart = scores[best] - scores
    spread = np.sqrt(scores.shape[1]) * np.std(apart, axis=1, ddof=1)
    sizes = np.array([one.parameters for one in trials])
    # A level that one curve misses by far makes that spread large: it must not excuse it.
    as_good = (total[best] - total) <= np.minimum(spread, _DECISIVE)
    as_good[best] = True
    # Of equally many parameters the one that is listed first, unless another is clearly better:
    # what the noise decides would widen nobody's band.
    least = as_good & (sizes == sizes[as_good].min())
    chosen = int(np.flatnonzero(least & (total >= total[least].max() - _DECISIVE))[0])
    # Bands know a curve's spread, not the bias of a term too few: one more if data allow.
    fair = (total[best] - total) <= 2 * spread + _UNDECIDED
    mine = trials[chosen]
    larger = [
        k
        for k in np.flatnonzero(fair)
        if (trials[k].kind, trials[k].argument) == (mine.kind, mine.argument)
        and sizes[k] > sizes[chosen]
    ]
    chosen = int(min(larger, key=lambda k: sizes[k], default=chosen))
    weight = _weights(total)
    table = [
        FamilyCandidate(
            curve=name,
            family=one.kind,
            size=int(one.size),
            argument=one.argument,
            parameters=int(sizes[k]),
            score=float(total[k] - total[best]),
            score_std=float(spread[k]),
            prediction_error=float(one.prediction_error),
            chosen=k == chosen,
            weight=float(weight[k]),
            converged=one.converged,
        )
        for k, one in enumerate(trials)
    ]
    ordered = [k for k in np.argsort(-weight) if k != chosen and weight[k] > _NEGLIGIBLE]
    rivals = [RivalCurve(name, float(weight[k]), trials[k].best) for k in ordered[:_MOST_RIVALS]]
    return Compared(trials[chosen].best, table, rivals)
