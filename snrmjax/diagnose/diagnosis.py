"""The whole diagnosis: name the laws that explain the misfit, fit them, check the answer."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from snrmjax.diagnose import priors
from snrmjax.diagnose.answer_by_parts import (
    agrees,
    answers_of,
    completed_by_parts,
    fitted_parts,
    kinds_to_fit,
    parts_of,
    verdict_of,
)
from snrmjax.diagnose.checks.gains import fitted_gain, notes_on_gains
from snrmjax.diagnose.checks.residuals import (
    WithheldLevel,
    neighbour_noise,
    rms_misfit,
    withheld_level_indices,
    withheld_levels,
    without_level,
)
from snrmjax.diagnose.design.discriminating_test import recommendation, recommended_test
from snrmjax.diagnose.diagnosis_result import (
    Answer,
    Checks,
    CompletedModel,
    Diagnosis,
    Estimate,
    ForceMisfit,
    FormerAnswer,
    Gap,
    completed_model,
)
from snrmjax.diagnose.explained_parts import named_parts
from snrmjax.diagnose.fitted_effects import FittedEffects
from snrmjax.diagnose.kinds.registry import hypothesis_of
from snrmjax.diagnose.misfit.effect_fit import EffectFit, at_phases_of, at_reference
from snrmjax.diagnose.misfit.locating import Located, locate_misfit
from snrmjax.diagnose.misfit.noise_model import notes_without_phases, unit_columns
from snrmjax.diagnose.misfit.predictions import Predictions, predictions_of
from snrmjax.diagnose.misfit.reference import driven_by_voltage, with_first_gain, with_reference
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit, weighted_misfit
from snrmjax.diagnose.naming.detection import detection_limits
from snrmjax.diagnose.verdict import Kinds, Verdict
from snrmjax.identify.calibrate.calibration_states import ASSUMED_ERROR
from snrmjax.measure.phase_convention import naming_wrong_phases
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effect_base import AbstractLinearChange
from snrmjax.model.effects import EFFECTS
from snrmjax.model.structures import Structure, linear_terms_of
from snrmjax.numerics.blocks import on_one_core
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus
from snrmjax.numerics.rules import InputError


@on_numbers("Differentiate the force that a motion needs: `sj.identify.inverse_force`.")
@on_one_core
@naming_wrong_phases(data="data", modes="model")
def diagnose_model(
    model: Structure,
    data: SteadyStates,
    *,
    force_gain_std: float = 0.0,
    former: FormerAnswer | None = None,
) -> Diagnosis:
    """Identify the physics that a model lacks to explain measured steady states.

    Every state gives the mode's stiffness and damping, and other recorded harmonics, in excess of
    the model. The laws that explain most of this excess are named by parts (`naming`); the
    remainder is drawn as a free curve. The laws are then fitted together by harmonic balance at the
    measured motions.

    `force_gain_std`: relative 1σ of a gain common to all forces; 1 where it is unknown.
    `former`: the answer from fewer of these states; a note reports what the further states changed.
    With a drive voltage in index of the force, the gain is estimated and left free. Noise and level
    errors that are not stated are estimated: the noise from the scatter about smooth curves of
    amplitude, the level errors from the variance between levels that such curves leave. Phases that
    were not recorded are those of smooth curves with the recorded amplitudes; then only magnitudes
    are compared.

    Returns a `Diagnosis`; `diagnose.priors` has the thresholds of its verdict.
    Raises `ValueError` for too few states, an unknown force or sensors other than the model's.
    Validity: steady motions with the period of the force; effects that change the motion
    moderately, so that their contributions add up.
    Not differentiable: differentiate the force that a motion needs:
    `snrmjax.identify.inverse_force`.
    """
    gain, notes = None, list[Fact | str]()
    if driven_by_voltage(data):
        data, gain, of_gain = with_first_gain(model, data)
        force_gain_std = force_gain_std or priors.FREE_GAIN_STD
        notes += of_gain
    recorded = predictions_of(model, data, force_gain_std, kinds=())
    unknown = recorded.chosen.phase_unknown
    _check_states(recorded)
    phases = not unknown[:, 0].all()
    excluded = excluded_kinds(model, force_gain_std, phases=phases)
    named = named_parts(recorded, data, [kind for kind in EFFECTS if kind not in excluded])
    predictions = _corrected_predictions(recorded.with_kinds(kinds_to_fit(named)), data)
    fitted = fitted_parts(named, predictions, data)
    checked = _Checked.of(fitted)
    misfit, fit, naming = checked.misfit, fitted.fit, named.naming
    completed = _completed(model, checked)
    verdict, reasons = verdict_of(named, fitted)
    probabilities = answers_of(naming, verdict)
    notes += reasons
    if former is not None:
        notes.append(former.changed_to(probabilities))
    answer = _answer(verdict, probabilities, checked, completed)
    before, after = rms_misfit(misfit, fitted.baseline), rms_misfit(misfit, fit)
    if not agrees(naming, after):
        answer = answer._replace(force_gain=1.0)
    elif gain is not None and answer.effects:
        notes.append(Fact("gain_with_effects", gain=gain * answer.force_gain, before=gain))
    notes += _notes_on_data(checked)
    notes += _notes_on_answer(checked, completed) if agrees(naming, after) else []
    recorded_phases = not unknown[:, 0].any()
    open_classes = verdict is Verdict.AMBIGUOUS and recorded_phases
    test = recommended_test(fitted) if open_classes else None
    recommended = (
        recommendation(fitted, test, phases=recorded_phases) if verdict.is_answer else None
    )
    if verdict is Verdict.NOTHING_MISSING:  # less estimated level errors
        before = after = min(after, naming.misfit)
    diagnosis = Diagnosis(
        verdict=verdict,
        answer=answer,
        recommended=recommended,
        discriminating_test=test,
        located=checked.located,
        gap=Gap(before, after, *(checked.levels or (None, None))),
        checks=Checks(fit.p_value, float(np.sqrt(checked.neighbours)), completed.without),
        detection_limits=detection_limits(named.problem, naming, excluded),
        table=fitted.table,
        notes=tuple(notes),
        force_misfit=_force_misfit(misfit, fitted.baseline, fit),
        data=data,
        parts=parts_of(naming, explained=all(r.kind != "no_effect_explains" for r in reasons)),
    )
    diagnosis = completed_by_parts(diagnosis, named, misfit.baseline_parameters(fit.rows), model)
    shift = _frequency_shift(model, diagnosis.completed or model)
    if abs(shift) > priors.OTHER_MODE:
        off = Fact("frequency_off", fraction=shift)
        diagnosis = dataclasses.replace(diagnosis, notes=(*diagnosis.notes, off))
    return diagnosis


def _check_states(predictions: Predictions) -> None:
    """Raise `ValueError` for fewer states than a diagnosis needs."""
    unknown, least = predictions.chosen.phase_unknown[:, 0], 6
    n = len(unknown)
    if 2 * n - unknown.sum() < 2 * least:
        raise InputError(
            f"a diagnosis needs at least {least} usable steady states, or {2 * least} where phases "
            f"are unknown, not {n}."
        )


def _corrected_predictions(predictions: Predictions, data: SteadyStates) -> Predictions:
    """Predictions of corrected records, weighted by the smooth curves through the states."""
    predictions = with_reference(predictions)
    if not np.isfinite(weighted_misfit(predictions).base).all():
        raise InputError(
            "the model has no motion of the measured amplitude for some states: it is too far "
            "from the data for a comparison."
        )
    return at_reference(predictions, data)


class _Checked(NamedTuple):
    """An answer with the checks beyond its fit."""

    fitted: FittedEffects
    misfit: WeightedMisfit  # with unknown phases set to those of the answer
    located: tuple[Located, ...]
    neighbours: float  # variance over the stated one
    levels: list[WithheldLevel]  # in the middle and at the top; none below three levels
    parameters: dict[str, Estimate]

    @classmethod
    def of(cls, fitted: FittedEffects) -> "_Checked":
        """The checks of fitted effects."""
        fit, misfit = fitted.fit, at_phases_of(fitted.misfit, fitted.fit)
        neighbours = neighbour_noise(misfit, fit)
        levels = withheld_levels(misfit, fitted.baseline, fit)
        located = locate_misfit(misfit, fitted.baseline)
        return cls(fitted, misfit, located, neighbours, levels, _estimates(misfit, fit))


class _Completed(NamedTuple):
    """The completed model, and by level the one completed without it."""

    whole: CompletedModel
    without: dict[int, Structure]
    refused: tuple[int, ...]  # levels without which it is not physical


def _completed(model: Structure, checked: _Checked) -> _Completed:
    misfit, fit = checked.misfit, checked.fitted.fit
    values = {name: one.value for name, one in checked.parameters.items()}
    whole = completed_model(model, misfit.baseline_parameters(fit.rows), fit.kinds, values)
    without = {}
    for index in withheld_level_indices(misfit) if fit.kinds else ():
        parameters, baseline = without_level(misfit, fit, index)
        of_others = dict(zip(fit.labels, parameters.tolist(), strict=True))
        level = int(misfit.level_numbers[index])
        without[level] = completed_model(model, baseline, fit.kinds, of_others).model
    physical = {level: one for level, one in without.items() if one is not None}
    refused = tuple(level for level, one in without.items() if one is None)
    return _Completed(whole, physical, refused)


def _answer(
    verdict: Verdict,
    probabilities: Mapping[Kinds, float],
    checked: _Checked,
    completed: _Completed,
) -> Answer:
    fit, gain = checked.fitted.fit, fitted_gain(checked.misfit, checked.fitted.fit)
    return Answer(
        effects=fit.kinds if verdict.is_answer else (),
        candidates=checked.fitted.classes if verdict.is_answer else (),
        parameters=checked.parameters,
        status=fit.status,
        completed=completed.whole.model,
        extended=completed.whole.extended,
        force_gain=1.0 if gain is None else gain,
        probabilities=dict(probabilities),
    )


def excluded_kinds(model: Structure, force_gain_std: float, *, phases: bool) -> set[str]:
    """Kinds of effects excluded from the search."""
    excluded = {effect.kind for effect in model.effects}
    if force_gain_std > 0:  # a free gain already covers gain and mass errors
        excluded |= {kind for kind in EFFECTS if hypothesis_of(kind).like_force_gain}
    if force_gain_std > priors.LOOSE_GAIN:
        excluded |= {kind for kind in EFFECTS if hypothesis_of(kind).follows_force}
    if not phases:
        excluded |= {kind for kind in EFFECTS if hypothesis_of(kind).only_phase}
    return excluded


def _estimates(misfit: WeightedMisfit, fit: EffectFit) -> dict[str, Estimate]:
    """The effects' parameters and their 1σ."""
    sensitivities, norm = unit_columns(misfit.noise.decorrelated(fit.slopes.T).T)
    inverse = np.linalg.pinv(sensitivities.T @ sensitivities, rcond=1e-12, hermitian=True)
    std = np.sqrt(np.diag(inverse)) / norm
    return {
        label: Estimate(float(value), float(error))
        for label, value, error in zip(fit.labels, fit.values, std, strict=True)
    }


def _force_misfit(misfit: WeightedMisfit, baseline: EffectFit, fit: EffectFit) -> ForceMisfit:
    noise, chosen = misfit.noise, misfit.predictions.chosen
    rows = noise.column < 2
    used = np.unique(noise.state[rows])

    def left_of(one: EffectFit) -> Float[np.ndarray, "state part"]:
        left = np.full((len(chosen.rows), 2), np.nan)
        left[noise.state[rows], noise.column[rows]] = noise.without_shared(one.rows)[rows]
        return left[used]

    return ForceMisfit(chosen.rows[used], chosen.sensors[0], left_of(baseline), left_of(fit))


def _notes_on_data(checked: _Checked) -> Iterator[Fact | str]:
    """Notes on estimated noise and level errors where not stated, and on unknown phases."""
    predictions = checked.fitted.misfit.predictions
    if not predictions.chosen.noise_stated:
        yield Fact("noise_not_stated", size=ASSUMED_ERROR * predictions.error_scale)
    differing = predictions.reference.posterior.differing if predictions.reference else (False,) * 4
    free = np.where(predictions.unstated_levels, predictions.level_error_std, 0.0)
    for of_data, which in ((True, differing), (False, ~np.array(differing))):
        gain, phase, stiffness, damping = stds = np.where(which, free, 0.0).tolist()
        if any(stds):
            fractions = {"gain": gain, "frequency": 0.5 * stiffness, "damping": damping}
            yield Fact("levels_not_stated", phase=phase, **fractions, of_data=of_data)
    chosen = checked.misfit.predictions.chosen
    if not checked.levels:
        yield Fact("no_level_left_out", n_levels=chosen.n_levels)
    phase = np.angle(np.asarray(chosen.states.velocity)[:, 0])
    yield from notes_without_phases(chosen, phase, checked.misfit.level_numbers)
    yield from chosen.notes


def _notes_on_answer(checked: _Checked, completed: _Completed) -> Iterator[Fact]:
    misfit, fit = checked.misfit, checked.fitted.fit
    yield from notes_on_gains(misfit, fit)
    if completed.whole.reason:
        yield Fact("not_physical", reason=completed.whole.reason)
    if completed.refused:
        yield Fact("not_physical_without", levels=completed.refused)
    if not (fit.status.found_minimum or fit.status is MinimisationStatus.NOT_FITTED):
        yield Fact("answer_not_converged")
    tried = checked.fitted.table
    lost = {row.kind for row in tried if row.status is MinimisationStatus.NOT_FINITE}
    if lost:
        yield Fact("effects_not_fitted", effects=tuple(sorted(lost)))


def _frequency_shift(model: Structure, completed: Structure) -> float:
    """Relative shift of the natural frequency by the identified linear changes."""
    j, added = model.modes.mode_of_interest, completed.effects[len(model.effects) :]
    linear = [effect for effect in added if isinstance(effect, AbstractLinearChange)]
    changed = dataclasses.replace(model, effects=(*model.effects, *linear))
    before, after = (jax.tree.map(np.asarray, linear_terms_of(one)) for one in (model, changed))
    square = after.stiffness[j] / before.stiffness[j] * (before.mass[j] / after.mass[j])
    return float(np.sqrt(square)) - 1
