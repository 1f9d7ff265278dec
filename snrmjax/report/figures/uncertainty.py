"""Figures of propagated uncertainty and of sensitivity indices."""

import numpy as np
from matplotlib.figure import Figure

from snrmjax.numerics.rules import InputError
from snrmjax.report.style import (
    COLUMN,
    PAGE,
    SERIES,
    SMALL,
    legend,
    name_axes,
    panels,
)
from snrmjax.study.uncertainty.propagation import METHOD_NAMES, Propagation
from snrmjax.study.uncertainty.sensitivity import SobolIndices


def propagation_figure(result: Propagation) -> Figure:
    """Mean and 95 % range of every quantity by first and by second order. Returns the figure."""
    names = result.quantities.names
    columns = min(len(names), 2)
    rows = -(-len(names) // columns)
    figure, grid = panels(PAGE if columns > 1 else COLUMN, 0.6 + 1.1 * rows, rows, columns)
    for q, axes in enumerate(grid.flat[: len(names)]):
        for m, (method, colour) in enumerate(zip(METHOD_NAMES, SERIES, strict=False)):
            mean, _, lower, upper = result.statistics[m, :, q]
            axes.plot([lower, upper], [-m, -m], color=colour, linewidth=2.0, label=method)
            axes.plot(mean, -m, "o", color=colour, markersize=4.0)
        axes.set_ylim(-1.6, 0.6)
        axes.set_yticks([])
        name_axes(axes, "", _label(names[q]), "")
    for axes in grid.flat[len(names) :]:
        axes.set_visible(False)
    legend(figure)
    return figure


def sensitivity_figure(indices: SobolIndices) -> Figure:
    """First-order and total Sobol' indices of every quantity, with 95 % intervals.

    Returns the figure. Raises `ValueError` when there are none.
    """
    shown = [q for q in range(len(indices.names)) if np.isfinite(indices.total[q]).any()]
    if not shown:
        raise InputError("there is nothing to show: no quantity has indices.")
    columns, n = min(len(shown), 2), len(indices.input_names)
    rows = -(-len(shown) // columns)
    height = 0.6 + rows * (0.7 + 0.26 * n)
    figure, grid = panels(PAGE if columns > 1 else COLUMN, height, rows, columns)
    position = np.arange(n, dtype=float)
    for axes, q in zip(grid.flat, shown, strict=False):
        for shift, values, half, colour, name in (
            (-0.18, indices.first, indices.first_half_width, SERIES[1], "first order"),
            (0.18, indices.total, indices.total_half_width, SERIES[0], "total"),
        ):
            axes.barh(
                position + shift,
                values[q],
                height=0.34,
                xerr=half[q],
                color=colour,
                error_kw={"linewidth": 0.8},
                label=f"{name} index, 95 %",
            )
        axes.set_yticks(position, list(indices.input_names) if q in shown[::columns] else [""] * n)
        axes.tick_params(axis="y", labelsize=SMALL)
        axes.set_xlim(0.0, 1.05)
        axes.invert_yaxis()
        name_axes(axes, _label(indices.names[q]), "Fraction of the variance", "")
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    legend(figure)
    return figure


def _label(name: str) -> str:
    """An output's name in words, with its unit.

    >>> _label("peak_frequency_hz at 0.01 N")
    'Peak frequency (Hz) at 0.01 N'
    """
    name, at, force = name.partition(" at ")
    unit = next((end for end in ("_hz", "_m_s") if name.endswith(end)), "")
    words = name.removesuffix(unit).replace("_", " ")
    return (
        words[:1].upper()
        + words[1:]
        + {"_hz": " (Hz)", "_m_s": " (m/s)"}.get(unit, "")
        + at
        + force
    )
