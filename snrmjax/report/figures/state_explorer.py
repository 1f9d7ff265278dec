"""Explorer of the steady states of a test: levels, phases, identified points, raw records.

Tapping a state shows its record folded to one period, with the fitted harmonics and the harmonics
of its force.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from snrmjax.identify.inference.identification import Identification
from snrmjax.measure.states import SteadyStates
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ
from snrmjax.pipelines.whole_test import FoldedRecord
from snrmjax.report.figures.live import (
    legend_at_right,
    live_figures,
    panel,
    points_by_level,
    require_bokeh,
)
from snrmjax.report.html import LiveFigures
from snrmjax.report.style import IDENTIFIED, MEASURED, Unit, unit_for

if TYPE_CHECKING:
    from bokeh.models import ColumnDataSource
    from bokeh.plotting import figure

_SAMPLES = 160  # of a folded record that are shown: a page of 500 states stays below 3 MB
_BARS = "#8c8c8c"
_CURVE = 120  # points of a fitted period


def state_explorer(
    data: SteadyStates,
    found: Identification | None = None,
    records: Sequence[FoldedRecord | None] = (),
) -> LiveFigures:
    """Live figures of a test.

    Arguments: `found` adds natural frequency and damping of every state; `records`, one a state
    (None where there is none), adds the raw record of the tapped state, initially that of
    the largest velocity. The sensor is the reference sensor of `found`, or the first.
    Raises `ValueError` where Bokeh is missing or `records` are not as many as the states.
    """
    require_bokeh()
    from bokeh.layouts import column
    from bokeh.models import ColumnDataSource

    if len(records) not in (0, data.n_states):
        raise InputError(f"`records` must be one a state, {data.n_states}, but are {len(records)}.")
    at = 0 if found is None else data.sensors.index(found.points.sensor)
    columns, speed, load = _columns(data, at)
    if found is not None:
        points = found.points
        columns["amplitude"] = np.asarray(points.backbone_velocity) / speed.size
        columns["natural"] = np.asarray(points.natural_frequency) / HERTZ
        columns["damping"] = 100 * np.asarray(points.damping_ratio)
    source = ColumnDataSource(columns)
    frequency = "Frequency (Hz)"
    response = panel("Levels", frequency, f"Velocity ({speed.name})")
    shared = response.x_range
    panels = [
        (response, "frequency", "velocity"),
        (
            panel("Phase", frequency, "Velocity ahead of force (°)", x_range=shared),
            *("frequency", "phase"),
        ),
        (panel("Force", frequency, f"Force ({load.name})", x_range=shared), "frequency", "force"),
    ]
    if found is not None:
        name = f"Velocity at resonance ({speed.name})"
        backbone = panel("Natural frequency of every state", name, "Natural frequency (Hz)")
        ratio = panel("Damping of every state", name, "Damping ratio (%)", x_range=backbone.x_range)
        panels += [(backbone, "amplitude", "natural"), (ratio, "amplitude", "damping")]
    hover = [
        ("level", "@level"),
        ("frequency", "@frequency{0.0000} Hz"),
        ("velocity", f"@velocity{{0.0000}} {speed.name}"),
        ("phase", "@phase{0.0}°"),
        ("force", f"@force{{0.0000}} {load.name}"),
    ]
    points_by_level(panels, source, np.asarray(data.level), hover)
    rows = [one for one, _, _ in panels]
    if any(record is not None for record in records):
        rows += _record_panels(source, records, load)
    return live_figures(column(*rows, sizing_mode="stretch_width"))


def _columns(data: SteadyStates, at: int) -> tuple[dict[str, np.ndarray], Unit, Unit]:
    """The quantities drawn of every state, and the units of velocity and force."""
    velocity = np.where(np.asarray(data.measured)[:, at], np.asarray(data.velocity)[:, at], np.nan)
    force, drive = np.asarray(data.force), np.asarray(data.drive)
    in_volts = not np.isfinite(force).any()
    load = unit_for(drive, "V") if in_volts else unit_for(force, data.force_unit)
    speed = unit_for(np.abs(velocity), "m/s")
    columns = {
        "level": np.asarray(data.level),
        "frequency": np.asarray(data.frequency) / HERTZ,
        "velocity": np.abs(velocity) / speed.size,
        "phase": np.degrees(np.angle(velocity)),
        "force": (drive if in_volts else force) / load.size,
    }
    return columns, speed, load


_SHOW = """
const chosen = states.selected.indices;
const k = chosen.length ? chosen[0] : first;
const at = row[k];
const words = "level " + states.data.level[k] + ", " + states.data.frequency[k].toFixed(4) + " Hz";
for (const [shown, every, size, title, name] of pairs) {
  const data = {};
  for (const key of Object.keys(every.data))
    data[key] = at < 0 ? [] : Array.from(every.data[key].slice(at * size, (at + 1) * size));
  shown.data = data;
  title.text = name + (at < 0 ? " of no record: " : ": ") + words;
}
"""


def _record_panels(
    source: "ColumnDataSource", records: Sequence[FoldedRecord | None], load: Unit
) -> list["figure"]:
    """Record and fit of one state over a period, and the harmonics of its force."""
    from bokeh.models import ColumnDataSource, CustomJS

    kept = [record for record in records if record is not None]
    numbers = iter(range(len(kept)))
    row = [-1 if record is None else next(numbers) for record in records]
    largest = int(np.nanargmax(np.where(np.array(row) < 0, -1.0, source.data["velocity"])))
    orders = [order for order in kept[0].orders if order >= 1]
    sizes = {"samples": _SAMPLES, "fit": _CURVE, "orders": len(orders)}
    moved = unit_for(np.concatenate([one.response for one in kept]), kept[0].unit)
    every = {
        "samples": _joined([_samples(one, moved, load) for one in kept]),
        "fit": _joined([_fitted(one, moved, load) for one in kept]),
        "orders": _joined([_force_orders(one, orders) for one in kept]),
    }
    start = row[largest]
    shown = {
        key: ColumnDataSource(
            {name: v[start * sizes[key] : (start + 1) * sizes[key]] for name, v in data.items()}
        )
        for key, data in every.items()
    }
    period = "Phase of the force (°)"
    name = kept[0].quantity.capitalize()
    response = panel(name, period, f"{name} ({moved.name})")
    force = panel("Force", period, f"Force ({load.name})", x_range=response.x_range)
    for made, name in ((response, "response"), (force, "force")):
        made.scatter("phase", name, source=shown["samples"], size=4, color=MEASURED,
                     legend_label="recorded")  # fmt: skip
        made.line("phase", name, source=shown["fit"], color=IDENTIFIED, width=2,
                  legend_label="fitted harmonics")  # fmt: skip
        legend_at_right(made)
    made = panel("Harmonics of the force", "Harmonic", "Over the fundamental (%)", height=220)
    made.vbar("order", 0.5, "fraction", source=shown["orders"], color=_BARS)
    made.y_range.start = 0
    made.xaxis.ticker = [order for order in orders if order > 1]
    titles = {"samples": response.title, "fit": force.title, "orders": made.title}
    pairs = [
        [shown[key], ColumnDataSource(every[key]), sizes[key], titles[key], titles[key].text]
        for key in every
    ]
    words = f"level {source.data['level'][largest]}, {source.data['frequency'][largest]:.4f} Hz"
    for title in titles.values():
        title.text = f"{title.text}: {words}"
    show = CustomJS(
        args={"states": source, "row": row, "first": largest, "pairs": pairs}, code=_SHOW
    )
    source.selected.js_on_change("indices", show)
    return [response, force, made]


def _joined(parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Records concatenated, in four bytes per number."""
    return {name: np.concatenate([part[name] for part in parts]).astype("f4") for name in parts[0]}


def _samples(one: FoldedRecord, moved: Unit, load: Unit) -> dict[str, np.ndarray]:
    """The samples shown, in order of phase."""
    rows = np.linspace(0, len(one.phase) - 1, _SAMPLES).round().astype(int)
    rows = rows[np.argsort(one.phase[rows])]
    return {
        "phase": np.degrees(one.phase[rows]),
        "response": one.response[rows] / moved.size,
        "force": one.force[rows] / load.size,
    }


def _fitted(one: FoldedRecord, moved: Unit, load: Unit) -> dict[str, np.ndarray]:
    phase = np.linspace(0, 2 * np.pi, _CURVE)
    rotation = np.exp(1j * np.array(one.orders)[:, None] * phase)
    return {
        "phase": np.degrees(phase),
        "response": (one.response_harmonics @ rotation).real / moved.size,
        "force": (one.force_harmonics @ rotation).real / load.size,
    }


def _force_orders(one: FoldedRecord, orders: Sequence[int]) -> dict[str, np.ndarray]:
    magnitude = {order: abs(one.force_harmonics[one.orders.index(order)]) for order in orders}
    fraction = [100 * magnitude[order] / magnitude[1] if order > 1 else np.nan for order in orders]
    return {"order": np.array(orders, dtype=float), "fraction": np.array(fraction)}
