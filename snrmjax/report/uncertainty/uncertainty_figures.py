"""Figures of propagated uncertainty and of sensitivity indices."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from snrmjax.report.style import (
    BACKGROUND,
    COLUMN,
    CURVE,
    PAGE,
    SERIES,
    SIMULATED,
    SMALL,
    legend,
    name_axes,
    panels,
)
from snrmjax.study.uncertainty.propagation import METHOD_NAMES, Propagation
from snrmjax.study.uncertainty.sensitivity import SobolIndices

_COLOURS = (SERIES[0], SERIES[1], SERIES[2], SIMULATED)  # of the methods
_ROW = 1.9  # inches: a row of panels


def propagation_figure(result: Propagation) -> Figure:
    """Members of every quantity, first order's normal distribution, and all 95 % ranges.

    Returns the figure. Raises `ValueError` when no quantity has a member.
    """
    shown = [q for q in range(len(result.names)) if np.isfinite(result.members.values[:, q]).any()]
    if not shown:
        raise ValueError("there is nothing to show: no quantity of any member was found.")
    columns = min(len(shown), 2)
    rows = -(-len(shown) // columns)
    figure, grid = panels(PAGE if columns > 1 else COLUMN, 0.6 + _ROW * rows, rows, columns)
    for axes, q in zip(grid.flat, shown, strict=False):
        _distribution(axes, result, q)
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    legend(figure)
    return figure


def _distribution(axes: Axes, result: Propagation, q: int) -> None:
    values = result.members.values[:, q]
    values = values[np.isfinite(values)]
    heights, *_ = axes.hist(values, bins=40, density=True, color=BACKGROUND, label="members")
    mean, std = result.statistics[0, :2, q]
    top = float(np.max(heights))
    if std > 0:
        x = np.linspace(mean - 3.5 * std, mean + 3.5 * std, 200)
        density = stats.norm.pdf(x, mean, std)
        axes.plot(x, density, color=_COLOURS[0], **CURVE, label="first order: normal")
        top = max(top, float(density.max()))
    for m, (method, colour) in enumerate(zip(METHOD_NAMES, _COLOURS, strict=True)):
        middle, _, lower, upper = result.statistics[m, :, q]
        height = -top * (0.07 + 0.08 * m)
        name = f"mean and 95 %, {method}"
        axes.plot([lower, upper], [height] * 2, color=colour, linewidth=2.0, label=name)
        axes.plot(middle, height, "o", color=colour, markersize=4.0)
    axes.set_ylim(-top * 0.4, top * 1.08)
    axes.set_yticks([])
    name_axes(axes, "", _label(result.names[q]), "Density")


def sensitivity_figure(indices: SobolIndices) -> Figure:
    """First-order and total Sobol' indices of every quantity, with 95 % intervals.

    Returns the figure. Raises `ValueError` when there are none.
    """
    shown = [q for q in range(len(indices.names)) if np.isfinite(indices.total[q]).any()]
    if not shown:
        raise ValueError("there is nothing to show: no quantity has indices.")
    columns, n = min(len(shown), 2), len(indices.input_names)
    rows = -(-len(shown) // columns)
    height = 0.6 + rows * (0.7 + 0.26 * n)
    figure, grid = panels(PAGE if columns > 1 else COLUMN, height, rows, columns)
    place = np.arange(n, dtype=float)
    for axes, q in zip(grid.flat, shown, strict=False):
        for shift, values, half, colour, name in (
            (-0.18, indices.first, indices.first_half_width, SERIES[1], "first order"),
            (0.18, indices.total, indices.total_half_width, SERIES[0], "total"),
        ):
            axes.barh(
                place + shift,
                values[q],
                height=0.34,
                xerr=half[q],
                color=colour,
                error_kw={"linewidth": 0.8},
                label=f"{name} index, 95 %",
            )
        axes.set_yticks(place, list(indices.input_names) if q in shown[::columns] else [""] * n)
        axes.tick_params(axis="y", labelsize=SMALL)
        axes.set_xlim(0.0, 1.05)
        axes.invert_yaxis()
        name_axes(axes, _label(indices.names[q]), "Share of the variance", "")
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    legend(figure)
    return figure


def _label(name: str) -> str:
    """A column's name in words, with its unit.

    >>> _label("fold_1_frequency_hz")
    'Fold 1 frequency (Hz)'
    """
    for end, unit in (("_hz", " (Hz)"), ("_m_s", " (m/s)")):
        if name.endswith(end):
            name = name.removesuffix(end) + unit
    words = name.replace("_", " ", name.split(" (")[0].count("_"))
    return words[:1].upper() + words[1:]
