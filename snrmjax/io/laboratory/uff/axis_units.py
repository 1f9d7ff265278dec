"""Quantity, unit and factor of an axis of a universal file."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from snrmjax.io.laboratory.physical_units import unit_meaning
from snrmjax.io.laboratory.uff.data_sets import stated
from snrmjax.measure.recordings.channels import SI_UNIT, Quantity

_QUANTITIES: dict[int, Quantity] = {
    8: "displacement",
    9: "force",
    11: "velocity",
    12: "acceleration",
    13: "force",
}


class UnitSystem(NamedTuple):
    """Data set 164: a number of the file over its factor is in SI."""

    length: float = 1.0
    force: float = 1.0
    notes: tuple[str, ...] = ()


class AxisUnit(NamedTuple):
    """What an axis is in: a number of it times `calibration` is in the SI unit of `quantity`."""

    quantity: Quantity
    unit: str
    calibration: float
    note: str = ""


def unit_system(sets: Sequence[Mapping[str, Any]]) -> UnitSystem:
    """The units of a file; SI where no data set 164 states them."""
    if not sets:
        return UnitSystem(notes=("no units (data set 164): SI where an axis states none.",))
    one = sets[0]
    length, force = float(one["length"]), float(one["force"])
    if not (0 < length < float("inf") and 0 < force < float("inf")):
        raise ValueError(f"the factors of units (data set 164) must be positive: {length}, {force}")
    if length == force == 1:
        return UnitSystem()
    words = stated(one["units_description"])
    note = f"units{words and ' '}{words}: 1 m is {length:.6g} of the file's, 1 N is {force:.6g}."
    return UnitSystem(length, force, (note,))


def axis_unit(one: Mapping[str, Any], axis: str, units: UnitSystem) -> AxisUnit:
    """The unit of an axis ("ordinate", "orddenom"): its label, else the file's system of units.

    A label such as (mm/s)/lbf of an ordinate is that of response over reference.
    """
    stated_quantity = _QUANTITIES.get(one.get(f"{axis}_spec_data_type", 0), "unknown")
    label = stated(one.get(f"{axis}_axis_units_lab", ""))
    of_system = 1 / (units.force if stated_quantity == "force" else units.length)
    by_system = AxisUnit(
        stated_quantity, SI_UNIT[stated_quantity] if of_system == 1 else "", of_system
    )
    if stated_quantity == "unknown":
        by_system = AxisUnit("unknown", "", 1.0)
    if not label:
        return by_system
    try:
        meaning = unit_meaning(label)
    except ValueError:
        note = f"the unit {label!r} is not understood and its factor is taken as 1."
        return AxisUnit(stated_quantity, label, 1.0, note)
    if meaning.quantity == "unknown" or meaning.per_volt:
        factor = meaning.factor if meaning.dimension == "other" else 1.0
        return AxisUnit(stated_quantity, label, factor)
    if stated_quantity not in ("unknown", meaning.quantity):
        note = f"an axis of {stated_quantity} has the unit {label!r}: taken for {meaning.quantity}."
        return AxisUnit(meaning.quantity, label, meaning.factor, note)
    return AxisUnit(meaning.quantity, label, meaning.factor)
