"""Steady states, or records of a decay, of a laboratory's time records."""

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

ENDINGS = {"velocity": "m_s", "acceleration": "m_s2", "displacement": "m"}
"""Units of motions in names of columns."""

_FEW_DIGITS = 0.02  # relative: two digits of a step
_DIRECT: dict[str, Levels] = {"force": "force", "drive": "drive", "runs": "runs"}


def ask_for_rate(notes: Iterable[Fact | str], rate: float, file: str) -> None:
    """Raise `ValueError` where a file's few digits leave its sampling rate open.

    Arguments: `rate` (Hz) is what is stated instead, or 0.
    """
    for note in notes:
        if not rate and isinstance(note, Fact) and note.kind == "rate_left_open":
            raise ValueError(
                f"which sampling rate has {file}? Its step of {note['step']} s has few digits, so "
                f"that frequencies may be off by {note['off']:.1g} %. Say so by "
                f"`--rate {note['rate']:g}`, if that is it."
            )


def at_stated_rate(record: TimeRecording, rate: float, file: str) -> TimeRecording:
    """A record with the sampling rate (Hz) that is stated, if one is; 0: its own.

    Raises `ValueError` for one that a few digits of the file's own do not explain.
    """
    own = record.sampling_rate
    if rate and abs(rate / own - 1) > _FEW_DIGITS:
        raise ValueError(
            f"--rate says {rate:g} Hz, but {file} {own:g} Hz: which of both is right? Few digits "
            "of the file do not explain that much."
        )
    return dataclasses.replace(record, sampling_rate=rate) if rate else record


def mapped_record(
    record: TimeRecording, mapping: ImportMap, file: str, assumed: Assumptions
) -> tuple[TimeRecording, ImportMap]:
    """The channels of a map with their quantities and units, and the map with what was found.

    Raises `ValueError` with a question that names the option for what cannot be told.
    """
    if not mapping.responses:
        names = ", ".join(record.channel_names)
        raise ValueError(
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
        raise ValueError(
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
            raise ValueError(
                f"{response.channel} of {file} is named as the response and as what drives the "
                "structure: one channel is one of the two."
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
    """Steady states of a record of steps or of sweeps, or None for one that stays a record.

    Returns them, the map with what was found, notes, and how many of the steps were used.
    Raises `ValueError` with a question that names the option for what cannot be told.
    """
    if mapping.record in ("decay", "broadband"):
        return None, mapping, (), None
    if not mapping.load:
        raise ValueError(
            f"which channel of {file} is the force? --force CHANNEL names it, of "
            f"{', '.join(record.channel_names)}; --base CHANNEL:acceleration is the motion of a "
            "base, and --record decay says that there is none."
        )
    if mapping.level and mapping.level not in (*_DIRECT, "auto", "file"):
        raise ValueError(
            f"--level must be one of force, drive, runs or file for time records, but is "
            f"{mapping.level!r}."
        )
    level = _DIRECT.get(mapping.level, "auto")
    said: dict[str, Any] = {
        "level": level,
        "sensors": [response.sensor for response in mapping.responses],
        "drive": mapping.drive or None,
        "is_base": bool(mapping.base),
    }
    read = record, mapping.load, [response.channel for response in mapping.responses]
    failed = []
    for kind in (mapping.record,) if mapping.record else ("steps", "sweep"):
        try:
            if kind == "steps":
                steps = stepped_sine_states(*read, **said)
                states, notes, counts = steps.states, steps.notes, steps.counts
            else:
                swept = sweep_states(*read, **said)
                states, notes, counts = swept.states, swept.notes, None
        except ValueError as error:
            failed.append(f"{kind}: {error}")
            continue
        if not mapping.record:
            assumed.add("record", Fact("record_recognised"), kind)
        if not mapping.level:
            assumed.add("level", Fact("levels_found", n=len(np.unique(states.level))))
        return states, mapping._replace(record=kind, level=mapping.level or level), notes, counts
    if mapping.record:
        raise ValueError(f"{file} does not read as {failed[0]}")
    raise ValueError(
        f"what is the record of {file}: --record steps, sweep, decay or broadband? It was read "
        f"neither as {' Nor as '.join(failed)}"
    )


def record_columns(record: TimeRecording, mapping: ImportMap) -> dict[str, Channel]:
    """Names of the columns of a record's table, with the channels that they hold, in SI."""
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
    except ValueError as error:
        raise ValueError(f"{option}: in {file} {error}") from error
