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


class FittedEffects(NamedTuple):
    """The fitted effects of an answer, and the alternatives to them."""

    misfit: WeightedMisfit  # with errors propagated through the answer
    fit: EffectFit
    baseline: EffectFit
    rivals: tuple[EffectFit, ...] = ()
    classes: tuple[tuple[str, ...], ...] = ()  # of every effect: itself, then its alternatives

    @property
    def table(self) -> tuple[TriedEffect, ...]:
        """The fits of effects with their gains over the given model, the answer's first."""
        return tuple(
            TriedEffect(
                one.kinds[-1],
                self.baseline.criterion - one.criterion,
                one.chi_square,
                dict(zip(one.labels, one.values.tolist(), strict=True)),
                one.status,
            )
            for one in (self.fit, *self.rivals)
            if one.kinds
        )


def refitted(misfit: WeightedMisfit, fit: EffectFit) -> EffectFit:
    """The same effects refitted together to another misfit, from their current values."""
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
    start = candidate(last, scales_of(misfit.predictions))._replace(starts=(fit.of_kind(last),))
    return fit_effect(misfit, start, before)


def refined(
    data: SteadyStates, misfit: WeightedMisfit, fit: EffectFit
) -> tuple[WeightedMisfit, EffectFit]:
    """Refit with the records corrected for the errors that the fit itself estimates.

    Starts from the current corrections and, unless that fits, also from the uncorrected records:
    the first corrections are those of smooth curves, which may miss a corner of the law.
    """
    corrected = _corrected(data, misfit, fit)
    if corrected is not None and corrected[1].p_value > priors.REJECTED:
        return corrected
    none = np.zeros_like(misfit.predictions.added)
    plain = without_errors(misfit, fit, data, none)
    other = _corrected(data, plain, refitted(plain, fit))
    both = [pair for pair in (corrected, other) if pair is not None]
    return min(both, key=lambda pair: pair[1].chi_square, default=(misfit, fit))


def _corrected(
    data: SteadyStates, misfit: WeightedMisfit, fit: EffectFit
) -> tuple[WeightedMisfit, EffectFit] | None:
    """The fit with converged corrections; None where no plausible errors explain the records."""
    change, tolerance = np.inf, 0.003  # relative or rad
    for _ in range(6):
        if not np.isfinite(fit.chi_square):
            return None
        added = likely_errors(misfit, fit.rows)
        if np.max(np.abs(added), initial=0.0) > priors.FARTHEST_ERROR:
            return None
        change = np.max(np.abs(added - misfit.predictions.added), initial=0.0)
        if change < tolerance:
            return misfit, fit
        misfit = without_errors(misfit, fit, data, added)
        fit = refitted(misfit, fit)
    return (misfit, fit) if change < priors.SETTLED_ERROR else None
