"""Units and quantities of an import, from the map or the file; decibels become amplitudes."""

import re
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.io.exchange.import_map import Assumptions, ImportMap
from snrmjax.io.laboratory.contents import NumberTable
from snrmjax.io.laboratory.physical_units import (
    UnitMeaning,
    amplitude_kind,
    level_reference,
    meaning_or_none,
    unit_meaning,
)
from snrmjax.measure.recordings.channels import DERIVATIVE, SI_UNIT, Quantity
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.names import near_miss
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

AMPLITUDE_FACTORS = {"peak": 1.0, "": 1.0, "rms": np.sqrt(2.0), "peak_to_peak": 0.5}
"""Factors to peak amplitude for sinusoidal signals."""


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


class Force(NamedTuple):
    """Conversion of a force, drive voltage or base `motion` to SI."""

    factor: float
    is_voltage: bool
    unit: str
    motion: Quantity | None = None  # of a base, in place of a force

    @property
    def dimension(self) -> str:
        """Force, voltage, or the quantity of the base motion."""
        return self.motion or ("voltage" if self.is_voltage else "force")

    def acceleration(
        self, omega: Float[np.ndarray, " row"]
    ) -> Complex[np.ndarray, " row"] | Float[np.ndarray, " row"]:
        """Factor from base-motion phasors to acceleration, (iω)ⁿ; 1 for a force."""
        if self.motion is None:
            return np.ones(len(omega))
        return (1j * omega) ** (2 - DERIVATIVE[self.motion])


def require_name(option: str, name: str, known: Iterable[str], what: str, file: str) -> None:
    """Raise `ValueError` where an option names something that the file lacks; `what` in plural."""
    names = list(known)
    if name not in names:
        near = near_miss(name, names)
        raise InputError(
            f"{option} names {name!r}, but {file} has the {what} {', '.join(names)}"
            f"{f' (did you mean {near}?)' if near else ''}."
        )


_IN_A_NAME = re.compile(
    r"(?<![0-9.,])([0-9]+(?:[.,][0-9]+)?)[ _-]?((?:k|m|u|µ)?N|lbf|m?V|m?g|m_s2|mm?)(?![A-Za-z0-9])"
)


def amplitude_of_name(file: str) -> tuple[float, str] | None:
    """Amplitude and unit in a file name, as 0.4 N in "sine_0.4N_up.txt"; None without exactly one.

    >>> amplitude_of_name("sine_0,4N_up.txt"), amplitude_of_name("run 2.csv")
    ((0.4, 'N'), None)
    """
    matches = {(match[1], match[2]) for match in _IN_A_NAME.finditer(file.rsplit(".", 1)[0])}
    if len(matches) != 1:
        return None
    number, unit = matches.pop()
    return float(number.replace(",", ".")), unit.replace("m_s2", "m/s^2")


def force_meaning(mapping: ImportMap, file_unit: str, what: str) -> Force:
    """The unit of the force. Raises `ValueError` with a question where it is not stated."""
    if mapping.force_unit and level_reference(file_unit) is not None:
        raise InputError(f"{what} is a level in {file_unit}, not in {mapping.force_unit}.")
    unit = mapping.force_unit or file_unit
    if not unit:
        raise InputError(
            f"in which unit is {what}? State it: --force-unit N (or lbf, V for a drive voltage)."
        )
    meaning = _meaning(unit, "--force-unit")
    if meaning.dimension not in ("force", "voltage"):
        raise InputError(
            f"{what} must be a force or a voltage, but its unit {unit} is of {meaning.dimension}: "
            "--force names another channel, --force-unit another unit, and --base the motion of a "
            "base."
        )
    return Force(meaning.factor, meaning.dimension == "voltage", unit)


def load_meaning(mapping: ImportMap, file_unit: str, what: str) -> Force:
    """Quantity and unit of the excitation: a force, a voltage or a base motion.

    Raises `ValueError` with a question where they are not stated.
    """
    if not mapping.base:
        return force_meaning(mapping, file_unit, what)
    stated = mapping.base_motion
    quantity, factor, unit = motion_meaning(
        stated.quantity, stated.unit, file_unit, stated.channel, option="--base"
    )
    return Force(factor, False, unit, quantity)


def motion_meaning(
    quantity: str,
    unit: str,
    file_unit: str,
    channel: str,
    *,
    over: Force | None = None,
    option: str = "--response",
) -> tuple[Quantity, float, str]:
    """Quantity, factor into SI and unit of a response.

    Arguments: `over` is the force (or base motion) that the response is divided by, in its own unit
    unless the response's unit states it, as "m/s/N" or "g/g".
    Raises `ValueError` with a question where they are not stated or contradict one another.
    """
    if unit and level_reference(file_unit) is not None:
        raise InputError(
            f"{channel} is a level in {file_unit}, not in {unit}: give the response itself."
        )
    stated = unit or file_unit
    if not stated:
        of: Quantity = next((known for known in SI_UNIT if known == quantity), "velocity")
        example = f"{channel}:{of}:{SI_UNIT[of]}"
        others = ", or --unit for all responses" if option == "--response" else ""
        raise InputError(f"in which unit is {channel}? State it: {option} {example}{others}.")
    stated_meaning = meaning_or_none(stated)
    is_per_force = stated_meaning is not None and stated_meaning.per_force
    if is_per_force and (over is None or over.is_voltage or over.motion is not None):
        way = "give --over-force, with the force's column or amplitude in a unit of force"
        if over is not None:
            way = f"the divisor of --over-force is in {over.unit}, which is no unit of force"
        raise InputError(f"{channel} is a response per force by its unit {stated}: {way}.")
    below = 1.0 if over is None or is_per_force else over.factor
    if over is not None and not is_per_force and "/" in stated:
        numerator, _, divisor = (part.strip("() ") for part in stated.rpartition("/"))
        divisor_meaning = meaning_or_none(divisor)
        if divisor_meaning is not None and divisor_meaning.dimension == over.dimension:
            stated, below = numerator, divisor_meaning.factor
    meaning = _meaning(stated, "--unit")
    if meaning.per_volt:
        raise InputError(
            f"{stated} of {channel} is a sensitivity: give the unit of the channel's numbers, as "
            "--unit g, or for volts the motion per volt, as --unit '9.8 m/s^2'."
        )
    if meaning.dimension not in ("displacement", "velocity", "acceleration"):
        raise InputError(
            f"{channel} must be a displacement, velocity or acceleration, but its unit {stated} is "
            f"of {meaning.dimension}: {'give' if unit else '--unit states'} the motion that the "
            "number 1 means (a sensor of 100 mV/g: --unit '10 g' per volt)."
        )
    if quantity and quantity != meaning.dimension:
        raise InputError(
            f"{channel} is called {quantity} ({option}), but its unit {stated} is of "
            f"{meaning.dimension}: which of both is right?"
        )
    return meaning.quantity, meaning.factor / below, stated


def amplitude_factor(mapping: ImportMap, units: Mapping[str, str], assumed: Assumptions) -> float:
    """Factor to peak amplitudes: as stated, else by units and names, else 1.

    Arguments: `units` of the columns by their names.
    """
    of_units = {amplitude_kind(unit) for unit in units.values()} - {""}
    all_kinds = {amplitude_kind(unit) or amplitude_kind(name) for name, unit in units.items()}
    kinds = all_kinds - {""}
    if mapping.amplitude:
        if of_units - {mapping.amplitude}:
            raise InputError(
                f"--amplitude states {mapping.amplitude}, but a unit states {min(of_units)}: "
                "which is right?"
            )
        return float(AMPLITUDE_FACTORS[mapping.amplitude])
    if len(kinds) > 1 or (kinds and "" in all_kinds and kinds != {"peak"}):
        raise InputError(
            f"names and units state {' and '.join(sorted(kinds))} for some columns but not for "
            "others: which holds for all? --amplitude peak, rms or peak_to_peak."
        )
    kind = next(iter(kinds), "peak")
    reason = Fact("units_say_so") if of_units else Fact("by_names_of_columns")
    assumed.add("amplitude", reason if kinds else Fact("nothing_is_said"), kind)
    return float(AMPLITUDE_FACTORS[kind])


def frequency_in_rad(
    values: Float[np.ndarray, " row"], mapping: ImportMap, file_unit: str, assumed: Assumptions
) -> Float[np.ndarray, " row"]:
    """Frequencies in rad/s, from hertz unless stated otherwise."""
    unit = mapping.frequency_unit or file_unit
    if not unit:
        if mapping.frequency.lower().rsplit(".", 1)[-1] in ("w", "omega", "om"):
            raise InputError(
                f"is {mapping.frequency} in Hz or in rad/s? State it: --frequency-unit Hz or rad/s."
            )
        assumed.add("frequency_unit", Fact("nothing_is_said"), "Hz")
        return values * HERTZ
    assumed.unit("frequency_unit", mapping.frequency_unit, file_unit)
    meaning = _meaning(unit, "--frequency-unit")
    if meaning.dimension != "frequency":
        way = "--frequency-unit is Hz or rad/s" if mapping.frequency_unit else ""
        raise InputError(
            f"{mapping.frequency} must be a frequency, but its unit {unit} is of "
            f"{meaning.dimension}: {way or '--frequency names another column'}."
        )
    return values * meaning.factor


def phase_in_rad(
    values: Float[np.ndarray, "*row"],
    column: str,
    mapping: ImportMap,
    file_unit: str,
    assumed: Assumptions,
) -> Float[np.ndarray, "*row"]:
    """Phases in rad, positive where the response leads.

    Raises `ValueError` with a question where both degrees and radians are possible.
    """
    stated = unit_meaning(file_unit) if file_unit else None
    if stated and stated.dimension != "angle" and not mapping.phase_unit:
        raise InputError(
            f"{column} must be an angle, but its unit is {file_unit}: --phase names another "
            "column, --phase-unit its unit."
        )
    of_file = (
        "" if not stated or stated.dimension != "angle" else "rad" if stated.factor == 1 else "deg"
    )
    unit = mapping.phase_unit or of_file
    assumed.unit("phase_unit", mapping.phase_unit, of_file)
    if not unit:
        if not np.nanmax(np.abs(values), initial=0.0) > 2 * HERTZ:
            raise InputError(f"is {column} in degrees or in radians? --phase-unit deg or rad.")
        unit = "deg"
        assumed.add("phase_unit", Fact("phase_beyond_two_turns", column=column), unit)
    if not mapping.phase_sign:
        assumed.add("phase_sign", Fact("phase_ahead_of_the_force"), "lead")
    sign = -1.0 if mapping.phase_sign == "lag" else 1.0
    return sign * (np.radians(values) if unit == "deg" else values)


def _meaning(unit: str, option: str) -> UnitMeaning:
    try:
        return unit_meaning(unit)
    except InputError as error:
        raise InputError(f"{str(error).rstrip('.')}: {option} states it.") from error
