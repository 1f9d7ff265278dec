"""Universal files: functions (data sets 58) combined into records, responses and tables."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from snrmjax.io.laboratory.contents import LaboratoryFile, NumberTable
from snrmjax.io.laboratory.physical_units import is_per_force
from snrmjax.io.laboratory.printed_times import odd_step, resampled
from snrmjax.io.laboratory.uff.axis_units import (
    EvenAbscissa,
    UnitSystem,
    abscissa,
    axis_unit,
    even_abscissa,
    in_si,
    other_abscissa,
    unit_system,
)
from snrmjax.io.laboratory.uff.data_sets import direction_of, read_data_sets, stated
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses, frequency_responses
from snrmjax.measure.recordings.time_recording import TimeRecording, time_recording
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_MOST_NOTES = 20
_TIME, _RESPONSE, _COHERENCE = 1, (4, 5), 6
_Function = Mapping[str, Any]


class _Source(NamedTuple):
    """File name and units common to all functions, and notes."""

    file: str
    units: UnitSystem
    notes: list[Fact]

    def channel(self, function: _Function, side: str, axis: str) -> Channel:
        """The channel of one side of a function."""
        unit = axis_unit(function, axis, self.units)
        self.notes.extend(unit.notes)
        node = function.get(f"{side}_node", 0)
        return Channel(
            _point_name(function, side),
            unit.quantity,
            unit.unit,
            unit.calibration,
            str(node) if node else "",
            direction_of(function.get(f"{side}_dir", 0)),
        )


def read_uff(path: Path) -> LaboratoryFile:
    """A universal file, its functions grouped into records, responses and tables.

    Raises `ValueError` as `read_laboratory_file` does.
    """
    sets = read_data_sets(path)
    units = unit_system(sets.of_type(164))
    notes = [*sets.notes]
    measured = [in_si(function, notes) for function in sets.of_type(58)]
    source = _Source(path.name, units, [*notes, *(units.notes if measured else ())])
    recordings: list[TimeRecording] = []
    responses: list[FrequencyResponses] = []
    levels: list[float] = []
    tables: list[NumberTable] = []
    for group in _grouped(measured, _TIME):
        record = _recording(group, source)
        if record is None:
            tables.append(_table(group, f"uneven record {len(tables) + 1}", source, "time"))
        else:
            recordings.append(record)
    for group in _grouped(measured, *_RESPONSE, _COHERENCE):
        level = float(group[0]["z_axis_value"])
        for part in map(_rising, _without_doubles(group)):
            x = abscissa(part[0])
            other = other_abscissa(part[0])
            if not any(function["func_type"] in _RESPONSE for function in part):
                source.notes.append(Fact("coherence_alone"))
            elif other:
                source.notes.append(Fact("responses_over", what=other))
                tables.append(_table(part, f"responses {len(tables) + 1}", source, "abscissa"))
            elif np.all(np.diff(x) > 0) and x[0] >= 0:
                responses.append(_responses(part, x, source))
                levels.append(level if level else np.nan)
            else:
                source.notes.append(Fact("frequencies_do_not_rise"))
                tables.append(_table(part, f"responses {len(tables) + 1}", source))
    others = {function["func_type"] for function in measured} - {_TIME, _COHERENCE, *_RESPONSE}
    for group in _grouped(measured, *others):
        tables.append(_table(group, f"functions {len(tables) + 1}", source))
    models = [stated(function.get("model_name", "")) for function in sets.of_type(151)]
    source.notes.extend(Fact("model_named", name=name) for name in models if name)
    return LaboratoryFile(
        path.name,
        tuple(recordings),
        tuple(responses),
        tuple(tables),
        tuple(dict.fromkeys(source.notes)),
        tuple(levels),
    )


def _grouped(sets: Sequence[_Function], *kinds: int) -> list[list[_Function]]:
    """Functions of some kinds, grouped by equal abscissa and z value."""
    groups: list[list[_Function]] = []
    for function in (each for each in sets if each["func_type"] in kinds):
        for group in groups:
            alike = function["z_axis_value"] == group[0]["z_axis_value"]
            if alike and np.array_equal(function["x"], group[0]["x"]):
                group.append(function)
                break
        else:
            groups.append([function])
    return groups


def _point_name(function: _Function, side: str) -> str:
    """Name of the measurement point of a function; of a record without one, its axis label."""
    entity = stated(function.get(f"{side}_ent_name", ""))
    node = function.get(f"{side}_node", 0)
    point = f"{node}{direction_of(function.get(f'{side}_dir', 0))}"
    if entity and entity.lower() != point:
        return entity if not node else f"{entity}:{point}"
    label = stated(function.get("ordinate_axis_lab", "")) if function["func_type"] == _TIME else ""
    return label if label and not node else point


def _unique(channels: Sequence[Channel]) -> list[Channel]:
    """Channels with unique names: duplicates get the quantity, then a number."""
    named = list(channels)
    for ending in ("{channel.quantity}", "#{number}"):
        names = [channel.name for channel in named]
        named = [
            channel._replace(name=f"{channel.name} {ending.format(channel=channel, number=k)}")
            if names.count(channel.name) > 1
            else channel
            for k, channel in enumerate(named, 1)
        ]
    return named


def _recording(group: Sequence[_Function], source: _Source) -> TimeRecording | None:
    """A time record of functions on one time axis; None, with a note, where it is uneven."""
    if any(np.iscomplexobj(function["data"]) for function in group):
        raise InputError("a time record cannot have complex numbers.")
    values = np.stack([function["data"] for function in group])
    even = even_abscissa(group[0])
    if even is None:
        time = np.asarray(group[0]["x"], dtype=float)
        found = resampled(time, values, "time")
        if found is None:
            source.notes.append(odd_step(time, "time"))
            return None
        source.notes.append(found.note)
        values, even = found.values, EvenAbscissa(found.start, found.rate, (found.note,))
    channels = _unique([source.channel(function, "rsp", "ordinate") for function in group])
    described = [stated(function["id1"]) for function in group]
    descriptions = [
        Fact("channel_described", name=channel.name, text=text)
        for channel, text in zip(channels, described, strict=True)
        if text
    ]
    return time_recording(
        values,
        channels,
        even.rate,
        start_time=even.first,
        name=described[0] if len(set(described)) == 1 else "",
        notes=[*even.notes, *descriptions][:_MOST_NOTES],
    )


def _rising(part: list[_Function]) -> list[_Function]:
    """Functions of a falling abscissa in the order of a rising one."""
    if not np.all(np.diff(abscissa(part[0])) < 0):
        return part
    return [
        {**function, "abscissa_spacing": 0} | {key: function[key][::-1] for key in ("x", "data")}
        for function in part
    ]


def _without_doubles(group: Sequence[_Function]) -> list[list[_Function]]:
    """Split functions so that no pair of response and reference is repeated."""
    parts: list[list[_Function]] = [[]]
    pairs: set[tuple] = set()
    for function in group:
        key = (
            *(
                function["func_type"] == _COHERENCE,
                _point_name(function, "rsp"),
                _point_name(function, "ref"),
            ),
            function.get("ordinate_spec_data_type"),
        )
        if key in pairs:
            parts.append([])
            pairs = set()
        pairs.add(key)
        parts[-1].append(function)
    return parts


def _responses(part: Sequence[_Function], x: np.ndarray, source: _Source) -> FrequencyResponses:
    """Frequency responses of one frequency axis with their coherences."""
    measured = [function for function in part if function["func_type"] in _RESPONSE]
    outputs = [source.channel(function, "rsp", "ordinate") for function in measured]
    inputs = [source.channel(function, "ref", "orddenom") for function in measured]
    rows = {key: k for k, key in enumerate(dict.fromkeys(outputs))}
    columns = {key: k for k, key in enumerate(dict.fromkeys(inputs))}
    values = np.full((len(rows), len(columns), x.size), np.nan, dtype=complex)
    coherence = np.full(values.shape, np.nan)
    coherent = {
        (_point_name(function, "rsp"), _point_name(function, "ref")): function["data"].real
        for function in part
        if function["func_type"] == _COHERENCE
    }
    for function, output, given in zip(measured, outputs, inputs, strict=True):
        index = rows[output], columns[given]
        values[index] = function["data"]
        coherence[index] = coherent.get(
            (_point_name(function, "rsp"), _point_name(function, "ref")), coherence[index]
        )
    even = even_abscissa(measured[0])
    return frequency_responses(
        x * HERTZ,
        values,
        _unique(list(rows)),
        _unique(list(columns)),
        coherence=coherence,
        name=stated(measured[0]["id1"]) or source.file,
        notes=even.notes if even is not None else [],
    )


def _column(function: _Function, name: str) -> str:
    """The name of a function in a table."""
    if function["func_type"] == _COHERENCE:
        return f"coherence of {name} over {_point_name(function, 'ref')}"
    return (
        f"{name} over {_point_name(function, 'ref')}"
        if function["func_type"] in _RESPONSE
        else name
    )


def _in_one_unit(values: np.ndarray, channel: Channel) -> tuple[np.ndarray, str]:
    """Values of a channel and their unit: SI where only the file's system of units states it."""
    if channel.unit or channel.quantity == "unknown":
        return values, channel.unit
    return values * channel.calibration, channel.si_unit


def _table(
    group: Sequence[_Function], name: str, source: _Source, first: str = "frequency"
) -> NumberTable:
    """Functions of one abscissa as columns of a table."""
    kind = "time" if group[0].get("abscissa_spec_data_type") == 17 else first
    channels = [source.channel(function, "rsp", "ordinate") for function in group]
    named = _unique(
        [
            channel._replace(name=_column(function, channel.name))
            for function, channel in zip(group, channels, strict=True)
        ]
    )
    known = {"time": "s", "frequency": "Hz"}.get(kind, "")
    unit = stated(group[0].get("abscissa_axis_units_lab", "")) or known
    columns, units = {kind: abscissa(group[0])}, {kind: unit} if unit else {}
    for function, channel in zip(group, named, strict=True):
        key = channel.name if channel.name not in columns else f"{channel.name} value"
        columns[key], unit = _in_one_unit(function["data"], channel)
        if function["func_type"] in _RESPONSE and unit and not is_per_force(unit):
            reference = source.channel(function, "ref", "orddenom")
            if reference.quantity == "force":
                _, of_reference = _in_one_unit(columns[key], reference)
                if not reference.unit:
                    columns[key] = columns[key] / reference.calibration
                unit = f"({unit})/{of_reference}"
        units |= {key: unit} if unit else {}
    if level := group[0]["z_axis_value"]:
        columns["z_axis_value"] = np.full(len(group[0]["x"]), float(level))
    return NumberTable(name, columns, units)
