"""TDMS files (LabVIEW, NI): groups of channels with properties, read on demand."""

import dataclasses
import weakref
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Num

from snrmjax.io.laboratory.arrays.structs import read_struct
from snrmjax.io.laboratory.arrays.value_tree import Node, Numbers, Selection, in_memory
from snrmjax.io.laboratory.contents import LaboratoryFile, NumberTable
from snrmjax.io.laboratory.libraries import damaged_if_it_fails, library
from snrmjax.io.laboratory.physical_units import channel_meaning
from snrmjax.io.laboratory.shared_clock import (
    SharedAxis,
    TimeAxis,
    note_on_clocks,
    note_on_shift,
    shared_axes,
)
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.time_recording import AbstractSamples, TimeRecording, time_recording
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_UNITS = ("unit_string", "NI_UnitDescription", "Unit", "unit", "Units")
_MOST_CHANNELS = 4096


class _TdmsSamples(AbstractSamples):
    """Samples of the channels of one group; keeps the file open for its lifetime."""

    def __init__(
        self, file: Any, channels: Sequence[Any], skipped: Sequence[int], n_samples: int, name: str
    ) -> None:
        self._channels, self._skipped = tuple(channels), tuple(skipped)
        self._samples, self._name = n_samples, name
        weakref.finalize(self, file.close)

    @property
    def shape(self) -> tuple[int, int]:
        """Channels and samples."""
        return len(self._channels), self._samples

    def read(
        self, channels: Sequence[int], start: int, stop: int
    ) -> Num[np.ndarray, "channel sample"]:
        """Samples of some channels."""
        rows = []
        for k in channels:
            with damaged_if_it_fails(self._name, "a TDMS file"):
                first = start + self._skipped[k]
                rows.append(self._channels[k].read_data(first, max(0, stop - start)))
        if any(len(row) != stop - start for row in rows):
            raise InputError(f"{self._name} is damaged: samples {start} to {stop} are missing.")
        return np.stack(rows)


def read_tdms(path: Path) -> LaboratoryFile:
    """A TDMS file. Raises `ValueError` as `read_laboratory_file` does."""
    library("nptdms", "reading TDMS")
    size = path.stat().st_size
    recordings: list[TimeRecording] = []
    tables: list[NumberTable] = []
    notes: list[Fact] = []
    with damaged_if_it_fails(path.name, "a TDMS file"), open(path, "rb") as file:
        source = _contents(file)
        groups = [(group.name, list(group.channels())) for group in source.groups()]
        counted = [
            (channel, len(channel), dict(channel.properties))
            for _, channels in groups
            for channel in channels
        ]
    _check_sizes(counted, size, path.name)
    for name, channels in groups:
        waveforms: dict[str, TimeAxis] = {}
        start_times = _start_times(channels)
        separate: dict[str, Node] = {}
        for channel in channels:
            if not len(channel) or channel.dtype.kind not in "biufc":
                notes.append(
                    Fact("not_read", name=f"channel {channel.name}", why=_reason_unread(channel))
                )
                continue
            step = _number(channel, "wf_increment")
            start = _number(channel, "wf_start_offset") or 0.0
            if step is not None and step > 0 and len(channel) > 1 and _is_spectrum(channel):
                lines = start + step * np.arange(len(channel))
                alike = separate.get("frequency")
                other = isinstance(alike, Numbers) and alike.length != len(lines)
                axis = f"frequency of {channel.name}" if other else "frequency"
                separate.setdefault(axis, in_memory(lines, {"unit": "Hz"}))
                separate[channel.name] = _numbers(path, name, channel)
            elif step is not None and step > 0 and len(channel) > 1 and channel.dtype.kind != "c":
                start += start_times.get(channel.name, 0.0)
                waveforms[channel.name] = TimeAxis(step, start, len(channel))
            else:
                separate[channel.name] = _numbers(path, name, channel)
        clocks = shared_axes(waveforms)
        for shared in clocks:
            record = _recording(path, name, channels, shared)
            label = f"{name} {shared.channels[0]}" if len(clocks) > 1 else name
            recordings.append(dataclasses.replace(record, name=label))
            notes += note_on_shift(shared)
        notes += note_on_clocks(clocks)
        contents = read_struct(name, separate)
        recordings.extend(contents.recordings)
        tables.extend(table._replace(name=name) for table in contents.numbered())
        notes.extend(contents.notes)
    return LaboratoryFile(
        path.name, tuple(recordings), (), tuple(tables), tuple(dict.fromkeys(notes))
    )


def _contents(file: BinaryIO) -> Any:
    """Groups and channels of an open file.

    Opening by path would use an index file next to it, possibly of another measurement.
    """
    return library("nptdms", "reading TDMS").TdmsFile.open(file)


def _check_sizes(counted: Sequence[tuple[Any, int, dict]], size: int, file: str) -> None:
    """Refuse more samples than the file can hold, and too many channels."""
    if len(counted) > _MOST_CHANNELS:
        raise InputError(f"{file} has {len(counted)} channels, more than {_MOST_CHANNELS}.")
    total = sum(
        length * channel.dtype.itemsize
        for channel, length, _ in counted
        if channel.dtype.kind in "biufc"
    )
    if total > 8 * size:  # scaled channels give doubles for bytes
        raise InputError(f"{file} states {total} bytes of samples, but has {size} bytes.")


def _start_times(channels: Sequence[Any]) -> dict[str, float]:
    """Start times of channels in s after the first of them, as stated in the file."""
    stated = {
        channel.name: value.astype("datetime64[us]")
        for channel in channels
        if isinstance(value := channel.properties.get("wf_start_time"), np.datetime64)
        and not np.isnat(value)
    }
    if not stated:
        return {}
    times = np.array(list(stated.values())).astype(np.int64)  # µs
    return dict(zip(stated, (1e-6 * (times - times.min())).tolist(), strict=True))


def _recording(path: Path, name: str, channels: Sequence[Any], shared: SharedAxis) -> TimeRecording:
    """Channels on a common clock as a time record."""
    channels = [next(one for one in channels if one.name == key) for key in shared.channels]
    with ExitStack() as stack, damaged_if_it_fails(path.name, "a TDMS file"):
        file = stack.enter_context(open(path, "rb"))
        group = _contents(file)[name]
        opened = [group[channel.name] for channel in channels]
        stack.pop_all()  # the file stays open as long as the samples exist
    axis = shared.axis
    samples = _TdmsSamples(file, opened, shared.skipped, axis.n_samples, path.name)
    listed = []
    for channel in channels:
        unit = _unit(channel)
        quantity, calibration = channel_meaning(unit)
        listed.append(Channel(channel.name, quantity, unit, calibration))
    rate = 1 / axis.step
    whole = round(rate)
    rate = float(whole) if whole and abs(rate / whole - 1) < 4e-16 else rate
    return time_recording(samples, listed, rate, start_time=axis.start, name=name)


def _numbers(path: Path, group: str, channel: Any) -> Numbers:
    """A channel without a rate as numbers that are read on demand."""
    name, unit = channel.name, _unit(channel)

    def read(at: Selection) -> np.ndarray:
        with damaged_if_it_fails(path.name, "a TDMS file"), open(path, "rb") as file:
            channel = _contents(file)[group][name]
            return channel.read_data(at[0].start, at[0].stop - at[0].start)

    return Numbers((len(channel),), read, channel.dtype.kind == "c", {"unit": unit} if unit else {})


def _is_spectrum(channel: Any) -> bool:
    """Whether the even abscissa of a channel is a frequency and not a time."""
    unit = str(channel.properties.get("wf_xunit_string", "")).strip().lower()
    name = str(channel.properties.get("wf_xname", "")).strip().lower()
    return unit in ("hz", "hertz") or (not unit and name in ("frequency", "frequenz"))


def _reason_unread(channel: Any) -> str:
    """Why a channel is not read."""
    if not len(channel):
        return "empty"
    return "times_of_day" if channel.dtype.kind in "MV" else "type"


def _unit(channel: Any) -> str:
    """The unit stated by a property."""
    for key in _UNITS:
        value = channel.properties.get(key)
        if isinstance(value, str) and value.strip():
            return value.strip()
    return ""


def _number(channel: Any, key: str) -> float | None:
    """A finite number among the properties."""
    value = channel.properties.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return None
    return float(value) if np.isfinite(value) else None
