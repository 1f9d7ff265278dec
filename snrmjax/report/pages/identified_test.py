"""A complete identification: its figures, page and files."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from snrmjax import __version__
from snrmjax.identify.prediction.resonance_distribution import where_in_words
from snrmjax.io import joint_results, results
from snrmjax.io.files import write_summary
from snrmjax.io.results import load_named
from snrmjax.model.structures import Structure
from snrmjax.numerics.units import HERTZ
from snrmjax.pipelines.identify import FitDetails, IdentifiedTest, Prediction
from snrmjax.report.figures import identification as plot
from snrmjax.report.figures.simulation import normal_mode_figure
from snrmjax.report.html import Report, ReportFigure, Section, with_error, write_report
from snrmjax.report.pages import coupled_modes as coupled_page
from snrmjax.report.pages.identification import ComparedResponses, identification_report
from snrmjax.report.pages.joint_fit import (
    curves_in_words,
    joint_figures,
    joint_sections,
)
from snrmjax.report.sampling import BAND, SHOWN_AMPLITUDES, VELOCITY, ShownAmplitude
from snrmjax.report.style import PrintedFigure, save_figures


def settings_in_words(found: IdentifiedTest) -> dict[str, str]:
    """Which amplitude and which curves, as the summary and the page name them."""
    if found.joint is None:
        asked = found.options
        return {"amplitude": f"{asked.amplitude}, {asked.measure}", "curves": "smooth"}
    unknowns = found.joint.fit.unknowns
    pair = (unknowns.squared_frequency, unknowns.modal_damping)
    curves = " and ".join(curve.label for curve in pair)
    return {"amplitude": "displacement, fundamental", "curves": curves}


def headline(found: IdentifiedTest) -> list[str]:
    """The results as the lines printed when the command ends."""
    values = found.values
    speed, ratio = np.asarray(values.velocity), 100 * np.asarray(values.damping_ratio)
    hertz = np.asarray(values.natural_frequency) / HERTZ
    errors = BAND * np.asarray(values.natural_frequency_std) / HERTZ
    spreads = BAND * 100 * np.asarray(values.damping_ratio_std)
    ends = [
        f"{with_error(hertz[k], errors[k])} Hz and {with_error(ratio[k], spreads[k])} % of "
        f"critical damping at {speed[k]:.3g} m/s"
        for k in (0, -1)
    ]
    lines = [f"backbone: {ends[0]} to {ends[1]} (± 95 %)"]
    for prediction in found.predictions:
        for each in prediction.resonances:
            resonance = f"{each.frequency / HERTZ:.5g} Hz, {each.velocity:.3g} m/s"
            damped = f"{100 * each.damping_ratio:.3g} % of critical damping"
            lines.append(f"resonance at {prediction.load}: {resonance}, {damped}")
        lines.append(f"resonance at {prediction.load}: {where_in_words(prediction.further)}")
    if found.coupled is not None:
        lines += coupled_page.headline(found.coupled)
    for advised in found.advice or ():
        force, drive = advised.force, advised.drive
        unit = found.model.modes.force_unit
        load = f"force {force:.4g} {unit}" if drive is None else f"drive {drive:.4g} V"
        state = f"{load}, {advised.frequency / HERTZ:.6g} Hz (expected {advised.expected})"
        lines.append(f"measure next, {advised.rank}: {state}: {advised.reason}")
    return lines


def identification_figures(
    found: IdentifiedTest, shown: ShownAmplitude = VELOCITY
) -> dict[str, Figure]:
    """Figures of an identification by the names of their files."""
    points, backbone = found.identification.points, found.identification.backbone
    modes = found.model.modes
    figures = {
        "backbone": plot.backbone_figure(
            points, backbone, truth=found.truth, modes=modes, shown=shown
        ),
        "modal_damping": plot.modal_damping_figure(
            [plot.DampingSeries("identified", points=points, backbone=backbone)],
            linear=_linear_modal_damping(found.model),
            shown=shown,
        ),
        "loops": plot.force_velocity_figure(
            found.data, _typical_states(found), sensor=points.sensor
        ),
    }
    if found.predictions:
        figures["prediction"] = plot.response_figure(
            backbone,
            found.responses,
            found.resonances,
            simulated=found.simulated,
            measured=None if found.options.predict_at else found.data,
            force_unit=modes.force_unit,
        )
    if found.joint is not None:
        figures |= joint_figures(found.joint, points, shown)
    if found.coupled is not None:
        figures |= coupled_page.figures(found.coupled, found.identification.backbone)
    if found.truth is not None:
        figures["nnm"] = normal_mode_figure(found.truth, sensor=points.sensor)
    return figures


def _linear_modal_damping(model: Structure) -> float:
    j = model.modes.mode_of_interest
    return 2 * model.modes.damping_ratio.item(j) * model.modes.natural_frequency.item(j)


def _typical_states(found: IdentifiedTest) -> list[int]:
    """Three states of the largest level: nearest to resonance, farthest and one between."""
    points = found.identification.points
    phase = np.abs(np.angle(np.asarray(points.mode_velocity)))
    amplitude = np.where(np.asarray(points.usable), np.asarray(points.amplitude), -np.inf)
    level = np.asarray(points.level)[int(np.argmax(amplitude))]
    rows = np.flatnonzero((np.asarray(points.level) == level) & np.isfinite(amplitude))
    ordered = rows[np.argsort(phase[rows])]
    # dict, not set: the order is the caption's, and a level may have fewer than three states.
    return list(dict.fromkeys(int(ordered[k]) for k in (0, len(ordered) // 2, -1)))


LOOPS_CAPTION = (
    "Force against velocity over one period, nearest to resonance first: a straight line at phase "
    "resonance, the wider the farther from it."
)
DAMPING_CAPTION = (
    "Modal damping 2ζω against amplitude. Linear damping is constant near the dotted line, "
    "whatever the stiffness; harmonics of the motion add a few per cent."
)
MODE_CAPTION = (
    "The nonlinear normal mode of the model, followed by harmonic balance: velocity against "
    "frequency, frequency against energy and, of several modes, how the energy is distributed over "
    "them. Dashed parts are unstable; a marker names an internal resonance."
)


def findings_report(
    found: IdentifiedTest,
    title: str,
    done: dict[str, str],
    figures: Mapping[str, Figure | PrintedFigure],
) -> Report:
    """The report of an identification; `done` names data, model and settings."""
    further = [] if found.joint is None else joint_sections(found.joint, figures)
    further.append(
        Section(
            "Measured states and damping",
            (),
            [
                ReportFigure(figures["loops"], LOOPS_CAPTION),
                ReportFigure(figures["modal_damping"], DAMPING_CAPTION),
            ],
        )
    )
    if found.coupled is not None:
        further.append(coupled_page.section(found.coupled, figures))
    if "nnm" in figures:
        shown = [ReportFigure(figures["nnm"], MODE_CAPTION)]
        further.append(Section("The nonlinear normal mode", (), shown))
    return identification_report(
        found.identification,
        found.model.modes,
        figures,
        title=title,
        done=done,
        notes=[str(note) for note in found.notes],
        responses=ComparedResponses(
            *(found.responses, found.resonances, found.simulated),
            [f"Resonance at {p.load}: {where_in_words(p.further)}." for p in found.predictions],
        ),
        further=further,
    )


def write(
    folder: Path,
    found: IdentifiedTest,
    *,
    title: str = "",
    data: str = "",
    model: str = "",
    axis: str = "velocity",
) -> Report:
    """Write the results of an identification into a folder: tables, summary, figures and page.

    Arguments: `data` and `model` name the files; `axis` is the amplitude of the figures of
    backbone and damping, of which the tables then have a column. Returns the page's report.
    """
    shown = SHOWN_AMPLITUDES[axis]
    done = {"data": data, "model": model or found.model.name} | settings_in_words(found)
    added, unit = (shown.column, shown.power), found.model.modes.force_unit
    results.write_points(folder / "points.csv", found.identification, added=added, force_unit=unit)
    if found.predictions:
        drives = [
            prediction.drive for prediction in found.predictions for _ in prediction.responses
        ]
        given = (folder / "prediction.csv", found.responses)
        bands = found.joint is not None
        results.write_prediction(*given, drives=drives, bands=bands, force_unit=unit)
    summary: dict[str, object] = {"program": "snrmjax", "version": __version__, **done}
    if found.coupled is not None:
        summary["coupled_modes"] = coupled_page.write(folder, found.coupled)
    if found.joint is None:
        results.write_backbone(folder / "backbone.csv", found.identification, added=added)
    else:
        _write_fit(folder, found.joint, added)
        of_fit = found.joint.fit, found.responses, found.joint.fractions
        summary["joint_fit"] = joint_results.summarise_fit(*of_fit)
    summary |= results.summarise(found.identification, found.values)
    summary["resonances"] = [
        load_named(results.summarise_resonance(each), unit) | _further_load(prediction)
        for prediction in found.predictions
        for each in prediction.resonances
    ]
    summary["resonance_distributions"] = [
        load_named(results.summarise_distribution(prediction.further), unit)
        | _further_load(prediction)
        for prediction in found.predictions
    ]
    summary["notes"] = [str(note) for note in found.notes]
    write_summary(folder / "summary.json", summary)
    figures = save_figures(folder, identification_figures(found, shown))
    if found.joint is not None:
        done = done | {"curves": curves_in_words(found.joint.fit)}
    report = findings_report(found, title, done, figures)
    write_report(folder / "report.html", report)
    return report


def _further_load(prediction: Prediction) -> dict[str, float | str]:
    """Entries of a summary on a predicted force, in addition to its newtons."""
    given = {"drive_v": prediction.drive, "force_at": prediction.at}
    return {name: value for name, value in given.items() if value is not None}


def _write_fit(folder: Path, details: FitDetails, added: tuple[str, int]) -> None:
    """Write the files that a joint fit adds, and its curves."""
    joint_results.write_fitted_backbone(folder / "backbone.csv", details.fit, added=added)
    joint_results.write_joint_fit(folder / "fit.json", details.fit)
    if details.advice is not None:
        joint_results.write_next(
            folder / "next.csv", details.advice, force_unit=details.fit.modes.force_unit
        )
