"""Figures of a diagnosis: misfit before and after, and the laws of the identified effects."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from snrmjax.diagnose.diagnosis_result import Diagnosis
from snrmjax.diagnose.response_prediction import ControlledVelocityCurve, at_curve_force
from snrmjax.measure.states import SteadyStates
from snrmjax.model.effect_base import (
    AbstractAddedMode,
    AbstractEffect,
    AbstractForce,
    AbstractForceSpectrum,
    AbstractLinearChange,
    AbstractMeasurementEffect,
)
from snrmjax.model.effect_metadata import Argument
from snrmjax.model.effect_shape import shape_of
from snrmjax.model.structures import Structure
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import DEGREE, HERTZ
from snrmjax.report.sampling import sensor_index
from snrmjax.report.sentences.diagnose import effect_name
from snrmjax.report.style import (
    COLUMN,
    CURVE,
    DOT,
    IDENTIFIED,
    LINE,
    MEASURED,
    PAGE,
    SERIES,
    SMALL,
    Style,
    Unit,
    legend,
    marks,
    name_axes,
    panels,
    plain,
    unit_for,
)
from snrmjax.simulate.continuation.response_curve import ResponseCurve

_LARGEST = 5.0  # misfit, in units of noise, at the end of the colour scale
_SAMPLES = 361  # of a cycle
_AS_IT_IS = ("Hz", "periods", "%", "%, °", "1", "√kg m/s²")  # units without prefixes
_SINGLE_VALUED = 0.02  # of a force's range, between going there and coming back
CONTROLLED_CAPTION = (
    "These levels control the response, not the force: the force that keeps each level's median "
    "velocity against frequency, without and with the identified effects, over the measured "
    "forces. Lines should pass through the dots; the force is smallest at resonance."
)


def misfit_figure(diagnosis: Diagnosis) -> Figure:
    """Misfit of the force of every steady state, in units of its noise, before and after.

    Darker is worse; a correct model leaves about 1 everywhere and no pattern. Rings mark the level
    that was left out of a fit to test the answer.
    """
    data, misfits = diagnosis.data, diagnosis.force_misfit
    rows = misfits.rows
    frequency = np.asarray(data.frequency)[rows] / HERTZ
    speed = np.abs(np.asarray(data.velocity))[rows, misfits.sensor]
    unit = unit_for(speed, "m/s")
    figure, ((before, after),) = panels(PAGE, 3.3, 1, 2)
    out = diagnosis.gap.interpolated
    withheld = np.asarray(data.level)[rows] == out.level if out else np.zeros(len(rows), dtype=bool)
    for axes, title, misfit in (
        (before, "(a) model as given", misfits.before),
        (after, "(b) completed model", misfits.after),
    ):
        rms = np.sqrt(np.nanmean(misfit**2, axis=1))
        order = np.argsort(rms)  # the worst on top
        colours: Style = {"c": rms[order], "cmap": "magma_r", "vmin": 0.0, "vmax": _LARGEST}
        colours |= {"s": 16, "edgecolors": "0.4", "linewidths": 0.3}
        shown = axes.scatter(frequency[order], speed[order] / unit.size, **colours)
        if withheld.any():
            ring: Style = {"linestyle": "none", "marker": "o", "markersize": 7.0}
            ring |= {"fillstyle": "none", "color": MEASURED, "markeredgewidth": 0.8}
            name = f"level {out.level}, left out to test the answer" if out else None
            marks(axes, frequency[withheld], speed[withheld] / unit.size, ring, name)
        axes.set_ylim(bottom=0.0)
        name_axes(axes, title, "Frequency (Hz)", "")
    name_axes(before, "(a) model as given", "Frequency (Hz)", f"Velocity amplitude ({unit.name})")
    after.sharey(before)
    after.tick_params(labelleft=False)
    bar = figure.colorbar(shown, ax=[before, after], extend="max", aspect=30, pad=0.02)
    bar.set_label("Misfit of the force (σ of the noise)", fontsize=SMALL)
    bar.ax.tick_params(labelsize=SMALL)
    legend(figure)
    return figure


def comparison_figure(
    before: Sequence[ResponseCurve],
    after: Sequence[ResponseCurve],
    data: SteadyStates,
    *,
    sensor: str | None = None,
) -> Figure:
    """Simulated responses of two models over the measured steady states, side by side.

    States are pale where their force differs from that of every curve by more than 5 %: a test
    that controls the response changes its force along a level, and curves of constant force meet it
    at resonance only. The axis ends a little above the measured velocities.

    Arguments: responses of the model as given and of the completed one, one a level, at the
    level's force; `sensor` by default the first of the data.
    Raises `ValueError` where there is no response or the sensor is missing.
    """
    if not before or not after:
        raise InputError("there is no response to show: `before` or `after` is empty.")
    r = sensor_index(data.sensors, sensor or data.sensors[0])
    frequency, speed = np.asarray(data.frequency) / HERTZ, np.abs(np.asarray(data.velocity))[:, r]
    same = at_curve_force(data, [curve.force for curve in before])
    lines = [
        [(curve.frequency / HERTZ, np.abs(np.asarray(curve.velocity)[:, 1, r])) for curve in curves]
        for curves in (before, after)
    ]
    return _side_by_side(lines, frequency, speed, same, ("Velocity amplitude", "m/s"))


def controlled_velocity_figure(
    before: Sequence[ControlledVelocityCurve],
    after: Sequence[ControlledVelocityCurve],
    data: SteadyStates,
    sensor: str,
) -> Figure:
    """Force against frequency at controlled velocity, of two models, over the measured states.

    Arguments: curves of the model as given and of the completed one (`controlled_velocity_curves`).
    """
    r = sensor_index(data.sensors, sensor)
    good = np.asarray(data.measured)[:, r]
    frequency, force = np.asarray(data.frequency)[good] / HERTZ, np.asarray(data.force)[good]
    lines = [
        [(curve.frequency / HERTZ, curve.force) for curve in curves] for curves in (before, after)
    ]
    every, what = np.ones(len(force), dtype=bool), ("Force amplitude", "N")
    return _side_by_side(lines, frequency, force, every, what, ", velocity controlled")


def _side_by_side(
    lines: Sequence[Sequence[tuple[np.ndarray, np.ndarray]]],
    frequency: np.ndarray,
    measured: np.ndarray,
    same: np.ndarray,
    what: tuple[str, str],
    condition: str = "",
) -> Figure:
    """Curves of the model as given and of the completed one over the same measured states.

    Arguments: states that are not under the `same` force as a curve are pale; `what` is measured,
    and its unit.
    """
    unit = unit_for(measured, what[1])
    margin = 0.1 * np.ptp(frequency)
    ends = frequency.min() - margin, frequency.max() + margin
    top = 1.2 * float(np.nanmax(measured)) / unit.size
    figure, ((left, right),) = panels(PAGE, 3.3, 1, 2)
    pale = {**DOT, "alpha": 0.35, "markeredgewidth": 0.0, "markersize": 3.0}
    for axes, curves, colour, name in (
        (left, lines[0], "0.35", "model as given"),
        (right, lines[1], IDENTIFIED, "completed model"),
    ):
        marks(axes, frequency[~same], measured[~same] / unit.size, pale, "measured, other forces")
        marks(axes, frequency[same], measured[same] / unit.size, {**DOT, "zorder": 4}, "measured")
        for k, (x, y) in enumerate(curves):
            label = name if k == 0 else None
            axes.plot(x, y / unit.size, color=colour, **CURVE, label=label)
        highest = max(float(np.max(y, initial=0.0)) for _, y in curves) / unit.size  # or no point
        if highest > top:
            corner: Style = {"transform": axes.transAxes, "ha": "right", "va": "top"}
            text = f"peaks up to {highest:.2g} {unit.name}"
            corner["bbox"] = {"facecolor": "white", "alpha": 0.8, "linewidth": 0, "pad": 1.5}
            axes.text(0.99, 0.99, text, fontsize=SMALL, color="0.3", **corner)
        axes.set(xlim=ends, ylim=(0.0, top))
    quantity = f"{what[0]} ({unit.name})"
    name_axes(left, f"(a) model as given{condition}", "Frequency (Hz)", quantity)
    name_axes(right, f"(b) completed model{condition}", "Frequency (Hz)", "")
    right.tick_params(labelleft=False)
    legend(figure)
    return figure


class _Curve(NamedTuple):
    x: np.ndarray
    y: np.ndarray
    name: str | None = None


class _Law(NamedTuple):
    """The law of an effect as curves in SI units, with the names of their axes."""

    x: tuple[str, str]  # quantity and unit
    y: tuple[str, str]
    curves: tuple[_Curve, ...]
    dots: bool = False


def effect_laws_figure(
    model: Structure, data: SteadyStates, *, sensor: str | None = None
) -> Figure:
    """The law of every effect of a model over the measured range of motion.

    Forces are drawn against displacement or velocity at the sensor, as the equivalent force in
    newtons at the drive: springs as lines against displacement, dampers as lines against velocity,
    hysteretic friction as loops for the smallest, a middle and the largest amplitude. Effects of
    the instruments are drawn as the change of what they record, harmonics of the force as its
    course over a period, and a further mode by its coupling force.

    Arguments: `data` the measured steady states; `sensor` by default the first of the model.
    Raises `ValueError` where the model has no effect or not this sensor.
    Validity: the mode of interest alone moves, and harmonically.
    """
    if not model.effects:
        raise InputError("there is no effect to show: the model has none.")
    r = sensor_index(model.modes.sensors, sensor or model.modes.sensors[0])
    count = len(model.effects)
    columns = min(count, 3)
    rows = -(-count // columns)
    width, height = (COLUMN, 3.0) if count == 1 else (PAGE, 3.0 if columns == 2 else 2.6)
    figure, grid = panels(width, height * rows, rows, columns)
    for axes, effect in zip(grid.flat, model.effects, strict=False):
        _draw_law(axes, effect_name(effect.kind), _law(effect, model, data, r))
    for axes in grid.flat[count:]:
        axes.remove()
    if any(axes.get_legend_handles_labels()[0] for axes in figure.axes):
        legend(figure)
    return figure


def _draw_law(axes: Axes, title: str, law: _Law) -> None:
    units = [
        Unit(1.0, base) if base in _AS_IT_IS else unit_for(np.concatenate(values), base)
        for base, values in (
            (law.x[1], [curve.x for curve in law.curves]),
            (law.y[1], [curve.y for curve in law.curves]),
        )
    ]
    for number, curve in enumerate(law.curves):
        x, y = curve.x / units[0].size, curve.y / units[1].size
        colour = SERIES[number % len(SERIES)]
        if law.dots:
            marks(axes, x, y, {**DOT, "markersize": 3.0, "color": colour}, curve.name)
        else:
            axes.plot(x, y, color=colour, linewidth=LINE, label=curve.name)
    axes.axhline(0.0, color="0.6", linewidth=0.6, zorder=1)
    axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]))
    labels = (f"{law.x[0]} ({units[0].name})", f"{law.y[0]} ({units[1].name})")
    name_axes(axes, plain(title), *labels)


def _law(effect: AbstractEffect, model: Structure, data: SteadyStates, sensor: int) -> _Law:
    if isinstance(effect, AbstractMeasurementEffect):
        return _recorded_change(effect, model, data, sensor)
    if isinstance(effect, AbstractForceSpectrum):
        return _force_course(effect)
    motion = _Motion(model, data, sensor)
    if isinstance(effect, AbstractAddedMode):
        q = np.linspace(-1.0, 1.0, _SAMPLES) * motion.reached[-1].amplitude
        modes, potential = effect.expanded(model.modes, model.potential)
        displacement = np.zeros((_SAMPLES, len(modes.natural_frequency)))
        displacement[:, model.modes.mode_of_interest] = q
        force = np.asarray(potential.force(jnp.asarray(displacement)))[:, -1]
        quantity = ("Coupling force", "√kg m/s²")
        return _Law(("Displacement", "m"), quantity, (_Curve(motion.shape * q, force),))
    cycles = [_cycle(effect, motion, one) for one in motion.reached]
    if isinstance(effect, AbstractLinearChange):
        cycles = [_cycle(effect, motion, motion.reached[-1], order) for order in (0.0, 1.0)]
        names = ["first state of the test", "last state"]
        if np.allclose(cycles[0][2], cycles[1][2]):
            cycles, names = cycles[1:], [""]
    else:
        names = [one.name for one in motion.reached]
    axis = _axis(effect, cycles[-1])
    if axis is not None and len(cycles) > 2:
        cycles, names = cycles[-1:], [""]
    quantity = ("Velocity", "m/s") if axis == 1 else ("Displacement", "m")
    curves = tuple(
        _Curve(motion.shape * cycle[axis or 0], motion.newtons * cycle[2], name or None)
        for cycle, name in zip(cycles, names, strict=True)
    )
    return _Law(quantity, ("Equivalent force", "N"), curves)


class _Reached(NamedTuple):
    """The largest motion of a level."""

    amplitude: float  # kg^1/2 m, of the mode of interest
    frequency: float  # rad/s
    name: str  # the displacement at the sensor, in words


class _Motion:
    """The smallest, a middle and the largest motion of some states, and a mode's scales."""

    def __init__(self, model: Structure, data: SteadyStates, sensor: int) -> None:
        """Levels in order of their displacement at a sensor."""
        modes, j = model.modes, model.modes.mode_of_interest
        self.natural_frequency = modes.natural_frequency.item(j)
        self.damping_ratio = modes.damping_ratio.item(j)
        self.shape = abs(modes.mode_shape.item(sensor, j))  # m per kg^1/2 m
        self.newtons = 1.0 / abs(modes.participation.item(j))
        omega, level = np.asarray(data.frequency), np.asarray(data.level)
        moved = np.nan_to_num(np.abs(np.asarray(data.velocity))[:, sensor] / omega)
        farthest = [int(np.argmax(np.where(level == one, moved, -1.0))) for one in np.unique(level)]
        farthest.sort(key=lambda k: moved[k])
        chosen = [farthest[k] for k in sorted({0, len(farthest) // 2, len(farthest) - 1})]
        unit = unit_for(moved[chosen], "m")
        self.reached = [
            _Reached(
                float(moved[k]) / self.shape,
                float(omega[k]),
                f"up to {moved[k] / unit.size:.3g} {unit.name}",
            )
            for k in chosen
        ]


Cycle = tuple[np.ndarray, np.ndarray, np.ndarray]


def _cycle(effect: AbstractEffect, motion: _Motion, reached: _Reached, order: float = 0.0) -> Cycle:
    """Displacement, velocity and force of the mode over one period, its first sample repeated."""
    phase = np.linspace(0.0, 2 * np.pi, _SAMPLES)
    q = reached.amplitude * np.cos(phase)
    v = -reached.amplitude * reached.frequency * np.sin(phase)
    if isinstance(effect, AbstractForce):
        force = np.asarray(effect.cycle_force(jnp.asarray(q[:-1]), jnp.asarray(v[:-1])))
        return q, v, np.append(force, force[0])
    if isinstance(effect, AbstractLinearChange):
        linear = jnp.asarray(motion.natural_frequency), jnp.asarray(motion.damping_ratio)
        mass, damping, stiffness = map(float, effect.linear_terms(*linear, jnp.asarray(order)))
        return q, v, (stiffness - mass * reached.frequency**2) * q + damping * v
    raise InputError(f"no law can be drawn for an effect of the class {type(effect).__name__}.")


def _axis(effect: AbstractEffect, cycle: Cycle) -> int | None:
    """0 where an effect is drawn against displacement, 1 against velocity, None as a loop."""
    shape = shape_of(type(effect))
    if shape is None or shape.argument is None:
        return _single_valued_against(*cycle)
    return {Argument.DISPLACEMENT: 0, Argument.VELOCITY: 1}.get(shape.argument)


def _single_valued_against(q: np.ndarray, v: np.ndarray, force: np.ndarray) -> int | None:
    """0 for a force that is a function of displacement, 1 of velocity, None of neither."""
    allowed = _SINGLE_VALUED * max(float(np.ptp(force)), 1e-300)
    if (
        np.max(np.abs(force - force[::-1])) <= allowed
    ):  # at equal displacement, on the way there and back
        return 0
    half = (len(force) - 1) // 2
    mirrored = np.append(force[half::-1], force[-2 : half - 1 : -1])
    return 1 if np.max(np.abs(force - mirrored)) <= allowed else None


def _force_course(effect: AbstractForceSpectrum) -> _Law:
    time = np.linspace(0.0, 1.0, _SAMPLES)
    fractions = np.asarray(effect.load_orders())
    extra = sum(a * np.cos(2 * np.pi * h * time) for h, a in enumerate(fractions) if h != 1)
    sine = np.cos(2 * np.pi * time)
    curves = (_Curve(time, sine + extra, "force"), _Curve(time, sine, "fundamental alone"))
    return _Law(("Time", "periods"), ("Force over its amplitude", "1"), curves)


def _recorded_change(
    effect: AbstractMeasurementEffect, model: Structure, data: SteadyStates, sensor: int
) -> _Law:
    """Change of every recorded state by an effect of the instruments."""
    force, omega = np.asarray(data.force), np.asarray(data.frequency)
    speed = np.asarray(data.velocity)[:, sensor]
    good = np.isfinite(force) & np.isfinite(np.abs(speed))
    force, omega, speed = force[good], omega[good], speed[good]
    shape = model.modes.mode_shape.item(sensor, model.modes.mode_of_interest)
    phasors = np.zeros((len(force), 2, len(model.modes.sensors)), dtype=complex)
    phasors[:, 1, sensor] = speed
    known = map(jnp.asarray, (omega, force, phasors, np.abs(speed / omega / shape)))
    recorded_force, recorded = (np.asarray(one) for one in effect.recorded(*known))
    ratio = recorded[:, 1, sensor] / speed
    if np.allclose(ratio, 1.0, rtol=0.0, atol=1e-12):
        change = 100 * (recorded_force / force - 1)
        curve = _Curve(force, change)
        return _Law(("Force", "N"), ("Change of the force", "%"), (curve,), dots=True)
    gain, shift = 100 * (np.abs(ratio) - 1), np.angle(ratio) / DEGREE
    speed, hertz = np.abs(speed), omega / HERTZ
    roughness = [float(np.sum(np.abs(np.diff(gain[np.argsort(x)])))) for x in (speed, hertz)]
    x, quantity = speed, ("Velocity amplitude", "m/s")
    if roughness[1] < roughness[0]:
        x, quantity = hertz, ("Frequency", "Hz")
    curves = (_Curve(x, gain, "amplitude (%)"), _Curve(x, shift, "phase (°)"))
    return _Law(quantity, ("Change of the velocity", "%, °"), curves, dots=True)


def found_effects(diagnosis: Diagnosis) -> Structure | None:
    """The completed model with only the identified effects; None without any."""
    if diagnosis.completed is None or not diagnosis.effects:
        return None
    added = diagnosis.completed.effects[-len(diagnosis.effects) :]
    return dataclasses.replace(diagnosis.completed, effects=added)
