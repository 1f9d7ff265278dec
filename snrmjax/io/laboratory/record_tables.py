"""Time records as CSV: `time_s`, force or drive, and the motion of one sensor or several."""

import csv
import dataclasses
import io

import numpy as np
from jaxtyping import Float

from snrmjax.io.files import FilePath, file_name, read_text, shown, suggestion
from snrmjax.measure.recordings.channels import Channel, Quantity
from snrmjax.measure.recordings.time_recording import TimeRecording, time_recording

_COLUMNS: dict[str, Quantity] = {
    "force_n": "force",
    "drive_v": "voltage",
    "velocity_m_s": "velocity",
    "acceleration_m_s2": "acceleration",
    "displacement_m": "displacement",
}
_MOTIONS = ("velocity_m_s", "acceleration_m_s2", "displacement_m")
_FEWEST = 16  # samples of a record
_EVEN = 1e-2  # of a step, by which a time may be off; and what its digits leave open
_MOST_DIGITS = 9


def is_record_table(path: FilePath) -> bool:
    """Whether a CSV's header names `time_s`: a time record, no table of steady states."""
    first = read_text(path).lstrip().split("\n", 1)[0]
    return "time_s" in {field.strip().strip('"') for field in first.split(",")}


def read_record_table(path: FilePath) -> TimeRecording:
    """Read a time record from a CSV, one row a sample.

    Columns: `time_s`; `force_n` (N), `drive_v` (V, of the generator), or neither for a free decay;
    of each sensor one motion, `velocity_m_s`, `acceleration_m_s2` or `displacement_m`, alone or
    behind the sensor's name and a point: `tip.velocity_m_s`. Other columns are left out with a
    note.
    Returns a `TimeRecording` whose channels have the names of the columns and the sensor as their
    `point`. Raises `ValueError` that names file, row and column for what is no table of finite
    numbers, for times that do not rise evenly, for doubled columns, two motions of one sensor and
    none at all, and for fewer than 16 samples.
    """
    text, file = read_text(path).strip(), file_name(path)
    if not text:
        raise ValueError(f"{file} is empty.")
    lines = text.splitlines()
    names = [field.strip() for field in next(csv.reader(lines[:1], skipinitialspace=True))]
    channels, notes = _channels(names, file)
    values = _numbers(lines, names, file)
    if len(values) < _FEWEST:
        raise ValueError(
            f"a time record needs {_FEWEST} samples at least, but {file} has {len(values)}."
        )
    rate = _sampling_rate(values[:, names.index("time_s")], file)
    rows = [names.index(one.name) for one in channels]
    return time_recording(
        np.ascontiguousarray(values[:, rows].T),
        channels,
        rate,
        start_time=float(values[0, names.index("time_s")]),
        name=file,
        notes=notes,
    )


def with_named_channels(recording: TimeRecording, file: str) -> TimeRecording:
    """A laboratory's record under its file's name, with quantities that names of channels say.

    Where a file states no unit, `force_n`, `tip.velocity_m_s` or `tip_velocity_m_s` do; a quantity
    that the file states stays.
    """
    return dataclasses.replace(
        recording,
        channels=tuple(_named(one) for one in recording.channels),
        name=f"{recording.name} of {file}" if recording.name else file,
    )


def _named(channel: Channel) -> Channel:
    if channel.quantity != "unknown":
        return channel
    for column, quantity in _COLUMNS.items():
        sensor = channel.name.removesuffix(column)
        if sensor != channel.name and (not sensor or sensor[-1] in "._"):
            unit = column.split("_", 1)[1]
            place = channel.point or sensor[:-1]
            return channel._replace(quantity=quantity, unit=unit, point=place)
    return channel


def _channels(names: list[str], file: str) -> tuple[list[Channel], list[str]]:
    """Channels of the columns that are understood, and notes on the others."""
    if "time_s" not in names:
        raise ValueError(f"{file} is no time record: it has no column `time_s`.")
    doubled = [name for name in names if names.count(name) > 1]
    if doubled:
        raise ValueError(f"`{doubled[0]}` stands more than once in the header of {file}.")
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
    places = [one.point for one in channels if one.quantity not in ("force", "voltage")]
    if not places:
        near = "".join(suggestion(name, _MOTIONS) for name in others[:1])
        raise ValueError(
            f"a time record needs {', '.join(_MOTIONS[:2])} or {_MOTIONS[2]}, but {file} has "
            f"{', '.join(names)}{near}."
        )
    for place in places:
        if places.count(place) > 1:
            whose = f"sensor {place}" if place else "one sensor"
            raise ValueError(
                f"{file} has two motions of {whose}: keep one, or name sensors as in "
                "`tip.velocity_m_s`."
            )
    return channels, [f"column `{name}` of {file} is not used." for name in others]


def _numbers(lines: list[str], names: list[str], file: str) -> Float[np.ndarray, "row column"]:
    """All columns as finite numbers."""
    body = lines[1:]
    if not body:
        raise ValueError(f"{file} has a header, but no rows below it.")
    try:
        values = np.loadtxt(
            io.StringIO("\n".join(body)), delimiter=",", ndmin=2, comments=None, dtype=float
        )
    except ValueError as error:
        raise ValueError(_where(body, names, file)) from error
    if values.shape[1] != len(names):
        raise ValueError(
            f"each row must have {len(names)} fields as the header has, but row 2 of {file} has "
            f"{values.shape[1]}."
        )
    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        row, column = bad[0]
        raise ValueError(
            f"`{names[column]}` must be a finite number, but row {row + 2} of {file} has "
            f"{values[row, column]}."
        )
    return values


def _where(body: list[str], names: list[str], file: str) -> str:
    """What is wrong with the first row that is none of numbers."""
    for k, line in enumerate(body):
        fields = [field.strip() for field in line.split(",")]
        if len(fields) != len(names):
            return (
                f"each row must have {len(names)} fields as the header has, but row {k + 2} of "
                f"{file} has {len(fields)}."
            )
        for name, field in zip(names, fields, strict=True):
            try:
                float(field)
            except ValueError:
                what = shown(field) if field else "an empty field"
                return f"`{name}` must be a number, but row {k + 2} of {file} has {what}."
    return f"{file} is no table of numbers."


def _sampling_rate(time: Float[np.ndarray, " row"], file: str) -> float:
    """Samples a second of times that rise evenly, as far as their digits say."""
    steps = np.diff(time)
    falls = np.flatnonzero(steps <= 0)
    if falls.size:
        raise ValueError(
            f"`time_s` must rise, but row {falls[0] + 3} of {file} has {time[falls[0] + 1]:.9g} "
            f"after {time[falls[0]]:.9g}."
        )
    step = float(time[-1] - time[0]) / len(steps)
    away = np.abs(time - time[0] - step * np.arange(len(time)))
    worst = int(np.argmax(away))
    # A gap somewhere moves the mean step too: the median is that of the other samples.
    typical = float(np.median(steps))
    allowed = max(_EVEN * typical, 1.01 * _rounding(time, typical))
    if away[worst] > allowed:
        gap = int(np.argmax(np.abs(steps - typical)))
        raise ValueError(
            f"`time_s` must be evenly spaced, but in row {gap + 3} of {file} it steps by "
            f"{steps[gap]:.6g} s, elsewhere by {typical:.6g} s: resample the record."
        )
    return 1 / step


def _rounding(time: Float[np.ndarray, " row"], step: float) -> float:
    """The unit of the last digit that times are written with, where it is well below a step."""
    for digits in range(_MOST_DIGITS + 1):
        unit = 10.0**-digits
        if unit <= 0.2 * step and np.allclose(
            time / unit, np.round(time / unit), rtol=0, atol=1e-3
        ):
            return unit
    return 0.0
