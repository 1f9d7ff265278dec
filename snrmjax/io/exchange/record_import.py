"""Import of time records, as steady states or as records."""

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np

from snrmjax.io.exchange.import_map import Assumptions, ImportMap, ResponseMap
from snrmjax.io.exchange.import_units import force_meaning, load_meaning, motion_meaning
from snrmjax.io.exchange.table_import import sensor_of
from snrmjax.measure.recordings.channels import Channel, channel_number
from snrmjax.measure.recordings.step_counts import StepCounts
from snrmjax.measure.recordings.stepped_sine import stepped_sine_states
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.recordings.velocity_states import Levels
from snrmjax.measure.states import SteadyStates
from snrmjax.measure.sweeps.slow_sweep import sweep_states
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

ENDINGS = {"velocity": "m_s", "acceleration": "m_s2", "displacement": "m"}
"""Unit suffixes of motion columns."""

_FEW_DIGITS = 0.02  # relative error of a time step with two digits
_DIRECT: dict[str, Levels] = {"force": "force", "drive": "drive", "runs": "runs"}


def ask_for_rate(notes: Iterable[Fact | str], rate: float, file: str) -> None:
    """Raise `ValueError` where too few digits leave the sampling rate undetermined.

    Arguments: `rate` (Hz) stated instead, or 0.
    """
    for note in notes:
        if not rate and isinstance(note, Fact) and note.kind == "rate_left_open":
            raise InputError(
                f"which sampling rate has {file}? Its step of {note['step']} s has few digits, "
                f"so that frequencies may be off by {note['off']:.1g} %. Confirm it by "
                f"`--rate {note['rate']:g}`, or state another."
            )


def at_stated_rate(record: TimeRecording, rate: float, file: str) -> TimeRecording:
    """A record with the stated sampling rate (Hz); 0 keeps its own.

    Raises `ValueError` for a difference larger than rounding of the file's time step explains.
    """
    own = record.sampling_rate
    if rate and abs(rate / own - 1) > _FEW_DIGITS:
        raise InputError(
            f"--rate states {rate:g} Hz, but {file} {own:g} Hz: which is right? Rounding of the "
            "file's time step does not explain that much."
        )
    return dataclasses.replace(record, sampling_rate=rate) if rate else record


def mapped_record(
    record: TimeRecording, mapping: ImportMap, file: str, assumed: Assumptions
) -> tuple[TimeRecording, ImportMap]:
    """The record with quantities and units of the map, and the completed map.

    Raises `ValueError` with a question that names the option for anything undetermined.
    """
    if not mapping.responses:
        names = ", ".join(record.channel_names)
        raise InputError(
            f"which channel of {file} is the response? --response CHANNEL:acceleration (or "
            f"velocity, displacement) names it, of {names}."
        )
    channels = list(record.channels)
    mapping = mapping.with_names({channel.name: channel.unit for channel in channels})
    if mapping.force:
        k = _number(record, mapping.force, file, "--force")
        old = channels[k]
        unit = mapping.force_unit or (old.unit if old.quantity in ("force", "voltage") else "")
        if not mapping.force_unit and not unit and old.quantity in ("force", "voltage"):
            unit = old.si_unit
        force = force_meaning(mapping, unit, f"{mapping.force} of {file}")
        channels[k] = old._replace(
            quantity="voltage" if force.is_voltage else "force",
            unit=force.unit,
            calibration=force.factor,
        )
        assumed.unit("force_unit", mapping.force_unit, unit)
    if mapping.base_amplitudes:
        raise InputError(
            f"--base must name the channel of the base's motion in the time records of {file}, not "
            f"a number, of {', '.join(record.channel_names)}."
        )
    if mapping.base:
        k = _number(record, mapping.base_channel, file, "--base")
        base = load_meaning(mapping, channels[k].unit, f"{mapping.base_channel} of {file}")
        channels[k] = channels[k]._replace(
            quantity=base.motion or "unknown", unit=base.unit, calibration=base.factor
        )
    filled = []
    for number, response in enumerate(mapping.responses):
        k = _number(record, response.channel, file, "--response")
        old = channels[k]
        if response.channel in (mapping.load, mapping.drive):
            raise InputError(
                f"{response.channel} of {file} is named both as the response and as the excitation."
            )
        if old.quantity == "voltage" and not response.unit:
            old = old._replace(unit="")
        assumed.unit(f"response {number + 1}.unit", response.unit, old.unit)
        quantity, factor, unit = motion_meaning(
            response.quantity, response.unit, old.unit, response.channel
        )
        channels[k] = old._replace(quantity=quantity, unit=unit, calibration=factor)
        sensor = sensor_of(response, mapping, number + 1, assumed)
        filled.append(ResponseMap(response.channel, quantity, response.unit, sensor))
    if mapping.drive:
        k = _number(record, mapping.drive, file, "--drive")
        if channels[k].quantity == "unknown":
            channels[k] = channels[k]._replace(quantity="voltage", unit="V", calibration=1.0)
    return (
        dataclasses.replace(record, channels=tuple(channels)),
        mapping._replace(responses=tuple(filled)),
    )


def import_record(
    record: TimeRecording, mapping: ImportMap, file: str, assumed: Assumptions
) -> tuple[SteadyStates | None, ImportMap, tuple[Fact | str, ...], StepCounts | None]:
    """Steady states of a record of steps or sweeps; None for a record kept as such.

    Returns them, the completed map, notes, and the numbers of steps used and left out.
    Raises `ValueError` with a question that names the option for anything undetermined.
    """
    if mapping.record in ("decay", "broadband"):
        return None, mapping, (), None
    if not mapping.load:
        raise InputError(
            f"which channel of {file} is the force? --force CHANNEL names it, of "
            f"{', '.join(record.channel_names)}; --base CHANNEL:acceleration is the motion of a "
            "base, and --record decay states that there is none."
        )
    if mapping.level and mapping.level not in (*_DIRECT, "auto", "file"):
        raise InputError(
            f"--level must be one of force, drive, runs or file for time records, but is "
            f"{mapping.level!r}."
        )
    level = _DIRECT.get(mapping.level, "auto")
    settings: dict[str, Any] = {
        "level": level,
        "sensors": [response.sensor for response in mapping.responses],
        "drive": mapping.drive or None,
        "is_base": bool(mapping.base),
    }
    signals = record, mapping.load, [response.channel for response in mapping.responses]
    failures = []
    for kind in (mapping.record,) if mapping.record else ("steps", "sweep"):
        try:
            if kind == "steps":
                steps = stepped_sine_states(*signals, **settings)
                states, notes, counts = steps.states, steps.notes, steps.counts
            else:
                swept = sweep_states(*signals, **settings)
                states, notes, counts = swept.states, swept.notes, None
        except InputError as error:
            failures.append(f"{kind}: {error}")
            continue
        if not mapping.record:
            assumed.add("record", Fact("record_recognised"), kind)
        if not mapping.level:
            assumed.add("level", Fact("levels_found", n=len(np.unique(states.level))))
        return states, mapping._replace(record=kind, level=mapping.level or level), notes, counts
    if mapping.record:
        raise InputError(f"{file} does not read as {failures[0]}")
    raise InputError(
        f"what is the record of {file}: --record steps, sweep, decay or broadband? It was read "
        f"neither as {' Nor as '.join(failures)}"
    )


def record_columns(record: TimeRecording, mapping: ImportMap) -> dict[str, Channel]:
    """Column names of a record's table in SI, with their channels."""
    columns: dict[str, Channel] = {}
    by_name = {response.name: response for response in record.channels}
    if mapping.force:
        force = by_name[mapping.force]
        columns["drive_v" if force.quantity == "voltage" else "force_n"] = force
    if mapping.base:
        base = by_name[mapping.base_channel]
        columns[f"base_{base.quantity}_{ENDINGS[base.quantity]}"] = base
    for response in mapping.responses:
        lead = "" if len(mapping.responses) == 1 else f"{response.sensor}."
        quantity = by_name[response.channel].quantity
        columns[f"{lead}{quantity}_{ENDINGS[quantity]}"] = by_name[response.channel]
    return columns


def _number(record: TimeRecording, name: str, file: str, option: str) -> int:
    try:
        return channel_number(record.channels, name)
    except InputError as error:
        raise InputError(f"{option}: in {file} {error}") from error
