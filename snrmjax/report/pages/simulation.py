"""Simulated responses and normal modes: tables, figures and a page."""

from pathlib import Path

import numpy as np

from snrmjax.io import results
from snrmjax.io.files import write_summary
from snrmjax.numerics.units import HERTZ
from snrmjax.pipelines.simulate import SimulatedMode, SimulatedResponses
from snrmjax.report.figures.simulation import (
    event_curve_figure,
    normal_mode_figure,
    quasi_periodic_figure,
    simulated_response_figure,
)
from snrmjax.report.html import Report, ReportFigure, Section, write_report
from snrmjax.report.sentences import number_of, sentences
from snrmjax.report.style import save_figure, save_figures
from snrmjax.simulate.continuation.response_curve import Branch, ResponseCurve, velocity_at_sensors

# Events counted in the printed lines, in addition to the largest velocity.
_COUNTED = {
    "fold": "fold",
    "period_doubling": "period doubling",
    "neimark_sacker": "Neimark-Sacker point",
}
_CAPTIONS = {
    "response": "Velocity against excitation frequency; dashed where the response is unstable.",
    "events": "Events of the responses against the parameter.",
    "quasi_periodic": "Quasi-periodic motions and the responses from which they branch.",
}


def write(folder: Path, found: SimulatedResponses | SimulatedMode) -> None:
    """Write response.csv, response.png, summary.json and report.html, or nnm.csv and nnm.png.

    Also events.csv and events.png, quasi_periodic.csv and quasi_periodic.png, where there are any.
    """
    sensor = found.sensor
    if isinstance(found, SimulatedMode):
        results.write_normal_mode(folder / "nnm.csv", found.branch, sensor=sensor)
        save_figure(folder / "nnm.png", normal_mode_figure(found.branch, sensor=sensor))
        return
    results.write_response(folder / "response.csv", found.curves, sensor=sensor)
    figures = {"response": simulated_response_figure(found.curves, sensor=sensor)}
    if any(len(curve.frequency) for curve in found.events):
        results.write_event_curves(folder / "events.csv", found.events, sensor=sensor)
        figures["events"] = event_curve_figure(found.events, sensor=sensor)
    if found.quasi_periodic:
        path = folder / "quasi_periodic.csv"
        results.write_quasi_periodic(path, found.quasi_periodic, sensor=sensor)
        figures["quasi_periodic"] = quasi_periodic_figure(
            found.quasi_periodic, found.curves, sensor=sensor
        )
    drawn = save_figures(folder, figures)
    result, notes = headline(found), sentences(found.notes)
    write_summary(folder / "summary.json", {"result": result, "notes": notes})
    shown = [ReportFigure(one, _CAPTIONS[name]) for name, one in drawn.items()]
    report = Report(
        "Simulated responses",
        result=". ".join(result),
        notes=notes,
        sections=[Section("Curves", (), shown)],
    )
    write_report(folder / "report.html", report)


def headline(found: SimulatedResponses | SimulatedMode) -> list[str]:
    """The largest response of every curve, or where the mode ends."""
    if isinstance(found, SimulatedMode):
        branch = found.branch
        speed = np.abs(branch.velocity[-1, 1, branch.sensors.index(found.sensor)])
        end = f"{branch.frequency[-1] / HERTZ:.5g} Hz, {speed:.3g} m/s at {found.sensor}"
        return [f"the mode ends at {end}"]
    events = ["; ".join(curve.summary()) for curve in found.events]
    tori = ["; ".join(branch.summary()) for branch in found.quasi_periodic]
    return [*(_largest(curve, found.sensor) for curve in found.curves), *events, *tori]


def _largest(curve: ResponseCurve, sensor: str) -> str:
    velocity = velocity_at_sensors(curve, curve.force)[:, 1]
    speed = np.abs(velocity[:, curve.sensors.index(sensor)])
    name = "" if curve.branch == Branch.MAIN else f" ({curve.branch})"
    n = curve.subharmonic
    of = "fundamental velocity" if n == 1 else f"velocity at 1/{n} of the frequency"
    load = "force" if curve.base is None else "base acceleration"
    load = load if curve.unbalance is None else "unbalance"
    load = f"{load} {curve.force:g} {curve.force_unit}{name}"
    if not speed.size:
        return f"{load}: no response"
    top = int(np.argmax(speed))
    # A fold is always counted, the others where there are any.
    counts = {name: len(curve.at_events(kind)) for kind, name in _COUNTED.items()}
    events = ", ".join(number_of(n, name) for name, n in counts.items() if n or name == "fold")
    return (
        f"{load}: {of} at {sensor} up to {speed[top]:.4g} m/s, at "
        f"{curve.frequency[top] / HERTZ:.5g} Hz; {events}"
    )
