"""A drawn law as a figure, a curve with its 95 % band, and as a table."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from snrmjax.diagnose import priors
from snrmjax.diagnose.drawn_law import DrawnLaw
from snrmjax.model.effect_metadata import Argument
from snrmjax.numerics.rules import InputError
from snrmjax.report.html import ReportTable, number, with_error
from snrmjax.report.style import (
    COLUMN,
    IDENTIFIED,
    LINE,
    PAGE,
    Style,
    banded,
    legend,
    name_axes,
    panels,
    plain,
    unit_for,
)

LAW_CAPTION = (
    "The force drawn from the data, in addition to the linear model, as if it acted at the "
    "sensor, with its 95 % band. Crosses are the knots in model.toml; dashed parts lie beyond "
    "the measured range and are extrapolated. For friction it is the initial loading curve "
    "without the stuck stiffness."
)


def drawn_laws_figure(laws: Sequence[DrawnLaw]) -> Figure:
    """Every drawn law over the measured range: curve, 95 % band and knots.

    Arguments: `laws` as a `Diagnosis` has them, one or more.
    Raises `ValueError` without any.
    """
    if not laws:
        raise InputError("there is no drawn law to show.")
    figure, (row,) = panels(COLUMN if len(laws) == 1 else PAGE, 3.0, 1, len(laws))
    for axes, law in zip(row, laws, strict=True):
        _draw(axes, law)
    legend(figure)
    return figure


def _draw(axes: Axes, law: DrawnLaw) -> None:
    is_velocity = law.argument is Argument.VELOCITY
    x, y = unit_for(law.at, "m/s" if is_velocity else "m"), unit_for(law.force, "N")
    at, force = law.at / x.size, law.force / y.size
    error = priors.BAND * law.force_std / y.size
    inside = np.abs(law.at) <= 1.0001 * law.largest
    banded(axes, at, force, error, IDENTIFIED, linestyle="--", zorder=2)
    own: Style = {"color": IDENTIFIED, "linewidth": LINE, "label": "drawn law"}
    axes.plot(at[inside], force[inside], marker="x", markersize=3.0, **own)
    axes.axhline(0.0, color="0.6", linewidth=0.6, zorder=1)
    quantity = "Velocity" if is_velocity else "Displacement"
    title = law.title
    if law.passing is not None:
        title += f" (force at {law.passing:.2g} m/s)"
    name_axes(axes, plain(title), f"{quantity} ({x.name})", f"Force ({y.name})")


def law_tables(laws: Sequence[DrawnLaw]) -> list[ReportTable]:
    """The tables of drawn laws: displacement or velocity, force ± 1σ."""
    tables = []
    for law in laws:
        is_velocity = law.argument is Argument.VELOCITY
        x, y = unit_for(law.at, "m/s" if is_velocity else "m"), unit_for(law.force, "N")
        rows = [
            (number(a / x.size, 3), with_error(f / y.size, e / y.size) if e > 0 else number(0.0))
            for a, f, e in zip(law.at, law.force, law.force_std, strict=True)
        ]
        quantity = "velocity" if is_velocity else "displacement"
        header = (f"{quantity} ({x.name})", f"force ± 1σ ({y.name})")
        tables.append(ReportTable(header, rows, folded=f"Table of the law: {law.name}"))
    return tables
