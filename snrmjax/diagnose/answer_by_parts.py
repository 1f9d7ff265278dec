"""A diagnosis with its answer by parts: exact laws, and laws that explain most of a change."""

import dataclasses
from collections.abc import Iterable, Mapping

import numpy as np

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.residuals import scatter_of_levels
from snrmjax.diagnose.diagnosis_result import (
    CompletedStatus,
    Diagnosis,
    Estimate,
    completed_model,
)
from snrmjax.diagnose.drawn_law import DrawnLaw
from snrmjax.diagnose.explained_parts import NamedParts, overall
from snrmjax.diagnose.fitted_effects import FoundEffects, TriedEffect, refined
from snrmjax.diagnose.misfit.candidates import candidate, parameter_labels
from snrmjax.diagnose.misfit.effect_fit import EffectFit, baseline_fit, fit_effect
from snrmjax.diagnose.misfit.noise_model import chi_square_p_value
from snrmjax.diagnose.misfit.predictions import Predictions, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit, weighted_misfit
from snrmjax.diagnose.naming.parts import DRAWN, Naming, PartAnswer, Remainder
from snrmjax.diagnose.naming.remainder_law import remainder_laws
from snrmjax.diagnose.verdict import Kinds, Verdict, answer_of
from snrmjax.identify.calibrate.calibration_states import ASSUMED_ERROR
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effect_metadata import Argument
from snrmjax.model.effects import EFFECTS, is_own
from snrmjax.model.library.free_laws import StiffnessLaw
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact

_AS_WELL = 1.5  # times the misfit, up to which two explanations are as good
_SCATTERED = 2.0  # times the scatter of neighbours, beyond which a misfit is no noise
_INDEPENDENT = 0.5  # of the states that err by themselves, from which on a misfit may be noise


def verdict_of(named: NamedParts, found: FoundEffects) -> tuple[Verdict, tuple[Fact, ...]]:
    """The verdict on a test, and why nothing is named where the readings do not say it."""
    posterior, chosen = named.problem.readings.posterior, found.misfit.predictions.chosen
    low, high = priors.TOLERATED_NOISE
    # Of smooth curves, and of what the answer leaves of it: a drift is no smooth curve.
    noise = float(posterior.hyper.noise)
    noise = min(noise, max(noise * named.naming.of_fundamentals, 1.0)) if noise > 1 else noise
    # What neighbouring states miss alike is no noise of any standard deviation.
    stated = chosen.noise_stated and posterior.fraction > _INDEPENDENT
    stated = stated and not chosen.phase_unknown.any()
    misstated = stated and not low < np.log(noise) < high
    # Noise of another size shows in all levels, a jump or a drift in some; neither makes it less.
    scatter = float(np.quantile(scatter_of_levels(found.misfit, found.fit), 0.25))
    as_noise = np.log(scatter) > high and noise < _SCATTERED * scatter
    if misstated and (noise < 1 or as_noise):
        return Verdict.NOISE_REJECTED, (Fact("noise_misstated", ratio=noise),)
    verdict = overall(named.naming)
    if misstated:  # neighbours scatter as stated: what is left is no function of the amplitude
        nothing = verdict is Verdict.NOTHING_MISSING
        return Verdict.UNKNOWN if nothing else Verdict.DRAWN, (Fact("no_effect_explains"),)
    n_rows = len(named.problem.readings.rows)
    by_chance = chi_square_p_value(n_rows * named.naming.misfit**2, n_rows)
    if verdict is Verdict.NOTHING_MISSING and by_chance < priors.REJECTED:
        return Verdict.UNKNOWN, (Fact("no_effect_explains"),)
    missed = _missed_by_other_sensors(found)
    if missed is None:
        return verdict, ()
    nothing = verdict is Verdict.NOTHING_MISSING
    return Verdict.UNKNOWN if nothing else verdict, (Fact("other_sensors_missed", misfit=missed),)


def _missed_by_other_sensors(found: FoundEffects) -> float | None:
    """Misfit of the fundamentals of the other sensors over the noise, where it is no chance."""
    misfit, noise = found.misfit, found.misfit.noise
    others = (noise.column >= 2) & (noise.column < 2 * len(misfit.predictions.chosen.sensors))
    left = noise.without_shared(found.fit.rows)[others]
    if not left.size or chi_square_p_value(float(left @ left), left.size) > priors.REJECTED:
        return None
    missed = float(np.sqrt(np.mean(left**2)))
    return missed if missed > _AS_WELL else None


def parts_of(naming: Naming, *, explained: bool) -> tuple[PartAnswer, ...]:
    """The parts of an answer; none of them is named where what is left is no noise."""
    named = (Verdict.NAMED, Verdict.AMBIGUOUS)
    return tuple(
        part if explained or part.verdict not in named else part._replace(verdict="drawn")
        for part in naming.parts
    )


def answers_of(naming: Naming, verdict: Verdict) -> dict[Kinds, float]:
    """Probabilities of all sets of laws; of a verdict without an answer that of itself."""
    if verdict in (Verdict.NOISE_REJECTED, Verdict.UNKNOWN):
        return {(verdict.value,): 1.0}
    return {answer_of(kinds): p for kinds, p in naming.answers.items()}


def agrees(naming: Naming, misfit: float) -> bool:
    """Whether a fit of the laws ended where the readings are: else it leaves more than they do."""
    return misfit < _AS_WELL * max(naming.misfit, 1.0)


def kinds_to_fit(named: NamedParts) -> list[str]:
    """The effects of a naming, those that may stand in their place, and the user's own."""
    wanted = {kind for group in named.naming.candidates for kind in group} | _own_kinds(named)
    return [kind for kind in EFFECTS if kind in wanted]


def _own_kinds(named: NamedParts) -> set[str]:
    return {one.kind for one in named.problem.columns if is_own(one.kind)}


def fitted_parts(named: NamedParts, predictions: Predictions, data: SteadyStates) -> FoundEffects:
    """The laws of a naming fitted by harmonic balance at the measured motions, all together."""
    reference = predictions.reference
    if not predictions.chosen.noise_stated and reference is not None:
        scale = reference.posterior.hyper.noise / ASSUMED_ERROR
        predictions = predictions.with_errors_scaled(scale / predictions.error_scale)
    misfit = weighted_misfit(predictions)
    fit = _fitted(misfit, named.naming, named.naming.effects)
    if fit.kinds:
        misfit, fit = refined(data, misfit, fit)
    by_kind = {group[0]: group for group in named.naming.candidates}
    groups = tuple(by_kind[kind] for kind in fit.kinds)
    rivals = [
        _fitted(misfit, named.naming, [rival if one == kind else one for one in fit.kinds])
        for kind, group in by_kind.items()
        for rival in group[1:]
    ]
    tried = {*fit.kinds, *(kind for one in rivals for kind in one.kinds)}
    for kind in sorted(_own_kinds(named) - tried):
        rivals.append(_fitted(misfit, named.naming, [kind]))  # who brings an effect sees it fitted
    nothing = baseline_fit(misfit)
    rows = tuple(_tried(nothing, one) for one in (fit, *rivals) if one.kinds)
    return FoundEffects(misfit, fit, nothing, (rows,), groups)


def _fitted(misfit: WeightedMisfit, naming: Naming, effects: Iterable[str]) -> EffectFit:
    """Effects fitted together, from the readings' parameters where there are some."""
    fit, scales = baseline_fit(misfit), scales_of(misfit.predictions)
    for kind in effects:
        one, names = candidate(kind, scales), parameter_labels(kind)
        if all(name in naming.parameters for name in names):
            first = tuple(naming.parameters[name].value for name in names)
            one = one._replace(starts=(first, *one.starts[:1]))
        fit = fit_effect(misfit, one, fit if fit.kinds else None)
    return fit


def _tried(nothing: EffectFit, fit: EffectFit) -> TriedEffect:
    """What a fit gains over the model as given."""
    return TriedEffect(
        fit.kinds[-1],
        nothing.criterion - fit.criterion,
        fit.chi_square,
        dict(zip(fit.labels, fit.values.tolist(), strict=True)),
        fit.status,
    )


def completed_by_parts(
    diagnosis: Diagnosis, named: NamedParts, baseline: Mapping[str, float], model: Structure
) -> Diagnosis:
    """The diagnosis with a completed model that holds laws and remainders.

    Where a remainder is seen, or the fit ended elsewhere, the laws' parameters are those of the
    readings; else those of the fit.
    """
    naming, answer = named.naming, diagnosis.answer
    if not diagnosis.verdict.is_answer:
        return diagnosis
    left = {
        part.part: part.remainder
        for part in naming.parts
        if part.part in DRAWN
        and part.remainder is not None
        and (part.remainder.significant or part.verdict == "drawn")
    }
    if agrees(naming, diagnosis.gap.after) and not left:
        return diagnosis
    parameters = _estimates(naming)
    # The linear mode is the one that the readings found with the laws.
    mode = f"mode_{model.modes.mode_of_interest + 1}"
    linear = {
        f"{mode}.natural_frequency": naming.natural_frequency,
        f"{mode}.damping_ratio": naming.damping_ratio,
    }
    baseline = {name: value for name, value in linear.items() if name in baseline}
    whole = completed_model(model, baseline, *_structural(naming.effects, parameters))
    completed, status, reason = whole.model, whole.status, whole.reason
    # Without a level the answer would be another one.
    checks = diagnosis.checks._replace(completed_without={})
    gap = diagnosis.gap._replace(after=naming.misfit, interpolated=None, extrapolated=None)
    drawn: tuple[str, ...] = ()
    laws: tuple[DrawnLaw, ...] = ()
    if left and completed is not None:
        added = remainder_laws(named.problem, left)
        completed = dataclasses.replace(completed, effects=(*completed.effects, *added))
        status = CompletedStatus.COMPLETED
        if diagnosis.verdict is Verdict.DRAWN:
            laws = tuple(_drawn(named, part, one) for part, one in left.items())
            drawn = tuple(DRAWN[part] for part in left)
    notes = diagnosis.notes
    if reason:
        notes = (*notes, Fact("not_physical", reason=reason))
    answer = answer._replace(
        effects=(*naming.effects, *drawn),
        candidates=(*naming.candidates, *((kind,) for kind in drawn)),
        parameters=parameters,
        completed=completed,
        completed_status=status,
        laws=laws,
    )
    return dataclasses.replace(diagnosis, answer=answer, gap=gap, checks=checks, notes=notes)


def _structural(
    effects: tuple[str, ...], parameters: Mapping[str, Estimate]
) -> tuple[tuple[str, ...], dict[str, float]]:
    """Of effects those whose parameters are known, which a model can hold, and their values."""
    values = {name: one.value for name, one in parameters.items()}
    held = tuple(k for k in effects if any(name.startswith(f"{k}.") for name in values))
    return held, values


def _estimates(naming: Naming) -> dict[str, Estimate]:
    return {name: Estimate(*one) for name, one in naming.parameters.items()}


def _drawn(named: NamedParts, part: str, remainder: Remainder) -> DrawnLaw:
    """A remainder as the force at the sensor that has its describing function."""
    (law,) = remainder_laws(named.problem, {part: remainder})
    readings = named.problem.readings
    shape = abs(readings.linear.shape)
    at = np.asarray(law.displacement)
    relative = float(np.max(remainder.std) / max(np.max(np.abs(remainder.value)), 1e-300))
    if isinstance(law, StiffnessLaw):
        force, passing, name = np.asarray(law.restoring_force), None, "spring"
    else:
        passing = float(np.max(remainder.velocity))
        force, name = np.asarray(law.coefficient) * passing / shape, "displacement_damping"
    largest = readings.largest * shape
    std = relative * np.max(np.abs(force)) * np.ones_like(force)
    return DrawnLaw(
        *(name, ("odd",), (), Argument.DISPLACEMENT, at * shape, force / shape, std / shape),
        largest=largest,
        passing=passing,
    )
