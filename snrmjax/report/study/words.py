"""The units in which a study's numbers read well."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.report.html import ten_to
from snrmjax.report.style import unit_for

_FEWEST_DIGITS, _MOST_DIGITS = -2, 4  # powers of ten that axes are written with
_PREFIXED = ("m/s", "N", "J")  # units that read better with a prefix where numbers are small


class Display(NamedTuple):
    """How numbers are shown: divided by `size`, in `unit`."""

    size: float
    unit: str

    def labelled(self, text: str) -> str:
        """A label with the unit."""
        return f"{text} ({self.unit})" if self.unit else text


def display(values: Float[np.ndarray, "..."], unit: str) -> Display:
    """The unit in which values of this unit read well."""
    if unit in _PREFIXED and np.any(np.isfinite(values)):
        return Display(*unit_for(values, unit))
    return Display(1.0, "" if unit == "1" else unit)


def display_on_axis(values: Float[np.ndarray, "..."], unit: str) -> Display:
    """The same for an axis, with a power of ten where numbers are very large or very small."""
    shown = display(values, unit)
    largest = np.max(np.abs(values), initial=0.0, where=np.isfinite(values)) / shown.size
    power = 0 if largest == 0 else int(np.floor(np.log10(largest)))
    if _FEWEST_DIGITS <= power <= _MOST_DIGITS:
        return shown
    return Display(shown.size * 10.0**power, f"{ten_to(power)} {shown.unit}".rstrip())
