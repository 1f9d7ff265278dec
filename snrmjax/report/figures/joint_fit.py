"""Figures of joint fits: curves, residuals, contributions to bands, where to measure next."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from snrmjax.identify.inference.contributions import Contribution, Contributions
from snrmjax.identify.inference.fitted_response import FittedResponse
from snrmjax.identify.inference.optimal_design import NextMeasurement
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.pointwise.backbone_points import BackbonePoints
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import DEGREE, HERTZ
from snrmjax.report.sampling import (
    BAND,
    VELOCITY,
    ShownAmplitude,
    fit_residuals,
    sample_fit,
    usable_damping,
    velocity_of,
)
from snrmjax.report.style import (
    COLUMN,
    CURVE,
    DOT,
    HOLLOW,
    IDENTIFIED,
    LINE,
    MEASURED,
    PAGE,
    SERIES,
    SIMULATED,
    SMALL,
    TEXT,
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
    unit_for,
    with_unit,
)
from snrmjax.simulate.solutions.controlled import DampedModeBranch
from snrmjax.simulate.solutions.normal_modes import NormalModeBranch

_LEAST_FRACTION = 0.005  # of a band's variance: smaller ones are combined in one bar


class FitSeries(NamedTuple):
    """A joint fit to be drawn, and the points of single states."""

    label: str
    fit: JointFit
    points: BackbonePoints | None = None


def fitted_curves_figure(
    series: Sequence[FitSeries],
    *,
    truth: NormalModeBranch | DampedModeBranch | None = None,
    shown: ShownAmplitude = VELOCITY,
) -> Figure:
    """Natural frequency and damping of joint fits against amplitude, with 95 % bands.

    The amplitude is that of the velocity unless `shown` says another. Dots are the results of
    single states. For a single fit whose levels scatter, the paler band is that of a further
    level.

    Arguments: `truth` a mode to compare with, of which a damped one shows its damping too.
    Returns the figure. Raises `ValueError` when there is no fit.
    """
    if not series:
        raise InputError("there is no fit to show: `series` is empty.")
    curves = [sample_fit(one.fit) for one in series]
    unit = unit_for(np.concatenate([curve.amplitude(shown) for curve in curves]), shown.unit)
    reach = [curve.amplitude(shown)[-1] for curve in curves]
    for one in series:
        if one.points is not None:
            reach += [*usable_damping(one.points, shown)[0]]
    top = 1.04 * max(reach) / unit.size
    level = f"{shown.name.capitalize()} amplitude ({unit.name})"
    figure, natural, damping = frequency_and_damping(3.4, level)
    seen: tuple[list[float], list[float]] = ([], [])
    dots: tuple[list[float], list[float]] = ([], [])
    for number, (one, curve) in enumerate(zip(series, curves, strict=True)):
        colour, name = SERIES[number % len(SERIES)], plain(one.label)
        if one.points is not None:
            use = np.asarray(one.points.usable)
            own = usable_damping(one.points, shown)[0] / unit.size
            each = (
                np.asarray(one.points.natural_frequency)[use] / HERTZ,
                100 * np.asarray(one.points.damping_ratio)[use],
            )
            style = {**DOT, "markersize": 2.8, "alpha": 0.6, "color": MEASURED}
            if len(series) > 1:
                style["color"] = colour
            for axes, y, kept in zip((natural, damping), each, dots, strict=True):
                marks(axes, own, y, style, "single states")
                kept += [*y]
        if len(series) == 1 and np.any(one.fit.noise.level_std[2:] > 0):
            wide = sample_fit(one.fit, include_level_variance=True)
            x = wide.amplitude(shown) / unit.size
            style = {"band": "95 % band of a further level", "strength": 0.5, "linestyle": "none"}
            for axes, y, error in zip((natural, damping), *wide.curves(), strict=True):
                banded(axes, x, y, error, colour, **style)
        x = curve.amplitude(shown) / unit.size
        for axes, kept, y, error in zip((natural, damping), seen, *curve.curves(), strict=True):
            banded(axes, x, y, error, colour, name)
            kept += [*(y - error), *(y + error)]
    if truth is not None:
        x = np.abs(velocity_of(truth, series[0].fit.modes.sensors[series[0].fit.data.sensor]))
        x = shown.of(x, truth.frequency)
        inside = x / unit.size <= top
        style = {"color": SIMULATED, "linestyle": "--", "linewidth": LINE, "zorder": 5}
        natural.plot(x[inside] / unit.size, truth.frequency[inside] / HERTZ, **style, label="true")
        if isinstance(truth, DampedModeBranch):
            damping.plot(x[inside] / unit.size, 100 * truth.damping_ratio[inside], **style)
    for axes, kept, lines in zip((natural, damping), dots, seen, strict=True):
        axes.set_xlim(0.0, top)
        fit_axis(axes, "y", kept, lines)
    legend(figure)
    return figure


PARTS = ("in phase with the force", "in quadrature with it")


def residuals_figure(fit: JointFit, shown: ShownAmplitude = VELOCITY) -> Figure:
    """Misfit of each point in standard deviations, against amplitude and phase, and its spread.

    The amplitude is that of the velocity unless `shown` says another.
    The part of the force balance in phase with the force, due to damping at resonance, and the part
    in quadrature, due to stiffness there, made independent of the first. A trend means that the
    curves do not follow the data; more than one in twenty outside ±1.96 means noise larger than
    stated, or outliers.
    """
    left = fit_residuals(fit)
    amplitude = shown.of(left.velocity, left.frequency)
    unit = unit_for(amplitude, shown.unit)
    figure, ((speeds, phases, spread),) = panels(PAGE, 2.9, 1, 3)
    for part, (colour, name) in enumerate(((MEASURED, PARTS[0]), (IDENTIFIED, PARTS[1]))):
        style = {**DOT, "color": colour, "markersize": 2.8, "alpha": 0.7}
        marks(speeds, amplitude / unit.size, left.parts[:, part], style, name)
        marks(phases, left.phase, left.parts[:, part], style)
    reach = max(3.5, 1.08 * float(np.max(np.abs(left.parts))))
    for axes in (speeds, phases):
        for y, line in ((0.0, "-"), (-BAND, "--"), (BAND, "--")):
            axes.axhline(y, color="0.4", linewidth=0.6, linestyle=line, zorder=1)
        axes.set_ylim(-reach, reach)
    speeds.set_xlim(left=0.0)
    edges = np.linspace(-reach, reach, 2 * int(np.clip(np.sqrt(left.parts.size), 8, 20)) + 1)
    spread.hist(left.parts.reshape(-1), edges, density=True, color="0.75", label="misfits")
    x = np.linspace(-reach, reach, 201)
    normal = np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
    spread.plot(x, normal, color=SIMULATED, **CURVE, label="standard normal distribution")
    outside = 100 * float(np.mean(np.abs(left.parts) > BAND))
    ylabel = "Misfit (σ)"
    level = f"{shown.name.capitalize()} amplitude ({unit.name})"
    name_axes(speeds, "(a) against amplitude", level, ylabel)
    name_axes(phases, "(b) against phase", "Velocity phase (°)", ylabel)
    title = f"(c) rms {left.rms:.2f} σ,\n{outside:.1f} % outside ±1.96 σ"
    name_axes(spread, title, ylabel, "Density (1/σ)")
    legend(figure)
    return figure


def contributions_figure(rows: Sequence[Contribution]) -> Figure:
    """Contributions to the bands of both curves: fractions of their variance, as bars.

    Errors are grouped by kind, those of levels among them; kinds that add less than 0.5 % to
    both bands share one bar. Bars of one colour sum to the whole variance.

    Raises `ValueError` when there is no contribution.
    """
    if not rows:
        raise InputError("there is nothing to show: `rows` is empty.")
    kinds = Contributions(tuple(rows)).by_kind()
    large = [
        row for row in kinds if max(row.frequency_fraction, row.damping_fraction) >= _LEAST_FRACTION
    ]
    small = [row for row in kinds if row not in large]
    names = [row.source for row in large]
    fractions = [(row.frequency_fraction, row.damping_fraction) for row in large]
    if small:
        names.append(small[0].source if len(small) == 1 else f"{len(small)} smaller ones together")
        fractions.append(
            (sum(r.frequency_fraction for r in small), sum(r.damping_fraction for r in small))
        )
    position = np.arange(len(names))
    figure, ((axes,),) = panels(COLUMN, 1.0 + 0.36 * len(names), 1, 1)
    for k, (what, colour) in enumerate((("natural frequency", MEASURED), ("damping", IDENTIFIED))):
        widths = [100 * fraction[k] for fraction in fractions]
        bars = axes.barh(position + (k - 0.5) * 0.38, widths, 0.36, color=colour, label=what)
        axes.bar_label(bars, [f"{w:.1f} %" for w in widths], padding=2, fontsize=SMALL)
    axes.set_yticks(position, [plain(name) for name in names])
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set_xlim(0.0, 1.22 * 100 * max(max(fraction) for fraction in fractions))
    axes.xaxis.set_major_formatter(PercentFormatter(decimals=0))
    name_axes(axes, "", "Fraction of the band's variance", "")
    legend(figure)
    return figure


def next_measurements_figure(
    responses: Sequence[FittedResponse], measurements: Sequence[NextMeasurement], *, sensor: str
) -> Figure:
    """Where to measure next: states on the responses that a fit predicts, numbered by rank.

    Arguments: `responses` under the forces of the `measurements`, drawn above a quarter of their
    peaks and as far as a measurement is from them; `sensor` is what the axis names.
    Returns the figure. Raises `ValueError` when there is no response.
    """
    if not responses:
        raise InputError("there is no response to show: `responses` is empty.")
    forces = sorted({response.force for response in responses})
    largest = max(float(np.max(np.abs(response.velocity))) for response in responses)
    unit = unit_for(largest, "m/s")
    figure, speeds, phases = amplitude_and_phase(PAGE, 5.0, sensor, unit)
    resonant = np.concatenate(
        [response.velocity[[np.argmax(np.abs(response.velocity))]] for response in responses]
    )
    sign = 1.0 if np.sum(resonant.real) >= 0 else -1.0
    drives = {
        measurement.force: measurement.drive
        for measurement in measurements
        if measurement.drive is not None
    }
    for curve in responses:
        colour = SERIES[forces.index(curve.force) % len(SERIES)]
        speed = np.abs(curve.velocity)
        mine = [
            measurement.velocity for measurement in measurements if measurement.force == curve.force
        ]
        near = speed >= min([0.25 * speed.max(), *(0.8 * v for v in mine)])
        drive = drives.get(curve.force)
        name = with_unit(curve.force, "N") if drive is None else with_unit(drive, "V")
        x = curve.frequency[near] / HERTZ
        angle = np.angle(sign * curve.velocity[near]) / DEGREE
        for axes, y in ((speeds, speed[near] / unit.size), (phases, angle)):
            pieces = (curve.stable[near], name, colour, LINE, curve.continued[near])
            response_line(axes, x, y, *pieces)
    for measurement in measurements:
        marks(
            speeds,
            measurement.frequency / HERTZ,
            measurement.velocity / unit.size,
            {**HOLLOW, "clip_on": True},
        )
        angle = np.angle(sign * np.exp(1j * measurement.phase)) / DEGREE
        marks(phases, measurement.frequency / HERTZ, angle, HOLLOW)
    for ranks, first in _together(measurements):
        at = (first.frequency / HERTZ, first.velocity / unit.size)
        text = ", ".join(map(str, ranks))
        offset: dict[str, Any] = {"xytext": (0, 6), "textcoords": "offset points", "ha": "center"}
        box = {"boxstyle": "round,pad=0.1", "facecolor": "white", "alpha": 0.8, "linewidth": 0}
        speeds.annotate(text, at, **offset, fontsize=TEXT, zorder=6, bbox=box)
    if forces[-1] > 8 * forces[0]:
        speeds.set_yscale("log")
    else:
        speeds.set_ylim(0.0, 1.12 * largest / unit.size)
    phase_axis(phases)
    explain_lines(figure)
    legend(figure)
    return figure


def _together(measurements: Sequence[NextMeasurement]) -> list[tuple[list[int], NextMeasurement]]:
    """Ranks whose marks would hide one another, with the first of them."""
    groups: list[tuple[list[int], NextMeasurement]] = []
    for measurement in measurements:
        for ranks, first in groups:
            near = abs(measurement.frequency / first.frequency - 1) < 0.005
            if near and abs(measurement.velocity / first.velocity - 1) < 0.03:
                ranks.append(measurement.rank)
                break
        else:
            groups.append(([measurement.rank], measurement))
    return groups
