"""Sentences of a diagnosis: verdict, reasons, notes, drawn laws."""

from collections.abc import Sequence

import numpy as np

from snrmjax.numerics.units import unit_in_print
from snrmjax.report.sentences import Wording, number_of, of_levels

_PEOPLE = ("Coulomb", "Jenkins", "Iwan", "Van der Pol")
_LAWS = {
    "spring": "odd stiffness",
    "displacement_damping": "odd damping that depends on the displacement",
}
_COMPLETED = {
    "completed": "",
    "nothing_added": "nothing was added to the model",
    "not_physical": ", but the parameters are not physical: there is no completed model",
}
_UNITS = {"velocity": "m/s", "displacement": "m"}


def effect_name(kind: str) -> str:
    """An effect's kind in words.

    >>> effect_name("internal_resonance_1_3")
    'internal resonance 1:3'
    """
    words = kind.replace("_", " ")
    for name in _PEOPLE:
        words = words.replace(name.lower(), name)
    return f"{words[:-2]}:{words[-1]}" if words[-3:-2].isdigit() and words[-1].isdigit() else words


def probability_in_words(probability: float) -> str:
    """A probability in per cent, never rounded to certainty.

    >>> probability_in_words(0.937), probability_in_words(0.9999)
    ('94 %', 'above 99 %')
    """
    if 0.005 <= probability <= 0.995:
        return f"{100 * probability:.0f} %"
    return "below 1 %" if probability < 0.5 else "above 99 %"


def effect_names(kinds: Sequence[str], word: str = "and") -> str:
    """Kinds in words as a list."""
    names = [effect_name(kind) for kind in kinds]
    return f" {word} ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _times(misfit: float) -> str:
    return f"{misfit:.1f}" if misfit < 10 else f"{misfit:.0f}"


def kinds_in_words(kinds: Sequence[str]) -> str:
    """The effects of an answer, or that of none, in words."""
    return " with ".join(map(effect_name, kinds))


def _verdict(
    *,
    verdict: str,
    classes: Sequence[Sequence[str]],
    laws: Sequence[str],
    misfit_before: float,
    misfit: float,
) -> str:
    effects = effect_names([group[0] for group in classes])
    falls = f"the misfit falls from {_times(misfit_before)} to {_times(misfit)} times the noise"
    with_it = "with them" if len(classes) > 1 else "with it"
    match verdict:
        case "none":
            return (
                "No missing effect is detected in these data: the model as given fits them to "
                f"{_times(misfit)} times the noise."
            )
        case "noise_rejected":
            return (
                "The stated noise is inconsistent with the scatter of these data, so no effect is "
                "named: state the noise of a repeated test, or none, and diagnose again."
            )
        case "unknown":
            start = "The model lacks something that no effect in the library explains reliably"
            return f"{start}; the best attempt is {effects}: {falls}." if effects else f"{start}."
        case "drawn":
            return (
                "The model lacks a force that no effect in the library explains, drawn from the "
                f"data: {'; in addition '.join(laws)}. With it {falls}."
            )
        case "named":
            return (
                f"The model lacks {effects}: {with_it} {falls}, and nothing else explains as much."
            )
    if any(len(group) > 1 for group in classes):
        rivals = " and ".join(effect_names(group, "or") for group in classes)
        return (
            f"The model lacks {rivals}, and these data cannot distinguish them: {with_it} {falls}."
        )
    return (
        f"The model probably lacks {effects}: {with_it} {falls}, but something else could have the "
        "same effect (see the notes)."
    )


def _part_of_change(
    *,
    part: str,
    verdict: str,
    classes: Sequence[Sequence[str]],
    probability: float,
    explained: Sequence[float] | None,
    left: bool,
) -> str:
    laws = " and ".join(effect_names(group, "or") for group in classes)
    if part == "instrument":
        if verdict == "drawn":
            return f"The records probably show {laws} ({probability_in_words(probability)})."
        return f"The records show {laws}."
    what = f"the change of {part} with amplitude"
    if part.startswith("harmonic"):
        what = part.replace("_", " ")
    if not classes or explained is None:
        return f"No law in the library explains {what}: it is drawn as a curve."
    value, low, high = (f"{100 * number:.0f}" for number in explained)
    band = f"{value} %" if low == high else f"{value} % ({low} to {high})"
    if explained[0] < 0.5:
        return (
            f"No law in the library explains most of {what}: it is drawn as a curve. Closest: "
            f"{laws}, {band}."
        )
    several = any(len(group) > 1 for group in classes)
    verb = "explain" if len(classes) > 1 else "explains"
    text = f"{laws[0].upper()}{laws[1:]} {verb} {band} of {what}"
    if several:
        text += "; these data cannot distinguish them"
    elif probability < 0.99:
        text += f", with a probability of {probability_in_words(probability)}"
    return (
        f"{text}. The remainder exceeds the noise: it is drawn as a curve." if left else f"{text}."
    )


def _most_probable(*, verdict: float, answers: Sequence[tuple[Sequence[str], float]]) -> str:
    listed = ", ".join(f"{kinds_in_words(one)} {probability_in_words(p)}" for one, p in answers)
    return f"{probability_in_words(verdict)} for this verdict ({listed})"


def _before(
    *,
    verdict: str,
    effects: Sequence[str],
    probabilities: Sequence[tuple[Sequence[str], float | None, float]],
) -> str:
    changes = [
        f"{kinds_in_words(kinds)} "
        + (f"now {100 * now:.0f} %" if p is None else f"{100 * p:.0f} % → {100 * now:.0f} %")
        for kinds, p, now in probabilities
    ]
    named = effect_names(effects) or "no effect"
    return (
        f"before the additional states the verdict was {verdict} ({named}). Probabilities: "
        f"{', '.join(changes)}."
    )


def _level_errors(
    *, gain: float, phase: float, frequency: float, damping: float, of_data: bool
) -> str:
    errors = (
        *((gain, 100.0, " % in gain"), (phase, 180 / np.pi, "° in phase")),
        *((frequency, 100.0, " % in frequency"), (damping, 100.0, " % in damping")),
    )
    listed = ", ".join(f"{unit * error:.2g}{word}" for error, unit, word in errors if error > 0)
    if of_data:
        return (
            f"levels differ by {listed} (1σ), for which no error is stated: treated as errors "
            "common to all states of a level. State them in [measurement] if they are known."
        )
    return (
        f"no level-to-level errors are stated: {listed} (1σ) are assumed. State them in "
        "[measurement] if they are known."
    )


def _placed(place: str, probability: float, other: str, misfit: float, sensor: str | None) -> str:
    where = "on the mode as a whole" if place == "everywhere" else f"at {place}"
    return f"the missing force acts {where} ({probability_in_words(probability)})."


def _no_place_fits(
    place: str, probability: float, other: str, misfit: float, sensor: str | None, kind: str
) -> str:
    law = f"{effect_name(kind)} at {place}" if kind else place
    return (
        "no single force at these points reproduces the measured response: the best, "
        f"{law}, leaves a residual of {misfit:.2g} times the noise. The force acts elsewhere, at "
        "several points or with another law, or the linear model is wrong."
    )


def _not_placed(
    place: str, probability: float, other: str, misfit: float, sensor: str | None
) -> str:
    ranking = (
        f"the sensors do not determine where the missing force acts: {place} "
        f"({probability_in_words(probability)}) and {other} are the most probable"
    )
    return f"{ranking}." if sensor is None else f"{ranking}; a sensor at {sensor} would decide."


SENTENCES: dict[str, Wording] = {
    "force_placed": _placed,
    "placed_law_explains": lambda kind: (
        f"{effect_name(kind)} at one point explains all sensors within the noise, which effects on "
        "the mode alone do not."
    ),
    "force_not_placed": _not_placed,
    "no_place_fits": _no_place_fits,
    # The verdict and the first lines of a result.
    "verdict": _verdict,
    "part_of_change": _part_of_change,
    "misfit_falls": lambda *, before, after: (
        f"With this the misfit falls from {_times(before)} to {_times(after)} times the noise."
    ),
    "most_probable": _most_probable,
    "probability_of_verdict": "probability: {probability}",
    "parameter_found": lambda *, name, unit, value, std: (
        f"{name} = {value:.4g} ± {std:.2g} {unit_in_print(unit)}".rstrip()
    ),
    "misfits": lambda *, before, after, unsure: (
        f"misfit: {before:.3g} before, {after:.3g} after, in units of noise"
        + ("; the ± above holds only if the noise is as stated" if unsure else "")
    ),
    "level_left_out": "level {level}, left out: {before:.3g} before, {after:.3g} after",
    "to_decide": "to decide: {by}",
    "diagnosis_ended": lambda *, fit, completed: (
        "status: "
        + (f"fit {fit.replace('_', ' ')}" if completed != "nothing_added" else "")
        + _COMPLETED[completed]
    ),
    "diagnosis_note": "note: {note}",
    # Reasons of a verdict.
    "noise_misstated": lambda *, ratio: (
        f"the misfit is {ratio:.2g} times the stated noise, without a pattern: the noise is "
        f"{'overstated' if ratio < 1 else 'understated'}."
    ),
    "no_effect_explains": "no effect in the library explains the remaining misfit.",
    "other_sensors_missed": (
        "the answer rests on the reference sensor; at the other sensors its residual is "
        "{misfit:.2g} times the noise: the mode shape may change with amplitude, or the force acts "
        "elsewhere (`--where`)."
    ),
    # Notes on data and model.
    "answer_before": _before,
    "gain_of_drive": lambda *, gain, from_curves: (
        f"the force is known only as a drive voltage: about {gain:.4g} N/V from "
        f"{'smooth curves of amplitude' if from_curves else 'the model as given'}. The gain is "
        "fitted too: a 1 % error of the gain looks like a 1 % change of damping."
    ),
    "gain_with_effects": (
        "with the identified effects the gain is {gain:.3g} N/V (before: {before:.3g})."
    ),
    "noise_not_stated": lambda *, size: (
        f"no noise is stated: it is estimated from the residuals ({100 * size:.2g} % of velocity, "
        f"{np.degrees(size):.2g}°), so a good fit is no evidence for the model."
    ),
    "levels_not_stated": _level_errors,
    "no_level_left_out": lambda *, n_levels: (
        f"only {number_of(n_levels, 'level')}: none can be left out of the fit to validate the "
        "answer."
    ),
    "phases_of_sensors_unknown": (
        "the phases of some sensors are unknown: only their amplitudes are compared."
    ),
    "phases_unknown": (
        "the phases of {n_states} of {of_states} states are unknown: for these only the "
        "magnitude of the force is compared, one number instead of two, with the phases of smooth "
        "curves at the recorded amplitudes. "
        "This hardly separates stiffness from damping: at resonance the amplitude depends on the "
        "damping alone, off resonance hardly on it."
    ),
    "sensor_phase_unseen": (
        "a phase error of the sensor cannot be detected and is not among the candidates."
    ),
    "harmonics_without_phase": (
        "only the amplitudes of harmonics are compared: their signs, which distinguish cubic from "
        "van der Pol damping, are lost."
    ),
    "no_state_there": lambda *, near, levels: (
        f"no state {'within' if near else 'beyond'} 30° of resonance at level "
        f"{', '.join(map(str, levels))} (according to the model): its "
        f"{'damping' if near else 'stiffness'} is poorly determined."
    ),
    "stated_parameters_moved": lambda *, parameters: (
        "the fit moves "
        + ", ".join(
            f"`{name}` by {step:+.2g} times its stated 1σ of {std:.2g}"
            for name, step, std in parameters
        )
        + ": check the linear test, and whether it was on the same assembly."
    ),
    "other_modal_mass": lambda *, value, std, model, stated_std, beyond: (
        f"the data give a modal mass of {value:.4g} ± {std:.2g} kg; the model has "
        f"{model:.4g} kg (stated 1σ: {100 * stated_std:.2g} %)"
        f"{', a larger deviation than that: check the linear test' if beyond else ''}. A gain "
        "error of force or sensor has the same effect and cannot be separated from it: "
        "calibrate both statically, or repeat a level with a known added mass."
    ),
    "frequency_off": lambda *, fraction: (
        f"the model's natural frequency is off by {100 * fraction:.0f} %: are these "
        "measurements of another mode?"
    ),
    "not_physical": (
        "there is no completed model: {reason} The best-fit parameters are not physical."
    ),
    "not_physical_without": lambda *, levels: (
        f"without {of_levels(levels)} the best-fit parameters are not physical."
    ),
    "answer_not_converged": "the fit of the answer itself stopped before it converged.",
    "effects_not_fitted": lambda *, effects: (
        f"{', '.join(map(effect_name, effects))} could not be fitted: no starting point "
        "reproduces the measured motions."
    ),
    # Drawn laws.
    "law_class": lambda *, law: _LAWS[law],
}
