"""Time records among named arrays: samples with a sampling rate, a step or an even time vector."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, get_args

import numpy as np

from snrmjax.io.laboratory.arrays.value_tree import (
    ArraySamples,
    ChannelPosition,
    Numbers,
    in_memory,
)
from snrmjax.io.laboratory.names import label_of, role_of
from snrmjax.io.laboratory.physical_units import channel_meaning, level_reference, meaning_or_none
from snrmjax.io.laboratory.printed_times import odd_step, rate_of_printed_times, resampled
from snrmjax.measure.recordings.channels import Channel, Quantity
from snrmjax.measure.recordings.time_recording import TimeRecording, time_recording
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

_SHORTEST = 64  # samples; shorter vectors with a time are a table
_MOST_CHANNELS = 4096
_LOOK = 4096  # samples checked of a long time vector, at each of three positions
_EVEN = 1e-3  # of a step: tolerance for rounding of an even time
_NAMES = frozenset({"channel", "channels", "channel_names", "names", "labels", "chan"})
_METADATA = {"unit": "unit", "quantity": "quantity", "point": "point", "direction": "direction"}
_METADATA |= {
    "units": "unit",
    "quantities": "quantity",
    "points": "point",
    "directions": "direction",
}


class StructRecord(NamedTuple):
    """The time record of a struct, the arrays used, and notes."""

    record: TimeRecording | None = None
    used: frozenset[str] = frozenset()
    notes: tuple[Fact, ...] = ()


class _Axis(NamedTuple):
    length: int | None  # of the time vector
    rate: float
    start: float
    used: tuple[str, ...]
    notes: tuple[Fact, ...] = ()


def recording_of(
    name: str, numbers: Mapping[str, Numbers], words: Mapping[str, Sequence[str]]
) -> StructRecord:
    """The time record of a struct, if it has one.

    Arguments: `words` are lists of text of the struct: names of channels, and lists called
    unit, quantity, point and direction.
    """
    found: _Axis | Fact | str | None = _time_axis(numbers)
    if isinstance(found, str):
        found, numbers = _resampled(found, numbers)
    if found is None or isinstance(found, Fact):
        return StructRecord(notes=() if found is None else (found,))
    axis = found
    sampled = {
        key: array
        for key, array in numbers.items()
        if key not in axis.used and not array.is_complex and len(array.dimensions) < 3
    }
    lengths = [max(array.shape, default=1) for array in sampled.values()]
    long = axis.length or max(lengths, default=0)
    if long < _SHORTEST:
        return StructRecord()
    alike = {key: array for key, array in sampled.items() if long in array.shape}
    if any(role_of(key) == "frequency" and array.length == long for key, array in alike.items()):
        return StructRecord()
    positions: list[ChannelPosition] = []
    channels: list[Channel] = []
    for key, array in alike.items():
        side = array.shape.index(long)
        others = 1 if array.length is not None else array.size // long
        labels = _labels(words, others)
        alone = others == 1 and len(alike) == 1  # texts then describe this channel
        metadata = _metadata_of(words, others) if labels or alone else [{} for _ in range(others)]
        for k in range(others):
            by_position = key if others == 1 else f"{key}_{k + 1}"
            positions.append(ChannelPosition(array, side, k))
            name_of = (labels[k] if labels else "") or by_position
            channels.append(_channel(name_of, {**array.attributes, **metadata[k]}))
    names = [channel.name for channel in channels]
    if not channels or len(channels) > _MOST_CHANNELS:
        return StructRecord()
    if len(set(names)) < len(names):
        channels = [
            channel._replace(name=f"{channel.name} #{k + 1}") for k, channel in enumerate(channels)
        ]
    record = time_recording(
        ArraySamples(positions, long),
        channels,
        axis.rate,
        start_time=axis.start,
        name=name,
        notes=axis.notes,
    )
    notes = tuple(note for note in axis.notes if note.kind != "time_seen_in_places")
    return StructRecord(record, frozenset((*alike, *axis.used)), notes)


def _labels(words: Mapping[str, Sequence[str]], count: int) -> Sequence[str] | None:
    """Names of the columns of a matrix among lists of text, or None."""
    for key, word in words.items():
        if key.lower() in _NAMES and len(word) == count:
            return word
    alike = [
        word
        for key, word in words.items()
        if len(word) == count > 1 and key.lower() not in _METADATA
    ]
    return alike[0] if alike else None


def _metadata_of(words: Mapping[str, Sequence[str]], count: int) -> list[dict[str, str]]:
    """Metadata of each column of a matrix, from lists of text."""
    metadata: list[dict[str, str]] = [{} for _ in range(count)]
    for key, word in words.items():
        if key.lower() in _METADATA and len(word) == count:
            for k, text in enumerate(word):
                metadata[k][_METADATA[key.lower()]] = text
    return metadata


def _channel(name: str, metadata: Mapping[str, str]) -> Channel:
    """A channel with its metadata from the file."""
    unit = metadata.get("unit", "")
    quantity, calibration = channel_meaning(unit)
    if quantity == "unknown" and level_reference(unit) is None:
        known: tuple[Quantity, ...] = get_args(Quantity)
        quantity = next((name for name in known if name == metadata.get("quantity")), "unknown")
    point_and_direction = metadata.get("point", ""), metadata.get("direction", "")
    return Channel(name, quantity, unit, calibration, *point_and_direction)


def _time_axis(numbers: Mapping[str, Numbers]) -> _Axis | str | None:
    """The sampling rate, as stated or from a time vector; its name where that is uneven."""
    single = {
        key: array for key, array in numbers.items() if array.size == 1 and not array.is_complex
    }
    starts = [key for key in single if key in ("start_time_s", "start_time", "t0")][-1:]
    start = _only(single[starts[0]]) if starts else 0.0
    if not np.isfinite(start):
        start, starts = 0.0, []
    stated: tuple[float, str] | None = None
    for key in single:
        if stated is None and (role := role_of(key)) in ("rate", "step"):
            dimension = "time" if role == "step" else "frequency"
            value = _only(single[key]) * _unit_factor(key, single[key], dimension)
            value = 1 / value if role == "step" and value > 0 else value
            stated = (value, key) if np.isfinite(value) and value > 0 else None
    vectors = [
        key
        for key, array in numbers.items()
        if role_of(key) == "time"
        and array.length is not None
        and array.length >= _SHORTEST
        and not array.is_complex
    ]
    if stated is not None:
        used = (stated[1], *starts, *vectors[:1])
        length = numbers[vectors[0]].length if vectors else None
        if vectors and not starts:
            start = float(numbers[vectors[0]].part(0, 1)[0])
            start = start if np.isfinite(start) else 0.0
        return _Axis(length, stated[0], start, used)
    if not vectors:
        return None
    return _even_axis(vectors[0], numbers[vectors[0]])


def _resampled(
    key: str, numbers: Mapping[str, Numbers]
) -> tuple[_Axis | Fact | None, Mapping[str, Numbers]]:
    """Arrays along a time with a few odd steps, resampled; a note for all other uneven times.

    None for the times of a table of steady states.
    """
    n = numbers[key].length or 0
    alike = {
        name: array
        for name, array in numbers.items()
        if n in array.shape and len(array.dimensions) < 3 and not array.is_complex
    }
    time = alike.pop(key).vector(key).astype(float) * _unit_factor(key, numbers[key], "time")
    if any(role_of(name) == "frequency" for name in alike):
        return None, numbers
    rows = [
        np.moveaxis(array.all(name).astype(float), array.shape.index(n), -1).reshape(-1, n)
        for name, array in alike.items()
    ]
    even = resampled(time, np.concatenate(rows), key) if rows else None
    if even is None:
        return odd_step(time, key), numbers
    ends = np.cumsum([len(part) for part in rows])[:-1]
    parts = np.split(even.values, ends)
    changed = {
        name: in_memory(part.T if len(part) > 1 else part[0], alike[name].attributes)
        for name, part in zip(alike, parts, strict=True)
    }
    axis = _Axis(even.values.shape[1], even.rate, even.start, (key,), (even.note,))
    return axis, {**numbers, **changed}


def _even_axis(key: str, array: Numbers) -> _Axis | str:
    """Rate and start of a time vector, checked completely or, if long, at three positions.

    The name of the time where its steps are uneven.
    """
    n = array.length or 0
    first, last = float(array.part(0, 1)[0]), float(array.part(n - 1, n)[0])
    step = (last - first) / (n - 1)
    if not (np.isfinite(step) and step > 0 and np.isfinite(1 / step)):
        return key
    starts = sorted({0, max(0, n // 2 - _LOOK // 2), max(0, n - _LOOK)})
    parts = [np.arange(start, min(start + _LOOK, n)) for start in starts]
    at, where = np.unique(np.concatenate(parts), return_index=True)
    values = [array.part(int(part[0]), int(part[-1]) + 1) for part in parts]
    time = np.concatenate(values).astype(float)[where]
    unit = _unit_factor(key, array, "time")
    notes = [Fact("time_seen_in_places", name=key)] if n > 3 * _LOOK else []
    # Long times in single precision are rounded by its resolution.
    slack = _EVEN * step + 4e-16 * abs(last) + _single(array) * abs(last)
    if np.all(np.abs(time - (first + step * at)) <= slack):
        rate = 1 / (step * unit)
        whole = round(rate)
        if whole and abs(rate - whole) < 1e-6 * rate * min(1.0, 1e3 / n):
            rate = float(whole)
    else:
        printed = rate_of_printed_times(time, at, unit) if np.isfinite(time).all() else None
        if printed is None:
            return key
        rate = printed.rate
        notes += [] if printed.note is None else [printed.note]
    return _Axis(n, rate, first * unit, (key,), tuple(notes))


def _unit_factor(key: str, array: Numbers, dimension: str) -> float:
    """Factor to s or Hz from the unit stated by the file or the name; 1 without one."""
    meaning = meaning_or_none(array.unit or label_of(key).unit)
    if meaning is None:
        return 1.0
    factor = meaning.factor / HERTZ if dimension == "frequency" else meaning.factor
    return factor if meaning.dimension == dimension else 1.0


def _single(array: Numbers) -> float:
    """Relative resolution of times that are stored in single precision, else 0."""
    kind = array.part(0, 1).dtype
    return 1.2e-7 if kind == np.float32 else 0.0


def _only(array: Numbers) -> float:
    """The value of a scalar array."""
    return float(array.read(tuple(slice(0, 1) for _ in array.shape)).reshape(-1)[0])
