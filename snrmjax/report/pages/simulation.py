"""Simulated responses and normal modes: a table and a figure of each."""

from pathlib import Path

import numpy as np

from snrmjax.io import results
from snrmjax.io.units import HERTZ
from snrmjax.pipelines.simulate import SimulatedMode, SimulatedResponses
from snrmjax.report.figures.simulation import (
    event_curve_figure,
    normal_mode_figure,
    quasi_periodic_figure,
    simulated_response_figure,
)
from snrmjax.report.style import save_figure
from snrmjax.simulate.continuation.response_curve import Branch, ResponseCurve, velocity_at_sensors


def write(folder: Path, found: SimulatedResponses | SimulatedMode) -> None:
    """Write response.csv and response.png, or nnm.csv and nnm.png.

    Also events.csv and events.png, quasi_periodic.csv and quasi_periodic.png, where there are any.
    """
    sensor = found.sensor
    if isinstance(found, SimulatedMode):
        results.write_normal_mode(folder / "nnm.csv", found.branch, sensor=sensor)
        save_figure(folder / "nnm.png", normal_mode_figure(found.branch, sensor=sensor))
        return
    results.write_response(folder / "response.csv", found.curves, sensor=sensor)
    figure = simulated_response_figure(found.curves, sensor=sensor)
    save_figure(folder / "response.png", figure)
    if any(len(curve.frequency) for curve in found.events):
        results.write_event_curves(folder / "events.csv", found.events, sensor=sensor)
        save_figure(folder / "events.png", event_curve_figure(found.events, sensor=sensor))
    if found.quasi_periodic:
        path = folder / "quasi_periodic.csv"
        results.write_quasi_periodic(path, found.quasi_periodic, sensor=sensor)
        figure = quasi_periodic_figure(found.quasi_periodic, found.curves, sensor=sensor)
        save_figure(folder / "quasi_periodic.png", figure)


def headline(found: SimulatedResponses | SimulatedMode) -> list[str]:
    """The largest response of every curve, or where the mode ends."""
    if isinstance(found, SimulatedMode):
        branch = found.branch
        speed = np.abs(branch.velocity[-1, 1, branch.sensors.index(found.sensor)])
        place = f"{branch.frequency[-1] / HERTZ:.5g} Hz, {speed:.3g} m/s at {found.sensor}"
        return [f"the mode ends at {place}"]
    events = ["; ".join(curve.summary()) for curve in found.events]
    tori = ["; ".join(branch.summary()) for branch in found.quasi_periodic]
    return [*(_largest(curve, found.sensor) for curve in found.curves), *events, *tori]


def _largest(curve: ResponseCurve, sensor: str) -> str:
    velocity = velocity_at_sensors(curve, curve.force)[:, 1]
    speed = np.abs(velocity[:, curve.sensors.index(sensor)])
    name = "" if curve.branch == Branch.MAIN else f" ({curve.branch})"
    load = "force" if curve.base is None else "base acceleration"
    load = f"{load} {curve.force:g} {curve.force_unit}{name}"
    if not speed.size:
        return f"{load}: no response"
    top = int(np.argmax(speed))
    return (
        f"{load}: {speed[top]:.4g} m/s at {sensor} at most, at "
        f"{curve.frequency[top] / HERTZ:.5g} Hz; {len(curve.at_events('fold'))} folds"
    )
