"""Time records as CSV: `time_s`, force or drive, and the motion of one sensor or several."""

import dataclasses
import re

import numpy as np
from jaxtyping import Float

from snrmjax.io.files import FilePath
from snrmjax.io.laboratory.names import column_unit
from snrmjax.io.laboratory.physical_units import channel_meaning, level_reference
from snrmjax.io.laboratory.printed_times import (
    PrintedRate,
    odd_step,
    rate_of_printed_times,
    resampled,
)
from snrmjax.io.rows import header_of, read_cells
from snrmjax.measure.recordings.channels import Channel, Quantity
from snrmjax.measure.recordings.time_recording import TimeRecording, time_recording
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.names import suggestion
from snrmjax.numerics.rules import InputError

_COLUMNS: dict[str, Quantity] = {
    "force_n": "force",
    "drive_v": "voltage",
    "velocity_m_s": "velocity",
    "acceleration_m_s2": "acceleration",
    "displacement_m": "displacement",
}
_MOTIONS = ("velocity_m_s", "acceleration_m_s2", "displacement_m")
_FEWEST = 16  # samples of a record
_EVEN = 1e-2  # of a step: tolerance of an even time
_MOST_DIGITS = 9


def is_record_table(path: FilePath) -> bool:
    """Whether a CSV's header has `time_s`, which makes it a time record."""
    return "time_s" in header_of(path)


def read_record_table(path: FilePath) -> TimeRecording:
    """Read a time record from a CSV, one row a sample.

    Columns: `time_s`; `force_n` (N), `drive_v` (V, of the generator), or neither for a free decay;
    of each sensor one motion, `velocity_m_s`, `acceleration_m_s2` or `displacement_m`, alone or
    after the sensor's name and a point: `tip.velocity_m_s`. Other columns are left out with a
    note.
    Returns a `TimeRecording` whose channels have the names of the columns and the sensor as their
    `point`; at few odd steps of the time it is resampled, with a note. Raises `ValueError` as
    `read_cells` does, for other uneven times, for two motions of one sensor or none at all, and
    for fewer than 16 samples.
    """
    cells = read_cells(path)
    file = cells.file
    channels, notes = _channels(cells.names, file)
    cells.require_rows()
    time = cells.numbers("time_s")
    values = np.stack([cells.numbers(channel.name) for channel in channels])
    if len(time) < _FEWEST:
        raise InputError(
            f"a time record needs {_FEWEST} samples at least, but {file} has {len(time)}."
        )
    start = float(time[0])
    printed = _sampling_rate(time)
    if printed is None:
        even = resampled(time, values, "`time_s`")
        if even is None:
            odd = odd_step(time, "time_s")
            raise InputError(
                f"`time_s` must rise in even steps, but to row {odd['sample'] + 1} of {file} it "
                f"steps by {odd['step']:.6g} s, usually by {odd['usual']:.6g} s: cut or resample "
                "the record there."
            )
        rate, values, further = even.rate, even.values, [even.note]
    else:
        rate, further = printed.rate, [] if printed.note is None else [printed.note]
    return time_recording(
        values, channels, rate, start_time=start, name=file, notes=[*notes, *further]
    )


def with_named_channels(recording: TimeRecording) -> TimeRecording:
    """A laboratory record with quantities from the units in its channel names.

    Used where the file states none: `Force / N`, `tip_mm_s` or `tip.velocity_m_s` (`label_of`),
    the last with the point. A quantity stated by the file is kept.
    """
    channels = tuple(_named(channel) for channel in recording.channels)
    return dataclasses.replace(recording, channels=channels)


def _named(channel: Channel) -> Channel:
    unit = column_unit(channel.name, channel.unit)
    quantity, calibration = channel_meaning(unit)
    if level_reference(unit) is not None:
        return channel._replace(quantity="unknown", unit=unit, calibration=1.0)
    if channel.quantity != "unknown" or quantity == "unknown":
        return channel
    ours = (re.fullmatch(rf"(.+)[._]{column}", channel.name) for column in _COLUMNS)
    point = channel.point or next((match[1] for match in ours if match), "")
    return channel._replace(quantity=quantity, unit=unit, calibration=calibration, point=point)


def _channels(names: list[str], file: str) -> tuple[list[Channel], list[Fact]]:
    """Channels of the known columns, and notes on the others."""
    if "time_s" not in names:
        raise InputError(f"{file} is no time record: it has no column `time_s`.")
    channels, others = [], []
    for name in names:
        sensor, _, column = name.rpartition(".")
        if name == "time_s":
            continue
        if column not in _COLUMNS or (sensor and column not in _MOTIONS):
            others.append(name)
            continue
        quantity = _COLUMNS[column]
        channels.append(Channel(name, quantity, column.split("_", 1)[1], 1.0, sensor))
    points = [channel.point for channel in channels if channel.quantity not in ("force", "voltage")]
    if not points:
        near = "".join(suggestion(name, _MOTIONS) for name in others[:1])
        raise InputError(
            f"a time record needs {', '.join(_MOTIONS[:2])} or {_MOTIONS[2]}, but {file} has "
            f"{', '.join(names)}{near}."
        )
    for point in points:
        if points.count(point) > 1:
            whose = f"sensor {point}" if point else "one sensor"
            raise InputError(
                f"{file} has two motions of {whose}: keep one, or name sensors as in "
                "`tip.velocity_m_s`."
            )
    return channels, [Fact("column_not_used", name=name, file=file, near="") for name in others]


def _sampling_rate(time: Float[np.ndarray, " row"]) -> PrintedRate | None:
    """The sampling rate (Hz) of times that are even within their printed digits, or None."""
    steps = np.diff(time)
    step = float(time[-1] - time[0]) / len(steps)
    deviation = np.abs(time - time[0] - step * np.arange(len(time)))
    typical = float(np.median(steps))
    allowed = max(_EVEN * typical, 1.01 * _last_digit(time, typical))
    if deviation.max() <= allowed and step > 0:
        return PrintedRate(1 / step)
    return rate_of_printed_times(time)


def _last_digit(time: Float[np.ndarray, " row"], step: float) -> float:
    """The unit of the last digit of the times, if well below a step; else 0."""
    for digits in range(_MOST_DIGITS + 1):
        unit = 10.0**-digits
        if unit <= 0.2 * step and np.allclose(
            time / unit, np.round(time / unit), rtol=0, atol=1e-3
        ):
            return unit
    return 0.0
