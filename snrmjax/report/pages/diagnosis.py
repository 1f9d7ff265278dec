"""The report of a diagnosis: verdict, effects and their laws, evidence, resonances."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from snrmjax.diagnose.diagnosis_result import Diagnosis
from snrmjax.diagnose.fitted_effects import TriedEffect
from snrmjax.diagnose.location.where import Localisation, LocatedForce
from snrmjax.diagnose.misfit.candidates import scales_of_motions
from snrmjax.diagnose.misfit.locating import Located
from snrmjax.diagnose.naming.detection import beyond_data
from snrmjax.diagnose.priors import AS_NOISE
from snrmjax.diagnose.response_prediction import LevelResponse, is_response_controlled
from snrmjax.diagnose.verdict import NOISE_REJECTED, NONE, UNKNOWN, Verdict
from snrmjax.io import diagnosis_results as written
from snrmjax.io.files import write_summary
from snrmjax.io.models import write_model
from snrmjax.io.tables import write_table
from snrmjax.measure.states import relative_errors
from snrmjax.model.effect_shape import shape_of
from snrmjax.model.effects import effect_class
from snrmjax.pipelines.diagnose import DiagnosedTest, SimulatedLevels
from snrmjax.report.figures.diagnosis import (
    CONTROLLED_CAPTION,
    comparison_figure,
    controlled_velocity_figure,
    effect_laws_figure,
    found_effects,
    misfit_figure,
)
from snrmjax.report.figures.parts import (
    LAW_CAPTION,
    PARTS_CAPTION,
    drawn_laws_figure,
    law_tables,
    parts_figure,
)
from snrmjax.report.html import (
    PROGRAM,
    Report,
    ReportFigure,
    ReportTable,
    Section,
    minus,
    number,
    write_report,
)
from snrmjax.report.pages.resonance_table import resonance_in_words, resonance_rows, velocity_unit
from snrmjax.report.parameters import (
    own_parameters,
    parameter_meaning,
    parameter_words,
    printed_unit,
    value_and_unit,
    values_in_words,
)
from snrmjax.report.sentences.diagnose import effect_name, kinds_in_words
from snrmjax.report.sentences.diagnose import probability_in_words as in_words
from snrmjax.report.style import PrintedFigure, save_figures, unit_for, with_unit

_SHOWN = 10  # candidates
_LEAST_P_VALUE = 1e-12  # smaller ones are not distinguished

_CAPTIONS = {
    "laws": (
        "Forces that the completed model adds, over the measured range of motion, expressed as the "
        "equivalent force at the drive point."
    ),
    "responses": (
        "Responses at the force of every level, without and with the identified effects, over "
        "the measured states. Lines should pass through the dots."
    ),
    "residuals": (
        "Force that each measured state requires minus the force that acted, in standard "
        "deviations of the noise (magnitudes only where the phase is unknown). A correct model "
        "leaves about 1 everywhere; dark regions show where the model is wrong."
    ),
    "parts": PARTS_CAPTION,
}
_PROBABILITIES = (
    "The most probable answers, by their evidence: how well each explains these data on average "
    "over its uncertain parameters. All answers considered add up to 100 %."
)
_ONLY_AS_STATED = "; the ± holds only if the noise is as stated"
_OTHER_ANSWERS = {
    NONE: "nothing is missing",
    UNKNOWN: "something that no effect in the library explains",
    NOISE_REJECTED: "the noise is not as stated",
}


def write(folder: Path, found: DiagnosedTest, *, title: str = "", data: str = "") -> Report:
    """Write the results of a diagnosis: diagnosis.json, model.toml, figures and page.

    Where the parameters are not physical, there is no `model.toml`.
    """
    diagnosis, predicted = found.diagnosis, found.predicted
    figures = diagnosis_figures(diagnosis)
    if found.simulated is not None:
        figures["responses"] = responses_figure(diagnosis, found.simulated)
    summary = written.summarise_diagnosis(diagnosis, predicted)
    if found.where is not None:
        summary |= written.summarise_localisation(found.where)
        if found.is_located:
            summary |= written.placed_answer(found.where)
    write_summary(folder / "diagnosis.json", summary)
    if diagnosis.parts:
        write_table(folder / "remainder.csv", written.remainder_columns(diagnosis.parts))
    if found.where is not None and found.where.explains:
        write_model(folder / "model.toml", found.where.model)
    elif diagnosis.completed is not None:
        write_model(folder / "model.toml", diagnosis.completed)
    report = diagnosis_report(
        diagnosis,
        f"Diagnosis of {title}",
        save_figures(folder, figures),
        predicted,
        done={"data": data, "model": found.model.name},
    )
    if found.where is not None:
        report = report._replace(sections=[_location_section(found.where), *report.sections])
    write_report(folder / "report.html", report)
    return report


def _location_section(where: Localisation) -> Section:
    """Attachment points with probabilities, and the law that best explains the sensors at each."""
    rows = []
    for place in where.candidates:
        law = "" if place.law is None else effect_name(place.law.kind)
        rows.append((place.name, in_words(place.probability), law))
    table = ReportTable(("location", "probability", "law there"), rows, "Where the force acts")
    return Section("Location of the force", (str(where.words),), (), [table])


def answer_in_words(found: DiagnosedTest) -> str:
    """The verdict with the effects of the answer, or of the best attempt."""
    diagnosis, where = found.diagnosis, found.where
    if found.is_located and where is not None and where.candidates[0].law is not None:
        return f"{found.verdict} ({where.candidates[0].law.kind} at {where.candidates[0].name})"
    effects = ", ".join(diagnosis.effects)
    if effects:
        effects = f" ({effects})" if diagnosis.verdict.is_answer else f"; best attempt: {effects}"
    return f"{diagnosis.verdict.replace('_', ' ')}{effects}"


def headline(found: DiagnosedTest) -> list[str]:
    """Verdict, values of its effects, probability, and what would decide an open answer."""
    diagnosis = found.diagnosis
    values = _effects_with_values(diagnosis)
    lines = [
        diagnosis.verdict_sentence,
        *([f"{_attempt(diagnosis, 'identified')} (± 1σ): {values}"] if values else []),
        f"probability: {diagnosis.most_probable()}",
    ]
    if found.is_located and found.where is not None:
        lines = [
            str(found.where.answer),
            f"identified (± 1σ): {_located_values(found.where.candidates[0])}",
        ]
    elif diagnosis.decide_by:
        lines.append(f"what would decide: {diagnosis.decide_by}")
    if found.where is not None:
        lines.append(str(found.where.words))
    return lines


def _attempt(diagnosis: Diagnosis, answer: str) -> str:
    """What to call effects: the answer's name for them, or that they are an attempt."""
    return "best attempt" if diagnosis.verdict == Verdict.UNKNOWN else answer


def _effects_with_values(diagnosis: Diagnosis) -> str:
    """The identified effects with their parameters, in one line; "" where none has any."""
    values = {kind: values_in_words(kind, diagnosis.parameters) for kind in diagnosis.effects}
    line = "; ".join(f"{effect_name(kind)}, {text}" for kind, text in values.items() if text)
    return line + (_ONLY_AS_STATED if line and diagnosis.gap.after > AS_NOISE else "")


def _located_values(place: LocatedForce) -> str:
    """The law at a point with its parameters, in one line."""
    law = place.law
    if law is None:
        return ""
    pairs = {f"{law.kind}.{name}": (value, law.std[name]) for name, value in law.parameters.items()}
    values = values_in_words(law.kind, pairs, place.influence)
    return f"{effect_name(law.kind)} at {place.name}, {values}"


def responses_figure(diagnosis: Diagnosis, simulated: SimulatedLevels) -> Figure:
    """Responses of all levels, of the model as given and as completed."""
    data = diagnosis.data
    sensor = data.sensors[diagnosis.force_misfit.sensor]
    _, before, after = simulated.predicted
    if simulated.required_forces is None:
        return comparison_figure(before, after, data, sensor=sensor)
    return controlled_velocity_figure(*simulated.required_forces, data, sensor)


def diagnosis_figures(diagnosis: Diagnosis) -> dict[str, Figure]:
    """The figures that need no simulation, by the names of their files."""
    figures = {"residuals": misfit_figure(diagnosis)}
    if diagnosis.parts:
        figures["parts"] = parts_figure(diagnosis)
    found = found_effects(diagnosis)
    if diagnosis.answer.laws:
        figures["laws"] = drawn_laws_figure(diagnosis.answer.laws)
    elif found is not None:
        data = diagnosis.data
        sensor = data.sensors[diagnosis.force_misfit.sensor]
        figures["laws"] = effect_laws_figure(found, data, sensor=sensor)
    return figures


def diagnosis_report(
    diagnosis: Diagnosis,
    title: str,
    figures: Mapping[str, Figure | PrintedFigure],
    predicted: Sequence[LevelResponse] = (),
    *,
    done: Mapping[str, str] | None = None,
) -> Report:
    """The report of a diagnosis.

    Arguments: `figures` by the names that `diagnosis_figures` gives them, and `responses`;
    `predicted` resonances of the levels; `done` names the inputs.
    """
    captions = {**_CAPTIONS} | ({"laws": LAW_CAPTION} if diagnosis.answer.laws else {})
    if is_response_controlled(diagnosis.data, predicted):
        captions["responses"] = CONTROLLED_CAPTION
    shown = {name: ReportFigure(figure, captions[name]) for name, figure in figures.items()}
    return Report(
        title=title,
        done=[*(done or {}).items(), PROGRAM],
        result=diagnosis.verdict_sentence,
        summary=_key_numbers(diagnosis, predicted),
        notes=[*map(str, diagnosis.notes)],
        sections=[
            *([_effects_section(diagnosis, shown)] if diagnosis.effects else []),
            _comparison_section(diagnosis, predicted, shown),
            _candidates_section(diagnosis),
            _limits_section(diagnosis),
        ],
    )


def _times(misfit: float) -> str:
    return f"{misfit:.1f}" if misfit < 10 else number(misfit, 2)


def _key_numbers(diagnosis: Diagnosis, predicted: Sequence[LevelResponse]) -> list[tuple[str, str]]:
    gap, rows = diagnosis.gap, []
    for kind in diagnosis.effects:
        name, attempt = effect_name(kind), _attempt(diagnosis, "")
        values = values_in_words(kind, diagnosis.parameters)
        rows.append((f"{attempt}: {name}" if attempt else name, values))
    misfit = f"{_times(gap.before)} → {_times(gap.after)} × noise"
    if diagnosis.effects and gap.after > AS_NOISE:
        misfit += _ONLY_AS_STATED
    rows.append(("misfit of the force (rms), with errors of levels and laws", misfit))
    if np.isfinite(np.asarray(relative_errors(jax.tree.map(np.asarray, diagnosis.data)))).any():
        rows.append(
            (
                "random part of it, from neighbouring states",
                f"{_times(diagnosis.checks.noise_scale)} × noise, errors of whole levels excluded",
            )
        )
    rows.append(("probability of this answer", in_words(diagnosis.probability)))
    for what, out in (
        ("misfit of an intermediate level", gap.interpolated),
        ("misfit of the largest level", gap.extrapolated),
    ):
        if out:
            name = f"{what} (level {out.level}), left out"
            text = f"{_times(out.before)} → {_times(out.after)} × its prediction error"
            rows.append((name, text))
    if predicted:
        top = max(predicted, key=lambda one: one.force)
        pairs = [("measured", top.measured), ("model as given", top.before)]
        pairs.append(("completed model", top.completed))
        if top.withheld:
            pairs.append((f"predicted without level {top.level}", top.after))
        unit = velocity_unit(one for _, one in pairs)
        text = "; ".join(f"{name}: {resonance_in_words(one, unit)}" for name, one in pairs)
        rows.append((f"resonance at {with_unit(top.force, diagnosis.data.force_unit)}", text))
    if diagnosis.decide_by:
        rows.append(("what to measure next", diagnosis.decide_by))
    return rows


def _effects_section(diagnosis: Diagnosis, shown: Mapping[str, ReportFigure]) -> Section:
    """The identified effects: their physical meaning, laws and parameters."""
    text = []
    for kind, group in zip(diagnosis.effects, diagnosis.candidates, strict=True):
        name = effect_name(kind)
        text.append(f"{name[0].upper()}{name[1:]}. {_description(kind)}")
        others = [effect_name(other) for other in group if other != kind]
        if others:
            text[-1] += f" Not distinguishable in these data: {', '.join(others)}."
    rows = [
        (effect_name(kind), parameter_meaning(kind, name), *value_and_unit(kind, name, pair))
        for kind in diagnosis.effects
        for name, pair in own_parameters(kind, diagnosis.parameters).items()
    ]
    caption = "Parameters of the effects ± 1σ, as model.toml has them."
    if diagnosis.gap.after > AS_NOISE:
        caption += (
            " The ± holds only if the noise is as stated, but the remaining misfit is "
            f"{_times(diagnosis.gap.after)} times that noise."
        )
    table = ReportTable(("effect", "parameter", "value ± 1σ", "unit"), rows, caption)
    figures = [shown["laws"]] if "laws" in shown else []
    unsure = diagnosis.verdict == Verdict.UNKNOWN
    heading = "The best attempt, which does not explain the data" if unsure else "What is missing"
    tables = law_tables(diagnosis.answer.laws) or [table]
    return Section(heading, text, figures, tables)


def _comparison_section(
    diagnosis: Diagnosis, predicted: Sequence[LevelResponse], shown: Mapping[str, ReportFigure]
) -> Section:
    """Responses and misfit before and after, what disagrees, and the resonances."""
    tables = []
    if predicted:
        header = ["level", "force", "measured", "model as given", "completed model"]
        caption = (
            "Phase resonances of the levels: frequency, velocity amplitude and, for models, the "
            "fold where the branch ends. Where no phase was measured: the state with the largest "
            "ratio of velocity to force."
        )
        if any(row.withheld for row in predicted):
            header.append("predicted without this level")
            caption += " The last column is from models fitted without that level."
        tables.append(
            ReportTable(header, resonance_rows(predicted, diagnosis.data.force_unit), caption)
        )
    figures = [shown[name] for name in ("parts", "responses", "residuals") if name in shown]
    text = [_located(part) for part in diagnosis.located]
    if not text:
        text = ["No part of the force balance differs from the model by more than the noise."]
    return Section("Model and data, before and after", text, figures, tables)


def _candidates_section(diagnosis: Diagnosis) -> Section:
    rows = [
        (_OTHER_ANSWERS.get(kinds) or kinds_in_words(kinds), in_words(value))
        for kinds, value in list(diagnosis.answer.probabilities.items())[:_SHOWN]
    ]
    tables = [ReportTable(("answer", "probability"), rows, _PROBABILITIES)]
    if diagnosis.table:
        tried = [_tried(row) for row in diagnosis.table]
        header = ("effect", "gain", "parameters")
        tables.append(ReportTable(header, tried, folded=f"{len(tried)} fits compared"))
    return Section("Other answers considered", (), (), tables)


def _limits_section(diagnosis: Diagnosis) -> Section:
    rows, misfit, scales = [], diagnosis.force_misfit, None
    if diagnosis.completed is not None:
        modes, data = diagnosis.completed.modes, diagnosis.data
        columns = (np.abs(np.asarray(data.velocity)[:, misfit.sensor]), data.frequency, data.force)
        of_states = (np.asarray(column)[misfit.rows] for column in columns)
        scales = scales_of_motions(modes, misfit.sensor, *of_states)
    for name, limit in sorted(diagnosis.detection_limits.items()):
        kind, parameter = name.split(".", 1)
        from_value = (number(limit, 2), printed_unit(kind, parameter))
        if beyond_data(kind, limit, scales):
            from_value = ("not detectable in these data", "")
        rows.append((effect_name(kind), parameter_meaning(kind, parameter), *from_value))
    table = ReportTable(
        ("effect", "parameter", "detected from", "unit"),
        rows,
        folded=f"Detection limits of {len(rows)} further effects",
    )
    text = "Effects larger than these limits would have been detected in addition to the answer."
    return Section("What would have been detected", [text], (), [table])


def _description(kind: str) -> str:
    """What an effect is physically and where it shows, as its class states it."""
    shape = shape_of(effect_class(kind))
    return f"{effect_class(kind).description} {shape.fact if shape else ''}".strip()


def _tried(row: TriedEffect) -> tuple[str, str, str]:
    own = own_parameters(row.kind, {name: (value, 0.0) for name, value in row.parameters.items()})
    own = own or {name: (value, 0.0) for name, value in row.parameters.items()}
    values = [
        f"{parameter_words(name)} {number(value, 3)} {printed_unit(row.kind, name)}".strip()
        for name, (value, _) in own.items()
    ]
    gain = _gain(row.gain) if np.isfinite(row.gain) else "not fitted"
    return effect_name(row.kind), gain, ", ".join(values)


def _gain(gain: float) -> str:
    return minus(f"{gain:.0f}") if abs(gain) < 1e4 else number(gain, 2)


_PARTS = {
    "stiffness": "The stiffness, and with it the natural frequency, differs from the model's",
    "damping": "The damping differs from the model's",
    "harmonic_2": "The second harmonic of the velocity differs from the model's",
    "harmonic_3": "The third harmonic of the velocity differs from the model's",
    "not_a_function_of_amplitude": (
        "A part of the misfit is not a function of amplitude: it differs between states of equal "
        "amplitude"
    ),
}


def _located(part: Located) -> str:
    """One part of the disagreement as a sentence."""
    unit = unit_for(part.velocity_range, "m/s")
    low, high = (f"{one / unit.size:.3g}" for one in part.velocity_range)
    small = part.p_value < _LEAST_P_VALUE
    chance = "below 10⁻¹²" if small else number(part.p_value, 1)
    where = f"at velocity amplitudes from {low} to {high} {unit.name}"
    return f"{_PARTS[part.part]}, {where} (by chance: {chance})."
