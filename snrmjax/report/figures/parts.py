"""Figures of a diagnosis by parts: changes at the states, laws, drawn laws, remainder."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from snrmjax.diagnose import priors
from snrmjax.diagnose.diagnosis_result import Diagnosis, DrawnLaw
from snrmjax.diagnose.naming.parts import Remainder
from snrmjax.numerics.rules import InputError
from snrmjax.report.html import ReportTable, number, with_error
from snrmjax.report.style import (
    COLUMN,
    DOT,
    IDENTIFIED,
    LINE,
    PAGE,
    SIMULATED,
    Style,
    banded,
    legend,
    marks,
    name_axes,
    panels,
    plain,
    unit_for,
)

LAW_CAPTION = (
    "The force drawn from the data, in addition to the linear model, as if it acted at the "
    "sensor, with its 95 % band. Crosses are the knots in model.toml; dashed parts lie beyond "
    "the measured range and are extrapolated."
)
PARTS_CAPTION = (
    "Change relative to the model at every state, the errors of its level included, and the "
    "curves that explain it: the laws, and the laws with the remainder (95 % band)."
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
        _draw_law(axes, law)
    legend(figure)
    return figure


def _draw_law(axes: Axes, law: DrawnLaw) -> None:
    x, y = unit_for(law.at, "m"), unit_for(law.force, "N")
    at, force = law.at / x.size, law.force / y.size
    error = priors.BAND * law.force_std / y.size
    inside = np.abs(law.at) <= 1.0001 * law.largest
    banded(axes, at, force, error, IDENTIFIED, linestyle="--", zorder=2)
    own: Style = {"color": IDENTIFIED, "linewidth": LINE, "label": "drawn law"}
    axes.plot(at[inside], force[inside], marker="x", markersize=3.0, **own)
    axes.axhline(0.0, color="0.6", linewidth=0.6, zorder=1)
    title = law.name
    if law.passing is not None:
        title += f" (force at {law.passing:.2g} m/s)"
    name_axes(axes, plain(title), f"Displacement ({x.name})", f"Force ({y.name})")


def law_tables(laws: Sequence[DrawnLaw]) -> list[ReportTable]:
    """The tables of drawn laws: displacement, force ± 1σ."""
    tables = []
    for law in laws:
        x, y = unit_for(law.at, "m"), unit_for(law.force, "N")
        rows = [
            (number(a / x.size, 3), with_error(f / y.size, e / y.size) if e > 0 else number(0.0))
            for a, f, e in zip(law.at, law.force, law.force_std, strict=True)
        ]
        header = (f"displacement ({x.name})", f"force ± 1σ ({y.name})")
        tables.append(ReportTable(header, rows, folded=f"Table of the law: {law.name}"))
    return tables


def parts_figure(diagnosis: Diagnosis) -> Figure:
    """Changes of stiffness and damping, and other harmonics, beyond the model against velocity.

    Dots are the changes at the states, with the errors common to their level; the dashed line is
    the named laws, the solid one these and the remainder, with the remainder's 95 % band.
    """
    shown = [one for one in diagnosis.parts if one.remainder is not None]
    n_rows = 1 + (len(shown) > 2)
    figure, rows = panels(PAGE, 3.0 * n_rows, n_rows, -(-len(shown) // n_rows))
    for axes, one in zip(np.ravel(rows), shown, strict=False):
        if one.remainder is not None:
            _draw(axes, one.part, one.remainder, laws=bool(one.effects))
    for axes in np.ravel(rows)[len(shown) :]:
        axes.set_visible(False)
    legend(figure)
    return figure


def _draw(axes: Axes, part: str, left: Remainder, *, laws: bool) -> None:
    """One part: in per cent of the linear value, or a harmonic's velocity."""
    unit, times = unit_for(left.velocity, "m/s"), 100.0
    title = {"stiffness": "Change of stiffness (%)", "damping": "Change of damping ratio (%)"}
    if part not in title:
        magnitude = np.abs(np.concatenate([left.laws, left.laws + left.value]))
        own = unit_for(np.maximum(magnitude, 1e-12), "m/s")
        times, title = 1 / own.size, {part: f"{part.replace('_', ' ').capitalize()} ({own.name})"}
    at, whole = left.velocity / unit.size, times * (left.laws + left.value)
    marks(axes, left.state_velocity / unit.size, times * left.state_change, DOT, "states")
    band = times * priors.BAND * left.std
    axes.fill_between(at, whole - band, whole + band, color=IDENTIFIED, alpha=0.25, lw=0)
    axes.plot(at, whole, color=IDENTIFIED, label="laws and remainder")
    if laws:
        law: Style = {"color": SIMULATED, "linestyle": "--"}
        axes.plot(at, times * left.laws, **law, label="laws alone")
    # States far from resonance are uncertain: the axis follows the curves and the other states.
    states = np.nanquantile(times * left.state_change, [0.25, 0.75])
    reach = np.concatenate([whole, times * left.laws, states])
    margin = 0.5 * max(np.ptp(reach), 1e-3 * np.max(np.abs(reach), initial=1e-9))
    axes.set_ylim(np.min(reach) - margin, np.max(reach) + margin)
    name_axes(axes, "", f"Velocity amplitude ({unit.name})", title[part])
