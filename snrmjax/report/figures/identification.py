"""Figures of an identification in the style of the method paper: measured and identified.

Blue is measured, vermilion identified or predicted, black simulated (broad and grey behind a
prediction); dashed thin lines are unstable and pale ones lie beyond the measured amplitudes. Axes
are in Hz, degrees and per cent of critical damping. Figures need no display and change none of
matplotlib's settings.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from snrmjax.identify.pointwise.backbone import Backbone
from snrmjax.identify.pointwise.backbone_points import BackbonePoints
from snrmjax.identify.pointwise.prediction import (
    LARGEST_AMPLITUDE_RATIO,
    PredictedResponse,
    Resonance,
)
from snrmjax.measure.signals import appropriation_of, force_velocity_loop
from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import DEGREE, HERTZ
from snrmjax.report.sampling import (
    BAND,
    VELOCITY,
    ShownAmplitude,
    measured_near,
    phase_of,
    sample_backbone,
    sensor_index,
    span_of,
    usable_damping,
    velocity_of,
)
from snrmjax.report.style import (
    BACKGROUND,
    COLUMN,
    CROSS,
    CURVE,
    DOT,
    FILL,
    HOLLOW,
    IDENTIFIED,
    LINE,
    MEASURED,
    PAGE,
    SERIES,
    SIMULATED,
    STAR,
    banded,
    dress,
    explain_lines,
    fit_axis,
    legend,
    marks,
    name_axes,
    panels,
    phase_axis,
    plain,
    response_line,
    share_frequencies,
    stars,
    unit_for,
    with_unit,
)
from snrmjax.simulate.solutions.forced_response import ResponseCurve
from snrmjax.simulate.solutions.normal_modes import NormalModeBranch

_VISIBLE = 0.01  # of an axis: shorter bars are inside the stars


class DampingSeries(NamedTuple):
    """The modal damping of one structure, or by one method: points, a curve, or both."""

    label: str
    points: BackbonePoints | None = None
    backbone: Backbone | None = None


def _named_with_bars(*axes: tuple[np.ndarray, np.ndarray]) -> str:
    """Legend of identified points, with their bars only where visible.

    Arguments: of every axis the bars and the values that it spans.
    """
    widths = [
        (np.nanmax(bars, initial=0.0), np.ptp(values) if len(values) else 0.0)
        for bars, values in axes
    ]
    if not any(bar > 0 for bar, _ in widths):
        return "identified"
    seen = any(bar > _VISIBLE * span for bar, span in widths)
    return "identified, 95 % bars" if seen else "identified, 95 % bars smaller than the stars"


def backbone_figure(
    points: BackbonePoints,
    backbone: Backbone,
    *,
    truth: NormalModeBranch | None = None,
    modes: LinearModes | None = None,
    shown: ShownAmplitude = VELOCITY,
) -> Figure:
    """Measured steady states, the points identified from them, and the curves through these.

    Three panels: amplitude over velocity phase against frequency (0° at resonance), and damping
    ratio against amplitude, which is that of the velocity unless `shown` says another. Error
    bars and bands are 95 %; axes fit the points, so that a wide band may leave them. Steady states
    that are left out of the curves, by their status, are grey crosses.

    Arguments: `truth` a nonlinear mode to compare with; `modes` the linear modes, of which the
    mode of interest is marked at zero amplitude.
    Returns the figure. Raises `ValueError` when `truth` lacks the backbone's sensor.
    Reference: Kwarta & Allen, Figs. 7 and 10.
    """
    use = np.asarray(points.usable)
    omega = np.asarray(points.frequency) / HERTZ
    natural = np.asarray(points.natural_frequency) / HERTZ
    damping = 100 * np.asarray(points.damping_ratio)
    measured = shown.of(np.abs(np.asarray(points.velocity)), np.asarray(points.frequency))
    own = shown.of(points.backbone_velocity, points.natural_frequency)
    unit = unit_for([*measured[use], *own[use]], shown.unit)
    measured, own = measured / unit.size, own / unit.size
    top = 1.06 * np.max([*measured[use], *own[use]])
    curve = sample_backbone(backbone)
    amplitude = curve.amplitude(shown) / unit.size

    figure = Figure(figsize=(PAGE, 4.4), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=(1.8, 1.0))
    speeds, phases, dampings = map(figure.add_subplot, (grid[0, 0], grid[1, 0], grid[:, 1]))
    for axes in figure.axes:
        dress(axes)
    for axes, y in ((speeds, measured), (phases, phase_of(points.mode_velocity, backbone))):
        marks(axes, omega[use], y[use], DOT, "measured")
        marks(axes, omega[~use], y[~use], CROSS, "measured, left out")
    marks(dampings, own[~use], damping[~use], CROSS)
    bars = BAND * np.asarray(points.natural_frequency_std)[use] / HERTZ
    damping_bars = 100 * BAND * np.asarray(points.damping_ratio_std)[use]
    name = _named_with_bars((bars, omega[use]), (damping_bars, damping[use]))
    stars(speeds, natural[use], own[use], name, xerr=bars)
    stars(phases, natural[use], np.zeros(use.sum()), xerr=bars)
    stars(dampings, own[use], damping[use], yerr=damping_bars)
    above = {**CURVE, "zorder": 4}
    speeds.plot(curve.frequency, amplitude, color=IDENTIFIED, **above, label="identified curve")
    sides = curve.frequency - curve.frequency_error, curve.frequency + curve.frequency_error
    speeds.fill_betweenx(amplitude, *sides, color=IDENTIFIED, **FILL, label="95 % band")
    banded(dampings, amplitude, curve.damping, curve.damping_error, IDENTIFIED, band=None)
    seen, seen_damping = [*omega, *curve.frequency], [*curve.damping]
    if truth is not None:
        true = np.abs(velocity_of(truth, backbone.sensor))
        true = shown.of(true, np.asarray(truth.frequency)) / unit.size
        inside = np.where(true <= top, truth.frequency / HERTZ, np.nan)
        speeds.plot(inside, true, "--", color=SIMULATED, **above, label="true mode")
        seen += [*inside]
    if modes is not None:
        j = modes.mode_of_interest
        linear = modes.natural_frequency.item(j) / HERTZ, 100 * modes.damping_ratio.item(j)
        diamond = {**HOLLOW, "marker": "D"}
        marks(speeds, linear[0], 0.0, diamond, "linear mode")
        marks(dampings, 0.0, linear[1], diamond)
        seen, seen_damping = [*seen, linear[0]], [*seen_damping, linear[1]]
    share_frequencies(speeds, phases)
    speeds.set_ylim(0.0, top)
    dampings.set_xlim(0.0, top)
    fit_axis(speeds, "x", natural[use], seen, bars)
    fit_axis(dampings, "y", damping[use], seen_damping, damping_bars)
    phase_axis(phases)
    at, level = plain(backbone.sensor), f"{shown.name.capitalize()} amplitude ({unit.name})"
    name_axes(speeds, f"(a) amplitude at {at}", "", level)
    name_axes(phases, "(b) phase of the mode", "Frequency (Hz)", "Velocity phase (°)")
    name_axes(dampings, "(c) damping", level, "Damping ratio (% of critical)")
    legend(figure)
    return figure


def response_figure(
    backbone: Backbone,
    predicted: Sequence[PredictedResponse],
    resonances: Sequence[Resonance] = (),
    *,
    simulated: Sequence[ResponseCurve] = (),
    measured: SteadyStates | None = None,
    frequency_range: tuple[float, float] | None = None,
    force_tolerance: float = 0.03,
    force_unit: str = "N",
) -> Figure:
    """Predicted responses, one row per force, with harmonic balance and measured states.

    Two panels a row: velocity amplitude and velocity phase against frequency. Stars are phase
    resonances, dashed parts unstable, pale ones beyond the measured amplitudes.

    Arguments: `frequency_range` in rad/s, by default where a response exceeds a quarter of its
    peak; `measured` steady states appear in the row whose force is within the relative
    `force_tolerance` of theirs; `force_unit` of what drives it, m/s² of a base.
    Returns the figure. Raises `ValueError` when there is no response or a sensor is missing.
    Reference: Kwarta & Allen, Figs. 8 and 11.
    """
    sensor = backbone.sensor
    exact = [c for c in simulated if len(c.frequency)]
    every: list[PredictedResponse | ResponseCurve] = [*exact, *predicted]
    forces = sorted({c.force for c in every})
    if not forces:
        raise InputError("there is no response to show: `predicted` and `simulated` are empty.")
    spans = (
        [frequency_range] if frequency_range else [span_of(c, sensor) for c in predicted or exact]
    )
    low, high = min(s[0] for s in spans) / HERTZ, max(s[1] for s in spans) / HERTZ
    spine = sample_backbone(backbone, reach=LARGEST_AMPLITUDE_RATIO)
    figure, rows = panels(PAGE, 0.6 + 1.9 * len(forces), len(forces), 2)
    for force, (speeds, phases) in zip(forces, rows, strict=True):
        omega, states = measured_near(measured, sensor, force, force_tolerance)
        curves = [c for c in every if c.force == force]
        velocities = [velocity_of(curve, sensor) for curve in curves]
        largest = np.nanmax(np.abs(np.concatenate([*velocities, states])))
        unit = unit_for(largest, "m/s")
        for part, style in ((~spine.beyond, {"label": "backbone"}), (spine.beyond, {"alpha": 0.4})):
            x, y = spine.frequency[part], spine.velocity[part] / unit.size
            speeds.plot(x, y, ":", color=IDENTIFIED, **CURVE, **style)
        phases.axhline(0.0, color="0.6", linewidth=0.6, zorder=1)
        for curve, v in zip(curves, velocities, strict=True):
            for axes, y in ((speeds, np.abs(v) / unit.size), (phases, phase_of(v, backbone))):
                x = curve.frequency / HERTZ
                if isinstance(curve, PredictedResponse):
                    name, colour, width, beyond = "predicted", IDENTIFIED, LINE, curve.continued
                else:
                    name, colour, width, beyond = "harmonic balance", BACKGROUND, 3.5 * LINE, None
                pieces = curve.stability if isinstance(curve, ResponseCurve) else curve.stable
                response_line(axes, x, y, pieces, name, colour, width, beyond)
        for axes, y in ((speeds, np.abs(states) / unit.size), (phases, phase_of(states, backbone))):
            marks(axes, omega, y, DOT, "measured")
        found = [
            (resonance.frequency / HERTZ, resonance.velocity)
            for resonance in resonances
            if resonance.force == force
        ]
        star = {**STAR, "markersize": 10.0, "zorder": 5}
        marks(speeds, [f for f, _ in found], [v / unit.size for _, v in found], star, "resonance")
        marks(phases, [f for f, _ in found], np.zeros(len(found)), star)
        speeds.set(xlim=(low, high), ylim=(0.0, 1.12 * largest / unit.size))
        phases.sharex(speeds)
        phase_axis(phases)
        last = force == forces[-1]
        for axes in (speeds, phases):
            axes.tick_params(labelbottom=last)
        bottom = "Frequency (Hz)" if last else ""
        load = "force" if force_unit == "N" else "base acceleration"
        title, level = (
            f"{load} {with_unit(force, force_unit)}: ",
            f"Velocity amplitude ({unit.name})",
        )
        name_axes(speeds, f"{title}amplitude at {plain(sensor)}", bottom, level)
        name_axes(phases, f"{title}phase", bottom, "Velocity phase (°)")
    explain_lines(figure)
    legend(figure)
    return figure


def force_velocity_figure(
    data: SteadyStates, states: Sequence[int], *, sensor: str | None = None
) -> Figure:
    """Force-velocity loops of a few steady states: the thinner, the nearer to resonance.

    The dashed line is the part of the fundamental in phase with the force: at phase resonance
    and without further harmonics nothing else is left.

    Arguments: `states` are row numbers of `data`; `sensor` by default the first. Harmonics that
    were not measured are left out.
    Returns the figure. Raises `ValueError` when there is no state, one does not exist or was not
    measured under a known force, or the sensor is missing.
    Reference: Kwarta & Allen, Fig. 2.
    """
    name = sensor or data.sensors[0]
    r = sensor_index(data.sensors, name)
    good = np.flatnonzero(np.asarray(data.measured)[:, r] & np.isfinite(np.asarray(data.force)))
    wrong = [k for k in states if k not in good]
    if wrong or not len(states):
        raise InputError(
            f"`states` must be rows measured at {name!r} under a known force, of which there are "
            f"{len(good)}, but {f'has {wrong[0]}' if wrong else 'is empty'}."
        )
    velocity, higher = np.asarray(data.velocity), np.asarray(data.harmonics)
    phasors = np.concatenate([velocity[:, r, None], higher[:, r]], axis=1)
    phasors = np.where(np.isfinite(phasors), phasors, 0.0)[list(states)]
    forces = np.asarray(data.force)[list(states)]
    loops = force_velocity_loop(forces, phasors, (1, *data.harmonic_order))
    frequency, indicator = np.asarray(data.frequency) / HERTZ, np.asarray(appropriation_of(data))
    load = "Force" if data.base is None else "Base acceleration"
    columns = min(3, len(states))
    height = -(-len(states) // columns)
    figure, grid = panels(PAGE / 3 * columns, 0.2 + 2.4 * height, height, columns)
    for number, (axes, k) in enumerate(zip(grid.flat, states, strict=False)):
        force, velocity = np.asarray(loops.force)[number], np.asarray(loops.velocity)[number]
        force_unit, unit = unit_for(force, data.force_unit), unit_for(velocity, "m/s")
        ends, phasor = np.array([-1.0, 1.0]), phasors[number, 0]
        in_phase = ends * forces[number] / force_unit.size, ends * phasor.real / unit.size
        axes.plot(*in_phase, "--", color=SIMULATED, linewidth=0.8)
        axes.plot(force / force_unit.size, velocity / unit.size, color=MEASURED, **CURVE)
        angle = f"{np.angle(phasor) / DEGREE:+.0f}°".replace("-", "−")
        title = f"level {int(np.asarray(data.level)[k])}, {frequency[k]:.4g} Hz\n"
        title += f"phase {angle}, indicator {indicator[k]:.2f}"
        name_axes(axes, title, f"{load} ({force_unit.name})", f"Velocity ({unit.name})")
    for axes in grid.flat[len(states) :]:
        axes.remove()
    return figure


def modal_damping_figure(
    series: Sequence[DampingSeries],
    *,
    linear: float | None = None,
    shown: ShownAmplitude = VELOCITY,
) -> Figure:
    """Modal damping 2ζ̃ω̃ against an amplitude on the backbone, with 95 % bands.

    Constant for a structure with linear damping, whatever its stiffness does.

    Arguments: `linear` the value 2ζω of the linear mode in 1/s, drawn as a dotted line.
    Returns the figure. Raises `ValueError` when there is nothing to show.
    Reference: Kwarta & Allen, Fig. B.1.
    """
    drawn = [s for s in series if s.points is not None or s.backbone is not None]
    if not drawn:
        raise InputError("there is no damping to show: no series has points or a backbone.")
    figure, ((axes,),) = panels(COLUMN, 3.5, 1, 1)
    curves = [None if s.backbone is None else sample_backbone(s.backbone) for s in drawn]
    largest = [c.amplitude(shown) for c in curves if c]
    largest += [usable_damping(s.points, shown)[0] for s in drawn if s.points]
    unit = unit_for(np.concatenate(largest), shown.unit)
    dots: list[float] = []
    lines: list[float] = [] if linear is None else [linear]
    for number, (one, curve) in enumerate(zip(drawn, curves, strict=True)):
        colour, name = SERIES[number % len(SERIES)], plain(one.label)
        if one.points is not None:
            amplitude, damping = usable_damping(one.points, shown)
            style = {**DOT, "color": colour, "alpha": 0.7}
            marks(axes, amplitude / unit.size, damping, style, None if curve else name)
            dots += [*damping]
        if curve is not None:
            pair = curve.modal_damping, curve.modal_damping_error
            banded(axes, curve.amplitude(shown) / unit.size, *pair, colour, name, band=None)
            lines += [*curve.modal_damping]
    if linear is not None:
        axes.axhline(linear, color=SIMULATED, linestyle=":", linewidth=LINE, label="linear mode")
    axes.set_xlim(left=0.0)
    fit_axis(axes, "y", dots, lines)
    level = f"{shown.name.capitalize()} amplitude ({unit.name})"
    name_axes(axes, "", level, "Modal damping 2ζω (1/s)")
    legend(figure)
    return figure
