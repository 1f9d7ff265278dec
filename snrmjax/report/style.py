"""Markers, colours, panels and legends shared by all figures.

Sizes are those of a printed page: a figure of `PAGE` inches fills its width, and no letter is
smaller than 8 pt there. Everything is set on the figures themselves: matplotlib's settings stay
as they are.
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.colors import to_hex
from matplotlib.container import Container
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, MultipleLocator

from snrmjax.io.files import FilePath, file_name, write_atomically
from snrmjax.numerics.rules import InputError
from snrmjax.simulate.continuation.stability import Stability

PAGE, COLUMN = 7.2, 4.8  # inches: a figure of several panels, and of one
TEXT, SMALL = 9.0, 8.5  # points: of titles and labels, and of ticks, legends and notes

MEASURED, IDENTIFIED, SIMULATED, EXCLUDED = "#0072B2", "#D55E00", "black", "0.55"
BACKGROUND = "0.72"  # of a curve to compare with, broad behind another one
SERIES = (IDENTIFIED, MEASURED, "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
"""Colours that colour-blind readers can distinguish (Okabe & Ito)."""

CROWD = 120
"""From this number of points on they are drawn small."""

Style = dict[str, Any]
DOT: Style = {"linestyle": "none", "marker": "o", "markersize": 4.0, "color": MEASURED}
DOT |= {"markeredgecolor": "white", "markeredgewidth": 0.3}
STAR: Style = {**DOT, "marker": "*", "markersize": 7.5, "color": IDENTIFIED}
CROSS: Style = {**DOT, "marker": "x", "markeredgecolor": EXCLUDED, "markeredgewidth": 1.1}
HOLLOW: Style = {**DOT, "color": "white", "markeredgecolor": "black", "markersize": 5.0}
HOLLOW |= {"markeredgewidth": 0.9, "zorder": 5, "clip_on": False}
LINE = 1.3  # points: the width of a curve
CURVE: Style = {"linewidth": LINE}
FILL: Style = {"alpha": 0.22, "linewidth": 0}


class Unit(NamedTuple):
    """A unit by its name and its value in the SI unit."""

    size: float
    name: str


def unit_for(values: Any, base: str) -> Unit:
    """The unit with the prefix that puts the largest value between 0.1 and 1000, where one does.

    >>> unit_for([0.02, 0.05], "m/s"), unit_for(1.166e-11, "N")
    (Unit(size=0.001, name='mm/s'), Unit(size=1.0, name='N'))
    """
    largest = np.nanmax(np.abs(np.asarray(values)), initial=0.0)
    if base.startswith("×"):  # a number of what is then named: no unit of its own
        return Unit(1.0, base)
    for size, prefix in ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n")):
        if largest >= 0.1 * size:
            return Unit(size, prefix + base)
    return Unit(1.0, base)


def with_unit(value: float, base: str, digits: int = 4) -> str:
    """A value to some digits with its unit.

    >>> with_unit(2.669e-3, "N")
    '2.669 mN'
    """
    unit = unit_for(value, base)
    return f"{value / unit.size:.{digits}g} {unit.name}"


def plain(text: str) -> str:
    """A user's text as a label: no mathematics in it, and not hidden from legends."""
    return (" " if text.startswith("_") else "") + text.replace("$", r"\$")


def png_bytes(figure: Figure, *, dots_per_inch: float = 220.0) -> bytes:
    """A figure as the content of a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dots_per_inch)
    return buffer.getvalue()


class PrintedFigure(NamedTuple):
    """The content of a PNG file, with the width of the figure on paper."""

    png: bytes
    width: float  # inches


def printed(figure: Figure) -> PrintedFigure:
    """A figure drawn once, for a file and for a report."""
    return PrintedFigure(png_bytes(figure), figure.get_figwidth())


def save_figure(path: FilePath, figure: Figure, *, dots_per_inch: float = 220.0) -> None:
    """Write a figure as a PNG, completely or not at all.

    Raises `ValueError` when `path` does not end in .png or cannot be written.
    """
    if not file_name(path).lower().endswith(".png"):
        raise InputError(f"`path` must end in .png, but is {file_name(path)}.")
    write_atomically(path, png_bytes(figure, dots_per_inch=dots_per_inch))


def save_figures(folder: Path, figures: Mapping[str, Figure]) -> dict[str, PrintedFigure]:
    """Write figures as PNG files into a folder, each under its name; as printed, for a report."""
    drawn = {name: printed(figure) for name, figure in figures.items()}
    for name, one in drawn.items():
        write_atomically(folder / f"{name}.png", one.png)
    return drawn


def panels(width: float, height: float, rows: int, columns: int) -> tuple[Figure, np.ndarray]:
    """A figure, width and height in inches, and its panels as an array of rows."""
    figure = Figure(figsize=(width, height), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat:
        dress(axes)
    return figure, grid


def dress(axes: Axes) -> None:
    """The ticks, grid and spines that all panels have."""
    axes.tick_params(labelsize=SMALL, width=0.6, length=3.0)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["bottom", "left"]].set_linewidth(0.6)
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))


def name_axes(axes: Axes, title: str, x: str, y: str) -> None:
    """Title and axis labels."""
    axes.set_title(title, loc="left", fontsize=TEXT)
    axes.set_xlabel(x, fontsize=TEXT)
    axes.set_ylabel(y, fontsize=TEXT)


def fit_axis(axes: Axes, direction: str, points: Any, others: Any = (), bars: Any = (0.0,)) -> None:
    """Limits of an axis that show all `others` and all points but far outliers, which are counted.

    Arguments: `direction` "x" or "y"; `bars` the error bars of the points, of which a typical one
    fits on the axis unless it is longer than the rest. A point is far out when it lies outside
    the middle nine tenths of the points by more than their width. NaN is left out.
    """
    value, shown = np.asarray(points, dtype=float), np.asarray(others, dtype=float)
    value, shown = value[np.isfinite(value)], shown[np.isfinite(shown)]
    low, high = np.quantile(value, [0.05, 0.95]) if value.size else (-np.inf, np.inf)
    near = np.abs(value - 0.5 * (low + high)) <= 1.5 * (high - low)
    shown = np.concatenate([shown, value[near] if near.any() else value])
    if not shown.size:
        return
    width = max(np.ptp(shown), 1e-3 * np.max(np.abs(shown)))
    margin = 0.06 * width + min(float(np.median(np.nan_to_num(np.asarray(bars)))), 0.5 * width)
    ends = shown.min() - margin, shown.max() + margin
    axes.set(**{f"{direction}lim": ends})
    outside = int(np.sum((value < ends[0]) | (value > ends[1])))
    if outside:
        note = f"{outside} point{'s' if outside > 1 else ''} outside the {direction} range"
        corner: Style = {"transform": axes.transAxes, "ha": "right", "va": "top", "fontsize": SMALL}
        axes.text(0.99, 0.99 if direction == "y" else 0.93, note, color="0.3", **corner)


def phase_axis(axes: Axes) -> None:
    """A vertical axis of phases in degrees: from -100 to 100 at least, ticks every 45."""
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, -100.0), max(high, 100.0))
    axes.yaxis.set_major_locator(MultipleLocator(45.0))


def share_frequencies(upper: Axes, lower: Axes) -> None:
    """Two panels above one another on one frequency axis, with its numbers below both."""
    lower.sharex(upper)
    upper.tick_params(labelbottom=False)


def amplitude_and_phase(
    width: float, height: float, sensor: str, unit: Unit
) -> tuple[Figure, Axes, Axes]:
    """Two panels over one axis of frequency: velocity amplitude at a sensor, and its phase."""
    figure, ((upper,), (lower,)) = panels(width, height, 2, 1)
    share_frequencies(upper, lower)
    level = f"Velocity amplitude ({unit.name})"
    name_axes(upper, f"(a) amplitude at {plain(sensor)}", "", level)
    name_axes(lower, "(b) phase", "Frequency (Hz)", "Velocity phase (°)")
    return figure, upper, lower


def frequency_and_damping(height: float, level: str, where: str = "") -> tuple[Figure, Axes, Axes]:
    """Two panels over an amplitude, which `level` names: natural frequency and damping ratio."""
    figure, ((left, right),) = panels(PAGE, height, 1, 2)
    name_axes(left, "(a) natural frequency", level, "Natural frequency (Hz)")
    name_axes(right, f"(b) damping{where}", level, "Damping ratio (% of critical)")
    return figure, left, right


def marks(axes: Axes, x: Any, y: Any, style: Style, name: str | None = None) -> None:
    """Markers, if there are any; without a point nothing enters the legend."""
    if np.size(x):
        axes.plot(x, y, **style, label=name)


def banded(
    axes: Axes,
    x: Any,
    y: Any,
    error: Any,
    colour: Any,
    name: str | None = None,
    *,
    band: str | None = "95 % band",
    strength: float = 1.0,
    **style: Any,
) -> None:
    """A curve with the band y ± error; without a band where `error` is None.

    Arguments: `name` and `band` in the legend; a curve without a style of its own is solid.
    """
    if error is not None:
        fill = {**FILL, "alpha": strength * FILL["alpha"], "color": colour}
        axes.fill_between(x, y - error, y + error, **fill, label=band)
    axes.plot(x, y, **{**CURVE, "color": colour, "zorder": 4, **style}, label=name)


def stars(axes: Axes, x: Any, y: Any, name: str | None = None, **bars: Any) -> None:
    """Identified points with their error bars, small and without edges when they are many."""
    crowded = {"markersize": 3.5, "markeredgewidth": 0.0} if len(x) > CROWD else {}
    axes.errorbar(x, y, **bars, fmt="none", ecolor=IDENTIFIED, elinewidth=0.6, alpha=0.4)
    marks(axes, x, y, {**STAR, **crowded, "zorder": 3}, name)


_LINES = {Stability.STABLE: "-", Stability.UNSTABLE: "--", Stability.NOT_COMPUTED: "-."}


def response_line(
    axes: Axes,
    x: np.ndarray,
    y: np.ndarray,
    stability: np.ndarray,
    name: str,
    colour: Any,
    width: float,
    beyond: np.ndarray | None = None,
) -> None:
    """A response curve in pieces: unstable ones dashed and thin, ones `beyond` the data pale.

    `stability` has a `Stability` for every point, or whether it is stable; pieces whose stability
    was not computed are dash-dotted.
    """
    known = np.asarray(stability).astype(int)
    axes.plot([], [], color=colour, linewidth=width, label=name)  # for the legend
    pale = np.zeros(len(x), dtype=bool) if beyond is None else beyond
    starts = [0, *(np.flatnonzero(np.diff(4 * pale.astype(int) + known)) + 1)]
    for start, stop in zip(starts, [*starts[1:], len(x) - 1], strict=True):
        piece = slice(start, stop + 1)  # up to the next piece's first point: no gaps
        axes.plot(
            x[piece],
            y[piece],
            _LINES[known[start]],
            color=colour,
            linewidth=width * (0.6 if known[start] == Stability.UNSTABLE else 1.0),
            alpha=0.4 if pale[start] else 1.0,
        )


def explain_lines(figure: Figure) -> None:
    """Name dashed, dash-dotted and pale lines in the legend to come, if there are any."""
    lines = [line for axes in figure.axes for line in axes.lines]
    style: Style = {"color": "0.3", "linewidth": 0.8}
    if any(line.get_linestyle() == "--" for line in lines):
        figure.axes[-1].plot([], [], "--", **style, label="unstable")
    if any(line.get_linestyle() == "-." for line in lines):
        figure.axes[-1].plot([], [], "-.", **style, label="stability not computed")
    if any((line.get_alpha() or 1.0) < 1.0 for line in lines):
        figure.axes[-1].plot([], [], **style, alpha=0.4, label="beyond the data")


def legend(figure: Figure) -> None:
    """One legend below all panels, each name once with all its colours, in reading order."""
    every: dict[str, dict[str, Any]] = {}
    for axes in figure.axes:
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
            every.setdefault(name, {}).setdefault(_colour(handle), handle)
    entries: dict[str, Any] = {name: tuple(of.values()) for name, of in every.items()}
    columns = _columns(list(entries), figure.get_figwidth())
    order = [k for first in range(columns) for k in range(first, len(entries), columns)]
    names = [list(entries)[k] for k in order]
    figure.legend(
        [entries[name] for name in names],
        names,
        loc="outside lower center",
        ncols=columns,
        fontsize=SMALL,
        frameon=False,
        handlelength=1.8,
        columnspacing=1.6,
        handler_map={tuple: HandlerTuple(ndivide=None, pad=0.2)},
    )


def _colour(handle: Artist | Container) -> str:
    """The colour of a line or of an area; the same of everything else."""
    if isinstance(handle, Line2D):
        return to_hex(handle.get_color())
    if isinstance(handle, Collection) and len(handle.get_facecolor()):
        return to_hex(np.asarray(handle.get_facecolor())[0])
    return ""


def _columns(names: list[str], width: float) -> int:
    """The most columns of names that fit a width in inches, when they are read row by row."""
    for columns in range(len(names), 1, -1):
        longest = [max(map(len, names[first::columns])) for first in range(columns)]
        if sum(0.065 * letters + 0.55 for letters in longest) < width:
            return columns
    return 1
