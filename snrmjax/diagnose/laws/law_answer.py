"""Where no effect of the library explains the data, an answer by a law that is drawn from them."""

import dataclasses
import logging
from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.residuals import (
    HeldOutLevels,
    held_out_by,
    held_out_places,
    left_curve,
    neighbour_noise,
    pattern,
    rows_of_level,
    tolerated,
)
from snrmjax.diagnose.laws.law_prior import PARTS, posterior
from snrmjax.diagnose.laws.law_search import (
    LAW_KINDS,
    DrawnLaw,
    LawFit,
    drawn_tables,
    fit_laws,
    law_effects,
    law_problem,
    secants_of,
)
from snrmjax.diagnose.misfit.effect_fit import EffectFit, baseline_fit
from snrmjax.diagnose.misfit.noise_model import chi_square_p_value
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.diagnose.search.model_search import FoundEffects
from snrmjax.model.parameters import with_parameters
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact

_log = logging.getLogger(__name__)


class LawAnswer(NamedTuple):
    """A law that passed all checks, and what it makes of the model."""

    laws: tuple[DrawnLaw, ...]
    kinds: tuple[str, ...]  # of the effects of the completed model
    share: float  # probability of its class, where the data follow one curve that the library lacks
    rivals: tuple[str, ...]  # kinds that would do about as well as the first
    fit: EffectFit
    misfit: WeightedMisfit
    p_value: float
    noise: float  # variance over the stated one, that neighbouring states show
    levels: HeldOutLevels | None
    completed: Structure
    completed_without: dict[int, Structure]
    notes: tuple[Fact, ...]
    decide_by: Fact | None


def law_answer(found: FoundEffects, model: Structure) -> LawAnswer | None:
    """A law in place of the effects that a search found, if it explains the data; else None.

    It must do so as an effect must: what is left is noise without a pattern, and a level between
    others that was left out of the fit is predicted; and where the effects do not fit, its evidence
    must be better than theirs.
    """
    _log.info("draws a force law from the data")
    try:
        fit = fit_laws(found.misfit)
    except np.linalg.LinAlgError:  # errors as a law passes them on leave nothing that was measured
        return None
    if fit is None or not fit.settled or fit.posterior.cost > -priors.DETECTED:
        return None
    misfit, numbers = fit.misfit, fit.misfit.level_numbers
    # Each with errors passed on as it passes them. Effects that fit were refuted otherwise.
    rejected = found.p_value < priors.REJECTED
    if rejected and fit.criterion > found.fit.criterion - priors.DETECTED:
        return None
    as_effect = _as_effect_fit(fit)
    neighbours = neighbour_noise(misfit, as_effect)
    freedom = round(misfit.n_rows - fit.posterior.freedom)
    p_value = chi_square_p_value(as_effect.chi_square, freedom)
    structure = pattern(misfit, as_effect) if p_value < priors.REJECTED else None
    allowed = tolerated(neighbours) if structure is None else 1.0
    if chi_square_p_value(as_effect.chi_square / allowed, freedom) < priors.REJECTED:
        return None
    if left_curve(misfit, as_effect) is not None:
        return None
    completed = _completed(model, misfit.baseline_parameters(as_effect.rows), fit, fit.secants)
    pairs, completed_without = [], {}
    for place in held_out_places(misfit):
        # The same parts, sizes and reaches chosen without the level too.
        kept = ~rows_of_level(misfit, place)
        problem = law_problem(misfit, fit.columns, fit.secants, fit.knots, fit.units, kept)
        without = posterior(problem, fit.posterior.parts)
        rows = as_effect.rows + as_effect.slopes @ (without.mean - fit.posterior.mean)
        values, vectors = np.linalg.eigh(without.covariance)
        root = as_effect.slopes @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        before = baseline_fit(misfit).rows, np.zeros((misfit.n_rows, 0))
        pairs.append(held_out_by(misfit, place, before, (rows, root), allowed))
        secants = secants_of(without.parts, without.mean, fit.units)
        baseline = misfit.baseline_parameters(rows, kept)
        completed_without[int(numbers[place])] = _completed(model, baseline, fit, secants)
    levels = HeldOutLevels(*pairs) if pairs else None
    if levels is not None:
        # The top one is predicted by extrapolation, of which a law of any shape promises nothing.
        inner = levels.inner
        worse = inner.after > inner.before and inner.p_value < priors.REJECTED
        if worse or inner.uncertain_p_value < priors.REJECTED / 2:
            return None
    laws = tuple(drawn_tables(fit))
    return LawAnswer(
        laws=laws,
        kinds=tuple(effect.kind for effect in completed.effects[len(model.effects) :]),
        share=(1 - priors.NO_CURVE) * fit.share,
        rivals=tuple(LAW_KINDS[part] for part in fit.rivals),
        fit=as_effect,
        misfit=misfit,
        p_value=p_value,
        noise=neighbours,
        levels=levels,
        completed=completed,
        completed_without=completed_without,
        notes=tuple(_notes(fit, laws, levels)),
        decide_by=_decide_by(fit),
    )


def _as_effect_fit(fit: LawFit) -> EffectFit:
    """The law as an effect whose parameters are the secants of its parts, in units plainly seen."""
    parts, mean = fit.posterior.parts, fit.posterior.mean
    units = secants_of(parts, np.eye(len(mean)), fit.units)
    columns = np.einsum("sctk,etk->esc", fit.columns.by_secant, units)
    slopes = fit.misfit.noise.noise_units(columns).T
    kinds = tuple(LAW_KINDS[part] for part in parts)
    labels = tuple(f"{kind}_{k}" for k, kind in enumerate(kinds))
    square, anywhere = fit.misfit.chi_square(fit.rows), np.full(len(mean), np.inf)
    return EffectFit(kinds, labels, mean, square, fit.rows, slopes, -anywhere, anywhere)


def _completed(
    model: Structure, baseline: dict[str, float], fit: LawFit, secants: np.ndarray
) -> Structure:
    """The model with its own parameters at their most likely values, and with a law."""
    moved = with_parameters(model, tuple(baseline), jnp.array(list(baseline.values())))
    return dataclasses.replace(moved, effects=(*model.effects, *law_effects(fit, secants)))


def _notes(
    fit: LawFit,
    laws: tuple[DrawnLaw, ...],
    levels: HeldOutLevels | None,
) -> Iterator[Fact]:
    first = laws[0]
    yield Fact(
        "law_is_drawn",
        freedom=fit.posterior.freedom,
        largest=first.largest,
        argument=first.argument.value,
    )
    if levels is not None:
        inner, outer = ((held.level, held.before, held.after) for held in levels)
        yield Fact("law_left_out", inner=inner, outer=outer)
    if _odd_alone(fit):
        yield Fact("odd_part_alone")
    if fit.rivals:
        yield Fact("laws_as_good", effects=tuple(LAW_KINDS[part] for part in fit.rivals))


def _odd_alone(fit: LawFit) -> bool:
    odd = PARTS[fit.posterior.parts[0]].symmetry == "odd"
    return odd and not fit.misfit.predictions.chosen.orders


def _decide_by(fit: LawFit) -> Fact | None:
    """The measurement that would settle what kind of law it is."""
    if not (fit.rivals or _odd_alone(fit)):
        return None
    return Fact("record_harmonics_of_law", kind_is_open=bool(fit.rivals))
