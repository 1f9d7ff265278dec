"""Figure of a diagnosis by parts: what the states read, the laws that explain it, and the rest."""

import numpy as np
from matplotlib.figure import Figure

from snrmjax.diagnose import priors
from snrmjax.diagnose.diagnosis_result import Diagnosis
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
    "What every state reads of the change beyond the model, the errors of its level included, "
    "and the curves that explain it: the laws, and the laws with what is left (95 % band)."
)


def parts_figure(diagnosis: Diagnosis) -> Figure:
    """Changes of stiffness and damping beyond the model, against velocity amplitude.

    Dots are what every state reads, with the errors that its level shares; the dashed line is what
    the named laws add, the line that and the remainder, with the remainder's 95 % band.
    """
    shown = [one for one in diagnosis.parts if one.remainder is not None]
    figure, (row,) = panels(PAGE, 3.0, 1, len(shown))
    titles = {"stiffness": "Change of stiffness (%)", "damping": "Change of damping ratio (%)"}
    for axes, one in zip(row, shown, strict=True):
        left = one.remainder
        if left is None:
            continue
        unit = unit_for(left.velocity, "m/s")
        at, whole = left.velocity / unit.size, 100 * (left.laws + left.value)
        marks(axes, left.state_velocity / unit.size, 100 * left.state_change, DOT, "states")
        band = 100 * priors.BAND * left.std
        axes.fill_between(at, whole - band, whole + band, color=IDENTIFIED, alpha=0.25, lw=0)
        axes.plot(at, whole, color=IDENTIFIED, label="laws and remainder")
        if one.effects:
            law: Style = {"color": SIMULATED, "linestyle": "--"}
            axes.plot(at, 100 * left.laws, **law, label="laws alone")
        # States far from resonance read little: the axis is that of the curves.
        reach = np.concatenate([whole, 100 * left.laws])
        margin = 0.5 * max(np.ptp(reach), 1e-3 * np.max(np.abs(reach), initial=1e-9))
        axes.set_ylim(np.min(reach) - margin, np.max(reach) + margin)
        name_axes(axes, "", f"Velocity amplitude ({unit.name})", titles[one.part])
    legend(figure)
    return figure
