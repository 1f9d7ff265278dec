"""Modes that exchange energy in a test: files, headline, figures and section."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from snrmjax.identify.coupled.coupled_modes import CoupledModes
from snrmjax.identify.coupled.coupled_test import CoupledDetails
from snrmjax.identify.pointwise.backbone import Backbone
from snrmjax.io import results
from snrmjax.io.models import write_model
from snrmjax.model.parameters import parameter_unit
from snrmjax.numerics.units import HERTZ, unit_in_print
from snrmjax.report.figures.simulation import simulated_response_figure
from snrmjax.report.html import ReportFigure, ReportTable, Section, with_error
from snrmjax.report.style import (
    BACKGROUND,
    IDENTIFIED,
    LINE,
    PAGE,
    SERIES,
    PrintedFigure,
    legend,
    name_axes,
    panels,
    unit_for,
)
from snrmjax.simulate.solutions.forced_response import ResponseCurve

_TEXT = (
    "The motions of both modes are prescribed as the sensors measured them, and the coefficients "
    "of a potential are fitted to the forces that each mode requires; its terms are selected by "
    "their evidence."
)
_SHAPE_CAPTION = (
    "Curves identified for a single mode and for the coupled modes (grey), and the shape of the "
    "coupled mode: sensor velocities relative to the reference."
)
_RESPONSE_CAPTION = (
    "Responses of the coupled modes under the requested forces, by harmonic balance: "
    "triangles mark peaks, squares folds, dots phase resonances."
)


def headline(found: CoupledDetails) -> list[str]:
    """Resonances of the coupled modes."""
    lines = []
    for curve in found.responses:
        for k in curve.at_events("peak"):
            speed = np.abs(curve.velocity[k, 1, _reference(found, curve)])
            peak = f"{curve.frequency[k] / HERTZ:.5g} Hz, {speed:.3g} m/s"
            lines.append(f"peak of the coupled modes at {curve.force:g} {curve.force_unit}: {peak}")
    return lines


def write(folder: Path, found: CoupledDetails) -> dict[str, object]:
    """Write model and predictions into a folder; returns the entries of the summary."""
    fit, sensor = found.modes.calibration, found.bias.sensors[_first(found.modes)]
    write_model(folder / "model.toml", fit.model)
    if found.responses:
        results.write_coupled_prediction(folder / "prediction.csv", found.responses, sensor=sensor)
    velocity, frequency, damping, std = found.bias.at_largest
    return {
        "coupled": found.modes.coupled,
        "interactions": [
            {
                "modes": [one.mode + 1, one.other + 1],
                "ratio": one.ratio,
                "probability": one.probability,
                "energy_fraction": None if np.isnan(one.fraction) else one.fraction,
            }
            for one in found.modes.interactions
        ],
        "parameters": {
            name: {"value": float(value), "std": float(std)}
            for name, value, std in zip(fit.names, fit.values, fit.std, strict=True)
        },
        "noise_scale": fit.noise_scale,
        "single_mode_bias": {
            "velocity_m_s": velocity,
            "natural_frequency": frequency,
            "natural_frequency_std": std,
            "damping_ratio": damping,
        },
    }


def figures(found: CoupledDetails, backbone: Backbone) -> dict[str, Figure]:
    """Figures by the names of their files."""
    drawn = {"coupled_backbone": _backbone_figure(found, backbone)}
    if found.responses:
        sensor = found.bias.sensors[_first(found.modes)]
        drawn["coupled_response"] = simulated_response_figure(found.responses, sensor=sensor)
    return drawn


def section(found: CoupledDetails, drawn: Mapping[str, Figure | PrintedFigure]) -> Section:
    """The section of the page."""
    fit = found.modes.calibration
    rows = [
        (name, with_error(float(value), float(std)), unit_in_print(parameter_unit(fit.model, name)))
        for name, value, std in zip(fit.names, fit.values, fit.std, strict=True)
    ]
    shown = [ReportFigure(drawn["coupled_backbone"], _SHAPE_CAPTION)]
    if "coupled_response" in drawn:
        shown.append(ReportFigure(drawn["coupled_response"], _RESPONSE_CAPTION))
    table = ReportTable(("parameter", "value", "unit"), rows, "Fitted with both modes")
    notes = [str(note) for note in found.notes()]
    return Section("Coupled modes", (_TEXT, *notes), shown, [table])


def _first(modes: CoupledModes) -> int:
    shape = np.asarray(modes.model.modes.mode_shape)[:, modes.model.modes.mode_of_interest]
    return int(np.argmax(np.abs(shape)))


def _reference(found: CoupledDetails, curve: ResponseCurve) -> int:
    return curve.sensors.index(found.bias.sensors[_first(found.modes)])


def _backbone_figure(found: CoupledDetails, backbone: Backbone) -> Figure:
    bias, curve = found.bias, backbone.sampled(len(found.bias.velocity))
    unit = unit_for(bias.velocity, "m/s")
    speed = bias.velocity / unit.size
    figure, grid = panels(PAGE, 2.8, 1, 3)
    left, middle, right = grid[0]
    for axes, mode, own, factor in (
        (left, bias.natural_frequency, curve.natural_frequency, 1 / HERTZ),
        (middle, bias.damping_ratio, curve.damping_ratio, 100.0),
    ):
        axes.plot(factor * mode, speed, color=BACKGROUND, lw=4, label="coupled modes")
        axes.plot(factor * np.asarray(own), speed, color=IDENTIFIED, lw=LINE, label="one mode")
    for column, name, colour in zip(bias.shape.T, bias.sensors, SERIES[1:], strict=False):
        right.plot(column, speed, color=colour, lw=LINE, label=name)
    name_axes(left, "natural frequency", "Frequency (Hz)", f"Velocity ({unit.name})")
    name_axes(middle, "damping", "Damping ratio (%)", "")
    name_axes(right, "shape of the coupled mode", "Velocity / reference velocity", "")
    legend(figure)
    return figure
