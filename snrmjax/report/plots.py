"""Which figure shows which result: what `result.plot()` draws."""

import functools
from typing import Any

from matplotlib.figure import Figure

from snrmjax.identify.inference.optimal_design import NextMeasurements
from snrmjax.report import joint_figures


@functools.singledispatch
def plot_result(result: object, **settings: Any) -> Figure:
    """The figure that shows a result.

    Raises `ValueError` for results that no figure shows.
    """
    raise ValueError(f"there is no figure of a `{type(result).__name__}`; see `sj.plot`.")


@plot_result.register
def _(result: NextMeasurements, **settings: Any) -> Figure:
    return joint_figures.advice_figure(
        result.responses, result.measurements, result.sensor, **settings
    )
