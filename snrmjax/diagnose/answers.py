"""Answers under some errors: what a search finds, weighed, and found again where it misfits."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from snrmjax.diagnose import evidence, priors
from snrmjax.diagnose.checks.residuals import neighbour_noise, rms_misfit
from snrmjax.diagnose.decide import most_probable
from snrmjax.diagnose.misfit.effect_fit import (
    EffectFit,
    at_phases_of,
    baseline_fit,
    likely_errors,
    without_errors,
)
from snrmjax.diagnose.misfit.predictions import Predictions
from snrmjax.diagnose.misfit.programs import MANY_HARMONICS
from snrmjax.diagnose.misfit.reference import with_unstated_level_errors
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit, weighted_misfit
from snrmjax.diagnose.search.model_search import FoundEffects, find_effects, refitted
from snrmjax.identify.calibrate.calibration_states import ASSUMED_ERROR
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effect_base import AbstractHysteresis, AbstractKinked
from snrmjax.model.effect_metadata import MotionScales
from snrmjax.model.effects import EFFECTS, is_own

_WITHOUT_LAST_HARMONIC = (AbstractKinked, AbstractHysteresis)


class Answered(NamedTuple):
    """What a search found under some errors, with the most probable answer first."""

    found: FoundEffects
    weights: evidence.Weights
    coarse: FoundEffects | None = None  # what was found with few harmonics, where many were taken

    @property
    def log_weight(self) -> float:
        """ln of the prior odds times the evidence of the most probable answer."""
        return self.weights.answers[0].log_weight


class Search(NamedTuple):
    """What is looked for, and from where."""

    scales: MotionScales
    kinds: tuple[str, ...]
    further_starts: Mapping[str, tuple[float, ...]]
    data: SteadyStates  # as it was measured

    def among(self, answered: Answered, n: int) -> "Search":
        """A search among the effects of the `n` best answers so far, and those of the user."""
        near = {kind for answer in answered.weights.answers[:n] for kind in answer.kinds}
        return self._replace(
            kinds=tuple(kind for kind in self.kinds if kind in near or is_own(kind))
        )

    def answered(self, predictions: Predictions) -> Answered:
        """What is missing; where no noise is stated, with noise as large as what is left.

        That begins with what smooth curves of amplitude leave, and is never below what
        neighbouring states show.
        """
        misfit, least = weighted_misfit(predictions), 0.0
        stated, reference = predictions.chosen.noise_stated, predictions.reference
        if not stated:
            alone = baseline_fit(misfit)
            least = float(np.sqrt(neighbour_noise(at_phases_of(misfit, alone), alone)))
            size = least
            if reference is not None:
                size = reference.posterior.hyper.noise / ASSUMED_ERROR
            least = min(least, size)
            misfit = weighted_misfit(predictions.with_errors_scaled(size / predictions.error_scale))
        found, winner = find_effects(misfit, *self[:3]), None
        for _ in range(0 if stated else 3):
            winner = self.refined(found.misfit, found.fit)
            factor = max(rms_misfit(*winner), least / misfit.predictions.error_scale)
            if priors.SAME_NOISE < factor < 1 / priors.SAME_NOISE:
                break
            misfit = weighted_misfit(misfit.predictions.with_errors_scaled(factor))
            found, winner = find_effects(misfit, *self[:3]), None
        best = found.fit

        def refined(misfit: WeightedMisfit, fit: EffectFit) -> tuple[WeightedMisfit, EffectFit]:
            return winner if winner is not None and fit is best else self.refined(misfit, fit)

        weights = evidence.weights_of(found, refined)
        return Answered(most_probable(found, weights), weights)

    def refined(self, misfit: WeightedMisfit, fit: EffectFit) -> tuple[WeightedMisfit, EffectFit]:
        """A fit again where the records are corrected for the errors that it finds in them.

        From where it is, and, unless that explains them, from the records as they are: smooth
        curves may miss a kink.
        """
        found = self._corrected(misfit, fit)
        if found is not None and found[1].p_value > priors.REJECTED:
            return found
        none = np.zeros_like(misfit.predictions.added)
        plain = without_errors(misfit, fit, self.data, none)
        other = self._corrected(plain, refitted(plain, self.scales, fit))
        both = [pair for pair in (found, other) if pair is not None]
        return min(both, key=lambda pair: pair[1].chi_square, default=(misfit, fit))

    def _corrected(
        self, misfit: WeightedMisfit, fit: EffectFit
    ) -> tuple[WeightedMisfit, EffectFit] | None:
        """The fit where nothing moves any more; None where no errors explain the records."""
        moved, straight = np.inf, 0.003  # relative or rad
        for _ in range(6):
            if not np.isfinite(fit.chi_square):
                return None
            added = likely_errors(misfit, fit.rows)
            if np.max(np.abs(added), initial=0.0) > priors.FARTHEST_ERROR:
                return None
            moved = np.max(np.abs(added - misfit.predictions.added), initial=0.0)
            if moved < straight:
                return misfit, fit
            misfit = without_errors(misfit, fit, self.data, added)
            fit = refitted(misfit, self.scales, fit)
        return (misfit, fit) if moved < priors.SETTLED_ERROR else None


def best_answer(search: Search, predictions: Predictions) -> Answered:
    """The most probable answer, whether levels differ by what nobody stated or not.

    That is asked where an answer leaves more than noise, or does what such levels would do.
    """
    answered = search.answered(predictions)
    answered = with_more_harmonics(answered, search.among(answered, priors.NEAREST_ANSWERS))
    alike = any(EFFECTS[kind].is_linear for kind in answered.found.fit.kinds)
    stated = all(std > 0 for std in predictions.given.level_stds)
    if stated or predictions.reference is None or not (alike or leaves_more_than_noise(answered)):
        return answered
    now = (answered.coarse or answered.found).misfit.predictions
    apart = search.answered(with_unstated_level_errors(now))
    apart = with_more_harmonics(apart, search.among(apart, priors.NEAREST_ANSWERS))
    odds = float(np.log(priors.LEVELS_APART))
    weights = evidence.either(answered.weights, apart.weights, odds)
    likelier = apart if apart.log_weight + odds > answered.log_weight else answered
    return likelier._replace(found=most_probable(likelier.found, weights), weights=weights)


def with_more_harmonics(answered: Answered, search: Search) -> Answered:
    """An answer that leaves more than noise, or beside noise of unknown size, with many harmonics.

    Kinks and slip have no last one.
    """
    found = answered.found
    kinked = any(issubclass(EFFECTS[kind], _WITHOUT_LAST_HARMONIC) for kind in found.fit.kinds)
    stated = found.misfit.predictions.chosen.noise_stated
    if not kinked or (stated and not leaves_more_than_noise(answered)):
        return answered
    now = found.misfit.predictions
    many = now.of_records(search.data, now.added, MANY_HARMONICS)
    winner = refitted(weighted_misfit(many), search.scales, found.fit)
    if winner.chi_square > 0.9 * found.fit.chi_square:
        return answered
    return search.answered(many)._replace(coarse=found)


def leaves_more_than_noise(answered: Answered) -> bool:
    """Whether the most probable answer leaves more than noise, or than smooth curves leave."""
    predictions = answered.found.misfit.predictions
    if predictions.chosen.noise_stated or predictions.reference is None:
        return answered.found.p_value < priors.REJECTED
    size = ASSUMED_ERROR * predictions.error_scale
    return bool(priors.SAME_NOISE * size > predictions.reference.posterior.hyper.noise)
