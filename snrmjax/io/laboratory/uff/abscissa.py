"""Abscissae of a universal file in s or Hz, from step and start with six digits."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.io.laboratory.physical_units import meaning_or_none
from snrmjax.io.laboratory.uff.data_sets import stated
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

_SI = {"time": 1.0, "frequency": HERTZ}  # s and Hz
_OTHERS = {19: "a rotation speed", 20: "an order"}  # specific data types
_EVEN = 1e-6  # of a step: tolerance of an even abscissa in double precision
_DIGITS = 5  # after the first, in the header's E13.5


class EvenAbscissa(NamedTuple):
    """An evenly spaced abscissa: `first + k / rate`."""

    first: float
    rate: float
    notes: tuple[Fact, ...] = ()


def in_si(function: Mapping[str, Any], notes: list[Fact]) -> Mapping[str, Any]:
    """A function with its abscissa in s or Hz, as its unit label states (ms, kHz, rad/s, rpm)."""
    label = stated(function.get("abscissa_axis_units_lab", ""))
    meaning = meaning_or_none(label)
    if meaning is None:
        return function
    factor = meaning.factor / _SI.get(meaning.dimension, meaning.factor)
    if abs(factor - 1) < 1e-12:
        return function
    unit = "Hz" if meaning.dimension == "frequency" else "s"
    notes.append(Fact("abscissa_converted", stated=label, unit=unit))
    numbers = {
        key: function[key] * factor
        for key in ("x", "abscissa_min", "abscissa_inc")
        if key in function
    }
    return {**function, **numbers, "abscissa_axis_units_lab": unit}


def other_abscissa(function: Mapping[str, Any]) -> str:
    """What the abscissa of a frequency response is, if no frequency; else empty."""
    return _OTHERS.get(function.get("abscissa_spec_data_type", 0), "")


def even_abscissa(function: Mapping[str, Any]) -> EvenAbscissa | None:
    """Start and rate of a function's abscissa, or None where its steps are uneven.

    The header has both to six digits. If these fit exactly one whole number of samples per unit
    (4.88281E-04 s: 2048 Hz), that is used.
    """
    x = np.asarray(function["x"])
    if function["abscissa_spacing"] != 1:
        return _of_values(x)
    first, step = float(function["abscissa_min"]), float(function["abscissa_inc"])
    if not (math.isfinite(step) and step > 0):
        return None
    half = 0.5 * 10.0 ** (math.floor(math.log10(step)) - _DIGITS)
    low, high = math.ceil(1 / (step + half)), math.floor(1 / (step - half))
    if float(f"{step:.4e}") == step:
        return EvenAbscissa(first, 1 / step)
    if low == high:
        return EvenAbscissa(first, float(low), (Fact("whole_rate", rate=low, step=step),))
    return EvenAbscissa(first, 1 / step, (Fact("six_digits", off=(x.size - 1) * half),))


def abscissa(function: Mapping[str, Any]) -> Float[np.ndarray, " point"]:
    """The abscissa of a function, value by value."""
    if function["abscissa_spacing"] != 1:
        return np.asarray(function["x"], dtype=float)
    even = even_abscissa(function)
    if even is None:
        return np.asarray(function["x"], dtype=float)
    return even.first + np.arange(len(function["x"])) / even.rate


def _of_values(x: Float[np.ndarray, " point"]) -> EvenAbscissa | None:
    """Start and rate where stored values are even."""
    if x.size < 2 or x[-1] <= x[0]:
        return None
    step = (x[-1] - x[0]) / (x.size - 1)
    if np.max(np.abs(x - (x[0] + step * np.arange(x.size)))) > _EVEN * step:
        return None
    return EvenAbscissa(float(x[0]), float(1 / step))
