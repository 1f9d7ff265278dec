"""The report of an identification: its numbers, notes and figures in words."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from snrmjax.identify.inference.identification import Identification
from snrmjax.identify.joint.joint_fit import NoiseEstimate
from snrmjax.identify.pointwise.backbone import Backbone
from snrmjax.identify.pointwise.inversion import PointStatus
from snrmjax.identify.pointwise.prediction import (
    PredictedResponse,
    Resonance,
)
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.units import DEGREE, HERTZ
from snrmjax.report.html import (
    PROGRAM,
    Report,
    ReportFigure,
    ReportTable,
    Rows,
    Section,
    minus,
    with_error,
)
from snrmjax.report.sampling import sample_backbone, velocity_of
from snrmjax.report.sentences.identify import in_words
from snrmjax.report.style import PrintedFigure, Unit, unit_for, with_unit
from snrmjax.simulate.solutions.forced_response import ResponseCurve

GAIN_NOT_IN_BANDS = (
    " A gain error of force or velocity, which scales all damping ratios alike, is not in them."
)
NO_SCATTER = "none beyond the noise"
_BACKBONE_CAPTION = (
    "Backbone. Blue dots are measured steady states. Each gives one star: (a) the natural "
    "frequency at its amplitude, (b) the phase resonance at 0°, (c) the damping ratio. "
    "The line is the joint fit to all steady states, not a curve drawn through the stars; the band "
    "is its 95 % range. Check that the stars lie on one line "
    "regardless of phase: a spread with phase at one amplitude means that the assumptions of the "
    "method do not hold. Grey crosses are steady states left out of the curves."
)
RESPONSE_CAPTION = (
    "Predicted responses, one row per force. Thin dashed parts are unstable: a test without "
    "control jumps before it reaches them. Pale parts lie beyond the measured amplitudes, where "
    "the curves are extrapolated. The star is the phase resonance. Broad grey lines are harmonic "
    "balance with the true model, blue dots measured steady states under the same force, where "
    "there are any: both should coincide with the prediction."
)
TRUTH_CAPTION = (
    " The dashed black line is the true nonlinear mode of the model. Where it leaves the backbone "
    "and returns, an internal resonance transfers energy to another mode."
)
_VALIDITY = (
    "The method treats one mode as nonlinear and all others as linear. It needs a well-separated "
    "mode of constant shape, and no internal resonance in the range of the test; natural "
    "frequency and damping must depend on the amplitude only, not on the history of the test.",
    "Phases are those of the velocity relative to the force: 0° is the phase resonance, positive "
    "means that the velocity leads. The angle in the paper is this one minus 90°.",
    "Amplitudes are peak amplitudes of the fundamental harmonic. The natural frequency belongs to "
    "the displacement amplitude, which is the velocity over the frequency of the force. A point "
    "measured at velocity v and angular frequency Ω therefore lies on the backbone at the velocity "
    "v·ω/Ω, with ω its natural frequency (unless the velocity was chosen as argument).",
    "Error bars and bands are 95 %. The bands include the noise, stated or estimated, and errors "
    "common to the points of one level{gain}",
    "Reference: Kwarta & Allen, Nonlinear Normal Mode Backbone Estimation with Near-Resonant "
    "Steady State Inputs.",
)


class ComparedResponses(NamedTuple):
    """Responses predicted from identified curves, and those of harmonic balance to compare."""

    predicted: Sequence[PredictedResponse] = ()
    resonances: Sequence[Resonance] = ()
    simulated: Sequence[ResponseCurve] = ()
    further: Sequence[str] = ()  # where a level that was not measured has its resonances


def identification_report(
    identification: Identification,
    modes: LinearModes,
    figures: Mapping[str, Figure | PrintedFigure],
    *,
    title: str,
    done: Mapping[str, str] | None = None,
    notes: Iterable[str] = (),
    responses: ComparedResponses | None = None,
    further: Sequence[Section] = (),
) -> Report:
    """The report of an identification: numbers, notes, backbone, predictions, validity.

    Arguments: `figures` by name: `backbone`, `prediction` where there are responses, and `nnm`
    where the backbone is compared with the true nonlinear mode; `done` names the inputs (data
    file, model, options); `notes` come before those of the identification; `responses` under the
    requested forces; `further` sections before the last one.
    Returns a `Report` for `write_report`.
    """
    backbone, fitted = identification.backbone, "force_gain" in identification.fit.free
    gain = ", and the error of the fitted force gain." if fitted else f".{GAIN_NOT_IN_BANDS}"
    validity = [text.format(gain=gain) for text in _VALIDITY]
    caption = _BACKBONE_CAPTION + (TRUTH_CAPTION if "nnm" in figures else "")
    shown = [ReportFigure(figures["backbone"], caption)]
    sections = [Section("Backbone and damping", (), shown)]
    if responses is not None and "prediction" in figures:
        predicted, resonances, simulated, further_levels = responses
        table = resonance_table(
            *(backbone, resonances, simulated, [c.force for c in predicted]),
            force_unit=modes.force_unit,
        )
        shown = [ReportFigure(figures["prediction"], RESPONSE_CAPTION)]
        sections.append(Section("Predicted responses", further_levels, shown, [table]))
    return Report(
        title=title,
        done=[*(done or {}).items(), PROGRAM],
        result=identification_sentence(identification, modes),
        summary=identification_summary(identification, modes),
        notes=list(dict.fromkeys(map(str, [*notes, *identification.notes]))),
        sections=[
            *sections,
            *further,
            Section("How to read this, and when to trust it", validity),
        ],
    )


class _Course(NamedTuple):
    """A curve over the amplitudes, with 95 % errors."""

    velocity: np.ndarray  # m/s
    values: np.ndarray
    errors: np.ndarray
    unit: str

    def extreme(self) -> tuple[int, int]:
        """Where it is lowest and highest."""
        return int(np.nanargmin(self.values)), int(np.nanargmax(self.values))

    def has_inner_extreme(self) -> bool:
        """Whether its lowest or highest value lies between the ends, beyond the errors."""
        ends = self.values[[0, -1]]
        low, high = self.extreme()
        return bool(
            self.values[low] + self.errors[low] < ends.min()
            or self.values[high] - self.errors[high] > ends.max()
        )

    def words(self) -> str:
        """Its course in words."""
        first, last = self.values[[0, -1]]
        if self.has_inner_extreme():
            low, high = self.extreme()
            at = [with_unit(self.velocity[k], "m/s", 3) for k in (low, high)]
            return (
                f"lies between {self.values[low]:.4g} {self.unit} (at {at[0]}) and "
                f"{self.values[high]:.4g} {self.unit} (at {at[1]})"
            )
        if abs(last - first) <= np.hypot(self.errors[0], self.errors[-1]):
            return f"stays at {0.5 * (first + last):.4g} {self.unit} within its error"
        verb = "rises" if last > first else "falls"
        return f"{verb} from {first:.4g} to {last:.4g} {self.unit}"


def _courses(identification: Identification) -> tuple[_Course, _Course]:
    """Natural frequency and damping ratio over the amplitudes."""
    curve = sample_backbone(identification.backbone)
    return (
        _Course(curve.velocity, curve.frequency, curve.frequency_error, "Hz"),
        _Course(curve.velocity, curve.damping, curve.damping_error, "%"),
    )


def identification_sentence(identification: Identification, modes: LinearModes) -> str:
    """The result of an identification in one plain sentence."""
    frequency, damping = _courses(identification)
    unit = unit_for(frequency.velocity, "m/s")
    low, high = (f"{one / unit.size:.3g}" for one in frequency.velocity[[0, -1]])
    return (
        f"From {low} to {high} {unit.name} at {identification.points.sensor}, the natural "
        f"frequency of mode {modes.mode_of_interest + 1} {frequency.words()} and its "
        f"damping ratio {damping.words()}."
    )


def linear_mode_row(modes: LinearModes) -> tuple[str, str]:
    """The mode of interest as the model has it."""
    j = modes.mode_of_interest
    linear, damping = modes.natural_frequency.item(j) / HERTZ, modes.damping_ratio.item(j)
    return "linear mode", f"{linear:.5g} Hz, {100 * damping:.3g} % damping"


def identification_summary(identification: Identification, modes: LinearModes) -> Rows:
    """The headline numbers of an identification as names and texts, ± being 95 %."""
    points, noise = identification.points, identification.fit.noise
    scatter = f"{in_words(noise.level_std)} (1σ)" if np.any(noise.level_std > 0) else NO_SCATTER
    frequency, damping = _courses(identification)
    unit = unit_for(frequency.velocity, "m/s")

    def at(course: _Course, k: int) -> str:
        return f"{course.unit} at {course.velocity[k] / unit.size:.3g} {unit.name}"

    def ends(course: _Course) -> str:
        pairs = [(with_error(course.values[k], course.errors[k]), at(course, k)) for k in (0, -1)]
        return ", ".join(f"{value} {where}" for value, where in pairs)

    def extremes(course: _Course) -> str:
        return " to ".join(f"{course.values[k]:.4g} {at(course, k)}" for k in course.extreme())

    linear = modes.natural_frequency.item(modes.mode_of_interest) / HERTZ
    change = frequency.values[-1] - frequency.values[0]
    used, every = int(np.sum(np.asarray(points.usable))), len(np.asarray(points.status))
    rows = [
        linear_mode_row(modes),
        ("natural frequency (± 95 %)", ends(frequency)),
        ("change over the range", minus(f"{change:+.3g} Hz ({100 * change / linear:+.3g} %)")),
        ("damping ratio (± 95 %)", ends(damping)),
        ("steady states used", f"{used} of {every} at sensor {points.sensor}"),
        ("left out", _left_out(identification)),
        ("phases measured", _phases(identification)),
        ("noise", _noise(noise)),
        ("scatter from level to level", scatter),
        ("argument of the curves", _argument(identification)),
    ]
    if frequency.has_inner_extreme():
        rows.insert(2, ("lowest to highest frequency", extremes(frequency)))
    if damping.has_inner_extreme():
        at_damping = [name for name, _ in rows].index("damping ratio (± 95 %)")
        rows.insert(at_damping + 1, ("lowest to highest damping", extremes(damping)))
    return [(name, text) for name, text in rows if text]


def _left_out(identification: Identification) -> str:
    """How many points the curves leave out and why; nothing where all are used."""
    status = np.asarray(identification.points.status)
    return ", ".join(
        f"{int(np.sum(status == kind))} ({kind.message})"
        for kind in PointStatus
        if kind is not PointStatus.OK and np.any(status == kind)
    )


def _phases(identification: Identification) -> str:
    sign = np.sign(float(identification.backbone.modal_constant))
    phase = np.angle(np.asarray(identification.points.mode_velocity) * sign)
    phase = phase[np.isfinite(phase)] / DEGREE
    return minus(f"{phase.min():.0f}° to {phase.max():.0f}°, 0° is resonance")


def _noise(noise: NoiseEstimate) -> str:
    """The scatter of the states, over their stated noise or in per cent."""
    scale = 1.0 if noise.stated else 100.0
    each = with_error(scale * noise.scale, scale * noise.scale_std)
    stated, of = ("", "times as much") if noise.stated else ("not ", "% of the velocity")
    scatter = f"{stated}stated; states scatter about the curves by {each} {of}"
    return f"{scatter}, errors of whole levels excluded"


def _argument(identification: Identification) -> str:
    """The amplitudes that the curves are functions of."""
    unknowns = identification.fit.unknowns
    squared, damping = unknowns.squared_frequency.argument, unknowns.modal_damping.argument
    if squared == damping == "displacement":
        return f"{identification.points.argument} amplitude"
    return f"natural frequency: {squared} amplitude; damping: {damping} amplitude"


def resonance_table(
    backbone: Backbone,
    resonances: Sequence[Resonance],
    simulated: Sequence[ResponseCurve] = (),
    forces: Iterable[float] = (),
    *,
    force_unit: str = "N",
) -> ReportTable:
    """Predicted phase resonances, with harmonic balance's nearest one under the same force.

    Arguments: requested `forces`: those without a resonance get a row of their own.
    """
    pairs: list[tuple[float, Resonance | None]] = [
        (resonance.force, resonance) for resonance in resonances
    ]
    pairs += [
        (f, None) for f in sorted(set(forces) - {resonance.force for resonance in resonances})
    ]
    load = unit_for([force for force, _ in pairs], force_unit)
    unit = unit_for([resonance.velocity for resonance in resonances], "m/s")
    header = [f"force ({load.name})", f"velocity ({unit.name})", "frequency (Hz)", "damping (%)"]
    header += ["beyond the data"]
    if simulated:
        header += [f"harmonic balance ({unit.name})", "harmonic balance (Hz)"]
        header += ["difference (%)", "difference (Hz)"]
    rows = []
    for force, one in sorted(pairs, key=lambda pair: pair[0]):
        row = [f"{force / load.size:.4g}"]
        if one is None:
            rows.append([*row, "not in range", *[""] * (len(header) - 2)])
            continue
        row += [f"{one.velocity / unit.size:.4g}", f"{one.frequency / HERTZ:.5g}"]
        row += [f"{100 * one.damping_ratio:.3g}", "yes" if one.continued else "no"]
        rows.append(row + (_compared(one, simulated, backbone.sensor, unit) if simulated else []))
    caption = "Phase resonances: the velocity of the mode is in phase with the force."
    if simulated:
        caption += " Differences are the prediction minus the nearest one of harmonic balance."
    return ReportTable(header, rows, caption)


def _compared(
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
