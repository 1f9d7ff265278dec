"""The report of a diagnosis: verdict, effects and their laws, evidence, resonances."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from snrmjax.diagnose.diagnosis import diagnose_model
from snrmjax.diagnose.diagnosis_result import Diagnosis
from snrmjax.diagnose.response_prediction import LevelResponse, PhaseResonance, predict_levels
from snrmjax.diagnose.search.locating import Located
from snrmjax.diagnose.search.model_search import TriedEffect
from snrmjax.io.diagnosis_results import summarise_diagnosis
from snrmjax.io.files import write_summary
from snrmjax.io.models import write_model
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effect_shape import shape_of
from snrmjax.model.effects import EFFECTS
from snrmjax.model.structures import Structure
from snrmjax.report.diagnosis_figures import (
    at_curve_force,
    candidates_figure,
    comparison_figure,
    effect_laws_figure,
    effect_name,
    found_effects,
    misfit_figure,
)
from snrmjax.report.figures import save_figures
from snrmjax.report.html import (
    Report,
    ReportFigure,
    ReportTable,
    Section,
    number,
    with_error,
    write_report,
)
from snrmjax.report.style import PrintedFigure, unit_for, with_unit

_SHOWN = 10  # candidates
_LEAST_P_VALUE = 1e-12  # smaller ones are not told apart
_RESPONSE_CONTROLLED = 0.2  # share of states away from their level's force, that makes a test one

_CAPTIONS = {
    "laws": (
        "What the completed model adds, over the measured range of motion. Forces are those that "
        "would have to act at the drive to do the same to the mode."
    ),
    "responses": (
        "Responses at the force of every level, without and with the effects that were found, over "
        "the measured states. Lines should pass through the dots."
    ),
    "residuals": (
        "How far the force that each measured state needs is from the one that acted, in standard "
        "deviations of the noise (of its size alone where the phase is unknown). A correct model "
        "leaves about 1 everywhere; dark regions show where the model is wrong."
    ),
    "candidates": (
        "How much better each effect, added alone, makes the model: gain of the Bayesian "
        "information criterion. Left of the dashed line an effect is not detected; vermilion bars "
        "are about as good as the best."
    ),
}
_HELD_RESPONSE = (
    " These levels hold the response, not the force: lines of constant force meet a level at its "
    "resonance only, and pale dots were measured under forces between those of the lines."
)


def write_diagnosis(
    folder: Path, title: str, model: Structure, data: SteadyStates, *, simulate: bool
) -> Diagnosis:
    """Diagnose, and write everything that the command writes into a folder.

    Where no structure can have the parameters found, there is no `model.toml` and nothing is
    simulated; the notes say so.
    """
    found = diagnose_model(model, data)
    predicted: list[LevelResponse] = []
    figures = diagnosis_figures(found)
    if simulate and found.effects and found.completed is not None:
        predicted, figures["responses"] = with_responses(found, model)
        found = dataclasses.replace(found, notes=(*found.notes, *_incomplete(predicted)))
    write_summary(folder / "diagnosis.json", summarise_diagnosis(found, predicted))
    if found.completed is not None:
        write_model(folder / "model.toml", found.completed)
    report = diagnosis_report(
        found,
        f"Diagnosis of {title.replace('_', ' ')}",
        save_figures(folder, figures),
        predicted,
        done={"data": f"{title}.csv", "model": model.name},
    )
    write_report(folder / "report.html", report)
    return found


def with_responses(diagnosis: Diagnosis, model: Structure) -> tuple[list[LevelResponse], Figure]:
    """Resonances and responses of all levels, simulated with the model as given and completed.

    Raises `ValueError` where there is no completed model.
    """
    data, sensor = diagnosis.data, diagnosis.force_misfit.sensor
    levels, before, after = predict_levels(diagnosis, model)
    return levels, comparison_figure(before, after, data, sensor=data.sensors[sensor])


def _incomplete(predicted: Sequence[LevelResponse]) -> list[str]:
    levels = [str(one.level) for one in predicted if not one.complete]
    if not levels:
        return []
    return [
        f"the simulated responses of level {', '.join(levels)} were not traced to the end of the "
        "frequency range: a resonance may be missing there."
    ]


def diagnosis_figures(diagnosis: Diagnosis) -> dict[str, Figure]:
    """The figures that need no simulation, by the names of their files."""
    figures = {"residuals": misfit_figure(diagnosis), "candidates": candidates_figure(diagnosis)}
    found = found_effects(diagnosis)
    if found is not None:
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
    captions = {**_CAPTIONS}
    if holds_response(diagnosis.data, predicted):
        captions["responses"] += _HELD_RESPONSE
    shown = {name: ReportFigure(figure, captions[name]) for name, figure in figures.items()}
    return Report(
        title=title,
        done=[*(done or {}).items(), ("program", f"snrmjax {version('snrmjax')}")],
        result=readable_verdict(diagnosis),
        summary=_key_numbers(diagnosis, predicted),
        notes=[_readable(note) for note in diagnosis.notes],
        sections=[
            *([_effects_section(diagnosis, shown)] if diagnosis.effects else []),
            _comparison_section(diagnosis, predicted, shown),
            _candidates_section(diagnosis, shown),
            _limits_section(diagnosis),
        ],
    )


def holds_response(data: SteadyStates, predicted: Sequence[LevelResponse]) -> bool:
    """Whether the force changes along the levels of a test, which then hold the response."""
    if not predicted:
        return False
    same = at_curve_force(data, [one.force for one in predicted])
    return bool(np.mean(~same) > _RESPONSE_CONTROLLED)


def readable_verdict(diagnosis: Diagnosis) -> str:
    """What a diagnosis says in one plain sentence, with the effects' names in words."""
    return _readable(diagnosis.verdict_sentence)


def _times(misfit: float) -> str:
    return f"{misfit:.1f}" if misfit < 10 else number(misfit, 2)


def _key_numbers(diagnosis: Diagnosis, predicted: Sequence[LevelResponse]) -> list[tuple[str, str]]:
    gap, rows = diagnosis.gap, []
    for kind in diagnosis.effects:
        values = [
            " ".join((_words(name), *_value_and_unit(kind, name, pair))).strip()
            for name, pair in _own(kind, diagnosis.parameters).items()
        ]
        rows.append((effect_name(kind), ", ".join(values)))
    rows.append(
        ("misfit of the force (rms)", f"{_times(gap.before)} → {_times(gap.after)} × noise")
    )
    for place, out in (
        ("misfit of a level between others", gap.interpolated),
        ("misfit of the largest level", gap.extrapolated),
    ):
        if out:
            name = f"{place} (level {out.level}), left out"
            text = f"{_times(out.before)} → {_times(out.after)} × its prediction error"
            rows.append((name, text))
    if predicted:
        top = max(predicted, key=lambda one: one.force)
        each = ("measured", top.measured), ("model as given", top.before)
        pairs = (*each, ("completed model", top.after))
        text = "; ".join(f"{name}: {_resonance(one)}" for name, one in pairs)
        rows.append((f"resonance at {with_unit(top.force, 'N')}", text))
    if diagnosis.decide_by:
        rows.append(("what to measure next", _readable(diagnosis.decide_by)))
    return rows


def _effects_section(diagnosis: Diagnosis, shown: Mapping[str, ReportFigure]) -> Section:
    """What was found: what it is physically, its law, its parameters."""
    text = []
    for kind, group in zip(diagnosis.effects, diagnosis.candidates, strict=True):
        name = effect_name(kind)
        text.append(f"{name[0].upper()}{name[1:]}. {_description(kind)}")
        others = [effect_name(other) for other in group if other != kind]
        if others:
            text[-1] += f" These data do not tell it from: {', '.join(others)}."
    rows = [
        (effect_name(kind), _meaning(kind, name), *_value_and_unit(kind, name, pair))
        for kind in diagnosis.effects
        for name, pair in _own(kind, diagnosis.parameters).items()
    ]
    caption = "Parameters of the effects ± 1σ, as model.toml has them."
    table = ReportTable(("effect", "parameter", "value ± 1σ", "unit"), rows, caption)
    figures = [shown["laws"]] if "laws" in shown else []
    return Section("What is missing", text, figures, [table])


def _comparison_section(
    diagnosis: Diagnosis, predicted: Sequence[LevelResponse], shown: Mapping[str, ReportFigure]
) -> Section:
    """Responses and misfit before and after, what disagrees, and the resonances."""
    tables = []
    if predicted:
        header = ("level", "force", "measured", "model as given", "completed model")
        caption = (
            "Phase resonances of the levels: frequency, velocity amplitude and, of models, the "
            "fold where the branch ends. Where no phase was measured: the state with the largest "
            "velocity over force. Levels with * are predicted by a model fitted without them."
        )
        tables.append(ReportTable(header, [_resonances(row) for row in predicted], caption))
    figures = [shown[name] for name in ("responses", "residuals") if name in shown]
    text = [_located(part) for part in diagnosis.located]
    if not text:
        text = ["No part of the force balance differs from the model by more than the noise."]
    return Section("Model and data, before and after", text, figures, tables)


def _candidates_section(diagnosis: Diagnosis, shown: Mapping[str, ReportFigure]) -> Section:
    header = ("effect", "gain", "parameters")
    tables = [
        ReportTable(header, [_tried(row) for row in step[:_SHOWN]], folded=_step(k, len(step)))
        for k, step in enumerate(diagnosis.table)
        if step
    ]
    return Section("What else was considered", (), [shown["candidates"]], tables)


def _step(number_of: int, count: int) -> str:
    return f"Comparison {number_of + 1}: the best {min(count, _SHOWN)} of {count} candidates"


def _limits_section(diagnosis: Diagnosis) -> Section:
    rows = []
    for name, limit in sorted(diagnosis.detection_limits.items()):
        kind, parameter = name.split(".", 1)
        size = (number(limit, 2), _unit(kind, parameter))
        rows.append((effect_name(kind), _meaning(kind, parameter), *size))
    table = ReportTable(
        ("effect", "parameter", "detected from", "unit"),
        rows,
        folded=f"Detection limits of {len(rows)} further effects",
    )
    text = "Effects larger than these limits would have been detected beside what was found."
    return Section("What would have been detected", [text], (), [table])


def _own(kind: str, parameters: Mapping[str, tuple[float, float]]) -> dict:
    """The parameters of one effect by their own names."""
    start = f"{kind}."
    return {k.removeprefix(start): v for k, v in parameters.items() if k.startswith(start)}


def _value_and_unit(kind: str, name: str, pair: tuple[float, float]) -> tuple[str, str]:
    value, std = pair
    if std > 0:
        return with_error(value, std), _unit(kind, name)
    return f"{number(value)} (1σ not determined by these data)", _unit(kind, name)


def _description(kind: str) -> str:
    """What an effect is physically and where it shows, as its class states it."""
    shape = shape_of(EFFECTS[kind])
    return f"{EFFECTS[kind].description} {shape.sentence if shape else ''}".strip()


def _unit(kind: str, name: str) -> str:
    unit = EFFECTS[kind].parameters()[name].unit.replace("kg^1/2", "√kg")
    return "" if unit == "1" else unit


def _meaning(kind: str, name: str) -> str:
    return EFFECTS[kind].parameters()[name].meaning or _words(name)


def _readable(text: str) -> str:
    """A sentence of the diagnosis with the effects' names in words."""
    for kind in sorted(EFFECTS, key=len, reverse=True):
        text = re.sub(rf"\b{kind}\b", effect_name(kind), text, flags=re.IGNORECASE)
    return text


def _words(name: str) -> str:
    return name.removesuffix("_hz").removesuffix("_deg").replace("_", " ")


def _tried(row: TriedEffect) -> tuple[str, str, str]:
    own = _own(row.kind, {name: (value, 0.0) for name, value in row.parameters.items()})
    own = own or {name: (value, 0.0) for name, value in row.parameters.items()}
    values = [
        f"{_words(name)} {number(value, 3)} {_unit(row.kind, name)}".strip()
        for name, (value, _) in own.items()
    ]
    return (
        effect_name(row.kind),
        f"{row.gain:.0f}" if np.isfinite(row.gain) else "not fitted",
        ", ".join(values),
    )


_PARTS = {
    "stiffness": "The stiffness, and with it the natural frequency, differs from the model's",
    "damping": "The damping differs from the model's",
    "harmonic_2": "The second harmonic of the velocity differs from the model's",
    "harmonic_3": "The third harmonic of the velocity differs from the model's",
    "not_a_function_of_amplitude": (
        "A part of the misfit is no function of the amplitude: it differs between states of one "
        "amplitude"
    ),
}


def _located(part: Located) -> str:
    """One part of the disagreement as a sentence."""
    unit = unit_for(part.velocity_range, "m/s")
    low, high = (f"{one / unit.size:.3g}" for one in part.velocity_range)
    small = part.p_value < _LEAST_P_VALUE
    chance = "below 10⁻¹²" if small else number(part.p_value, 1)
    text = f"{_PARTS[part.part]}, at velocity amplitudes from {low} to {high} {unit.name}"
    if part.exponent is not None:
        power = with_error(part.exponent, part.exponent_std or 0.0)
        text += f"; the change goes with the power {power} of the amplitude"
    return f"{text} (probability by chance: {chance})."


def _resonances(row: LevelResponse) -> tuple[str, ...]:
    mark = "*" if row.held_out else ""
    each = (_resonance(one) for one in (row.measured, row.before, row.after))
    return (f"{row.level}{mark}", _unbroken(with_unit(row.force, "N")), *each)


def _resonance(one: PhaseResonance) -> str:
    if not np.isfinite(one.frequency):
        return "no resonance"
    fold = f", fold at {_unbroken(f'{one.fold:.5g} Hz')}" if np.isfinite(one.fold) else ""
    speed = _unbroken(with_unit(one.velocity, "m/s", 3))
    return f"{_unbroken(f'{one.frequency:.5g} Hz')}, {speed}{fold}"


def _unbroken(text: str) -> str:
    """A value that keeps its unit in its line."""
    return text.replace(" ", "\u00a0")
