"""Frequency axis of responses given by start and step in place of a vector."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.io.laboratory.arrays.value_tree import Numbers
from snrmjax.io.laboratory.names import label_of, role_of
from snrmjax.io.laboratory.physical_units import meaning_or_none
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_FREQUENCY = r"(f|fr|freq|frequency|frequenz|hz)"
_START = rf"{_FREQUENCY}_?(start|min|begin|first|low|lower)|(start|min|first|low)_?{_FREQUENCY}"
_STEP = (
    rf"(d|delta)_?{_FREQUENCY}|{_FREQUENCY}_?(step|inc|increment|delta|res|resolution|spacing)"
    rf"|(step|increment|resolution)_?{_FREQUENCY}"
)
_FEWEST = 8  # least number of lines along an axis without a vector


class EvenAxis(NamedTuple):
    """Evenly spaced frequencies, start and step in Hz."""

    start: float
    step: float

    def hertz(self, count: int) -> Float[np.ndarray, " line"]:
        """The first `count` frequencies in Hz."""
        return self.start + self.step * np.arange(count)


def axis_of_options(start: float, step: float) -> EvenAxis | None:
    """The stated frequencies of responses without an axis, or None.

    Raises `ValueError` for a start without a step, and for negative or infinite numbers.
    """
    for flag, number in (("start", start), ("step", step)):
        if not 0 <= number < float("inf"):
            raise InputError(f"--frequency-{flag} must not be negative, but is {number:g} Hz.")
    if start and not step:
        raise InputError("--frequency-start needs --frequency-step: the step in Hz.")
    return EvenAxis(start, step) if step else None


def stated_axis(numbers: Mapping[str, Numbers]) -> EvenAxis | None:
    """The axis given by two scalars of a struct, recognised by name, or None."""
    stated: dict[str, float] = {}
    for key, role in axis_keys(numbers).items():
        array = numbers[key]
        unit = array.unit or label_of(key).unit
        stated.setdefault(role, float(array.vector(key)[0]) * in_hertz(unit))
    axis = EvenAxis(stated.get("start", np.nan), stated.get("step", np.nan))
    is_good = np.isfinite(axis).all() and axis.start >= 0 and axis.step > 0
    return axis if is_good else None


def axis_keys(numbers: Mapping[str, Numbers]) -> dict[str, str]:
    """The scalars that are start and step of the frequencies, by name."""
    keys = {}
    for key, array in numbers.items():
        word = label_of(key).word.rsplit(".", 1)[-1]
        for role, pattern in (("start", _START), ("step", _STEP)):
            is_one = array.size == 1 and not array.is_complex
            if is_one and re.fullmatch(pattern, word, re.IGNORECASE):
                keys[key] = role
    return keys


def frequency_dimension(dimensions: Sequence[int]) -> int | None:
    """Length of the frequency dimension: the unique longest one, if long enough."""
    longest = max(dimensions, default=0)
    return longest if longest >= _FEWEST and list(dimensions).count(longest) == 1 else None


def is_mark(name: str, array: Numbers) -> bool:
    """Whether an array flags lines (valid, overloaded, number of averages), by name and values."""
    if array.is_complex:
        return False
    values = array.vector(name)
    return values.dtype == bool or (
        role_of(name) in ("mark", "level", "")
        and bool(np.all(values == np.round(values)))
        and (role_of(name) == "mark" or bool(np.isin(values, (0, 1)).all()))
    )


def in_hertz(unit: str) -> float:
    """Factor from a unit to Hz; 1 for a unit of another quantity."""
    meaning = meaning_or_none(unit)
    if meaning is None or meaning.dimension != "frequency":
        return 1.0
    return meaning.factor / HERTZ
