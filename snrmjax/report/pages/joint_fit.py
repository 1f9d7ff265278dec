"""Report of a joint fit: its parameters, errors and residuals, and its advice."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from snrmjax.identify.inference.contributions import Contribution
from snrmjax.identify.inference.optimal_design import NextMeasurement
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.backbone_points import BackbonePoints
from snrmjax.io.joint_results import summarise_fit
from snrmjax.numerics.units import DEGREE, HERTZ
from snrmjax.pipelines.identify import FitDetails
from snrmjax.report.figures.joint_fit import (
    FitSeries,
    contributions_figure,
    fitted_curves_figure,
    next_measurements_figure,
    residuals_figure,
)
from snrmjax.report.html import ReportFigure, ReportTable, Section, minus, with_error
from snrmjax.report.sampling import VELOCITY, ShownAmplitude
from snrmjax.report.style import PrintedFigure, unit_for

_LISTED = 12  # contributions by name; the rest is summed in one row

CURVES_CAPTION = (
    "The joint fit. Lines are the curves fitted to all states at once; the darker band contains "
    "the true curve with a probability of 95 %. Where levels differ from one another, the paler "
    "band contains the curve of one further level. Dots are the results of single states, with "
    "the errors common to their level: dots off the line in a vertical streak are such errors, a "
    "line off all dots is not."
)
RESIDUALS_CAPTION = (
    "Residual of each point in standard deviations: the residual of the force balance in phase "
    "with the force (damping, at resonance) and in quadrature with it (stiffness, at resonance). "
    "Where curves and noise are right the dots are a structureless cloud, with one in twenty "
    "outside the dashed lines. A trend means that the curves, the phase or the linear modes are "
    "wrong; a funnel, that the noise is."
)
FRACTIONS_CAPTION = (
    "Contributions to the width of the bands: fractions of the variance, averaged over the "
    "measured amplitudes. Bars of one colour sum to 100 %. Random errors decrease with more "
    "states, level errors only with more levels."
)
ADVICE_CAPTION = (
    "Where to measure next: the states of the table, numbered in its order, on the responses "
    "predicted by the fit. Dashed parts are unstable."
)


def joint_figures(
    details: FitDetails, points: BackbonePoints, shown: ShownAmplitude = VELOCITY
) -> dict[str, Figure]:
    """Figures of a joint fit by the names of their files; `points` of single states.

    `shown` is the amplitude over which curves and residuals are drawn.
    """
    series = [FitSeries("joint fit", details.fit, points)]
    drawn = fitted_curves_figure(series, shown=shown)
    figures = {
        "joint_fit": drawn,
        "residuals": residuals_figure(details.fit, shown),
        "contributions": contributions_figure(details.fractions),
    }
    if details.advice:
        sensor = details.fit.modes.sensors[details.fit.data.sensor]
        figures["next"] = next_measurements_figure(
            details.responses, details.advice.rows, sensor=sensor
        )
    return figures


def joint_sections(
    details: FitDetails, figures: Mapping[str, Figure | PrintedFigure]
) -> list[Section]:
    """The sections of a report on a joint fit, with its figures."""
    fit = details.fit
    summary = summarise_fit(fit, ())
    intro = (
        f"Both curves were fitted together to {len(fit.data.level)} states of "
        f"{fit.data.n_levels} levels: {curves_in_words(fit)}. Errors common to the states of a "
        "level are unknowns of the fit."
    )
    shown = [
        ReportFigure(figures["joint_fit"], CURVES_CAPTION),
        ReportFigure(figures["residuals"], RESIDUALS_CAPTION),
    ]
    gain_unit = "N/V" if fit.drive_known_only else ""
    tables = [parameter_table(summary, gain_unit), error_table(summary)]
    sections = [
        Section("Joint fit", [intro], shown, tables),
        Section(
            "Contributions to the bands",
            (),
            [ReportFigure(figures["contributions"], FRACTIONS_CAPTION)],
            [contribution_table(details.fractions)],
        ),
    ]
    if details.advice:
        pictured = [ReportFigure(figures["next"], ADVICE_CAPTION)]
        table = advice_table(details.advice.rows)
        sections.append(Section("What to measure next", (), pictured, [table]))
    return sections


def curves_in_words(fit: JointFit) -> str:
    """The families of both curves: "natural frequency: power law of displacement; damping: …"."""
    squared, damping = fit.unknowns.squared_frequency, fit.unknowns.modal_damping
    return f"natural frequency: {squared.words}; damping: {damping.words}"


def parameter_table(summary: dict, gain_unit: str = "") -> ReportTable:
    """Parameters as `summarise_fit` has them, ± 1σ, and converted to other units.

    Arguments: `gain_unit` of the force gain: N/V where only the drive voltage is known.
    """
    rows = []
    for name, one in summary["parameters"].items():
        value, std = one["value"], one["std"]
        row = (name, minus(with_error(value, std)), _unit(one["unit"]))
        rows.append((*row, minus(_converted(name, value, std))))
        if name == "force_gain":
            # The fit's own unknown is the gain's logarithm.
            rows[-1] = (name, f"{np.exp(value):.4g} ± {100 * std:.2g} %", gain_unit, "")
    caption = (
        "Parameters ± 1σ. Those of a curve are values of ω² or 2ζω, or what a term adds to them "
        "at the largest measured amplitude. Knots ascend in amplitude, the first at zero."
    )
    return ReportTable(("parameter", "value ± 1σ", "unit", "that is"), rows, caption)


def _unit(name: str) -> str:
    return {"rad^2/s^2": "rad²/s²", "1": "", "log": "", "smallest force": "× smallest force"}.get(
        name, name
    )


def _converted(name: str, value: float, std: float) -> str:
    """Values of a backbone as frequencies, a phase in degrees."""
    if name.startswith(("backbone.at_zero", "backbone.knot_")) and value > 0:
        omega = float(np.sqrt(value))
        return f"{with_error(omega / HERTZ, 0.5 * std / omega / HERTZ)} Hz"
    if name == "instrument_phase":
        return f"{with_error(value / DEGREE, std / DEGREE)}°"
    return ""


def error_table(summary: dict) -> ReportTable:
    """Noise and level errors as the fit uses them."""
    noise, levels = summary["noise"], summary["levels"]
    scale, std = noise["scale"], noise["scale_std"]
    of_noise = (
        f"{with_error(scale, std)} × the stated one"
        if noise["stated"]
        else f"{with_error(100 * scale, 100 * std)} % of the velocity"
    )
    wandering = 100 * noise["wandering_of_natural_frequency"]
    rows = [
        ("random noise, from the residuals", of_noise),
        ("natural frequency, from state to state", f"{wandering:.2g} %"),
        ("gain of a level", f"{100 * levels['gain_std']:.2g} %"),
        ("phase of a level", f"{levels['phase_std_deg']:.2g}°"),
        (
            "natural frequency, from level to level",
            f"{100 * levels['natural_frequency_std_relative']:.2g} %",
        ),
        ("damping, from level to level", f"{100 * levels['damping_std_relative']:.2g} %"),
    ]
    return ReportTable(("error", "1σ"), rows, "Errors as used by the fit, stated or estimated.")


def contribution_table(fractions: Sequence[Contribution]) -> ReportTable:
    """The largest contributions to the bands by name, and all others in one row."""
    named, others = fractions[:_LISTED], fractions[_LISTED:]
    pairs = [(one.source, one.frequency_fraction, one.damping_fraction) for one in named]
    if others:
        rest = sum(o.frequency_fraction for o in others), sum(o.damping_fraction for o in others)
        pairs.append((f"{len(others)} further ones together", *rest))
    rows = [(name, f"{100 * a:.1f}", f"{100 * b:.1f}") for name, a, b in pairs]
    header = ("source of error", "natural frequency (%)", "damping (%)")
    caption = "Fractions of the variance of both bands, largest first."
    return ReportTable(header, rows, caption, "Every source of error by name")


def advice_table(advice: Sequence[NextMeasurement]) -> ReportTable:
    """Advised states by rank, with the reason of each."""
    drives = [one.drive for one in advice if one.drive is not None]
    # Where only the drive is known, a force in newtons cannot be set.
    loads, what = (drives, "drive") if drives else ([one.force for one in advice], "force")
    load = unit_for(loads, "V" if drives else "N")
    unit = unit_for([one.velocity for one in advice], "m/s")
    rows = [
        (
            *(f"{one.rank}", f"{value / load.size:.4g}", f"{one.frequency / HERTZ:.6g}"),
            *(f"{one.velocity / unit.size:.3g}", minus(f"{round(one.phase / DEGREE):d}")),
            *(f"{100 * one.expected_band_ratio:.1f}", str(one.reason)),
        )
        for one, value in zip(advice, loads, strict=True)
    ]
    header = (
        *("rank", f"{what} ({load.name})", "frequency (Hz)", f"velocity ({unit.name})"),
        *("phase (°)", "bands left (%)", "reason"),
    )
    caption = (
        "Each state assumes the ones before it. Velocity and phase are predictions; bands left: "
        "the mean width of the bands after this measurement, relative to the present one."
    )
    return ReportTable(header, rows, caption)
