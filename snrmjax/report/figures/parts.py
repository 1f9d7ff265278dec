"""Figure of a diagnosis by parts: changes at the states, explaining laws and remainder."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from snrmjax.diagnose import priors
from snrmjax.diagnose.diagnosis_result import Diagnosis
from snrmjax.diagnose.naming.parts import Remainder
from snrmjax.report.style import (
    DOT,
    IDENTIFIED,
    PAGE,
    SIMULATED,
    Style,
    legend,
    marks,
    name_axes,
    panels,
    unit_for,
)

PARTS_CAPTION = (
    "Change relative to the model at every state, the errors of its level included, and the "
    "curves that explain it: the laws, and the laws with the remainder (95 % band)."
)


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
