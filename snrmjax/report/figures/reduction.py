"""Figures of a reduced-order model: shapes, force and displacement, fit quality, load scale."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from snrmjax.condense.condensation import Condensation
from snrmjax.condense.load_cases import StaticCases
from snrmjax.condense.reduction import ShapeLines
from snrmjax.condense.scale_study import TOLERANCE, LoadScaleStudy
from snrmjax.condense.static_response import static_displacement
from snrmjax.model.potential import monomial_key
from snrmjax.report.style import (
    BACKGROUND,
    COLUMN,
    CROSS,
    DOT,
    EXCLUDED,
    HOLLOW,
    IDENTIFIED,
    LINE,
    PAGE,
    SERIES,
    STAR,
    legend,
    marks,
    name_axes,
    panels,
    unit_for,
)

_ACROSS = 3  # panels side by side
_ROW = 2.4  # inches
_FRAME = 0.1  # of a decade between a point and the frame
_TICKS = 12  # intervals between labels, of all panels of a row
_POINTS = 60  # on each side of a static curve
_MOST_LINES = 6  # coefficients that are drawn
_MOST_CHANGE = 50.0  # per cent of a coefficient that is drawn
FITTED, FURTHER = "finite elements, load cases of the fit", "finite elements, not fitted"


def shapes_figure(lines: ShapeLines, names: Sequence[str]) -> Figure:
    """Mode shapes along the structure, each over its largest value."""
    figure, grid = panels(COLUMN, _ROW + 0.4, 1, 1)
    axes = grid[0, 0]
    for k, name in enumerate(names):
        shape = lines.shape[:, k] / np.max(np.abs(lines.shape[:, k]))
        axes.plot(lines.position, shape, color=_colour(k), linewidth=LINE, label=name)
    name_axes(axes, "Mode shapes", lines.axis, "Shape over its largest value")
    legend(figure)
    return figure


def static_figure(
    found: Condensation, names: Sequence[str], sweep: StaticCases | None = None
) -> Figure:
    """Load and displacement of every mode loaded alone: finite elements and the reduced model.

    Arguments: `sweep` has further load cases, of single modes, that were not fitted.

    Loads are given as the displacement that they would cause in the linear structure.
    """
    n = len(names)
    columns = 2 if n == 4 else min(_ACROSS, n)
    rows = -(-n // columns)
    figure, grid = panels(PAGE if n > 1 else COLUMN, _ROW * rows + 0.4, rows, columns)
    largest, squared = np.asarray(found.basis.largest), np.asarray(found.basis.frequency) ** 2
    to_length = largest / squared
    for k, axes in enumerate(list(grid.flat)[:n]):
        own = _alone(found.cases, k)
        further = np.zeros((0, 2)) if sweep is None else _alone(sweep, k)
        every = np.concatenate([own, further])
        if not len(every):
            every = np.array([[np.max(np.abs(np.asarray(found.cases.force)[:, k])), 0.0]])
        end = 1.1 * np.max(np.abs(every[:, 0]))
        loads = np.zeros((2 * _POINTS + 1, n))
        loads[:, k] = np.linspace(-end, end, 2 * _POINTS + 1)
        loads[_POINTS, k] = 1e-9 * end  # at rest a path has no direction
        static = np.asarray(
            static_displacement(found.basis.frequency, found.potential, jnp.asarray(loads))
        )
        unit = unit_for(np.append(largest[k] * every[:, 1], to_length[k] * end), "m")
        x, y = largest[k] * static[:, k] / unit.size, loads[:, k] * to_length[k] / unit.size
        axes.plot(y, y, color=BACKGROUND, linewidth=LINE, label="linear")
        axes.plot(x, y, color=IDENTIFIED, linewidth=LINE, label="reduced model")
        for dots, style, name in ((own, DOT, FITTED), (further, HOLLOW, FURTHER)):
            at = largest[k] * dots[:, 1] / unit.size, to_length[k] * dots[:, 0] / unit.size
            marks(axes, at[0], at[1], {**style, "zorder": 3}, name)
        label = f"Load, as displacement ({unit.name})" if k % columns == 0 else ""
        name_axes(axes, names[k], f"Largest displacement ({unit.name})", label)
        reach = 1.15 * max(
            np.nanmax(np.abs(x), initial=0.0), np.max(np.abs(every[:, 1])) * largest[k] / unit.size
        )
        axes.set_xlim(-reach, reach)
        axes.xaxis.set_major_locator(MaxNLocator(_TICKS // columns))
    for axes in list(grid.flat)[n:]:
        axes.set_visible(False)
    legend(figure)
    return figure


def _alone(cases: StaticCases, mode: int) -> np.ndarray:
    """(force, modal displacement) of the solved cases that load one mode only."""
    force = np.asarray(cases.force)
    rows = cases.usable & (np.count_nonzero(force, axis=1) == 1) & (force[:, mode] != 0)
    moved = np.asarray(cases.modal_displacement)
    return np.stack([force[rows, mode], moved[rows, mode]], axis=1)


def quality_figure(found: Condensation) -> Figure:
    """Cross-validated error of every load case over how nonlinear it is."""
    figure, grid = panels(COLUMN, _ROW + 0.4, 1, 1)
    axes: Axes = grid[0, 0]
    quality = found.quality
    ratio, error = quality.nonlinear_ratio, quality.case_error
    named = np.zeros(len(ratio), dtype=bool)
    for warning in found.warnings:
        if warning.kind == "inconsistent_case":
            named[list(warning["cases"])] = True
    shown = np.isfinite(error) & (error > 0)
    marks(axes, ratio[shown & ~named], error[shown & ~named], DOT, "load case")
    cross = {**CROSS, "markeredgecolor": IDENTIFIED}
    marks(axes, ratio[shown & named], error[shown & named], cross, "inconsistent with the others")
    if shown.any():
        axes.set(
            xscale="log", yscale="log", xlim=_decades(ratio[shown]), ylim=_decades(error[shown])
        )
    name_axes(
        axes,
        "Each load case predicted from all others",
        "Nonlinear over linear force",
        "Error over nonlinear force",
    )
    legend(figure)
    return figure


def _decades(values: np.ndarray) -> tuple[float, float]:
    """Powers of ten around positive values, none of which lies on the frame."""
    power = np.log10(values)
    low, high = np.floor(power.min() - _FRAME), np.ceil(power.max() + _FRAME)
    return float(10.0**low), float(10.0**high)


def scale_figure(study: LoadScaleStudy) -> Figure:
    """Leading coefficients and misfit over the load scale, with the plateau."""
    figure, grid = panels(PAGE, _ROW + 0.5, 1, 2)
    left, right = grid[0]
    solved = np.isfinite(study.misfit)
    nearest = int(np.argmin(np.abs(np.log(study.scale))))
    listed = np.flatnonzero(study.leading)
    change = 100 * (study.coefficient[:, listed] / study.coefficient[nearest, listed] - 1)
    for k, column in enumerate(listed[:_MOST_LINES]):
        left.plot(
            study.scale[solved],
            change[solved, k],
            ".-",
            color=_colour(k),
            linewidth=LINE,
            label=f"coefficient {monomial_key(study.monomials[column])}",
        )
    reach = 1.2 * float(np.max(np.abs(change[solved]), initial=0.0))
    reach = min(max(reach, 200 * TOLERANCE), _MOST_CHANGE)
    left.set_ylim(-reach, reach)
    right.plot(study.scale[solved], study.misfit[solved], ".-", color="0.1", linewidth=LINE)
    right.plot(
        study.scale[solved],
        study.nonlinear_ratio[solved],
        "--",
        color="0.3",
        linewidth=LINE,
        label="nonlinear over linear force (right)",
    )
    right.plot([], [], ".-", color="0.1", label="residual over nonlinear force (right)")
    right.set_yscale("log")
    for axes in (left, right):
        axes.set_xscale("log")
        axes.axvline(
            1.0, color="0.2", linewidth=0.9, linestyle=":", label="load scale of the model"
        )
        if study.plateau is not None:
            axes.axvspan(*study.plateau, color=EXCLUDED, alpha=0.15, linewidth=0, label="plateau")
        lost = study.scale[~solved]
        marks(
            axes,
            lost,
            np.full(lost.size, 0.02),
            {**STAR, "transform": axes.get_xaxis_transform()},
            "load cases without solution",
        )
    name_axes(left, "Coefficients", "Load scale", "Change (%)")
    name_axes(right, "Fit", "Load scale", "Ratio")
    legend(figure)
    return figure


def _colour(k: int) -> str:
    return SERIES[k % len(SERIES)]
