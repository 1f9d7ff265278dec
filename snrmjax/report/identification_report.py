"""The report of an identification: its numbers, notes and figures in words."""

from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version

import numpy as np

from snrmjax.identify.pointwise.backbone import Backbone
from snrmjax.identify.pointwise.identification import Identification
from snrmjax.identify.pointwise.inversion import STATUS_MESSAGE, PointStatus
from snrmjax.identify.pointwise.prediction import (
    LARGEST_AMPLITUDE_RATIO,
    PredictedResponse,
    Resonance,
)
from snrmjax.io.units import DEGREE, HERTZ
from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import LinearModes
from snrmjax.report.figures import backbone_figure, response_figure
from snrmjax.report.html import Report, ReportFigure, ReportTable, Rows, Section, minus, with_error
from snrmjax.report.sampling import sample_backbone, velocity_of
from snrmjax.report.style import Unit, unit_for
from snrmjax.simulate.solutions.forced_response import ResponseCurve
from snrmjax.simulate.solutions.normal_modes import NormalModeBranch

BACKBONE_CAPTION = (
    "Backbone. Every blue dot is a measured steady state, and every star what the method makes of "
    "one: (a) the natural frequency at the amplitude it belongs to, (b) the phase resonance at 0°, "
    "(c) the damping ratio. The line is the curve through the stars, the band its 95 % range. "
    "Stars that lie on one line, whatever the phase of their dots, speak for the method; stars "
    "that spread with the phase at one amplitude speak against it. Grey crosses are steady states "
    "left out of the curves."
)
RESPONSE_CAPTION = (
    "Predicted responses, one row a force. Thin dashed parts are unstable: a test without control "
    "jumps before it gets there. Pale parts lie beyond the measured amplitudes, where the curves "
    "are continued on trust. The star is the phase resonance. Black lines are harmonic balance, "
    "blue dots measured steady states under the same force, where there are any."
)
TRUTH_CAPTION = (
    " The dashed black line is the true nonlinear mode of the model. Where it leaves the backbone "
    "and comes back, an internal resonance moves energy into another mode."
)
VALIDITY = (
    "The method takes one mode as nonlinear and all others as linear. It needs a well-separated "
    "mode whose shape keeps its form, and no internal resonance in the range of the test; natural "
    "frequency and damping must depend on the amplitude alone, not on the history of the test.",
    "Phases are those of the velocity relative to the force: 0° is the phase resonance, positive "
    "means that the velocity leads. The paper's angle is this one minus 90°.",
    "Amplitudes are peak amplitudes of the fundamental harmonic. The natural frequency belongs to "
    "the displacement amplitude, which is the velocity over the frequency of the force. A point "
    "measured at velocity v and angular frequency Ω therefore lies on the backbone at the velocity "
    "v·ω/Ω, with ω its natural frequency (unless the velocity was chosen as argument).",
    "Error bars and bands are 95 %. They hold random errors only: stated noise, or the scatter of "
    "the points where none was stated, and what the points of one level share. A wrong gain of "
    "force or velocity, which scales all damping ratios alike, is not in them.",
    "Reference: Kwarta & Allen, Nonlinear Normal Mode Backbone Estimation with Near-Resonant "
    "Steady State Inputs.",
)


def identification_report(
    identification: Identification,
    modes: LinearModes,
    *,
    title: str,
    done: Mapping[str, str] | None = None,
    notes: Iterable[str] = (),
    predicted: Sequence[PredictedResponse] = (),
    resonances: Sequence[Resonance] = (),
    simulated: Sequence[ResponseCurve] = (),
    truth: NormalModeBranch | None = None,
    measured: SteadyStates | None = None,
    further: Sequence[Section] = (),
) -> Report:
    """The report of an identification: numbers, notes, backbone, predictions, validity.

    Arguments: `done` names what was done (data file, model, options); `notes` come before those
    of the identification; `predicted` and `resonances` of the forces that were asked for, with
    `simulated` responses and steady states `measured` under them beside; `truth` the nonlinear
    mode of a model; `further` sections before the last one.
    Returns a `Report` for `write_report`.
    """
    points, backbone = identification.points, identification.fit.backbone
    figure = backbone_figure(points, backbone, truth=truth, modes=modes)
    caption = BACKBONE_CAPTION + (TRUTH_CAPTION if truth is not None else "")
    sections = [Section("Backbone and damping", (), [ReportFigure(figure, caption)])]
    if predicted or simulated:
        figure = response_figure(
            backbone, predicted, resonances, simulated=simulated, measured=measured
        )
        table = resonance_table(backbone, resonances, simulated, [c.force for c in predicted])
        sections.append(
            Section("Predicted responses", (), [ReportFigure(figure, RESPONSE_CAPTION)], [table])
        )
    return Report(
        title=title,
        done=[*(done or {}).items(), ("program", f"snrmjax {version('snrmjax')}")],
        summary=identification_summary(identification, modes),
        notes=list(dict.fromkeys([*notes, *identification.notes])),
        sections=[*sections, *further, Section("How to read this, and when to trust it", VALIDITY)],
    )


def identification_summary(identification: Identification, modes: LinearModes) -> Rows:
    """The headline numbers of an identification as names and texts, ± being 95 %."""
    points, fit, _ = identification
    backbone, status = fit.backbone, np.asarray(points.status)
    curve = sample_backbone(backbone)
    unit = unit_for(curve.velocity, "m/s")
    at = [f"at {one / unit.size:.3g} {unit.name}" for one in curve.velocity]

    def ends(values: np.ndarray, spread: np.ndarray, name: str) -> str:
        first, last = (f"{with_error(values[k], spread[k])} {name} {at[k]}" for k in (0, -1))
        return f"{first}, {last}"

    def extremes(values: np.ndarray, name: str) -> str:
        low, high = int(np.nanargmin(values)), int(np.nanargmax(values))
        return f"{values[low]:.4g} {name} {at[low]} to {values[high]:.4g} {name} {at[high]}"

    j = modes.mode_of_interest
    linear = float(modes.natural_frequency[j]) / HERTZ
    change = curve.frequency[-1] - curve.frequency[0]
    used = int(np.sum(np.asarray(points.usable)))
    left_out = [
        f"{int(np.sum(status == kind))} ({STATUS_MESSAGE[kind]})"
        for kind in PointStatus
        if kind is not PointStatus.OK and np.any(status == kind)
    ]
    phase = np.angle(np.asarray(points.mode_velocity) * np.sign(float(backbone.modal_constant)))
    phase = phase[np.isfinite(phase)] / DEGREE
    level_hz, level_damping = fit.level_frequency_std / HERTZ, 100 * fit.level_damping_std
    levels = f"{level_hz:.2g} Hz and {level_damping:.2g} % of critical damping (1σ)"
    if not level_hz > 0 and not level_damping > 0:
        levels = "none found beyond the noise"
    scale = fit.noise_scale
    noise = (
        f"stated; the points scatter {scale[0]:.2g} (frequency) and {scale[1]:.2g} (damping) times "
        "as much"
        if fit.noise_stated
        else f"not stated; from the scatter {100 * scale[0]:.2g} % (frequency) and "
        f"{100 * scale[1]:.2g} % (damping) of the measured phasor"
    )
    return [
        ("linear mode", f"{linear:.5g} Hz, {100 * float(modes.damping_ratio[j]):.3g} % damping"),
        ("natural frequency (± 95 %)", ends(curve.frequency, curve.frequency_error, "Hz")),
        ("lowest to highest frequency", extremes(curve.frequency, "Hz")),
        ("change over the range", minus(f"{change:+.3g} Hz ({100 * change / linear:+.3g} %)")),
        ("damping ratio (± 95 %)", ends(curve.damping, curve.damping_error, "%")),
        ("lowest to highest damping", extremes(curve.damping, "%")),
        ("points used", f"{used} of {len(status)} at sensor {points.sensor}"),
        ("left out", ", ".join(left_out) or "none"),
        ("phases measured", minus(f"{phase.min():.0f}° to {phase.max():.0f}°, 0° is resonance")),
        ("noise", noise),
        ("scatter from level to level", levels),
        ("argument of the curves", f"{points.argument} amplitude"),
    ]


def resonance_table(
    backbone: Backbone,
    resonances: Sequence[Resonance],
    simulated: Sequence[ResponseCurve] = (),
    forces: Iterable[float] = (),
) -> ReportTable:
    """Predicted phase resonances, with harmonic balance's nearest one under the same force.

    Arguments: `forces` that were asked for: those without a resonance get a row that says so.
    """
    pairs: list[tuple[float, Resonance | None]] = [(one.force, one) for one in resonances]
    pairs += [(f, None) for f in sorted(set(forces) - {one.force for one in resonances})]
    load = unit_for([force for force, _ in pairs], "N")
    unit = unit_for([one.velocity for one in resonances], "m/s")
    header = [f"force ({load.name})", f"velocity ({unit.name})", "frequency (Hz)", "damping (%)"]
    header += ["beyond the data"]
    if simulated:
        header += [f"harmonic balance ({unit.name})", "harmonic balance (Hz)"]
        header += ["difference (%)", "difference (Hz)"]
    rows = []
    for force, one in sorted(pairs, key=lambda pair: pair[0]):
        row = [f"{force / load.size:.4g}"]
        if one is None:
            rows.append([*row, "none found", *[""] * (len(header) - 2)])
            continue
        row += [f"{one.velocity / unit.size:.4g}", f"{one.frequency / HERTZ:.5g}"]
        row += [f"{100 * one.damping_ratio:.3g}", "yes" if one.continued else "no"]
        rows.append(row + (_beside(one, simulated, backbone.sensor, unit) if simulated else []))
    caption = (
        "Phase resonances: here the mode moves in phase with the force. Resonances are looked for "
        f"up to {LARGEST_AMPLITUDE_RATIO:g} times the largest measured amplitude."
    )
    if simulated:
        caption += " Differences are the prediction minus the nearest one of harmonic balance."
    return ReportTable(header, rows, caption)


def _beside(
    one: Resonance, simulated: Sequence[ResponseCurve], sensor: str, unit: Unit
) -> list[str]:
    """Harmonic balance's phase resonance nearest to a predicted one, and the differences."""
    exact = [
        (curve.frequency[k], abs(velocity_of(curve, sensor)[k]))
        for curve in simulated
        if curve.force == one.force
        for k in curve.at_events("phase_resonance")
    ]
    if not exact:
        return ["none found", "", "", ""]
    frequency, velocity = min(
        exact,
        key=lambda e: np.hypot(np.log(e[0] / one.frequency), np.log(e[1] / one.velocity)),
    )
    return [
        f"{velocity / unit.size:.4g}",
        f"{frequency / HERTZ:.5g}",
        minus(f"{100 * (one.velocity / velocity - 1):+.2g}"),
        minus(f"{(one.frequency - frequency) / HERTZ:+.2g}"),
    ]
