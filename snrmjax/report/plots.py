"""Which figure shows which result: what `result.plot()` draws."""

import functools
from typing import Any

from matplotlib.figure import Figure


@functools.singledispatch
def plot_result(result: object, **settings: Any) -> Figure:
    """The figure that shows a result.

    Raises `ValueError` for results that no figure shows.
    """
    raise ValueError(f"there is no figure of a `{type(result).__name__}`; see `sj.plot`.")
