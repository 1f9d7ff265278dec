"""Functions (data sets 58) gathered: time records, frequency responses, spectra."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from snrmjax.io.laboratory.contents import NumberTable, number_table
from snrmjax.io.laboratory.uff.abscissa import abscissa, even_abscissa
from snrmjax.io.laboratory.uff.axis_units import UnitSystem, axis_unit
from snrmjax.io.laboratory.uff.data_sets import direction_of, stated
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses, frequency_responses
from snrmjax.measure.recordings.time_recording import TimeRecording, time_recording

_HERTZ = 2 * np.pi
_TIME, _RESPONSE, _COHERENCE = 1, (4, 5), 6
_Function = Mapping[str, Any]


class Functions(NamedTuple):
    """What the functions of a file are."""

    recordings: tuple[TimeRecording, ...]
    responses: tuple[FrequencyResponses, ...]
    levels: tuple[float, ...]
    tables: tuple[NumberTable, ...]
    notes: tuple[str, ...]


def read_functions(sets: Sequence[_Function], units: UnitSystem, file: str) -> Functions:
    """Functions that belong together by abscissa and level (z axis), as what they are."""
    notes: list[str] = []
    recordings: list[TimeRecording] = []
    responses: list[FrequencyResponses] = []
    levels: list[float] = []
    tables: list[NumberTable] = []
    times = [one for one in sets if one["func_type"] == _TIME]
    for group in _grouped(times):
        found = _recording(group, units, notes)
        if found is None:
            tables.append(_table(group, f"uneven record {len(tables) + 1}", units, notes, "time"))
        else:
            recordings.append(found)
    others = [one for one in sets if one["func_type"] not in (_TIME, _COHERENCE, *_RESPONSE)]
    lines = [one for one in sets if one["func_type"] in (_COHERENCE, *_RESPONSE)]
    for group in _grouped(lines):
        level = float(group[0]["z_axis_value"])
        for part in _without_doubles(group):
            x = abscissa(part[0])
            if not any(one["func_type"] in _RESPONSE for one in part):
                notes.append("a coherence without its frequency response is not read.")
            elif np.all(np.diff(x) > 0) and x[0] >= 0:
                responses.append(_responses(part, x, units, file, notes))
                levels.append(level if level else np.nan)
            else:
                notes.append("frequency responses whose frequencies do not rise are in a table.")
                tables.append(_table(part, f"responses {len(tables) + 1}", units, notes))
    for group in _grouped(others):
        name = f"functions {len(tables) + 1}"
        tables.append(_table(group, name, units, notes))
    return Functions(
        tuple(recordings), tuple(responses), tuple(levels), tuple(tables), tuple(notes)
    )


def _grouped(sets: Sequence[_Function]) -> list[list[_Function]]:
    """Functions with the same abscissa and z value together."""
    groups: list[list[_Function]] = []
    for one in sets:
        for group in groups:
            alike = one["z_axis_value"] == group[0]["z_axis_value"]
            if alike and np.array_equal(one["x"], group[0]["x"]):
                group.append(one)
                break
        else:
            groups.append([one])
    return groups


def _place(one: _Function, side: str) -> str:
    """Where a function was measured, in words; of a record without a place, what its axis says."""
    entity = stated(one.get(f"{side}_ent_name", ""))
    node = one.get(f"{side}_node", 0)
    point = f"{node}{direction_of(one.get(f'{side}_dir', 0))}"
    if entity and entity.lower() != point:
        return entity if not node else f"{entity}:{point}"
    label = stated(one.get("ordinate_axis_lab", "")) if one["func_type"] == _TIME else ""
    return label if label and not node else point


def _channel(one: _Function, side: str, axis: str, units: UnitSystem, notes: list[str]) -> Channel:
    """The channel of one side of a function."""
    unit = axis_unit(one, axis, units)
    if unit.note:
        notes.append(unit.note)
    node = one.get(f"{side}_node", 0)
    return Channel(
        _place(one, side),
        unit.quantity,
        unit.unit,
        unit.calibration,
        str(node) if node else "",
        direction_of(one.get(f"{side}_dir", 0)),
    )


def _unique(channels: Sequence[Channel]) -> list[Channel]:
    """Channels with names of their own: doubled ones get the quantity, then a number."""

    def doubled(of: Sequence[Channel]) -> set[str]:
        names = [one.name for one in of]
        return {name for name in names if names.count(name) > 1}

    again = doubled(channels)
    named = [
        one._replace(name=f"{one.name} {one.quantity}") if one.name in again else one
        for one in channels
    ]
    again = doubled(named)
    return [
        one._replace(name=f"{one.name} #{k + 1}") if one.name in again else one
        for k, one in enumerate(named)
    ]


def _recording(
    group: Sequence[_Function], units: UnitSystem, notes: list[str]
) -> TimeRecording | None:
    """Time records of one time axis, or None where it is uneven."""
    even = even_abscissa(group[0])
    if even is None:
        notes.append("a time record with uneven steps is in a table.")
        return None
    channels = _unique([_channel(one, "rsp", "ordinate", units, notes) for one in group])
    if any(np.iscomplexobj(one["data"]) for one in group):
        raise ValueError("a time record of complex numbers is no time record.")
    described = [stated(one["id1"]) for one in group]
    said = [
        f"channel {channel.name}: {text}."
        for channel, text in zip(channels, described, strict=True)
        if text
    ]
    if even.note:
        said.insert(0, even.note)
    return time_recording(
        np.stack([one["data"] for one in group]),
        channels,
        even.rate,
        start_time=even.first,
        name=described[0] if len(set(described)) == 1 else "",
        notes=said if len(said) <= 20 else said[:20],
    )


def _without_doubles(group: Sequence[_Function]) -> list[list[_Function]]:
    """Runs of functions in which no pair of response and reference stands twice."""
    parts: list[list[_Function]] = [[]]
    seen: set[tuple] = set()
    for one in group:
        key = (
            *(one["func_type"] == _COHERENCE, _place(one, "rsp"), _place(one, "ref")),
            one.get("ordinate_spec_data_type"),
        )
        if key in seen:
            parts.append([])
            seen = set()
        seen.add(key)
        parts[-1].append(one)
    return parts


def _responses(
    part: Sequence[_Function],
    x: np.ndarray,
    units: UnitSystem,
    file: str,
    notes: list[str],
) -> FrequencyResponses:
    """Frequency responses of one frequency axis with their coherences."""
    measured = [one for one in part if one["func_type"] in _RESPONSE]
    outputs = [_channel(one, "rsp", "ordinate", units, notes) for one in measured]
    inputs = [_channel(one, "ref", "orddenom", units, notes) for one in measured]
    rows = {key: k for k, key in enumerate(dict.fromkeys(outputs))}
    columns = {key: k for k, key in enumerate(dict.fromkeys(inputs))}
    values = np.full((len(rows), len(columns), x.size), np.nan, dtype=complex)
    coherence = np.full(values.shape, np.nan)
    for one, output, given in zip(measured, outputs, inputs, strict=True):
        values[rows[output], columns[given]] = one["data"]
    pairs = {
        (_place(one, "rsp"), _place(one, "ref")): one["data"].real
        for one in part
        if one["func_type"] == _COHERENCE
    }
    for one, output, given in zip(measured, outputs, inputs, strict=True):
        told = pairs.get((_place(one, "rsp"), _place(one, "ref")))
        if told is not None:
            coherence[rows[output], columns[given]] = told
    even = even_abscissa(measured[0])
    return frequency_responses(
        x * _HERTZ,
        values,
        _unique(list(rows)),
        _unique(list(columns)),
        coherence=coherence,
        name=stated(measured[0]["id1"]) or file,
        notes=[even.note] if even is not None and even.note else [],
    )


def _column(one: _Function, name: str) -> str:
    """The name of a function in a table."""
    if one["func_type"] == _COHERENCE:
        return f"coherence of {name} over {_place(one, 'ref')}"
    return f"{name} over {_place(one, 'ref')}" if one["func_type"] in _RESPONSE else name


def _table(
    group: Sequence[_Function],
    name: str,
    units: UnitSystem,
    notes: list[str],
    first: str = "frequency",
) -> NumberTable:
    """Functions of one abscissa as columns beside it."""
    kind = "time" if group[0].get("abscissa_spec_data_type") == 17 else first
    channels = [_channel(one, "rsp", "ordinate", units, notes) for one in group]
    named = _unique(
        [
            channel._replace(name=_column(one, channel.name))
            for one, channel in zip(group, channels, strict=True)
        ]
    )
    unit = stated(group[0].get("abscissa_axis_units_lab", "")) or ("s" if kind == "time" else "Hz")
    columns = {kind: abscissa(group[0])}
    known = {kind: unit}
    for one, channel in zip(group, named, strict=True):
        key = channel.name if channel.name not in columns else f"{channel.name} value"
        columns[key] = one["data"]
        if channel.unit:
            known[key] = channel.unit
    if group[0]["z_axis_value"]:
        columns["z_axis_value"] = np.full(len(group[0]["x"]), float(group[0]["z_axis_value"]))
    return number_table(name, columns, known)
