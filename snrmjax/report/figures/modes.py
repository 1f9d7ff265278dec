"""Figures of linear modes: poles over the order, measured and synthesised responses, decays."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator

from snrmjax.identify.modal.free_decay import DecayModes
from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.numerics.units import HERTZ
from snrmjax.report.style import (
    COLUMN,
    EXCLUDED,
    IDENTIFIED,
    LINE,
    MEASURED,
    PAGE,
    SMALL,
    TEXT,
    Style,
    legend,
    marks,
    name_axes,
    panels,
    plain,
    share_frequencies,
    unit_for,
)

_MOST_SENSORS = 4  # that are drawn
_ROW = 3.6  # inches of an amplitude with its phase
_DENSE = 200  # measured lines from which on they are drawn as a line
_TAIL = 12.0  # time constants of the slowest mode that a decay is drawn for
_MOST_POINTS = 3000  # of a drawn signal


def stabilisation_figure(found: LinearModalFit | DecayModes) -> Figure:
    """Poles of all model orders over frequency, stable ones marked, and the selected modes."""
    figure, grid = panels(PAGE, 3.4, 1, 1)
    axes: Axes = grid[0, 0]
    orders = found.orders
    hertz = found.natural_frequency / HERTZ
    for k, one in enumerate(hertz):
        name = "mode" if k == 0 else None
        axes.axvline(one, color=IDENTIFIED, linewidth=0.9, alpha=0.7, label=name, zorder=1)
    if orders is not None:
        shown = np.abs(orders.damping_ratio) < 0.25
        x = orders.natural_frequency / HERTZ
        usual: Style = {"linestyle": "none", "markersize": 2.8, "zorder": 3}
        for chosen, marker, colour, label in (
            (~orders.stable, ".", EXCLUDED, "pole"),
            (orders.stable, "o", MEASURED, "stable over the order"),
        ):
            own = {**usual, "marker": marker, "color": colour}
            marks(axes, x[shown & chosen], orders.order[shown & chosen], own, label)
        axes.set_ylim(0, orders.highest + 1)
    if isinstance(found, LinearModalFit):
        omega = found.curves.omega / HERTZ
        right = axes.twinx()
        total = np.sqrt(np.nansum(np.abs(found.curves.measured) ** 2, axis=0))
        right.semilogy(omega, total, color="0.6", linewidth=0.8, zorder=0, label="receptances")
        right.set_ylabel(f"Sum of receptances ({_unit(found)})", fontsize=TEXT)
        right.tick_params(labelsize=SMALL)
        right.spines[["top"]].set_visible(False)
        axes.set_zorder(right.get_zorder() + 1)
        axes.patch.set_visible(False)
        axes.set_xlim(omega[0], omega[-1])
    elif orders is not None and hertz.size:
        axes.set_xlim(0, 1.3 * hertz.max())
    name_axes(axes, "Poles over the model order", "Frequency (Hz)", "Model order")
    legend(figure)
    return figure


def modal_responses_figure(found: LinearModalFit, sensors: Sequence[str] | None = None) -> Figure:
    """Receptances as measured and as synthesised from the modes, amplitude and phase.

    Arguments: `sensors` by name, the four that respond most by default.
    Raises `ValueError` for an unknown sensor.
    """
    largest = np.nanmax(np.abs(found.curves.measured), axis=1)
    if sensors is None:
        chosen = sorted(np.argsort(-largest)[:_MOST_SENSORS].tolist())
    else:
        chosen = [found.sensor_number(name) for name in sensors]
    columns = 1 if len(chosen) == 1 else 2
    blocks = -(-len(chosen) // columns)
    width = COLUMN if columns == 1 else PAGE
    figure, grid = panels(width, _ROW * blocks, 2 * blocks, columns)
    for axes in grid.flat[: grid.size]:
        axes.set_visible(False)
    omega = found.curves.omega / HERTZ
    style: Style = {"linestyle": "none", "marker": ".", "markersize": 3.0}
    if len(omega) > _DENSE:
        style = {"linestyle": "-", "linewidth": 2.2, "alpha": 0.55}
    for number, k in enumerate(chosen):
        row, column = divmod(number, columns)
        upper, lower = grid[2 * row, column], grid[2 * row + 1, column]
        for axes in (upper, lower):
            axes.set_visible(True)
        curves = (
            (found.curves.measured[k], {**style, "color": MEASURED, "label": "measured"}),
            (
                found.curves.fitted[k],
                {"color": IDENTIFIED, "linewidth": LINE, "label": "from the modes"},
            ),
        )
        for values, own in curves:
            upper.semilogy(omega, np.abs(values), **own)
            lower.plot(omega, _phase(values), **own)
        lower.yaxis.set_major_locator(MultipleLocator(90.0))
        lower.set_ylim(-200, 200)
        name_axes(upper, plain(found.sensor_names[k]), "", f"Receptance ({_unit(found)})")
        name_axes(lower, "", "Frequency (Hz)", "Phase (°)")
        share_frequencies(upper, lower)
    legend(figure)
    return figure


def decay_figure(found: DecayModes) -> Figure:
    """The decays as recorded and as synthesised from the modes."""
    names = found.sensors[:_MOST_SENSORS]
    figure, grid = panels(PAGE, 0.8 + 1.7 * len(names), len(names), 1)
    slowest = np.min(found.damping_ratio * found.natural_frequency)
    time = found.curves.time
    keep = np.flatnonzero(time <= time[0] + _TAIL / slowest)[:_MOST_POINTS]
    for k, one in enumerate(names):
        axes = grid[k, 0]
        values = found.curves.measured[k, keep]
        unit = unit_for(values, one.si_unit.replace("^2", "²"))
        axes.plot(
            time[keep],
            values / unit.size,
            color=MEASURED,
            linewidth=2.0,
            alpha=0.55,
            label="recorded",
        )
        fitted = found.curves.fitted[k, keep] / unit.size
        axes.plot(time[keep], fitted, color=IDENTIFIED, linewidth=0.9, label="from the modes")
        last = k == len(names) - 1
        name_axes(
            axes, plain(one.name), "Time (s)" if last else "", f"{one.quantity} ({unit.name})"
        )
    legend(figure)
    return figure


def _unit(found: LinearModalFit) -> str:
    return {"force": "m/N", "voltage": "m/V", "acceleration": "m per m/s²"}.get(
        found.reference.quantity, "SI"
    )


def _phase(values: np.ndarray) -> np.ndarray:
    """Degrees with gaps where the phase wraps."""
    phase = np.degrees(np.angle(values))
    jump = np.abs(np.diff(phase, append=phase[-1])) > 180
    return np.where(jump, np.nan, phase)
