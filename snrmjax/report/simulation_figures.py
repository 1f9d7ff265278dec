"""Figures of simulated motions: states under a controller, damped modes, batches and tests."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from snrmjax.io.units import DEGREE, HERTZ
from snrmjax.report.style import (
    COLUMN,
    CURVE,
    DOT,
    MEASURED,
    PAGE,
    SERIES,
    SIMULATED,
    Style,
    legend,
    marks,
    name_axes,
    panels,
    phase_axis,
    plain,
    unit_for,
)
from snrmjax.simulate.solutions.controlled import DampedModeBranch
from snrmjax.simulate.solutions.forced_response import ResponseBatch


def motions_figure(
    frequency: np.ndarray, velocity: np.ndarray, *, sensor: str = "the first sensor", joined: bool
) -> Figure:
    """Amplitude and phase of the velocity of motions against their frequency.

    Arguments: `frequency` in rad/s, `velocity` the complex fundamental in m/s, of every motion;
    `joined` draws them as a curve. Returns the figure. Raises `ValueError` without a motion.
    """
    speeds, omega = np.atleast_1d(velocity), np.atleast_1d(frequency) / HERTZ
    if not np.any(np.isfinite(speeds)):
        raise ValueError("there is no motion to show: none was found.")
    unit = unit_for(speeds[np.isfinite(speeds)], "m/s")
    figure, ((upper,), (lower,)) = panels(COLUMN, 5.0, 2, 1)
    style: Style = {"color": SIMULATED, **CURVE} if joined else {**DOT, "color": MEASURED}
    upper.plot(omega, np.abs(speeds) / unit.size, **style)
    lower.plot(omega, np.angle(speeds) / DEGREE, **style)
    upper.set_ylim(bottom=0.0)
    lower.sharex(upper)
    phase_axis(lower)
    title = f"(a) amplitude at {plain(sensor)}"
    name_axes(upper, title, "", f"Velocity amplitude ({unit.name})")
    name_axes(lower, "(b) phase", "Frequency (Hz)", "Velocity phase (°)")
    return figure


def damped_mode_figure(branch: DampedModeBranch, *, sensor: str | None = None) -> Figure:
    """Natural frequency and damping ratio of a damped nonlinear mode against its amplitude.

    Arguments: `sensor` by default the branch's first.
    Returns the figure. Raises `ValueError` when the branch has no point or not this sensor.
    """
    if not len(branch.frequency):
        raise ValueError("there is no mode to show: the branch has no point.")
    name = sensor or branch.sensors[0]
    if name not in branch.sensors:
        raise ValueError(f"`sensor` must be one of {branch.sensors}, but is {name!r}.")
    velocity = np.abs(branch.velocity[:, 1, branch.sensors.index(name)])
    unit = unit_for(velocity, "m/s")
    figure, ((frequencies, dampings),) = panels(PAGE, 3.2, 1, 2)
    for axes, values in (
        (frequencies, branch.frequency / HERTZ),
        (dampings, 100 * branch.damping_ratio),
    ):
        axes.plot(velocity / unit.size, values, color=SIMULATED, **CURVE)
        axes.set_xlim(left=0.0)
    level = f"Velocity amplitude ({unit.name})"
    name_axes(frequencies, "(a) natural frequency", level, "Natural frequency (Hz)")
    name_axes(dampings, f"(b) damping, at {plain(name)}", level, "Damping ratio (%)")
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
        raise ValueError("there is nothing to show: no member has a peak or a resonance.")
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
