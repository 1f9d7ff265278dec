"""The whole diagnosis: locate the misfit, find effects that explain it, and check the answer."""

import dataclasses
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.diagnose import priors
from snrmjax.diagnose.answers import Search, best_answer
from snrmjax.diagnose.checks.gains import (
    gain_found,
    level_gains,
    notes_on_found_mass,
    notes_on_level_forces,
    notes_on_stated_parameters,
    suspected_level_forces,
    with_forces_that_acted,
)
from snrmjax.diagnose.checks.residuals import (
    held_out_levels,
    held_out_places,
    neighbour_noise,
    rms_misfit,
    tolerated,
    without_level,
)
from snrmjax.diagnose.decide import Verdict, decide, imitations_of
from snrmjax.diagnose.design.discriminating_test import recommendation, recommended_test
from snrmjax.diagnose.diagnosis_result import (
    Answer,
    Checks,
    CompletedModel,
    CompletedStatus,
    Diagnosis,
    Estimate,
    ForceMisfit,
    FormerAnswer,
    Gap,
    completed_model,
    what_changed,
)
from snrmjax.diagnose.laws.law_answer import LawAnswer, law_answer
from snrmjax.diagnose.misfit.effect_fit import EffectFit, at_phases_of, at_reference, baseline_fit
from snrmjax.diagnose.misfit.noise_model import notes_without_phases
from snrmjax.diagnose.misfit.predictions import Predictions, predictions_of, scales_of
from snrmjax.diagnose.misfit.reference import (
    FREE_GAIN_STD,
    driven_by_voltage,
    with_first_gain,
    with_reference,
)
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit, weighted_misfit
from snrmjax.diagnose.search.locating import locate_misfit
from snrmjax.diagnose.search.model_search import FoundEffects, detection_limits
from snrmjax.identify.calibrate.calibration_states import ASSUMED_ERROR
from snrmjax.measure.phase_convention import naming_wrong_phases
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effect_base import AbstractLinearChange
from snrmjax.model.effects import EFFECTS
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import on_one_core
from snrmjax.numerics.levenberg_marquardt import MinimisationStatus

_FEW = 2  # effects of an answer beside which no law is drawn


@on_one_core
@naming_wrong_phases
def diagnose_model(
    model: Structure,
    data: SteadyStates,
    *,
    force_gain_std: float = 0.0,
    former: FormerAnswer | None = None,
) -> Diagnosis:
    """Find the physics that a model lacks to explain measured steady states.

    Works in the force balance: the measured fundamental is prescribed, harmonic balance finds the
    other harmonics, and the force that this motion needs is compared with the measured one. The
    library's effects are fitted with the baseline's parameters free inside their stated errors
    and the levels' errors inside theirs; their evidence decides. Answers that a linear mode
    nearby could have caused are compared with one.

    `force_gain_std` is the relative 1σ of a gain that all forces share: 1 where it is unknown.
    `former` is the answer by fewer of these states: fits begin where its fits ended too, and the
    notes say what the further states changed.
    Where the force is known as a drive voltage only, a first value of its gain is found and the
    gain is free. Where neither noise nor errors of levels are stated, both are estimated: the
    noise is what the answer leaves, and the level-to-level variance what no smooth curves of
    amplitude explain. Where no effect of the library explains the data, a law that does is drawn
    from them (`laws.law_answer`), if their noise and their forces are known. Where gains of the
    forces of single levels explain the data better than any effects, the answer is found beside
    them (`checks.gains`); where they explain them as well, they are said first.

    Returns a `Diagnosis`; `decide.decide` has the rules of its verdict. Raises `ValueError`
    for too few states, an unknown force or sensors other than the model's.
    Validity: steady motions with the period of the force; effects that change the motion
    moderately, so that two of them add up.
    """
    notes: list[str] = []
    gain = None
    if driven_by_voltage(data):
        data, gain, of_gain = with_first_gain(model, data)
        force_gain_std = force_gain_std or FREE_GAIN_STD
        notes += of_gain
    predictions = predictions_of(model, data, force_gain_std)
    unknown = predictions.chosen.phase_unknown[:, 0]
    n, least = len(unknown), 6
    if 2 * n - unknown.sum() < 2 * least:
        raise ValueError(
            f"a diagnosis needs at least {least} usable steady states, or {2 * least} where phases "
            f"are unknown, not {n}."
        )
    # Beside an unknown gain nothing says which level's force is off.
    estimable = force_gain_std == 0 and not predictions.chosen.phase_unknown.any()
    predictions = with_reference(predictions)
    misfit = weighted_misfit(predictions)
    if not np.isfinite(misfit.base).all():
        raise ValueError(
            "the model has no motion of the measured amplitude for some states: it is too far "
            "from the data to be compared."
        )
    predictions = at_reference(predictions, data)
    scales = scales_of(predictions)
    excluded = excluded_kinds(model, force_gain_std, phases=not unknown.all())
    kinds = tuple(kind for kind in EFFECTS if kind not in excluded)
    search = Search(scales, kinds, former.starts if former else {}, data)
    answered = best_answer(search, predictions)
    found, weights = answered.found, answered.weights
    as_recorded, rival = found, None
    if predictions.chosen.noise_stated and estimable:
        rival = suspected_level_forces(found, tolerated(neighbour_noise(found.misfit, found.fit)))
    if rival is not None and rival.is_better:
        own = found.misfit.predictions
        freed = dataclasses.replace(own, free_level_forces=rival.places)
        found, weights = search.answered(freed)[:2]
    misfit, fit = at_phases_of(found.misfit, found.fit), found.fit
    located = locate_misfit(misfit, found.baseline)
    weights = weights.with_imitations(len(imitations_of(found, located)))
    neighbours = neighbour_noise(misfit, fit)
    levels = held_out_levels(misfit, found.baseline, fit, tolerated(neighbours))
    parameters = _estimates(misfit, fit)
    errors = {name: one.std for name, one in parameters.items()}
    gains = level_gains(misfit, fit)
    judgement = decide(found, weights, located, levels, errors, None if gains else rival)
    test = None
    # Without phases the first measurement to recommend is that of the phases.
    if judgement.verdict is Verdict.AMBIGUOUS and not unknown.any():
        test = recommended_test(found)
    completed = completed_model(
        model,
        misfit.baseline_parameters(fit.rows),
        fit.kinds,
        {name: one.value for name, one in parameters.items()},
    )
    force = gain_found(misfit, fit)
    something = judgement.verdict is not Verdict.NOTHING_MISSING
    answer = Answer(
        effects=fit.kinds if something else (),
        candidates=found.classes if something else (),
        parameters=parameters,
        status=fit.status,
        completed=completed.model,
        completed_status=completed.status,
        force_gain=1.0 if force is None else force.value,
        probabilities=dict(judgement.probabilities),
    )
    without, refused = _completed_without_levels(misfit, model, fit)
    if former is not None:
        notes.append(what_changed(former, answer.probabilities))
    if gain is not None and answer.effects:
        notes.append(
            f"with the effects found the gain becomes {gain * answer.force_gain:.3g} N/V (before: "
            f"{gain:.3g})."
        )
    notes += notes_on_level_forces(gains, rival, as_recorded)
    notes += [*judgement.reasons, *_notes_on_noise(found.misfit.predictions)]
    if levels is None:
        n = predictions.chosen.n_levels
        notes.append(
            f"{n} level{'s' if n > 1 else ''} only: no level can be left out of the fit to test "
            "the answer."
        )
    chosen = misfit.predictions.chosen
    phase = np.angle(np.asarray(chosen.states.velocity)[:, 0])
    notes += [*notes_without_phases(chosen, phase, misfit.level_numbers), *map(str, chosen.notes)]
    notes += [*notes_on_stated_parameters(misfit, fit), *notes_on_found_mass(misfit, fit)]
    notes += _notes_on_answer(model, completed, refused, fit)
    notes += _notes_on_fits(found)
    diagnosis = Diagnosis(
        verdict=judgement.verdict,
        answer=answer,
        decide_by=recommendation(
            found,
            test,
            [
                *([rival.remedy] if rival is not None and gains else []),
                *(doubt.decide_by for doubt in judgement.open_questions),
            ],
            phases=not unknown.any(),
        ),
        discriminating_test=test,
        located=located,
        gap=Gap(
            rms_misfit(as_recorded.misfit, as_recorded.baseline),
            rms_misfit(misfit, fit),
            *(levels or (None, None)),
        ),
        checks=Checks(found.p_value, float(np.sqrt(neighbours)), without),
        detection_limits=detection_limits(misfit, fit, scales, excluded),
        table=found.table,
        notes=tuple(note for note in notes if note),
        force_misfit=_force_misfit(misfit, found.baseline, fit),
        data=with_forces_that_acted(data, gains),
        level_forces=gains,
    )
    known = predictions.chosen.noise_stated and force_gain_std == 0 and not unknown.any()
    # Three effects together can follow most laws: one drawn law may do as well.
    if not known or not (judgement.verdict is Verdict.UNKNOWN or len(fit.kinds) > _FEW):
        return diagnosis
    # Laws of many knots are drawn with few harmonics.
    law = law_answer(answered.coarse or found, model)
    return diagnosis if law is None else _with_law(diagnosis, law)


def _with_law(diagnosis: Diagnosis, law: LawAnswer) -> Diagnosis:
    """A diagnosis with a drawn law in place of effects that do not explain the data."""
    misfit, nothing = law.misfit, baseline_fit(law.misfit)
    answer = diagnosis.answer._replace(
        effects=law.kinds,
        candidates=((law.kinds[0], *law.rivals), *((kind,) for kind in law.kinds[1:])),
        parameters={},
        status=MinimisationStatus.CONVERGED,
        completed=law.completed,
        completed_status=CompletedStatus.COMPLETED,
        laws=law.laws,
        probabilities=_with_probability_of_law(diagnosis.probabilities, law),
    )
    checks = diagnosis.checks._replace(
        p_value=law.p_value,
        noise_scale=float(np.sqrt(law.noise)),
        completed_without=law.completed_without,
    )
    return dataclasses.replace(
        diagnosis,
        verdict=Verdict.DRAWN,
        answer=answer,
        decide_by=law.decide_by,
        discriminating_test=None,
        gap=Gap(
            rms_misfit(misfit, nothing), rms_misfit(misfit, law.fit), *(law.levels or (None, None))
        ),
        checks=checks,
        notes=(*law.notes, *map(str, misfit.predictions.chosen.notes)),
        force_misfit=_force_misfit(misfit, nothing, law.fit),
    )


def _with_probability_of_law(
    probabilities: Mapping[str, float], law: LawAnswer
) -> dict[str, float]:
    """A law's share of what is outside the library, and of the effects in whose place it stands."""
    apart = {
        name: p
        for name, p in probabilities.items()
        if name != Verdict.UNKNOWN.value and len(name.split("+")) <= _FEW
    }
    outside, own = 1 - sum(apart.values()), "+".join(law.kinds)
    shares = {own: law.share * outside, Verdict.UNKNOWN.value: (1 - law.share) * outside}
    return dict(sorted((apart | shares).items(), key=lambda pair: -pair[1]))


def excluded_kinds(model: Structure, force_gain_std: float, *, phases: bool) -> set[str]:
    """Kinds of effects that are not looked for."""
    excluded = {effect.kind for effect in model.effects}
    if force_gain_std > 0:  # of a gain that is not known none can be missing, nor of the mass
        excluded |= {kind for kind, effect in EFFECTS.items() if effect.like_force_gain}
    if force_gain_std > priors.LOOSE_GAIN:
        excluded |= {kind for kind, effect in EFFECTS.items() if effect.follows_force}
    if not phases:
        excluded |= {kind for kind, effect in EFFECTS.items() if effect.only_phase}
    return excluded


def _notes_on_noise(predictions: Predictions) -> list[str]:
    """What is taken for noise, and for errors of levels, where neither is stated."""
    notes = []
    if not predictions.chosen.noise_stated:
        size = ASSUMED_ERROR * predictions.error_scale
        notes.append(
            f"no noise is stated: what is left ({100 * size:.2g} % of velocity, "
            f"{np.degrees(size):.2g}°) is taken for it, so a good fit proves nothing."
        )
    found = predictions.reference.posterior.differing if predictions.reference else (False,) * 4
    free = np.where(predictions.unstated_levels, predictions.level_sizes, 0.0)
    units = (100.0, 180 / np.pi, 50.0, 100.0)
    words = (" % in gain", "° in phase", " % in frequency", " % in damping")
    seen, allowed = (
        ", ".join(
            f"{unit * size:.2g}{word}"
            for unit, size, word in zip(units, sizes, words, strict=True)
            if size > 0
        )
        for sizes in (np.where(found, free, 0.0), np.where(found, 0.0, free))
    )
    if seen:
        notes.append(
            f"levels differ by {seen} (1σ), which nobody stated: taken for errors that the states "
            "of a level share. State them in [measurement] if they are known."
        )
    if allowed:
        notes.append(
            f"nobody stated by how much levels may be off: {allowed} (1σ) are allowed for. State "
            "them in [measurement] if they are known."
        )
    return notes


def _estimates(misfit: WeightedMisfit, fit: EffectFit) -> dict[str, Estimate]:
    """The effects' parameters and their 1σ."""
    arms = misfit.noise.decorrelated(fit.slopes.T).T
    size = np.linalg.norm(arms, axis=0)
    size = np.where(size > 0, size, 1.0)
    inverse = np.linalg.pinv((arms / size).T @ (arms / size), rcond=1e-12, hermitian=True)
    std = np.sqrt(np.diag(inverse)) / size
    return {
        label: Estimate(float(value), float(error))
        for label, value, error in zip(fit.labels, fit.values, std, strict=True)
    }


def _completed_without_levels(
    misfit: WeightedMisfit, model: Structure, fit: EffectFit
) -> tuple[dict[int, Structure], list[int]]:
    """By level: the model completed by the other levels; and the levels where that is none."""
    found, refused, numbers = {}, [], misfit.level_numbers
    for place in held_out_places(misfit) if fit.kinds else ():
        values, baseline = without_level(misfit, fit, place)
        own, level = dict(zip(fit.labels, values.tolist(), strict=True)), int(numbers[place])
        completed = completed_model(model, baseline, fit.kinds, own)
        if completed.model is None:
            refused.append(level)
        else:
            found[level] = completed.model
    return found, refused


def _force_misfit(misfit: WeightedMisfit, baseline: EffectFit, fit: EffectFit) -> ForceMisfit:
    noise, chosen = misfit.noise, misfit.predictions.chosen
    mine = noise.column < 2
    used = np.unique(noise.state[mine])

    def left_of(one: EffectFit) -> Float[np.ndarray, "state part"]:
        left = np.full((len(chosen.rows), 2), np.nan)
        left[noise.state[mine], noise.column[mine]] = noise.without_shared(one.rows)[mine]
        return left[used]

    return ForceMisfit(chosen.rows[used], chosen.sensors[0], left_of(baseline), left_of(fit))


def _notes_on_answer(
    model: Structure,
    completed: CompletedModel,
    refused: list[int],
    fit: EffectFit,
) -> list[str]:
    notes = []
    shift = _frequency_shift(model, completed.model or model)
    if abs(shift) > priors.OTHER_MODE:
        notes.append(
            f"the model's natural frequency is off by {100 * shift:.0f} %: are these measurements "
            "of another mode?"
        )
    if completed.status is CompletedStatus.NOT_PHYSICAL:
        notes.append(
            f"there is no completed model: {completed.reason} The parameters that fit best are "
            "none that a structure can have."
        )
    if refused:
        levels = " and ".join(str(level) for level in refused)
        notes.append(f"without level {levels} the parameters are none that a structure can have.")
    if not (fit.status.found_minimum or fit.status is MinimisationStatus.NOT_FITTED):
        notes.append("the fit of the answer itself had not converged when it ended.")
    return notes


def _frequency_shift(model: Structure, completed: Structure) -> float:
    """Relative shift of the natural frequency by the linear changes that were found."""
    j, added = model.modes.mode_of_interest, completed.effects[len(model.effects) :]
    linear = [effect for effect in added if isinstance(effect, AbstractLinearChange)]
    changed = dataclasses.replace(model, effects=(*model.effects, *linear))
    before, after = model.linear_terms(), changed.linear_terms()
    square = after.stiffness[j] / before.stiffness[j] * (before.mass[j] / after.mass[j])
    return float(jnp.sqrt(square)) - 1


def _notes_on_fits(found: FoundEffects) -> list[str]:
    rows = [row for step in found.table for row in step]
    lost = sorted({row.kind for row in rows if row.status is MinimisationStatus.NOT_FINITE})
    if not lost:
        return []
    return [
        f"{', '.join(lost)} could not be fitted: with no starting point does the model have the "
        "measured motions."
    ]
