"""LabVIEW measurement files (.lvm): the header gives separator, decimal mark, steps and units.

Source: NI, "LabVIEW Measurement File format specification" (tutorial 4139).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from snrmjax.io.laboratory.arrays.structs import read_struct
from snrmjax.io.laboratory.arrays.value_tree import Node, Numbers, in_memory
from snrmjax.io.laboratory.contents import LaboratoryFile, NumberTable
from snrmjax.io.laboratory.physical_units import channel_meaning
from snrmjax.io.laboratory.printed_times import rate_between
from snrmjax.io.laboratory.shared_clock import SharedAxis, TimeAxis, note_on_shift, shared_axes
from snrmjax.io.laboratory.text.fields import SEPARATORS, fields_of, number_in, text_of
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.time_recording import SamplesInMemory, TimeRecording, time_recording
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_END = "***End_of_Header***"
_X = "X_Value"
_EVEN = 1e-3  # of a step: tolerance for rounding of an even abscissa


class _Style(NamedTuple):
    """Format stated by the file header."""

    file: str
    separator: str
    decimal: str
    x_columns: str  # No, One, Multi

    def number(self, field: str, what: str) -> float:
        """A number with either decimal mark: old headers mix points and commas."""
        value = number_in(field, "point")
        value = number_in(field, "comma") if value is None else value
        if value is None:
            raise InputError(f"{self.file} is damaged: its {what} is {field!r}.")
        return value


class _Column(NamedTuple):
    """A channel of a segment."""

    name: str
    unit: str
    dimension: str  # of its abscissa: Time, Frequency, …
    start: float
    step: float  # 0: not stated
    stated: int | None  # number of samples
    abscissa: np.ndarray | None
    values: np.ndarray


def read_labview_text(path: Path) -> LaboratoryFile:
    """A LabVIEW measurement file. Raises `ValueError` as `read_laboratory_file` does."""
    lines = text_of(path).splitlines()
    style, first = _style(lines, path.name)
    recordings: list[TimeRecording] = []
    tables: list[NumberTable] = []
    notes: list[Fact] = []
    segments = _segments(lines, first, style)
    for k, (header, rows) in enumerate(segments, 1):
        name = path.stem if len(segments) == 1 else f"segment {k}"
        columns, words, further = _columns(header, rows, style)
        notes += further
        separate: dict[str, Node] = {}
        waveforms: dict[int, TimeAxis] = {}
        for number, column in enumerate(columns):
            if _is_even(column) and column.dimension.lower() in ("time", ""):
                waveforms[number] = TimeAxis(column.step, column.start, len(column.values))
                continue
            is_time = column.dimension.lower() in ("time", "")
            axis = "time" if is_time else column.dimension.lower()
            x = column.abscissa
            x = column.start + column.step * np.arange(len(column.values)) if x is None else x
            known = separate.get(axis)
            if isinstance(known, Numbers) and not np.array_equal(known.vector(axis), x):
                axis = f"{axis} of {column.name}"
            unit = "s" if is_time else "Hz" if axis.startswith("frequency") else ""
            separate[axis] = in_memory(x, {"unit": unit} if unit else {})
            separate[column.name] = in_memory(
                column.values, {"unit": column.unit} if column.unit else {}
            )
        for shared in shared_axes({columns[n].name: axis for n, axis in waveforms.items()}):
            recordings.append(_recording(name, columns, shared))
            notes += note_on_shift(shared)
        separate |= words if separate else {}
        contents = read_struct("", separate)
        recordings += contents.recordings
        tables += [
            table._replace(name=name if not index else f"{name}.{index}")
            for index, table in contents.tables.items()
        ]
        notes += contents.notes
    mark = next(word for word, each in SEPARATORS.items() if each == style.separator)
    notes.append(Fact("text_says", separator=mark, decimal=style.decimal, n=len(segments)))
    return LaboratoryFile(
        path.name, tuple(recordings), (), tuple(tables), tuple(dict.fromkeys(notes))
    )


def _style(lines: Sequence[str], file: str) -> tuple[_Style, int]:
    """Format from the file header, and the index of the first line below it."""
    end = next((k for k, line in enumerate(lines) if line.startswith(_END)), None)
    if end is None:
        raise InputError(f"{file} is damaged: its header has no end ({_END}).")
    entries: dict[str, str] = {}
    for line in lines[1:end]:
        separator = "\t" if "\t" in line else ","
        key, _, value = line.partition(separator)
        entries[key.strip()] = value.strip().strip('"')
    stated = entries.get("Separator", "Tab").lower()
    separator = SEPARATORS.get({"": "tab", ",": "comma", ";": "semicolon"}.get(stated, stated), "")
    x_columns = entries.get("X_Columns", "One").lower()
    if not separator or x_columns not in ("no", "one", "multi"):
        raise InputError(
            f"{file} states the separator {entries.get('Separator')!r} and X_Columns "
            f"{entries.get('X_Columns')!r}: Tab, Comma or Semicolon, and No, One or Multi exist."
        )
    decimal = {".": "point", ",": "comma"}.get(entries.get("Decimal_Separator", "."), "")
    if not decimal or (separator, decimal) == (",", "comma"):
        raise InputError(
            f"{file} states the separator {stated} and the decimal mark "
            f"{entries.get('Decimal_Separator')!r}, which cannot be distinguished."
        )
    return _Style(file, separator, decimal, x_columns), end + 1


def _segments(
    lines: Sequence[str], first: int, style: _Style
) -> list[tuple[dict[str, list[str]], list[tuple[int, list[str]]]]]:
    """Header and rows (with the numbers of their lines) of every segment."""
    segments: list[tuple[dict[str, list[str]], list[tuple[int, list[str]]]]] = []
    special = in_header = False
    for k, line in enumerate(lines[first:], first + 1):
        special = special or line.startswith("***Start_Special***")
        if special or not line.strip():
            special = special and not line.startswith("***End_Special***")
            continue
        fields = fields_of(line, style.separator)
        if not fields:
            continue
        if fields[0] in ("Channels", "Notes", "Test_Name", "Test_Numbers", "Test_Series") and (
            not in_header
        ):
            segments.append(({}, []))
            in_header = True
        if not segments:
            raise InputError(
                f"line {k} of {style.file} belongs to no segment: its header lacks Channels."
            )
        header, rows = segments[-1]
        if not in_header:
            if rows or "names" in header:
                rows.append((k, fields))
            else:
                header["names"] = fields
        elif fields[0] == _END:
            in_header = False
        else:
            header[fields[0]] = fields
    if not segments:
        raise InputError(f"{style.file} has no segment: it has only a header.")
    return segments


def _columns(
    header: dict[str, list[str]], rows: Sequence[tuple[int, list[str]]], style: _Style
) -> tuple[list[_Column], dict[str, Node], list[Fact]]:
    """The channels of a segment, its column of comments, and notes."""
    file, names = style.file, header.get("names", [])
    if not rows or not names:
        return [], {}, [Fact("not_read", name="a segment without samples", why="empty")]
    is_multi = style.x_columns == "multi"
    last = len(names) - 1 if names[-1] == "Comment" else len(names)
    channel_columns = range(1, last, 2 if is_multi else 1)
    stated = header.get("Channels", ["", ""])
    count = int(style.number(stated[1], "number of channels")) if len(stated) > 1 else 0
    if names[0] != _X or count != len(channel_columns):
        raise InputError(
            f"{file} states {count} channels, but its row of names has "
            f"{len(channel_columns)}: {', '.join(names)}."
        )
    longest = max(len(fields) for _, fields in rows)
    if longest > len(names) and not (longest == last + 1 and names[-1] != "Comment"):
        row = next(k for k, fields in rows if len(fields) == longest)
        raise InputError(
            f"line {row} of {file} has {longest} fields, but its row of names has {len(names)}."
        )
    table = {index: _numbers(rows, index, style) for index in range(last)}
    plain = _unique([names[index] for index in channel_columns])
    columns: list[_Column] = []
    notes: list[Fact] = []
    for name, index in zip(plain, channel_columns, strict=True):

        def header_field(key: str, index: int = index) -> str:
            fields = header.get(key, [])
            return fields[index] if index < len(fields) else ""

        finite = np.isfinite(table[index])
        if not finite.any():
            notes.append(Fact("not_read", name=f"channel {name}", why="empty"))
            continue
        end = int(np.flatnonzero(finite)[-1]) + 1
        x_index = {"no": None, "one": 0, "multi": index - 1}[style.x_columns]
        x = None if x_index is None else table[x_index][:end]
        x = None if x is None or not np.isfinite(x).all() else x
        n = (
            int(style.number(header_field("Samples"), "number of samples"))
            if header_field("Samples")
            else None
        )
        if n is not None and n > end:
            notes.append(Fact("samples_missing", name=name, n=end, of=n))
        if not finite[:end].all():
            notes.append(Fact("empty_fields", name=name, n=int((~finite[:end]).sum())))
        start = style.number(header_field("X0"), "X0") if header_field("X0") else 0.0
        step = style.number(header_field("Delta_X"), "Delta_X") if header_field("Delta_X") else 0.0
        step = _exact_step(header_field("Delta_X"), step, notes) if step > 0 else step
        if style.x_columns == "no" and step <= 0:
            raise InputError(f"{file} states no step (Delta_X) of channel {name}, and no times.")
        columns.append(
            _Column(
                name,
                header_field("Y_Unit_Label"),
                header_field("X_Dimension"),
                start + _clock(header, index),
                step,
                n,
                x,
                table[index][:end],
            )
        )
    comments = [
        fields[last] if len(fields) > last and names[-1] == "Comment" else "" for _, fields in rows
    ]
    words: dict[str, Node] = {"Comment": list[Node](comments)} if any(comments) else {}
    return columns, words, notes


def _numbers(rows: Sequence[tuple[int, list[str]]], index: int, style: _Style) -> np.ndarray:
    """A column of numbers; NaN where a field is empty."""
    values = np.full(len(rows), np.nan)
    for k, (line, fields) in enumerate(rows):
        field = fields[index] if index < len(fields) else ""
        if not field:
            continue
        value = number_in(field, style.decimal)
        if value is None:
            raise InputError(
                f"line {line} of {style.file} must be numbers with a decimal {style.decimal}, but "
                f"has {field[:40]!r}."
            )
        values[k] = value
    return values


def _clock(header: dict[str, list[str]], index: int) -> float:
    """Start of a channel in s after the earliest of its segment, from the time of day."""
    times: dict[int, float] = {}
    for k, word in enumerate(header.get("Time", [])[1:], 1):
        parts = [number_in(part, "comma" if "," in part else "point") for part in word.split(":")]
        known = [part for part in parts if part is not None]
        if len(known) == len(parts) == 3:
            days = header.get("Date", [])
            day = np.datetime64(days[k].replace("/", "-")) if k < len(days) and days[k] else None
            since = 0.0 if day is None else float(day.astype("datetime64[D]").astype(int)) * 86400
            times[k] = since + known[0] * 3600 + known[1] * 60 + known[2]
    return times[index] - min(times.values()) if index in times else 0.0


def _is_even(column: _Column) -> bool:
    """Whether samples are even by `start` and `step`, and stated times agree."""
    if column.step <= 0 or not np.isfinite(column.values).all() or len(column.values) < 2:
        return False
    if column.abscissa is None:
        return True
    steps = np.diff(column.abscissa)
    # Printed times have six decimals: tolerate their rounding.
    return bool(np.all(np.abs(steps - column.step) < _EVEN * column.step + 1.01e-6))


def _recording(name: str, columns: Sequence[_Column], shared: SharedAxis) -> TimeRecording:
    """Channels on a common clock as a record."""
    by_name = {column.name: column for column in columns}
    rows, channels = [], []
    for key, skip in zip(shared.channels, shared.skipped, strict=True):
        column = by_name[key]
        rows.append(column.values[skip : skip + shared.axis.n_samples])
        quantity, calibration = channel_meaning(column.unit)
        channels.append(Channel(column.name, quantity, column.unit, calibration))
    rate = 1 / shared.axis.step
    whole = round(rate)
    rate = float(whole) if whole and abs(rate / whole - 1) < 1e-12 else rate
    return time_recording(
        SamplesInMemory(np.stack(rows)), channels, rate, start_time=shared.axis.start, name=name
    )


def _exact_step(word: str, step: float, notes: list[Fact]) -> float:
    """The exact sampling interval of one printed with few digits, by the unique whole rate.

    "0.000977" is 1024 Hz, the only whole rate with that rounding. If there are several, the
    interval is used as printed, and a note states the uncertainty.
    """
    plain, _, power = word.lower().replace(",", ".").partition("e")
    half = 0.5 * 10.0 ** (int(power or 0) - len(plain.partition(".")[2]))
    rate = 1 / step
    if step <= half or abs(rate / max(1, round(rate)) - 1) < 1e-9:
        return step
    printed = rate_between(1 / (step + half), 1 / (step - half), word)
    if printed.note is None:
        return step
    notes.append(printed.note)
    return step if printed.note.kind == "rate_left_open" else 1 / printed.rate


def _unique(names: Sequence[str]) -> list[str]:
    """Names made unique."""
    plain: list[str] = []
    for k, name in enumerate(names, 1):
        word = name or f"channel {k}"
        plain.append(f"{word} #{k}" if word in plain else word)
    return plain
