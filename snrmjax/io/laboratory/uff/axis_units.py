"""Quantity, unit and factor of an axis of a universal file."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from snrmjax.io.laboratory.physical_units import is_per_force, level_reference, meaning_or_none
from snrmjax.io.laboratory.uff.data_sets import stated
from snrmjax.measure.recordings.channels import SI_UNIT, Quantity
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_QUANTITIES: dict[int, Quantity] = {
    8: "displacement",
    9: "force",
    11: "velocity",
    12: "acceleration",
    13: "force",
}


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
