"""Conversion of columns in decibels to amplitudes."""

import numpy as np
from jaxtyping import Float

from snrmjax.io.exchange.import_map import ImportMap
from snrmjax.io.laboratory.contents import NumberTable
from snrmjax.io.laboratory.physical_units import level_reference, unit_meaning
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError


def with_stated_references(
    table: NumberTable, mapping: ImportMap, file: str
) -> tuple[NumberTable, ImportMap, list[Fact]]:
    """A table with levels converted to amplitudes, a map with their units, and notes.

    A level L re R is the amplitude R·10^(L/20). The reference is that of the file, or one
    stated by the map in place of a unit, as "dB re 1e-9 m/s", which takes precedence.
    Raises `ValueError` for a level used as an amplitude without a reference, and for a reference
    stated for a column that is not in dB.
    """
    responses, stated = [], dict[str, str]()
    imaginary = [one.channel for one in mapping.responses if one.imaginary]
    for response in mapping.responses:
        stated[response.channel] = response.unit
        reference = level_reference(response.unit)
        responses.append(response._replace(unit=reference) if reference else response)
    base = mapping.base
    if mapping.force:
        stated[mapping.force] = mapping.force_unit
    if mapping.base_channel:
        stated[mapping.base_channel] = mapping.base_motion.unit
        if reference := level_reference(mapping.base_motion.unit):
            base = f"{mapping.base_channel}:{mapping.base_motion.quantity}:{reference}"
    columns: dict[str, np.ndarray] = dict(table.columns)
    units = dict(table.units)
    notes = []
    for name, unit_of_map in stated.items():
        unit_of_file, values = units.get(name, ""), columns.get(name)
        of_file, of_map = level_reference(unit_of_file), level_reference(unit_of_map)
        if values is None or (of_file is None and of_map is None):
            continue
        if of_map is None and unit_of_map:
            of_volts = bool(of_file) and unit_meaning(of_file).dimension == "voltage"
            which = " (the amplitude that 1 V stands for)" if of_volts else ""
            raise InputError(
                f"{name} of {file} is in {unit_of_file}, not in {unit_of_map}: state the reference "
                f"of the level in place of its unit, as 'dB re 1 {unit_of_map}'{which}."
            )
        if not (of_map or of_file):
            raise InputError(
                f"{name} of {file} is a level in dB without a reference: state it in place of its "
                f"unit, as {name}:velocity:'dB re 1 m/s' (of a force: 'dB re 1 N')."
            )
        if unit_of_file and of_file is None:
            raise InputError(
                f"{name} of {file} is in {unit_of_file} by the file, but {unit_of_map} is stated: "
                "which of both is right?"
            )
        if np.iscomplexobj(values) or name in imaginary:
            raise InputError(
                f"{name} of {file} has real and imaginary parts, so it cannot be a level in "
                f"{unit_of_map or unit_of_file}."
            )
        columns[name] = amplitude_of_level(values)
        units[name] = of_map or of_file or ""
        notes.append(Fact("level_as_amplitude", name=name, unit=unit_of_map or unit_of_file))
    mapping = mapping._replace(
        responses=tuple(responses),
        base=base,
        force_unit=(mapping.force and level_reference(mapping.force_unit)) or mapping.force_unit,
    )
    return table._replace(columns=columns, units=units), mapping, notes


def amplitude_of_level(level: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
    """Amplitude ratios to the reference, from levels in dB.

    >>> amplitude_of_level(np.array([20.0, -40.0])).tolist()
    [10.0, 0.01]
    """
    return np.power(10.0, np.asarray(level, dtype=float) / 20)
