"""Units and wording of the numbers of a study."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.report.html import number, ten_to
from snrmjax.report.style import unit_for

_FEWEST_DIGITS, _MOST_DIGITS = -2, 4  # powers of ten that axes are written with
_PREFIXED = ("m/s", "N", "J")  # units shown with a prefix where numbers are small


class Display(NamedTuple):
    """How numbers are shown: divided by `size`, in `unit`."""

    size: float
    unit: str

    def labelled(self, text: str) -> str:
        """A label with the unit."""
        return f"{text} ({self.unit})" if self.unit else text


_PLAIN = Display(1.0, "")


def span_in_words(
    *values: float, ends: tuple[float, float] = (-np.inf, np.inf), shown: Display = _PLAIN
) -> str:
    """A value or a range; -inf and inf are below and above the ends of the range.

    >>> span_in_words(84.0, np.inf, ends=(70.0, 110.0))
    '84 to above 110'
    """
    beyond = {-np.inf: f"below {number(ends[0])}", np.inf: f"above {number(ends[1])}"}
    each = [beyond.get(value) or number(value / shown.size) for value in values]
    return " to ".join(dict.fromkeys(each) if values[0] in beyond else each)


def of_members(known: int, members: int) -> str:
    """The number of members that a statement refers to.

    >>> of_members(27, 100), of_members(100, 100)
    ('27 of 100 members', '100 members')
    """
    return f"{members} members" if known == members else f"{known} of {members} members"


def display(values: Float[np.ndarray, "..."], unit: str) -> Display:
    """The unit, with a prefix where suitable, in which to show values."""
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
