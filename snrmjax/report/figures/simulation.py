"""Figures of simulated motions: responses, nonlinear modes, batches and virtual tests."""

from collections.abc import Sequence
from itertools import cycle
from typing import Any

import numpy as np
from jaxtyping import Array, Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import DEGREE, HERTZ, unit_in_print
from snrmjax.report.sampling import BAND, sensor_index, velocity_of
from snrmjax.report.style import (
    BACKGROUND,
    COLUMN,
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
    Style,
    amplitude_and_phase,
    banded,
    explain_lines,
    fit_axis,
    frequency_and_damping,
    legend,
    marks,
    name_axes,
    panels,
    phase_axis,
    plain,
    response_line,
    stars,
    unit_for,
    with_unit,
)
from snrmjax.simulate.balance.labelled import velocity_peaks
from snrmjax.simulate.solutions.controlled import DampedModeBranch
from snrmjax.simulate.solutions.event_curves import EventCurve
from snrmjax.simulate.solutions.forced_response import ResponseBatch, ResponseCurve
from snrmjax.simulate.solutions.normal_modes import NormalModeBranch
from snrmjax.simulate.solutions.quasi_periodic import QuasiPeriodicBranch

_SEEN_FRACTION = 1e-3  # of the energy: the width of a line in its panel


def simulated_response_figure(
    curves: Sequence[ResponseCurve], *, sensor: str | None = None
) -> Figure:
    """Forced responses by harmonic balance: amplitude and phase of the velocity fundamental.

    Unstable parts are dashed, parts whose stability was not computed dash-dotted; triangles mark
    peaks, squares folds, dots phase resonances. Subharmonic motions have their component at 1/n of
    the frequency and no phase.

    Arguments: `sensor` by default the first of the curves.
    Returns the figure. Raises `ValueError` when no curve has a point or the sensor is missing.
    """
    drawn = sorted((c for c in curves if len(c.frequency)), key=lambda c: c.force)
    if not drawn:
        raise InputError("there is no response to show: no curve has a point.")
    name = sensor or drawn[0].sensors[0]
    kinds = sorted({(c.force, c.subharmonic) for c in drawn})
    shades = colormaps["viridis"](np.linspace(0.0, 0.85, len(kinds)))
    colours = dict(zip(kinds, shades, strict=True))
    unit = unit_for(np.concatenate([velocity_of(c, name) for c in drawn]), "m/s")
    figure, speeds, phases = amplitude_and_phase(PAGE, 5.4, name, unit)
    markers = {"peak": "^", "fold": "s", "phase_resonance": "o"}
    for event in (None, *markers):
        for curve in drawn:
            v, x = velocity_of(curve, name), curve.frequency / HERTZ
            n, label = curve.subharmonic, with_unit(curve.force, curve.force_unit)
            label += "" if n == 1 else f", component at 1/{n} of the frequency"
            shown = (speeds, np.abs(v) / unit.size), (phases, np.angle(v) / DEGREE)
            for axes, y in shown if n == 1 else shown[:1]:
                if event is None:
                    colour = colours[curve.force, n]
                    response_line(axes, x, y, curve.stability, label, colour, LINE)
                    continue
                at, style = curve.at_events(event), {**HOLLOW, "marker": markers[event]}
                if event == "phase_resonance":
                    style |= {"color": "black", "markersize": 2.0}
                marks(axes, x[at], y[at], style, event.replace("_", " "))
    speeds.set_ylim(bottom=0.0)
    phase_axis(phases)
    explain_lines(figure)
    legend(figure)
    return figure


def event_curve_figure(curves: Sequence[EventCurve], *, sensor: str | None = None) -> Figure:
    """Events of forced responses over a parameter: their frequency and their velocity amplitude.

    Squares mark turning points of the parameter: cusps, births and mergers of isolated responses.

    Arguments: `curves` over one parameter; `sensor` by default the first of the curves.
    Returns the figure. Raises `ValueError` when no curve has a point, the curves have several
    parameters, or the sensor is missing.
    """
    drawn = [c for c in curves if len(c.frequency)]
    if not drawn:
        raise InputError("there is no curve of events to show: no curve has a point.")
    name = sensor or drawn[0].sensors[0]
    parameters = sorted({(c.parameter, c.unit) for c in drawn})
    if len(parameters) > 1:
        listed = ", ".join(parameter for parameter, _ in parameters)
        raise InputError(f"the curves must be over one parameter, but are over {listed}.")
    ((parameter, base),) = parameters
    of = unit_for(np.concatenate([c.value for c in drawn]), "N") if base == "N" else None
    scale, label = (of.size, of.name) if of else (1.0, base)
    below = parameter.replace("_", " ").capitalize() if of else parameter
    below += f" ({unit_in_print(label)})" if unit_in_print(label) else ""
    unit = unit_for(np.concatenate([np.abs(velocity_of(c, name)) for c in drawn]), "m/s")
    figure, ((frequencies, speeds),) = panels(PAGE, 3.2, 1, 2)
    kinds = list(dict.fromkeys(curve.kind for curve in drawn))
    for curve in drawn:
        x, colour = curve.value / scale, SERIES[kinds.index(curve.kind)]
        turning = np.flatnonzero([bool(event) for event in curve.event])
        speed = np.abs(velocity_of(curve, name)) / unit.size
        for axes, y in ((frequencies, curve.frequency / HERTZ), (speeds, speed)):
            axes.plot(x, y, color=colour, **CURVE, label=curve.kind.replace("_", " "))
            marks(axes, x[turning], y[turning], {**HOLLOW, "marker": "s"}, "turning point")
    level = f"Velocity amplitude ({unit.name})"
    name_axes(frequencies, "(a) frequency", below, "Frequency (Hz)")
    name_axes(speeds, f"(b) amplitude at {plain(name)}", below, level)
    speeds.set_ylim(bottom=0.0)
    legend(figure)
    return figure


def quasi_periodic_figure(
    branches: Sequence[QuasiPeriodicBranch],
    curves: Sequence[ResponseCurve] = (),
    *,
    sensor: str | None = None,
) -> Figure:
    """Quasi-periodic motions: the range of their amplitude, and the period of the modulation.

    The amplitude of the velocity fundamental goes up and down within the shaded range; behind it
    are the responses with one frequency, unstable ones dashed.

    Arguments: `branches`, and the `curves` from which they branch; `sensor` by default the first.
    Returns the figure. Raises `ValueError` without a branch or when the sensor is missing.
    """
    if not branches:
        raise InputError("there is no quasi-periodic motion to show: no branch was found.")
    name = sensor or branches[0].sensors[0]
    r = sensor_index(branches[0].sensors, name)
    unit = unit_for(np.concatenate([b.largest_amplitude[:, r] for b in branches]), "m/s")
    figure, ((speeds, periods),) = panels(PAGE, 3.4, 1, 2)
    forces = sorted({b.force for b in branches})
    for curve in (c for c in curves if c.force in forces and len(c.frequency)):
        v, x = np.abs(velocity_of(curve, name)) / unit.size, curve.frequency / HERTZ
        response_line(speeds, x, v, curve.stability, "one frequency", SIMULATED, LINE)
    for branch, colour in zip(branches, cycle(SERIES), strict=False):
        x = branch.frequency / HERTZ
        least, most = (
            part[:, r] / unit.size for part in (branch.least_amplitude, branch.largest_amplitude)
        )
        begin = with_unit(branch.force, branch.force_unit)
        label = f"two frequencies, {begin}, from {x[0]:.5g} Hz"
        # A branch may have turning points in frequency: a polygon, not a band over an axis.
        speeds.fill([*x, *x[::-1]], [*least, *most[::-1]], color=colour, **FILL)
        for edge in (least, most):
            speeds.plot(x, edge, color=colour, **CURVE)
        periods.plot(x, branch.slow_period, color=colour, **CURVE, label=label)
    speeds.set_ylim(bottom=0.0)
    title, level = f"(a) amplitude at {plain(name)}", f"Velocity amplitude ({unit.name})"
    name_axes(speeds, title, "Frequency (Hz)", level)
    name_axes(periods, "(b) modulation", "Frequency (Hz)", "Period of the modulation (s)")
    explain_lines(figure)
    legend(figure)
    return figure


def normal_mode_figure(branch: NormalModeBranch, *, sensor: str | None = None) -> Figure:
    """A nonlinear normal mode: velocity, frequency, and how its shape changes with the energy.

    The velocity is shown as amplitude of the fundamental and as peak of the whole signal: they
    differ where an internal resonance puts energy into higher harmonics. Unstable motions are
    dashed; markers name internal resonances where the other mode has most of the energy. Several
    modes have a panel of their energy fractions, several sensors one of their fundamentals over
    the first.
    The energy axes show the last five decades.

    Arguments: `sensor` by default the branch's first.
    Returns the figure. Raises `ValueError` when the branch has no point or not this sensor.
    Reference: Kerschen et al., Mech. Syst. Signal Process. 23 (2009) 170,
    doi:10.1016/j.ymssp.2008.04.002, for the frequency-energy plot.
    """
    if not len(branch.frequency):
        raise InputError("there is no normal mode to show: the branch has no point.")
    name = sensor or branch.sensors[0]
    fundamental = np.abs(velocity_of(branch, name))
    peak = velocity_peaks(branch.velocity[:, :, branch.sensors.index(name)])
    unit, omega = unit_for(peak, "m/s"), branch.frequency / HERTZ
    several = branch.mode_fraction.shape[1] > 1
    figure, grid = panels(PAGE, 6.0 if several else 3.2, 2 if several else 1, 2)
    speeds, energies = grid[0]
    stable = branch.stability
    response_line(*(speeds, omega, peak / unit.size, stable, "peak of the signal", SERIES[5], LINE))
    response_line(speeds, omega, fundamental / unit.size, stable, "fundamental", SIMULATED, LINE)
    response_line(energies, branch.energy, omega, stable, "fundamental", SIMULATED, LINE)
    _energy_axis(energies, branch)
    drawn = [t for t in branch.tongues if t.last >= t.first]  # not those left out
    for tongue, marker in zip(drawn, cycle("osD^v"), strict=False):
        fraction = branch.mode_fraction[tongue.first : tongue.last + 1, tongue.mode]
        tip = tongue.first + int(np.argmax(fraction))
        style: Style = {**HOLLOW, "marker": marker}
        marks(energies, branch.energy[tip], omega[tip], style, f"internal resonance {tongue.name}")
    speeds.set_ylim(bottom=0.0)
    title, level = f"(a) amplitude at {plain(name)}", f"Velocity amplitude ({unit.name})"
    name_axes(speeds, title, "Frequency (Hz)", level)
    name_axes(energies, "(b) frequency and energy", "Energy (J)", "Frequency (Hz)")
    if several:
        fractions, shapes = grid[1]
        _draw_shapes(branch, fractions, shapes, branch.sensors.index(name))
    explain_lines(figure)
    legend(figure)
    return figure


def _draw_shapes(branch: NormalModeBranch, fractions: Axes, shapes: Axes, reference: int) -> None:
    """Energy fractions of the modes, and fundamentals of the sensors over one of them."""
    energy, stable = branch.energy, branch.stability
    seen = np.flatnonzero(branch.mode_fraction.max(axis=0) > _SEEN_FRACTION)
    for k, colour in zip(seen.tolist(), _many_colours(len(seen)), strict=True):
        fraction = 100.0 * branch.mode_fraction[:, k]
        response_line(fractions, energy, fraction, stable, f"mode {k + 1}", colour, LINE)
    name_axes(
        fractions, "(c) fractions of the modes", "Energy (J)", "Fraction of the kinetic energy (%)"
    )
    _energy_axis(fractions, branch)
    if len(branch.sensors) == 1:
        spec = fractions.get_subplotspec()
        shapes.remove()
        if spec is not None:
            fractions.set_subplotspec(spec.get_gridspec()[1, :])
        return
    shape = branch.shape(reference)
    over = shape / np.maximum(np.abs(shape[:, [reference]]), np.finfo(float).tiny)
    for k, colour in enumerate(_many_colours(len(branch.sensors))):
        label = f"at {plain(branch.sensors[k])}"
        response_line(shapes, energy, over[:, k], stable, label, colour, LINE)
    name_axes(shapes, "(d) shape", "Energy (J)", f"Over that at {plain(branch.sensors[reference])}")
    _energy_axis(shapes, branch)
    fit_axis(shapes, "y", over.ravel())


def _many_colours(number: int) -> Sequence[Any]:
    """This number of different colours."""
    if number <= len(SERIES):
        return SERIES[:number]
    return list(colormaps["viridis"](np.linspace(0.0, 0.9, number)))


def _energy_axis(axes: Axes, branch: NormalModeBranch) -> None:
    axes.set_xscale("log")
    axes.set_xlim(left=max(1e-5 * branch.energy.max(), branch.energy.min()))


def motions_figure(
    frequency: np.ndarray,
    velocity: np.ndarray,
    *,
    sensor: str = "the first sensor",
    joined: bool,
    stable: np.ndarray | None = None,
    beyond: np.ndarray | None = None,
) -> Figure:
    """Amplitude and phase of the velocity of motions against their frequency.

    Arguments: `frequency` in rad/s, `velocity` the complex fundamental in m/s, of every motion;
    `joined` draws them as a curve, dashed where it is not `stable` and pale `beyond` the data.
    Returns the figure. Raises `ValueError` without a motion.
    """
    speeds, omega = np.atleast_1d(velocity), np.atleast_1d(frequency) / HERTZ
    if not np.any(np.isfinite(speeds)):
        raise InputError("there is no motion to show: none was found.")
    unit = unit_for(speeds[np.isfinite(speeds)], "m/s")
    figure, upper, lower = amplitude_and_phase(COLUMN, 4.4, sensor, unit)
    steady = np.ones(len(speeds), dtype=bool) if stable is None else stable
    for axes, y in ((upper, np.abs(speeds) / unit.size), (lower, np.angle(speeds) / DEGREE)):
        if joined:
            response_line(axes, omega, y, steady, "response", SIMULATED, LINE, beyond)
        else:
            axes.plot(omega, y, **{**DOT, "color": MEASURED})
    upper.set_ylim(bottom=0.0)
    phase_axis(lower)
    if joined and not (np.all(steady) and beyond is None):
        explain_lines(figure)
        legend(figure)
    return figure


def damped_mode_figure(branch: DampedModeBranch, *, sensor: str | None = None) -> Figure:
    """Natural frequency and damping ratio of a damped nonlinear mode against its amplitude.

    Arguments: `sensor` by default the branch's first.
    Returns the figure. Raises `ValueError` when the branch has no point or not this sensor.
    """
    if not len(branch.frequency):
        raise InputError("there is no mode to show: the branch has no point.")
    name = sensor or branch.sensors[0]
    if name not in branch.sensors:
        raise InputError(f"`sensor` must be one of {branch.sensors}, but is {name!r}.")
    velocity = np.abs(branch.velocity[:, 1, branch.sensors.index(name)])
    return amplitudes_figure(velocity, branch.frequency, branch.damping_ratio, name)


def amplitudes_figure(
    velocity: Float[Array | np.ndarray, " point"],
    frequency: Float[Array | np.ndarray, " point"],
    damping_ratio: Float[Array | np.ndarray, " point"],
    sensor: str = "the sensor",
    *,
    stds: tuple[Any, Any] | None = None,
    joined: bool = True,
) -> Figure:
    """Natural frequency and damping ratio of a mode against the velocity amplitude.

    Arguments: `velocity` in m/s at `sensor`, `frequency` in rad/s; `stds` the 1σ of frequency
    and damping ratio, drawn as 95 % bands or bars; `joined` draws a curve.
    Returns the figure. Raises `ValueError` without a finite point.
    """
    speeds = np.asarray(velocity)
    if not np.any(np.isfinite(speeds)):
        raise InputError("there is no mode to show: no point is finite.")
    unit = unit_for(speeds[np.isfinite(speeds)], "m/s")
    level = f"Velocity amplitude ({unit.name})"
    figure, frequencies, dampings = frequency_and_damping(3.2, level, f", at {plain(sensor)}")
    colour = SIMULATED if stds is None else IDENTIFIED
    for number, (axes, values, scale) in enumerate(
        ((frequencies, frequency, 1 / HERTZ), (dampings, damping_ratio, 100.0))
    ):
        x, y = speeds / unit.size, scale * np.asarray(values)
        error = None if stds is None else BAND * scale * np.asarray(stds[number])
        if not joined:
            stars(axes, x, y, "identified, 95 % bars" if error is not None else None, yerr=error)
        else:
            banded(axes, x, y, error, colour, None if error is None else "curve")
        axes.set_xlim(left=0.0)
        fit_axis(axes, "y", y)
    if stds is not None:
        legend(figure)
    return figure


def batch_figure(batch: ResponseBatch) -> Figure:
    """Where the peaks and the phase resonances of many responses lie.

    Returns the figure. Raises `ValueError` when no member has either.
    """
    series: Sequence[tuple[str, np.ndarray, np.ndarray]] = (
        ("highest peak", batch.peak_frequency, batch.peak_velocity),
        ("phase resonance", batch.resonance_frequency, batch.resonance_velocity),
    )
    every = np.concatenate([velocity[np.isfinite(velocity)] for _, _, velocity in series])
    if not every.size:
        raise InputError("there is nothing to show: no member has a peak or a resonance.")
    unit = unit_for(every, "m/s")
    figure, ((axes,),) = panels(COLUMN, 3.4, 1, 1)
    for (name, frequency, velocity), colour, marker in zip(
        series, SERIES[:2], ("o", "x"), strict=True
    ):
        style: Style = {**DOT, "color": colour, "marker": marker}
        marks(axes, frequency / HERTZ, velocity / unit.size, style, name)
    axes.set_ylim(bottom=0.0)
    title = f"{len(batch.status)} responses"
    name_axes(axes, title, "Frequency (Hz)", f"Velocity amplitude ({unit.name})")
    legend(figure)
    return figure


def force_velocity_points(force: np.ndarray, velocity: np.ndarray) -> Figure:
    """Amplitude and phase of the force of prescribed motions against their velocity amplitude.

    Arguments: `force` in N and `velocity` in m/s, complex. Returns the figure.
    Raises `ValueError` when no motion was found.
    """
    finite = np.isfinite(force) & np.isfinite(velocity)
    if not finite.any():
        raise InputError("there is no force to show: no motion was found.")
    speed, load = np.abs(velocity[finite]), force[finite]
    unit, newton = unit_for(speed, "m/s"), unit_for(load, "N")
    figure, ((upper,), (lower,)) = panels(COLUMN, 5.0, 2, 1)
    upper.plot(speed / unit.size, np.abs(load) / newton.size, **DOT)
    lower.plot(speed / unit.size, np.angle(load) / DEGREE, **DOT)
    lower.sharex(upper)
    phase_axis(lower)
    name_axes(upper, "(a) amplitude", "", f"Force ({newton.name})")
    below = f"Velocity amplitude ({unit.name})"
    name_axes(lower, "(b) phase relative to the measured force", below, "Phase (°)")
    return figure


def points_figure(
    x: np.ndarray | Sequence[int],
    y: np.ndarray,
    title: str,
    abscissa: str,
    ordinate: str,
    *,
    limits: Sequence[float] = (),
) -> Figure:
    """Points, with dashed `limits`.

    Arguments: `title` and what the axes `abscissa` and `ordinate` are. Returns the figure. Raises
    `ValueError` without a finite value.
    """
    if not np.isfinite(y).any():
        raise InputError(f"there is nothing to show: {title} has no finite value.")
    figure, ((axes,),) = panels(COLUMN, 3.4, 1, 1)
    axes.plot(x, y, **DOT)
    for limit in limits:
        axes.axhline(limit, color=BACKGROUND, linestyle="--")
    name_axes(axes, title, abscissa, ordinate)
    return figure
