"""Effects fitted together by harmonic balance at the measured motions, and their rivals."""

from typing import NamedTuple

import numpy as np

from snrmjax.diagnose import priors
from snrmjax.diagnose.misfit.candidates import candidate
from snrmjax.diagnose.misfit.effect_fit import (
    EffectFit,
    baseline_fit,
    fit_effect,
    likely_errors,
    without_errors,
)
from snrmjax.diagnose.misfit.predictions import scales_of
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.measure.states import SteadyStates
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus


class TriedEffect(NamedTuple):
    """A candidate that was fitted."""

    kind: str
    gain: float  # fall of Schwarz's criterion from the model as given
    chi_square: float
    parameters: dict[str, float]
    status: MinimisationStatus


class FoundEffects(NamedTuple):
    """The effects of an answer, fitted, and those that may stand in their place."""

    misfit: WeightedMisfit  # with errors passed on as the answer passes them
    fit: EffectFit
    baseline: EffectFit
    table: tuple[tuple[TriedEffect, ...], ...]
    classes: tuple[tuple[str, ...], ...] = ()  # of every effect: itself, then those as probable

    @property
    def p_value(self) -> float:
        """Probability by chance of at least the misfit that is left."""
        return self.fit.p_value


def refitted(misfit: WeightedMisfit, fit: EffectFit) -> EffectFit:
    """The same effects fitted to another misfit, all together from where they were."""
    if not fit.kinds:
        return baseline_fit(misfit)
    *others, last = fit.kinds
    n = len(fit.values) - len(fit.of_kind(last))
    before = fit._replace(
        kinds=tuple(others),
        labels=fit.labels[:n],
        values=fit.values[:n],
        lower=fit.lower[:n],
        upper=fit.upper[:n],
    )
    begun = candidate(last, scales_of(misfit.predictions))._replace(starts=(fit.of_kind(last),))
    return fit_effect(misfit, begun, before)


def refined(
    data: SteadyStates, misfit: WeightedMisfit, fit: EffectFit
) -> tuple[WeightedMisfit, EffectFit]:
    """A fit again where the records are corrected for the errors that it finds in them.

    From where it is, and, unless that explains them, from the records as they are: smooth
    curves may miss a kink.
    """
    found = _corrected(data, misfit, fit)
    if found is not None and found[1].p_value > priors.REJECTED:
        return found
    none = np.zeros_like(misfit.predictions.added)
    plain = without_errors(misfit, fit, data, none)
    other = _corrected(data, plain, refitted(plain, fit))
    both = [pair for pair in (found, other) if pair is not None]
    return min(both, key=lambda pair: pair[1].chi_square, default=(misfit, fit))


def _corrected(
    data: SteadyStates, misfit: WeightedMisfit, fit: EffectFit
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
        misfit = without_errors(misfit, fit, data, added)
        fit = refitted(misfit, fit)
    return (misfit, fit) if moved < priors.SETTLED_ERROR else None
