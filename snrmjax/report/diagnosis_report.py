"""Figures and report of a diagnosis."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from snrmjax.diagnose.diagnosis import Diagnosis, diagnose_model
from snrmjax.diagnose.response_prediction import (
    LevelResponse,
    Resonance,
    level_responses,
    level_simulations,
)
from snrmjax.diagnose.search.locating import Located
from snrmjax.diagnose.search.model_search import AS_GOOD, DETECTED
from snrmjax.io.diagnosis_results import summarise_diagnosis
from snrmjax.io.files import write_atomically, write_summary
from snrmjax.io.models import write_model
from snrmjax.io.units import HERTZ
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure
from snrmjax.report.html import Report, ReportFigure, ReportTable, Section, write_report
from snrmjax.report.style import (
    IDENTIFIED,
    MEASURED,
    SERIES,
    name_axes,
    panels,
    png_bytes,
    unit_for,
)
from snrmjax.simulate.continuation.response_curve import ResponseCurve

_SHOWN = 10  # candidates
_LARGEST = 5.0  # misfit, in units of noise, at the end of the colour scale

VERDICTS = {
    "none": "Nothing is missing that these data could show.",
    "named": "One answer fits, and no other does nearly as well.",
    "ambiguous": "Several effects fit about equally well: the data cannot tell them apart.",
    "unknown": "Something is missing that no effect of the library explains.",
    "noise_rejected": "The stated noise does not fit the data: no effect is named before it does.",
}


def write_diagnosis(
    folder: Path, title: str, model: Structure, data: SteadyStates, *, simulate: bool
) -> Diagnosis:
    """Diagnose, and write everything that the command writes into a folder.

    Where the force is known as a drive voltage only, a joint fit finds a first gain, which stays
    free.
    """
    notes: tuple[str, ...] = ()
    gain_std = 0.0
    if not np.any(np.isfinite(np.asarray(data.force))):
        # Few need them, and they take as long to import as half the others.
        from snrmjax.identify.joint.joint_fit import fit_jointly
        from snrmjax.report.workflow import corrected

        fit = fit_jointly(data, model.modes, free=("force_gain",))
        data = corrected(data, fit)
        gain = float(np.exp(fit.unknowns.log_force_gain))
        notes = (
            f"the force is known as a drive voltage only: about {gain:.4g} N/V by a joint fit of "
            "smooth curves. Its gain stays free, so that damping and gain errors cannot be told.",
        )
        gain_std = 1.0
    found = diagnose_model(model, data, force_gain_std=gain_std)
    if gain_std and found.effects:
        notes = (*notes, f"the answer puts that gain at {gain * found.force_gain:.4g} N/V.")
    found = dataclasses.replace(found, notes=(*notes, *found.notes))
    foretold: list[LevelResponse] = []
    figures = diagnosis_figures(found, data)
    if simulate and found.effects:
        foretold, figures["responses"] = with_responses(found, model, data)
    write_summary(folder / "diagnosis.json", summarise_diagnosis(found, foretold))
    write_model(folder / "model.toml", found.completed)
    drawn = {name: png_bytes(figure) for name, figure in figures.items()}
    for name, png in drawn.items():
        write_atomically(folder / f"{name}.png", png)
    report = diagnosis_report(found, title.replace("_", " "), figures, foretold, drawn)
    write_report(folder / "report.html", report)
    return found


def with_responses(
    found: Diagnosis, model: Structure, data: SteadyStates
) -> tuple[list[LevelResponse], Figure]:
    """What simulation adds: resonances and responses of all levels."""
    simulated = level_simulations(
        model, found.completed, found.blind, data, found.sensor, found.force_gain
    )
    foretold = level_responses(simulated, data, found.sensor)
    old, new = ([c for one in curves for c in one] for curves in simulated[:2])
    figure = simulated_figure(old, new, data, found.sensor)
    return foretold, figure


def residual_figure(diagnosis: Diagnosis, data: SteadyStates) -> Figure:
    """Misfit of the force in units of noise over frequency and velocity, before and after."""
    rows = diagnosis.rows
    frequency = np.asarray(data.frequency)[rows] / HERTZ
    speed = np.abs(np.asarray(data.velocity))[rows, diagnosis.sensor]
    unit = unit_for(speed, "m/s")
    figure, grid = panels(9.5, 4.2, 1, 2)
    out = diagnosis.gap.interpolated
    held = np.asarray(data.level)[rows] == out.level if out else np.zeros(len(rows), dtype=bool)
    for axes, title, misfit in zip(
        grid[0], ("Before", "After"), (diagnosis.before, diagnosis.after), strict=True
    ):
        size = np.sqrt(np.nanmean(misfit**2, axis=1))
        marks = axes.scatter(
            frequency, speed / unit.size, c=size, cmap="viridis", vmin=0.0, vmax=_LARGEST, s=34
        )
        ringed = axes.scatter(
            frequency[held],
            speed[held] / unit.size,
            s=90,
            facecolors="none",
            edgecolors=IDENTIFIED,
            linewidths=0.9,
        )
        name_axes(axes, title, "frequency (Hz)", f"velocity ({unit.name})")
        if out:
            axes.legend([ringed], [f"level {out.level}, held out"], fontsize=9, loc="best")
    figure.colorbar(marks, ax=grid[0].tolist(), label="misfit of the force (units of noise)")
    return figure


def candidates_figure(diagnosis: Diagnosis) -> Figure:
    """What every effect would gain in the first step; those that cannot be told apart in colour."""
    rows = [row for row in diagnosis.table[0][:_SHOWN] if np.isfinite(row.gain)][::-1]
    figure, grid = panels(7.0, 0.8 + 0.32 * max(len(rows), 3), 1, 1)
    axes = grid[0, 0]
    best = max((row.gain for row in rows), default=0.0)
    near = [row.gain > max(best - AS_GOOD, DETECTED) for row in rows]
    colours = [IDENTIFIED if one else MEASURED for one in near]
    axes.barh([row.kind for row in rows], [row.gain for row in rows], color=colours)
    axes.axvline(DETECTED, color="black", linestyle="--", linewidth=1.0)
    name_axes(axes, "What each effect explains by itself", "gain of the criterion", "")
    return figure


def simulated_figure(
    before: Sequence[ResponseCurve],
    after: Sequence[ResponseCurve],
    data: SteadyStates,
    sensor: int,
) -> Figure:
    """Responses of the model before and after, over the measured states."""
    speed = np.abs(np.asarray(data.velocity))[:, sensor]
    unit = unit_for(speed, "m/s")
    figure, grid = panels(8.0, 4.6, 1, 1)
    axes = grid[0, 0]
    for label, curves, colour in (
        ("model as given", before, "0.55"),
        ("completed model", after, IDENTIFIED),
    ):
        for k, curve in enumerate(curves):
            size = np.abs(np.asarray(curve.velocity)[:, 1, sensor]) / unit.size
            axes.plot(
                np.asarray(curve.frequency) / HERTZ,
                size,
                color=colour,
                linewidth=1.3,
                label=label if k == 0 else None,
            )
    axes.plot(
        np.asarray(data.frequency) / HERTZ,
        speed / unit.size,
        linestyle="none",
        marker="o",
        markersize=4.0,
        color=SERIES[1],
        label="measured",
    )
    axes.legend(fontsize=9)
    name_axes(axes, "Responses", "frequency (Hz)", f"velocity ({unit.name})")
    return figure


def diagnosis_figures(diagnosis: Diagnosis, data: SteadyStates) -> dict[str, Figure]:
    """The figures that need no simulation, by name."""
    return {
        "residuals": residual_figure(diagnosis, data),
        "candidates": candidates_figure(diagnosis),
    }


def diagnosis_report(
    diagnosis: Diagnosis,
    title: str,
    figures: dict[str, Figure],
    foretold: Sequence[LevelResponse] = (),
    drawn: Mapping[str, bytes] | None = None,
) -> Report:
    """The report of a diagnosis; `foretold` are resonances of the simulated responses.

    `drawn` are the figures as PNG, where they are drawn already.
    """
    png = drawn or {}
    gap = diagnosis.gap
    answers = [
        (effect, " or ".join(group))
        for effect, group in zip(diagnosis.effects, diagnosis.candidates, strict=True)
    ]
    summary = [
        ("verdict", diagnosis.verdict.replace("_", " ")),
        ("effects", ", ".join(diagnosis.effects) or "none"),
        *((f"what {effect} may be", group) for effect, group in answers),
        ("misfit before and after, in units of noise", f"{gap.before:.3g} → {gap.after:.3g}"),
    ]
    for name, out in (("interpolated", gap.interpolated), ("extrapolated", gap.extrapolated)):
        if out:
            summary.append(
                (f"level {out.level}, held out ({name})", f"{out.before:.3g} → {out.after:.3g}")
            )
    if diagnosis.decide_by:
        summary.append(("what would decide", diagnosis.decide_by))
    captions = {
        "residuals": "Misfit of the force of every state, of its size alone where the phase is "
        "unknown. Where the model is right it is 1.",
        "candidates": "Gain of Schwarz's criterion. Right of the dashed line an effect is seen; "
        "orange ones cannot be told from the best.",
        "responses": "Simulated responses under each level's force at resonance.",
    }
    pictured = {
        name: ReportFigure(figure, captions[name], png.get(name))
        for name, figure in figures.items()
    }
    sections = [
        Section(
            "Where model and data disagree",
            tables=[
                ReportTable(("part", "velocities", "p", "exponent"), _parts(diagnosis.located))
            ],
            figures=[pictured["residuals"]],
        ),
        Section(
            "What explains it",
            tables=[
                ReportTable(
                    ("parameter", "value", "1σ"),
                    [(n, f"{v:.5g}", f"{s:.2g}") for n, (v, s) in diagnosis.parameters.items()],
                ),
                *(
                    ReportTable(
                        ("effect", "gain", "parameters"),
                        [
                            (
                                row.kind,
                                f"{row.gain:.1f}",
                                ", ".join(f"{v:.4g}" for v in row.parameters.values()),
                            )
                            for row in step[:_SHOWN]
                        ],
                        f"Step {number + 1}.",
                    )
                    for number, step in enumerate(diagnosis.table)
                ),
            ],
            figures=[pictured["candidates"]],
        ),
    ]
    if "responses" in figures:
        table = ReportTable(
            ("level", "force (N)", "measured", "model as given", "completed model"),
            [_resonances(row) for row in foretold],
            "Resonances: frequency, velocity and, of models, where the branch ends; measured "
            "without phases, the state with the largest velocity over force. Levels marked with * "
            "are foretold by a model that has not seen them.",
        )
        sections.append(
            Section("Simulated responses", tables=[table], figures=[pictured["responses"]])
        )
    limits = sorted(diagnosis.detection_limits.items())
    sections.append(
        Section(
            "What would have been seen",
            tables=[ReportTable(("parameter", "least size"), [(n, f"{v:.3g}") for n, v in limits])],
        )
    )
    notes = (VERDICTS[diagnosis.verdict], *diagnosis.notes)
    return Report(title=title, summary=summary, notes=notes, sections=sections)


def _parts(parts: Sequence[Located]) -> list[tuple[str, str, str, str]]:
    rows = []
    for part in parts:
        low, high = part.velocity_range
        exponent = "" if part.exponent is None else f"{part.exponent:.2g} ± {part.exponent_std:.1g}"
        name = part.part.replace("_", " ")
        rows.append((name, f"{low:.3g} to {high:.3g} m/s", f"{part.p_value:.1e}", exponent))
    return rows


def _resonances(row: LevelResponse) -> tuple[str, ...]:
    def words(one: Resonance) -> str:
        if not np.isfinite(one.frequency):
            return "none"
        fold = f", fold {one.fold:.5g} Hz" if np.isfinite(one.fold) else ""
        return f"{one.frequency:.5g} Hz, {one.velocity:.3g} m/s{fold}"

    mark = "*" if row.held_out else ""
    each = (words(one) for one in (row.measured, row.before, row.after))
    return (f"{row.level}{mark}", f"{row.force:.3g}", *each)
