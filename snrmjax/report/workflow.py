"""What the commands do with a table of steady states: identify, predict, and write all of it."""

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from snrmjax.doctor.column_misreadings import doubt, linear_damping_note, with_doubt
from snrmjax.identify.inference.fitted_curves import fitted_values
from snrmjax.identify.inference.identification import (
    Identification,
    identification_of_fit,
    identify_backbone,
)
from snrmjax.identify.inference.optimal_design import (
    AdviceStatus,
    NextMeasurements,
    next_measurements,
)
from snrmjax.identify.joint.joint_fit import corrected_states, fit_jointly
from snrmjax.identify.pointwise.backbone import BackboneValues
from snrmjax.identify.pointwise.backbone_points import AmplitudeArgument, AmplitudeMeasure
from snrmjax.identify.pointwise.prediction_result import PredictedResponse, Resonance
from snrmjax.identify.prediction.notes import notes_on_negative_damping, where_in_words
from snrmjax.io import joint_results, results
from snrmjax.io.files import write_summary
from snrmjax.io.units import HERTZ
from snrmjax.measure.states import SteadyStates, check_force, check_phases
from snrmjax.model.structures import Structure
from snrmjax.report import figures as plot
from snrmjax.report.html import Report, ReportFigure, Section, write_report
from snrmjax.report.identification_report import ComparedResponses, identification_report
from snrmjax.report.joint_report import (
    ReportedFit,
    curves_in_words,
    joint_figures,
    joint_sections,
    reported_fit,
    words_of_fit,
)
from snrmjax.report.prediction.predictions import (
    Loads,
    Prediction,
    notes_on_predictions,
    predictions_of_fit,
    predictions_of_points,
    require_drive,
)
from snrmjax.report.sampling import VELOCITY, ShownAmplitude
from snrmjax.report.simulation_figures import normal_mode_figure
from snrmjax.report.style import PrintedFigure
from snrmjax.simulate.solutions.forced_response import ResponseCurve
from snrmjax.simulate.solutions.normal_modes import NormalModeBranch

_DRAWN = 100  # amplitudes of curves that are looked at for negative damping


class Findings(NamedTuple):
    """An identification with its predictions and, where they are known, the true responses."""

    data: SteadyStates
    model: Structure
    identification: Identification
    predictions: tuple[Prediction, ...]
    notes: tuple[str, ...]
    values: BackboneValues  # of the curves, from the smallest to the largest measured amplitude
    settings: dict[str, str]  # in words, for the summary and the report
    fitted: ReportedFit | None = None
    advice: NextMeasurements | None = None  # None: no advice was asked for
    truth: NormalModeBranch | None = None
    simulated: tuple[ResponseCurve, ...] = ()

    @property
    def responses(self) -> list[PredictedResponse]:
        """Predicted responses of all forces."""
        return [response for one in self.predictions for response in one.responses]

    @property
    def resonances(self) -> list[Resonance]:
        """Predicted resonances of all forces."""
        return [resonance for one in self.predictions for resonance in one.resonances]


def identify_by_points(
    data: SteadyStates,
    model: Structure,
    loads: Loads,
    *,
    amplitude: AmplitudeArgument = "displacement",
    measure: AmplitudeMeasure = "fundamental",
    n_knots: int | None = None,
    anchor: bool = False,
) -> Findings:
    """Identify state by state, draw curves through the points, and predict responses from these.

    Arguments: those of `identify_backbone`, and the `loads` of predictions.
    Raises `ValueError` where the force is known as a drive voltage only, and what
    `identify_backbone` and `predict_response` raise.
    """
    if loads.drives:
        require_drive(data)
    check_phases(data, "an identification")
    check_force(data, "an identification state by state")
    try:
        found = identify_backbone(
            data, model, amplitude=amplitude, measure=measure, n_knots=n_knots, anchor=anchor
        )
    except ValueError as error:
        raise with_doubt(error, data, model) from error
    backbone = found.backbone
    predictions = predictions_of_points(found, model, loads)
    reach = loads.largest_amplitude_ratio if predictions else 1.0
    drawn = backbone.sampled(_DRAWN, reach=reach)
    notes = (*doubt(data, model, found.points), *found.notes)
    notes += (
        *notes_on_negative_damping(drawn),
        *notes_on_predictions(predictions, backbone, data),
    )
    words = {
        "amplitude": f"{amplitude}, {measure}",
        "curves": "smooth" + (", anchored at the linear mode" if anchor else ""),
    }
    values = backbone.sampled(results.BACKBONE_POINTS)
    return Findings(data, model, found, predictions, notes, values, words)


def identify_jointly(
    data: SteadyStates,
    model: Structure,
    loads: Loads,
    *,
    families: str = "auto",
    free: Sequence[str] = (),
    robust: bool = False,
    further: int = 0,
) -> Findings:
    """Fit both curves to all states at once, predict responses from the fit, advise further states.

    Arguments: `families` BACKBONE[,DAMPING]; `free` unknowns of the instruments, each entry one or
    several with commas; how many `further` measurements to advise.
    Raises `ValueError` for more than two families, for a drive voltage where the data have a
    force, and what `fit_jointly` and `fitted_response` raise.
    """
    if loads.drives:
        require_drive(data)
    names = families.split(",")
    if len(names) > 2:
        raise ValueError(f"--fit takes one or two families, but {families!r} names {len(names)}.")
    fit = fit_jointly(
        data,
        model,
        backbone=names[0],
        damping=names[1] if len(names) == 2 else "auto",
        free=[name for several in free for name in several.split(",")],
        robust=robust,
    )
    data = corrected_states(data, fit)
    found = identification_of_fit(data, fit)
    predictions, trends = predictions_of_fit(fit, loads)
    advice = next_measurements(fit, further) if further else None
    doubts = () if "force_gain" in fit.names() else doubt(data, model, found.points)
    notes = [*doubts, *data.notes, *found.notes, *linear_damping_note(fit, model)]
    if fit.drive_known_only:
        place = fit.names().index("force_gain")
        std = float(np.sqrt(fit.covariance[place, place]))
        notes.append(
            "forces in N are drive voltage times the fitted gain "
            f"({float(np.exp(fit.unknowns.log_force_gain)):.4g} N/V ± {100 * std:.2g} %); if the "
            "model's modal mass is wrong, so is the gain."
        )
    reach = (
        np.linspace(0.0, loads.largest_amplitude_ratio if predictions else 1.0, _DRAWN)
        * fit.largest[0]
    )
    notes += notes_on_negative_damping(fitted_values(fit, displacement=reach))
    notes += (*trends, *notes_on_predictions(predictions, found.backbone, data))
    notes += advice.notes if advice else ()
    if advice is not None and advice.status != AdviceStatus.COMPLETE:
        notes.append(
            f"{len(advice)} of {further} further measurements are advised: {advice.message}."
        )
    pair = (fit.unknowns.squared_frequency, fit.unknowns.modal_damping)
    words = {
        "amplitude": "displacement, fundamental",
        "curves": " and ".join(joint_results.described(curve) for curve in pair),
    }
    fitted = reported_fit(fit, tuple(advice or ()))
    ends = float(found.backbone.smallest), float(found.backbone.largest)
    values = fitted_values(fit, displacement=np.linspace(*ends, results.BACKBONE_POINTS))
    fields = (data, model, found, predictions, tuple(dict.fromkeys(notes)), values, words)
    return Findings(*fields, fitted, advice)


def headline(found: Findings) -> list[str]:
    """What was found, in lines to be read as soon as the command ends."""
    values = found.values
    speed, ratio = np.asarray(values.velocity), 100 * np.asarray(values.damping_ratio)
    hertz = np.asarray(values.natural_frequency) / HERTZ
    ends = [
        f"{hertz[k]:.5g} Hz and {ratio[k]:.3g} % of critical damping at {speed[k]:.3g} m/s"
        for k in (0, -1)
    ]
    lines = [f"backbone: {ends[0]} to {ends[1]}"]
    for one in found.predictions:
        for each in one.resonances:
            place = f"{each.frequency / HERTZ:.5g} Hz, {each.velocity:.3g} m/s"
            damped = f"{100 * each.damping_ratio:.3g} % of critical damping"
            lines.append(f"resonance at {one.load}: {place}, {damped}")
        lines.append(f"resonance at {one.load} {where_in_words(one.further)}")
    for advised in found.advice or ():
        force, drive = advised.force, advised.drive
        load = f"force {force:.4g} N" if drive is None else f"drive {drive:.4g} V"
        place = f"{load}, {advised.frequency / HERTZ:.6g} Hz (expected {advised.expected})"
        lines.append(f"measure next, {advised.rank}: {place}: {advised.reason}")
    return lines


def identification_figures(found: Findings, shown: ShownAmplitude = VELOCITY) -> dict[str, Figure]:
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
            measured=found.data,
        )
    if found.fitted is not None:
        figures |= joint_figures(found.fitted, points, shown)
    if found.truth is not None:
        figures["nnm"] = normal_mode_figure(found.truth, sensor=points.sensor)
    return figures


def _linear_modal_damping(model: Structure) -> float:
    j = model.modes.mode_of_interest
    return 2 * float(model.modes.damping_ratio[j] * model.modes.natural_frequency[j])


def _typical_states(found: Findings) -> list[int]:
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
    "Modal damping 2ζω against amplitude. Linear damping gives a constant near the dotted line, "
    "whatever the stiffness does; harmonics of the motion add a few per cent."
)
MODE_CAPTION = (
    "The nonlinear normal mode of the model, followed by harmonic balance: velocity against "
    "frequency, and frequency against energy."
)


def findings_report(
    found: Findings, title: str, done: dict[str, str], figures: Mapping[str, Figure | PrintedFigure]
) -> Report:
    """The report of an identification; `done` says what was done with which files."""
    further = [] if found.fitted is None else joint_sections(found.fitted, figures)
    further.append(
        Section(
            "What was measured, and its damping",
            (),
            [
                ReportFigure(figures["loops"], LOOPS_CAPTION),
                ReportFigure(figures["modal_damping"], DAMPING_CAPTION),
            ],
        )
    )
    if "nnm" in figures:
        shown = [ReportFigure(figures["nnm"], MODE_CAPTION)]
        further.append(Section("The nonlinear normal mode", (), shown))
    return identification_report(
        found.identification,
        found.model.modes,
        figures,
        title=title,
        done=done,
        notes=found.notes,
        responses=ComparedResponses(
            *(found.responses, found.resonances, found.simulated),
            [f"Resonance at {p.load}: {where_in_words(p.further)}." for p in found.predictions],
        ),
        further=further,
        words=None if found.fitted is None else words_of_fit(found.fitted.fit),
    )


def write_findings(
    folder: Path,
    found: Findings,
    title: str,
    done: dict[str, str],
    shown: ShownAmplitude = VELOCITY,
) -> Report:
    """Write what `identify` found into a folder: tables, summary, figures and report.

    Arguments: `done` says with which files; `shown` is the amplitude of the figures of backbone
    and damping, of which the tables then have a column. Returns the report.
    """
    done = done | found.settings
    results.write_points(folder / "points.csv", found.identification)
    if found.predictions:
        drives = [one.drive for one in found.predictions for _ in one.responses]
        stds = [b.velocity_std for one in found.predictions for b in one.banded]
        given = (folder / "prediction.csv", found.responses)
        results.write_prediction(*given, drives=drives, velocity_stds=stds)
    summary: dict[str, object] = {"program": "snrmjax", "version": version("snrmjax"), **done}
    if found.fitted is None:
        results.write_backbone(folder / "backbone.csv", found.identification)
    else:
        _write_fit(folder, found, found.fitted)
        banded = [response for one in found.predictions for response in one.banded]
        fit = joint_results.summarise_fit(found.fitted.fit, banded, found.fitted.shares)
        summary["joint_fit"] = fit
    for name, of in (("points", "backbone_velocity_m_s"), ("backbone", "velocity_m_s")):
        if shown.power:
            added = of.replace(VELOCITY.column, shown.column)
            results.with_amplitude(folder / f"{name}.csv", of, added, shown.power)
    summary |= results.summarise(found.identification, found.values)
    summary["resonances"] = [
        results.summarise_resonance(each) | ({} if one.drive is None else {"drive_v": one.drive})
        for one in found.predictions
        for each in one.resonances
    ]
    summary["resonance_distributions"] = [
        results.summarise_distribution(one.further)
        | ({} if one.drive is None else {"drive_v": one.drive})
        for one in found.predictions
    ]
    summary["notes"] = list(found.notes)
    write_summary(folder / "summary.json", summary)
    figures = plot.save_figures(folder, identification_figures(found, shown))
    if found.fitted is not None:
        done = done | {"curves": curves_in_words(found.fitted.fit)}
    report = findings_report(found, title, done, figures)
    write_report(folder / "report.html", report)
    return report


def _write_fit(folder: Path, found: Findings, fitted: ReportedFit) -> None:
    """Write the files that a joint fit adds, and its curves."""
    joint_results.write_fitted_backbone(folder / "backbone.csv", fitted.fit)
    joint_results.write_joint_fit(folder / "fit.json", fitted.fit)
    if found.advice is not None:
        joint_results.write_next(folder / "next.csv", found.advice)
