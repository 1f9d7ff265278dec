"""Axes of a universal file: quantity, unit and factor, and abscissae in s or Hz.

Even abscissae have a step and a start of six digits.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.io.laboratory.physical_units import is_per_force, level_reference, meaning_or_none
from snrmjax.io.laboratory.uff.data_sets import stated
from snrmjax.measure.recordings.channels import SI_UNIT, Quantity
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_SI = {"time": 1.0, "frequency": HERTZ}  # s and Hz
_OTHERS = {19: "a rotation speed", 20: "an order"}  # specific data types
_EVEN = 1e-6  # of a step: tolerance of an even abscissa in double precision
_DIGITS = 5  # after the first, in the header's E13.5
_QUANTITIES: dict[int, Quantity] = {
    8: "displacement",
    9: "force",
    11: "velocity",
    12: "acceleration",
    13: "force",
}


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


class UnitSystem(NamedTuple):
    """Data set 164: numbers in the file divided by these factors are in SI."""

    length: float = 1.0
    force: float = 1.0
    notes: tuple[Fact, ...] = ()


class AxisUnit(NamedTuple):
    """Unit of an axis: a number times `calibration` is in the SI unit of `quantity`."""

    quantity: Quantity
    unit: str
    calibration: float
    notes: tuple[Fact, ...] = ()


def unit_system(sets: Sequence[Mapping[str, Any]]) -> UnitSystem:
    """The units of a file; SI where no data set 164 states them."""
    if not sets:
        return UnitSystem(notes=(Fact("no_unit_system"),))
    function = sets[0]
    length, force = float(function["length"]), float(function["force"])
    if not (0 < length < float("inf") and 0 < force < float("inf")):
        raise InputError(f"the factors of units (data set 164) must be positive: {length}, {force}")
    if length == force == 1:
        return UnitSystem()
    name = stated(function["units_description"])
    return UnitSystem(length, force, (Fact("unit_system", name=name, length=length, force=force),))


def axis_unit(function: Mapping[str, Any], axis: str, units: UnitSystem) -> AxisUnit:
    """The unit of an axis ("ordinate", "orddenom"): its label, else the file's system of units.

    An ordinate label such as (mm/s)/lbf is that of response per reference: the reference is then a
    force, in newtons unless its own axis states another unit.
    """
    quantity = _QUANTITIES.get(function.get(f"{axis}_spec_data_type", 0), "unknown")
    label = stated(function.get(f"{axis}_axis_units_lab", ""))
    if not label:
        if (
            axis == "orddenom"
            and quantity == "unknown"
            and is_per_force(stated(function.get("ordinate_axis_units_lab", "")))
        ):
            return AxisUnit("force", SI_UNIT["force"], 1.0)
        factor = 1 / (units.force if quantity == "force" else units.length)
        known = quantity != "unknown"
        return AxisUnit(
            quantity, SI_UNIT[quantity] if factor == 1 else "", factor if known else 1.0
        )
    if level_reference(label) is not None:
        return AxisUnit("unknown", label, 1.0)
    meaning = meaning_or_none(label)
    if meaning is None:
        return AxisUnit(quantity, label, 1.0, (Fact("unit_unknown", unit=label),))
    if meaning.quantity == "unknown" or meaning.per_volt:
        return AxisUnit(quantity, label, meaning.factor if meaning.dimension == "other" else 1.0)
    # The reference axis' factor divides again later, so multiply by it here.
    reference_factor = (
        axis_unit(function, "orddenom", units).calibration if meaning.per_force else 1.0
    )
    other = quantity not in ("unknown", meaning.quantity)
    notes = (Fact("unit_of_other_quantity", stated=quantity, unit=label, taken=meaning.quantity),)
    return AxisUnit(
        meaning.quantity, label, meaning.factor * reference_factor, notes if other else ()
    )
