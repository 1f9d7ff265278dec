"""The frequency axis of responses that a start and a step state in place of a vector."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.io.laboratory.arrays.value_tree import Numbers
from snrmjax.io.laboratory.names import label_of, role_of
from snrmjax.io.laboratory.physical_units import unit_meaning
from snrmjax.io.units import HERTZ

_FREQUENCY = r"(f|fr|freq|frequency|frequenz|hz)"
_START = rf"{_FREQUENCY}_?(start|min|begin|first|low|lower)|(start|min|first|low)_?{_FREQUENCY}"
_STEP = (
    rf"(d|delta)_?{_FREQUENCY}|{_FREQUENCY}_?(step|inc|increment|delta|res|resolution|spacing)"
    rf"|(step|increment|resolution)_?{_FREQUENCY}"
)
_FEWEST = 8  # lines along an axis that no vector has


class EvenAxis(NamedTuple):
    """Frequencies in Hz from a start in even steps."""

    start: float
    step: float

    def hertz(self, count: int) -> Float[np.ndarray, " line"]:
        """That many frequencies."""
        return self.start + self.step * np.arange(count)


def axis_of_options(start: float, step: float) -> EvenAxis | None:
    """The frequencies of responses without any, or None: none are stated.

    Raises `ValueError` for a start without a step, and for numbers that are no frequencies.
    """
    for flag, number in (("start", start), ("step", step)):
        if not 0 <= number < float("inf"):
            raise ValueError(f"--frequency-{flag} must not be negative, but is {number:g} Hz.")
    if start and not step:
        raise ValueError("--frequency-start needs --frequency-step: the step in Hz.")
    return EvenAxis(start, step) if step else None


def stated_axis(numbers: Mapping[str, Numbers]) -> EvenAxis | None:
    """The axis that two single numbers of a struct state by their names, or None."""
    found: dict[str, float] = {}
    for key, role in axis_keys(numbers).items():
        array = numbers[key]
        unit = array.unit or label_of(key).unit
        found.setdefault(role, float(array.vector(key)[0]) * in_hertz(unit))
    axis = EvenAxis(found.get("start", np.nan), found.get("step", np.nan))
    is_good = np.isfinite(axis).all() and axis.start >= 0 and axis.step > 0
    return axis if is_good else None


def axis_keys(numbers: Mapping[str, Numbers]) -> dict[str, str]:
    """Which single numbers are the start and the step of frequencies, by their names."""
    found = {}
    for key, array in numbers.items():
        word = label_of(key).word.rsplit(".", 1)[-1]
        for role, pattern in (("start", _START), ("step", _STEP)):
            is_one = array.size == 1 and not array.is_complex
            if is_one and re.fullmatch(pattern, word, re.IGNORECASE):
                found[key] = role
    return found


def side_of_lines(sides: Sequence[int]) -> int | None:
    """Which of the sides is along the frequency: the only longest one, if it is long."""
    longest = max(sides, default=0)
    return longest if longest >= _FEWEST and list(sides).count(longest) == 1 else None


def is_mark(name: str, array: Numbers) -> bool:
    """Whether an array marks lines (valid, overloaded, a count of averages) by name and numbers."""
    if array.is_complex:
        return False
    values = array.vector(name)
    return values.dtype == bool or (
        role_of(name) in ("mark", "level", "")
        and bool(np.all(values == np.round(values)))
        and (role_of(name) == "mark" or bool(np.isin(values, (0, 1)).all()))
    )


def in_hertz(unit: str) -> float:
    """What a number in a unit is multiplied with; 1 where it is none of a frequency."""
    try:
        meaning = unit_meaning(unit)
    except ValueError:
        return 1.0
    return meaning.factor / HERTZ if meaning.dimension == "frequency" else 1.0
