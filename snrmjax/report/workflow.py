"""What a result is told with: predictions beside an identification, its figures, its report."""

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from snrmjax.identify.inference.fitted_response import as_backbone
from snrmjax.identify.inference.optimal_design import NextMeasurement
from snrmjax.identify.joint.joint_fit import JointFit, fit_jointly
from snrmjax.identify.pointwise.backbone import BackboneFit
from snrmjax.identify.pointwise.identification import Identification, identify_backbone
from snrmjax.identify.pointwise.prediction import (
    LARGEST_AMPLITUDE_RATIO,
    PredictedResponse,
    Resonance,
    predict_response,
    resonances,
)
from snrmjax.io import results
from snrmjax.io.files import write_summary
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure, equilibria
from snrmjax.report import figures as plot
from snrmjax.report.html import Report, ReportFigure, Section, write_report
from snrmjax.report.identification_report import identification_report
from snrmjax.report.joint_report import ToldFit, joint_figures, joint_sections, tell_fit
from snrmjax.simulate.solutions.forced_response import ResponseCurve
from snrmjax.simulate.solutions.normal_modes import NormalModeBranch


class Prediction(NamedTuple):
    """What the identified backbone says about one force."""

    force: float  # N
    resonances: list[Resonance]
    responses: list[PredictedResponse]


class Presentation(NamedTuple):
    """An identification with its predictions and, where it is known, the truth."""

    data: SteadyStates
    model: Structure
    identification: Identification
    predictions: tuple[Prediction, ...]
    notes: tuple[str, ...]
    truth: NormalModeBranch | None
    simulated: tuple[ResponseCurve, ...]
    fitted: ToldFit | None = None


def present_identification(
    data: SteadyStates,
    model: Structure,
    forces: Sequence[float],
    *,
    truth: NormalModeBranch | None = None,
    simulated: Sequence[ResponseCurve] = (),
    fit: JointFit | None = None,
    advice: Sequence[NextMeasurement] = (),
    **options: Any,
) -> Presentation:
    """Identify the mode of interest and predict its responses to some forces (N).

    `truth` and `simulated` are shown for comparison; `fit` gives the curves where there is a
    joint one, and `advice` what to measure next; `options` go to `identify_backbone`.
    """
    identification = identify_backbone(data, model.modes, **options)
    if fit is not None:
        identification = with_joint_fit(identification, fit)
    backbone = identification.fit.backbone
    predictions, notes = [], list(identification.notes)
    for force in forces:
        found = resonances(backbone, model.modes, force)
        responses = predict_response(backbone, model.modes, force)
        if not found:
            notes.append(
                f"no resonance at {force:g} N up to {LARGEST_AMPLITUDE_RATIO:g} times the largest "
                "measured amplitude."
            )
        elif any(one.continued for one in found):
            notes.append(f"the resonance at {force:g} N lies beyond the measured amplitudes.")
        if len(found) > 1:
            notes.append(f"{len(found)} resonances at {force:g} N: the damping allows several.")
        predictions.append(Prediction(force, found, responses))
    return Presentation(
        *(data, model, identification, tuple(predictions), tuple(notes), truth, tuple(simulated)),
        fitted=None if fit is None else tell_fit(fit, advice),
    )


def corrected(data: SteadyStates, fit: JointFit) -> SteadyStates:
    """The states with the force and the phase that a joint fit found for their instruments."""
    unknowns = fit.unknowns
    nominal = data.drive if fit.drive_known_only else data.force
    offset = unknowns.force_offset * jnp.min(fit.data.force)
    return eqx.tree_at(
        lambda d: (d.force, d.velocity),
        data,
        (
            nominal * jnp.exp(unknowns.log_force_gain) + offset,
            data.velocity * jnp.exp(-1j * unknowns.instrument_phase),
        ),
    )


def with_joint_fit(identification: Identification, fit: JointFit) -> Identification:
    """The identified points with the curves of a joint fit in place of their own."""
    both = (fit.noise_scale, fit.noise_scale)
    own = float(fit.modes.natural_frequency[fit.modes.mode_of_interest])
    ratio = float(fit.modes.damping_ratio[fit.modes.mode_of_interest])
    curves = BackboneFit(
        backbone=as_backbone(fit),
        noise_scale=both,
        level_frequency_std=0.5 * float(fit.level_std[2]) * own,
        level_damping_std=float(fit.level_std[3]) * ratio,
        noise_stated=fit.noise_stated,
        anchor=None,
    )
    return identification._replace(fit=curves, notes=fit.notes)


def equilibria_notes(model: Structure) -> list[str]:
    """A sentence when the structure has other equilibria than rest."""
    found = equilibria(model)
    others = [e for e in found if np.linalg.norm(e.displacement) > 0]
    if not others:
        return []
    shape = np.asarray(model.modes.mode_shape)
    listed = ", ".join(
        f"{'stable' if e.stable else 'unstable'} at q = "
        f"{np.array2string(e.displacement, precision=3)}"
        f" ({model.modes.sensors[0]} {1e3 * (shape @ e.displacement)[0]:.3g} mm)"
        for e in others
    )
    return [f"the model has {len(others)} further equilibria: {listed}. Curves start from rest."]


def identification_figures(told: Presentation) -> dict[str, Figure]:
    """Figures of an identification by the names of their files."""
    points, backbone = told.identification.points, told.identification.fit.backbone
    modes = told.model.modes
    figures = {
        "backbone": plot.backbone_figure(points, backbone, truth=told.truth, modes=modes),
        "modal_damping": plot.modal_damping_figure(
            [plot.DampingSeries("identified", points=points, backbone=backbone)],
            linear=_linear_modal_damping(told.model),
        ),
        "loops": plot.force_velocity_figure(told.data, _typical_states(told), sensor=points.sensor),
    }
    if told.predictions:
        figures["prediction"] = plot.response_figure(
            backbone,
            [response for one in told.predictions for response in one.responses],
            [resonance for one in told.predictions for resonance in one.resonances],
            simulated=told.simulated,
            measured=told.data,
        )
    if told.fitted is not None:
        figures |= joint_figures(told.fitted, points)
    if told.truth is not None:
        figures["nnm"] = plot.normal_mode_figure(told.truth, sensor=points.sensor)
    return figures


def _linear_modal_damping(model: Structure) -> float:
    j = model.modes.mode_of_interest
    return 2 * float(model.modes.damping_ratio[j] * model.modes.natural_frequency[j])


def _typical_states(told: Presentation) -> list[int]:
    """Three states of the largest level: nearest to resonance, farthest and one between."""
    points = told.identification.points
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


def presentation_report(
    told: Presentation,
    title: str,
    done: dict[str, str],
    notes: Sequence[str],
    figures: dict[str, Figure],
) -> Report:
    """The report of an identification; `notes` are those of the reader, before its own."""
    further = [] if told.fitted is None else joint_sections(told.fitted, figures)
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
        told.identification,
        told.model.modes,
        title=title,
        done=done,
        notes=[*notes, *told.notes],
        predicted=[response for one in told.predictions for response in one.responses],
        resonances=[resonance for one in told.predictions for resonance in one.resonances],
        simulated=told.simulated,
        truth=told.truth,
        measured=told.data,
        further=further,
    )


def fit_as_asked(
    data: SteadyStates, structure: Structure, fit: str, free: Sequence[str], *, robust: bool
) -> JointFit:
    """The joint fit that `--fit BACKBONE[,DAMPING]` and `--free NAME[,NAME]` ask for.

    Raises `ValueError` for more than two families, and what `fit_jointly` raises.
    """
    names = fit.split(",")
    if len(names) > 2:
        raise ValueError(f"--fit takes one or two families, but {fit!r} names {len(names)}.")
    return fit_jointly(
        data,
        structure,
        backbone=names[0],
        damping=names[1] if len(names) == 2 else "auto",
        free=[name for names in free for name in names.split(",")],
        robust=robust,
    )


def write_identification(
    folder: Path,
    told: Presentation,
    title: str,
    done: dict[str, str],
    notes: tuple[str, ...],
    further: dict[str, object] | None = None,
) -> None:
    """Write what `identify` found into a folder: tables, summary, figures and report."""
    identification = told.identification
    results.write_points(folder / "points.csv", identification)
    results.write_backbone(folder / "backbone.csv", identification)
    if told.predictions:
        responses = [response for one in told.predictions for response in one.responses]
        results.write_prediction(folder / "prediction.csv", responses)
    pairs = [(one.force, one.resonances) for one in told.predictions]
    summary: dict[str, object] = {"program": "snrmjax", "version": version("snrmjax"), **done}
    summary |= results.summarise(identification, pairs)
    summary |= {"notes": [*notes, *told.notes], **(further or {})}
    write_summary(folder / "summary.json", summary)
    figures = identification_figures(told)
    for name, figure in figures.items():
        plot.save_figure(figure, folder / f"{name}.png")
    report = presentation_report(told, title, done, notes, figures)
    write_report(folder / "report.html", report)
