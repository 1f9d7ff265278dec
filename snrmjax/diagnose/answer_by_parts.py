"""The answer of a diagnosis by parts: fitted laws, verdict, completed model with remainder."""

import dataclasses
from collections.abc import Iterable, Mapping

import numpy as np

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.residuals import scatter_of_levels
from snrmjax.diagnose.diagnosis_result import Diagnosis, DrawnLaw, Estimate, completed_model
from snrmjax.diagnose.explained_parts import NamedParts, overall
from snrmjax.diagnose.fitted_effects import FittedEffects, refined
from snrmjax.diagnose.misfit.candidates import candidate, parameter_labels
from snrmjax.diagnose.misfit.effect_fit import EffectFit, baseline_fit, fit_effect
from snrmjax.diagnose.misfit.noise_model import chi_square_p_value
from snrmjax.diagnose.misfit.predictions import Predictions, scales_of
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit, weighted_misfit
from snrmjax.diagnose.naming.assessed import DRAWN
from snrmjax.diagnose.naming.parts import Naming, PartAnswer, Remainder
from snrmjax.diagnose.naming.remainder_law import remainder_laws
from snrmjax.diagnose.verdict import Kinds, Verdict, answer_of
from snrmjax.identify.calibrate.calibration_states import ASSUMED_ERROR
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effects import EFFECTS, is_own
from snrmjax.model.library.free_laws import StiffnessLaw
from snrmjax.model.structures import Structure
from snrmjax.numerics.facts import Fact

_AS_WELL = 1.5  # ratio of misfits within which two explanations are equally good
_SCATTERED = 2.0  # ratio to the scatter of neighbours beyond which a misfit is not noise
_INDEPENDENT = 0.5  # fraction of independent states from which on a misfit may be noise


def verdict_of(named: NamedParts, fitted: FittedEffects) -> tuple[Verdict, tuple[Fact, ...]]:
    """The verdict on a test, and facts that give the reason where it is not that of the parts."""
    posterior, chosen = named.problem.readings.posterior, fitted.misfit.predictions.chosen
    low, high = priors.TOLERATED_NOISE
    # Residual of smooth curves or of the answer, if smaller: a drift is no smooth curve.
    noise = float(posterior.hyper.noise)
    noise = min(noise, max(noise * named.naming.of_fundamentals, 1.0)) if noise > 1 else noise
    # Residuals correlated between neighbouring states are not noise of any standard deviation.
    stated = chosen.noise_stated and posterior.fraction > _INDEPENDENT
    stated = stated and not chosen.phase_unknown.any()
    misstated = stated and not low < np.log(noise) < high
    # Misstated noise shows in all levels, a jump or drift only in some: take the lower quartile.
    scatter = float(np.quantile(scatter_of_levels(fitted.misfit, fitted.fit), 0.25))
    as_noise = np.log(scatter) > high and noise < _SCATTERED * scatter
    if misstated and (noise < 1 or as_noise):
        return Verdict.NOISE_REJECTED, (Fact("noise_misstated", ratio=noise),)
    verdict = overall(named.naming)
    if misstated:  # neighbours scatter as stated: the residual is no function of amplitude
        nothing = verdict is Verdict.NOTHING_MISSING
        return Verdict.UNKNOWN if nothing else Verdict.DRAWN, (Fact("no_effect_explains"),)
    n_rows = len(named.problem.readings.rows)
    p_value = chi_square_p_value(n_rows * named.naming.misfit**2, n_rows)
    if verdict is Verdict.NOTHING_MISSING and p_value < priors.REJECTED:
        return Verdict.UNKNOWN, (Fact("no_effect_explains"),)
    missed = _missed_by_other_sensors(fitted)
    if missed is None:
        return verdict, ()
    nothing = verdict is Verdict.NOTHING_MISSING
    return Verdict.UNKNOWN if nothing else verdict, (Fact("other_sensors_missed", misfit=missed),)


def _missed_by_other_sensors(fitted: FittedEffects) -> float | None:
    """Misfit of the other sensors' fundamentals over the noise, if significant."""
    misfit, noise = fitted.misfit, fitted.misfit.noise
    others = (noise.column >= 2) & (noise.column < 2 * len(misfit.predictions.chosen.sensors))
    left = noise.without_shared(fitted.fit.rows)[others]
    if not left.size or chi_square_p_value(float(left @ left), left.size) > priors.REJECTED:
        return None
    missed = float(np.sqrt(np.mean(left**2)))
    return missed if missed > _AS_WELL else None


def parts_of(naming: Naming, *, explained: bool) -> tuple[PartAnswer, ...]:
    """The parts of an answer; drawn in place of named where the residual is not `explained`."""
    named = (Verdict.NAMED, Verdict.AMBIGUOUS)
    return tuple(
        part if explained or part.verdict not in named else part._replace(verdict="drawn")
        for part in naming.parts
    )


def answers_of(naming: Naming, verdict: Verdict) -> dict[Kinds, float]:
    """Probabilities of all sets of laws; 1 for the verdict itself where it has no answer."""
    if verdict in (Verdict.NOISE_REJECTED, Verdict.UNKNOWN):
        return {(verdict.value,): 1.0}
    return {answer_of(kinds): p for kinds, p in naming.answers.items()}


def agrees(naming: Naming, misfit: float) -> bool:
    """Whether the fit of the laws leaves about the same misfit as the readings."""
    return misfit < _AS_WELL * max(naming.misfit, 1.0)


def kinds_to_fit(named: NamedParts) -> list[str]:
    """The named effects, their alternatives, and the user's own effects."""
    wanted = {kind for group in named.naming.candidates for kind in group} | _own_kinds(named)
    return [kind for kind in EFFECTS if kind in wanted]


def _own_kinds(named: NamedParts) -> set[str]:
    return {one.kind for one in named.problem.columns if is_own(one.kind)}


def fitted_parts(named: NamedParts, predictions: Predictions, data: SteadyStates) -> FittedEffects:
    """The named laws fitted together by harmonic balance at the measured motions."""
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
        rivals.append(_fitted(misfit, named.naming, [kind]))  # always fit the user's own effects
    return FittedEffects(misfit, fit, baseline_fit(misfit), tuple(rivals), groups)


def _fitted(misfit: WeightedMisfit, naming: Naming, effects: Iterable[str]) -> EffectFit:
    """Effects added one by one and refitted together, from the readings' parameters if known."""
    fit, scales = baseline_fit(misfit), scales_of(misfit.predictions)
    for kind in effects:
        start, names = candidate(kind, scales), parameter_labels(kind)
        if all(name in naming.parameters for name in names):
            first = tuple(naming.parameters[name].value for name in names)
            start = start._replace(starts=(first, *start.starts[:1]))
        fit = fit_effect(misfit, start, fit if fit.kinds else None)
    return fit


def completed_by_parts(
    diagnosis: Diagnosis, named: NamedParts, baseline: Mapping[str, float], model: Structure
) -> Diagnosis:
    """The diagnosis with a completed model of laws and remainders.

    With a significant remainder, or where the fit disagrees with the readings, the laws'
    parameters are those of the readings; else those of the fit.
    """
    naming, answer = named.naming, diagnosis.answer
    if not diagnosis.verdict.is_answer:
        return diagnosis
    remainders = {
        part.part: part.remainder
        for part in naming.parts
        if part.part in DRAWN
        and part.remainder is not None
        and (part.remainder.significant or part.verdict == "drawn")
    }
    if agrees(naming, diagnosis.gap.after) and not remainders:
        return diagnosis
    parameters = _estimates(naming)
    # The linear mode as estimated with the laws from the readings.
    mode = f"mode_{model.modes.mode_of_interest + 1}"
    linear = {
        f"{mode}.natural_frequency": naming.natural_frequency,
        f"{mode}.damping_ratio": naming.damping_ratio,
    }
    baseline = {name: value for name, value in linear.items() if name in baseline}
    whole = completed_model(model, baseline, *_structural(naming.effects, parameters))
    completed, extended, reason = whole
    # Without a level the readings may name other laws: no cross-validation here.
    checks = diagnosis.checks._replace(completed_without={})
    gap = diagnosis.gap._replace(after=naming.misfit, interpolated=None, extrapolated=None)
    drawn: tuple[str, ...] = ()
    laws: tuple[DrawnLaw, ...] = ()
    if remainders and completed is not None:
        added = remainder_laws(named.problem, remainders)
        completed = dataclasses.replace(completed, effects=(*completed.effects, *added))
        extended = True
        if diagnosis.verdict is Verdict.DRAWN:
            laws = tuple(_drawn(named, part, one) for part, one in remainders.items())
            drawn = tuple(DRAWN[part] for part in remainders)
    notes = diagnosis.notes
    if reason:
        notes = (*notes, Fact("not_physical", reason=reason))
    answer = answer._replace(
        effects=(*naming.effects, *drawn),
        candidates=(*naming.candidates, *((kind,) for kind in drawn)),
        parameters=parameters,
        completed=completed,
        extended=extended,
        laws=laws,
    )
    return dataclasses.replace(diagnosis, answer=answer, gap=gap, checks=checks, notes=notes)


def _structural(
    effects: tuple[str, ...], parameters: Mapping[str, Estimate]
) -> tuple[tuple[str, ...], dict[str, float]]:
    """The effects with known parameters, which a model can have, and their values."""
    values = {name: one.value for name, one in parameters.items()}
    structural = tuple(k for k in effects if any(name.startswith(f"{k}.") for name in values))
    return structural, values


def _estimates(naming: Naming) -> dict[str, Estimate]:
    return {name: Estimate(*one) for name, one in naming.parameters.items()}


def _drawn(named: NamedParts, part: str, remainder: Remainder) -> DrawnLaw:
    """A remainder as the equivalent force at the sensor, with its describing function."""
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
    return DrawnLaw(name, at * shape, force / shape, std / shape, largest, passing)
