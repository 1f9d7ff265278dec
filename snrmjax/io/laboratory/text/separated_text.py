"""Separated text (CSV and similar): separator, decimal mark, header and units detected or stated.

Units may stand after each number, or in a column of their own.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.io.files import shown
from snrmjax.io.laboratory.arrays.structs import read_struct
from snrmjax.io.laboratory.arrays.value_tree import Node, in_memory
from snrmjax.io.laboratory.contents import LaboratoryFile, TextFormat
from snrmjax.io.laboratory.names import Label, label_of, role_of
from snrmjax.io.laboratory.physical_units import level_reference, meaning_or_none, unit_meaning
from snrmjax.io.laboratory.text.columns import read_columns
from snrmjax.io.laboratory.text.fields import (
    SEPARATORS,
    fields_of,
    has_thousands,
    is_number,
    number_in,
    text_of,
)
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_NUMBER_AND_UNIT = re.compile(r"([+-]?[\d.,'’]*\d[.,]?(?:[eE][+-]?\d+)?)\s*([^\W\d_].*|[°%])")
_UNIT_COLUMN = re.compile(r"(units?|einheit(en)?)(_\d+)?", re.IGNORECASE)
_INSPECTED_LINES = 200  # lines searched for the first row of numbers
_MOST_COLUMNS = 4096
_COMMENTS = ("#", "%", "//", "!")
_AXES = ("time", "frequency", "level", "rate", "step")


class PlainRows(NamedTuple):
    """Lines without the units after their numbers, and these units by line (from 1) and column."""

    lines: list[str]
    units: Mapping[int, Sequence[str]]


def without_units(lines: list[str]) -> PlainRows:
    """Lines as plain numbers where most lines have units after numbers: "30.1 Hz;0.4 N"."""
    for separator in (mark for name, mark in SEPARATORS.items() if name != "space"):
        fields = {k: fields_of(line, separator) for k, line in enumerate(lines, 1) if line.strip()}
        parts = {k: [_parts(field) for field in row] for k, row in fields.items()}
        rows = {k: row for k, row in parts.items() if 2 <= 2 * sum(map(bool, row)) >= len(row) > 1}
        if 2 * len(rows) <= len(fields):
            continue
        plain = [
            separator.join(
                f'"{part[0] if part else field}"'
                for part, field in zip(rows[k], fields[k], strict=True)
            )
            if k in rows
            else line
            for k, line in enumerate(lines, 1)
        ]
        units = {k: [part[1] if part else "" for part in row] for k, row in rows.items()}
        return PlainRows(plain, units)
    return PlainRows(lines, {})


def _parts(field: str) -> tuple[str, str] | None:
    """A number and its unit; None for another field."""
    match = _NUMBER_AND_UNIT.fullmatch(field)
    if match is None:
        return None
    known = level_reference(match[2]) is not None or meaning_or_none(match[2]) is not None
    return (match[1], match[2]) if known else None


def columns_in_one_unit(
    columns: Mapping[str, np.ndarray | list[str]],
    units: Mapping[str, str],
    stated: Mapping[int, Sequence[str]],
    rows: Sequence[int],
    file: str,
) -> tuple[dict[str, np.ndarray | list[str]], dict[str, str]]:
    """Columns and units, with numbers converted to the unit of their first row.

    Arguments: `stated` are units after numbers by row, and `rows` the numbers of the table's rows.
    A column called unit has those of the column before it.
    Raises `ValueError` where the units of a column differ in quantity or are missing in a row.
    """
    converted, known = dict(columns), dict(units)
    names = list(columns)
    for k, name in enumerate(names):
        column = columns[name]
        after = columns[names[k + 1]] if k + 1 < len(names) else None
        if isinstance(column, list):
            continue
        words = [(stated.get(row) or [""] * len(names))[k] for row in rows]
        if isinstance(after, list) and _UNIT_COLUMN.fullmatch(names[k + 1]):
            words = after
        if any(words):
            known[name] = words[0]
            converted[name] = column * _factors(words, rows, name, file)
    return converted, known


def _factors(
    words: Sequence[str], rows: Sequence[int], name: str, file: str
) -> Float[np.ndarray, " row"] | float:
    """Factors of the rows to the unit of the first row."""
    others = {word for word in words if word != words[0]}
    if not others:
        return 1.0
    odd = next(k for k, word in enumerate(words) if word != words[0])
    different = (
        f"column {name} of {file} must have units of one quantity, but row {rows[0]} has "
        f"{shown(words[0])} and row {rows[odd]} {shown(words[odd])}."
    )
    try:
        meanings = {word: unit_meaning(word) for word in (words[0], *others)}
    except InputError as error:
        raise InputError(different) from error
    if not all(words) or len({meaning._replace(factor=1.0) for meaning in meanings.values()}) > 1:
        raise InputError(different)
    first = meanings[words[0]].factor
    return np.array([meanings[word].factor / first for word in words])


def read_separated_text(path: Path, text_format: TextFormat | None = None) -> LaboratoryFile:
    """A table of text. Raises `ValueError` as `read_laboratory_file` does."""
    stated, file = text_format or TextFormat(), path.name
    lines, units_of_rows = without_units(text_of(path).splitlines())
    separator, decimal = _marks(lines, stated, file)
    first, width = _first_row(lines, separator, decimal, stated, file)
    header = _header(lines, first, width, separator, stated, file)
    notes: list[Fact] = [] if header.is_found else [Fact("columns_numbered")]
    below = [(k, line) for k, line in enumerate(lines[first:], first + 1) if line.strip()]
    rows = [(k, line) for k, line in below if not line.lstrip().startswith(_COMMENTS)]
    if len(below) > len(rows):
        notes.append(Fact("comments_not_read", n=len(below) - len(rows)))
    columns = read_columns(rows, separator, stated, decimal, width, header.names, file, notes)
    numbers = [k for k, _ in rows]
    columns, known = columns_in_one_unit(columns, header.units, units_of_rows, numbers, file)
    header = header._replace(units=known)
    runs = _runs_side_by_side(header, columns)
    if runs is not None:
        columns, units, labels = runs
        notes.append(Fact("runs_side_by_side", labels=labels, n=int(max(columns["run"]))))
    else:
        units = header.units
    tree: dict[str, Node] = {}
    for name, column in columns.items():
        if isinstance(column, list):
            tree[name] = list[Node](column)
            continue
        missing = int(np.isnan(column).sum())
        if missing == len(column):
            notes.append(Fact("not_read", name=f"column {name}", why="empty"))
            continue
        if missing:
            notes.append(Fact("empty_fields", name=name, n=missing))
        tree[name] = in_memory(column, {"unit": units[name]} if units.get(name) else {})
    metadata = _metadata_above(lines[:first], separator, decimal)
    axes = {role_of(name) for name in tree}
    if metadata.rate and not axes & {"time", "frequency", "rate", "step"}:
        tree["fs" if metadata.is_rate else "dt"] = in_memory(np.asarray(metadata.rate))
        notes.append(Fact("rate_stated_above", text=metadata.text))
    signal, described = metadata.signal, [name for name in tree if role_of(name) not in _AXES]
    if signal and len(described) == 1 and signal not in tree:
        tree = {signal if name == described[0] else name: node for name, node in tree.items()}
    mark = next(word for word, each in SEPARATORS.items() if each == separator)
    notes.append(Fact("text_read", separator=mark, decimal=decimal, first_row=first + 1))
    contents = read_struct("", tree, entry=len(rows) == 1)
    tables = tuple(table._replace(name=path.stem or "table") for table in contents.numbered())
    records = tuple(contents.recordings)
    return LaboratoryFile(file, records, (), tables, (*notes, *contents.notes))


class _TableMetadata(NamedTuple):
    """Metadata from lines above a table."""

    signal: str = ""
    rate: float = 0.0  # Hz, or a step in s
    is_rate: bool = True
    text: str = ""


def _metadata_above(lines: Sequence[str], separator: str, decimal: str) -> _TableMetadata:
    """Name of a single signal, and sampling rate or step, from lines with key and value.

    "Sampling rate:<tab>5120 Hz", "dt = 0,001 s", "Signal:<tab>Vib - Velocity - Samples".
    """
    metadata = _TableMetadata()
    for line in lines:
        plain = line.strip().lstrip("#%!/ ").strip()
        fields = [field for field in fields_of(plain, separator) if field]
        if len(fields) < 2:
            key, _, value = plain.partition("=" if "=" in plain else ":")
            fields = [key.strip(), value.strip()]
        key, value = fields[0].rstrip(":= "), " ".join(fields[1:])
        if key.lower() == "signal" and value:
            parts = value.split(" - ")  # domain, channel, content
            metadata = metadata._replace(signal=parts[1] if len(parts) == 3 else value)
        role = role_of(key)
        if role not in ("rate", "step") or metadata.rate:
            continue
        number, _, unit = value.partition(" ")
        quantity = number_in(number, decimal, thousands=True)
        quantity = number_in(number, "point") if quantity is None else quantity
        unit = unit.strip() or label_of(key).unit or ("Hz" if role == "rate" else "s")
        meaning = meaning_or_none(unit)
        if meaning is None or quantity is None or quantity <= 0:
            continue
        if meaning.dimension not in ("frequency", "time"):
            continue
        is_rate = meaning.dimension == "frequency"
        factor = meaning.factor / HERTZ if is_rate else meaning.factor
        metadata = metadata._replace(rate=quantity * factor, is_rate=is_rate, text=plain)
    return metadata


def _marks(lines: list[str], stated: TextFormat, file: str) -> tuple[str, str]:
    """Separator and decimal mark that give most numbers."""
    separators = [SEPARATORS[stated.separator]] if stated.separator else SEPARATORS.values()
    decimals = [stated.decimal] if stated.decimal else ["point", "comma"]
    inspected = [line for line in lines[:_INSPECTED_LINES] if line.strip()]
    is_quoted = any('"' in line for line in inspected)
    scores = {
        (separator, decimal): score
        for separator in separators
        for decimal in decimals
        if ((separator, decimal) != (",", "comma") or is_quoted)
        and (score := _score(inspected, separator, decimal)) is not None
    }
    if not scores:
        begins = f": it begins with {shown(inspected[0].strip())}" if inspected else ""
        raise InputError(
            f"{file} has no row of numbers in its first {_INSPECTED_LINES} lines{begins}."
        )
    return max(scores, key=lambda marks: scores[marks])


def _score(lines: list[str], separator: str, decimal: str) -> tuple[int, int] | None:
    """Score of a separator and decimal mark: the numbers in the widest rows; None without a row.

    A field that is no number subtracts two, since "79,5" split at its comma gives numbers too. Ties
    go to fewer thousands separators, and blanks do not separate columns where tabs do.
    """
    split = [fields_of(line, separator) for line in lines]
    rows = [fields for fields in split if _is_row(fields, decimal)]
    if not rows:
        return None
    widest = max(map(len, rows))
    fields = [field for row in rows if len(row) == widest for field in row if field]
    good = _count_numbers(fields, decimal)
    grouped = sum(has_thousands(field, decimal) for field in fields)
    if separator == " " and any(map(_has_blank_thousands, lines)):
        return None
    return good - 2 * (len(fields) - good), -grouped


def _has_blank_thousands(line: str) -> bool:
    """Whether tabs separate columns, and blanks separate thousands: "1 000<tab>0,5"."""
    fields = [field for field in fields_of(line, "\t") if field]
    is_blank = len(fields) > 1 and any(" " in field for field in fields)
    return is_blank and any(
        _count_numbers(fields, decimal) == len(fields) for decimal in ("point", "comma")
    )


def _count_numbers(fields: list[str], decimal: str) -> int:
    return sum(is_number(field, decimal) for field in fields)


def _is_row(fields: list[str], decimal: str) -> bool:
    """Whether fields are a table row: at least half of them numbers."""
    good = _count_numbers(fields, decimal)
    return good > 0 and 2 * good >= len(fields)


def _first_row(
    lines: list[str], separator: str, decimal: str, stated: TextFormat, file: str
) -> tuple[int, int]:
    """Index of the first row of numbers and the number of columns of the table."""
    start = stated.header_row or 0
    split = (
        (k, fields_of(lines[k], separator)) for k in range(start, len(lines))[:_INSPECTED_LINES]
    )
    widths = {k: len(fields) for k, fields in split if _is_row(fields, decimal)}
    if not widths:
        raise InputError(f"{file} has no row of numbers below row {start}.")
    width = max(widths.values())
    if width > _MOST_COLUMNS:
        raise InputError(f"{file} has {width} columns, more than {_MOST_COLUMNS}.")
    # The first rows may lack their last values: the widest row sets the number of columns.
    first = next(k for k in widths if widths[k] == width)
    return first, width


class _Header(NamedTuple):
    """Header of the columns: unique names, names as written, units, labels of runs."""

    names: tuple[str, ...]
    written: tuple[str, ...]
    units: Mapping[str, str]
    labels: tuple[str, ...]  # of runs, above or below the names; may be empty
    is_found: bool


def _header(
    lines: list[str], first: int, width: int, separator: str, stated: TextFormat, file: str
) -> _Header:
    """Names and units from the rows above the numbers, by the fullest row that fits."""
    at = (stated.header_row or 0) - 1
    rows = {
        k: (fields + [""] * width)[:width]
        for k in range(max(0, first - _INSPECTED_LINES), first)
        if 0 < len(fields := _names_in(lines[k], separator, width)) <= width or k == at
    }
    if at >= 0:
        count = len(_names_in(lines[at], separator, width)) if at < first else 0
        if count != width:
            raise InputError(
                f"--header-row {at + 1} of {file} has {count} names, but the rows of numbers below "
                f"have {width} columns."
            )
        if not re.search(r"[^\W\d]", "".join(rows[at]).lower().replace("e", "")):
            raise InputError(f"--header-row {at + 1} of {file} has numbers, not names.")
        names, below = rows[at], [rows[k] for k in rows if k > at]
    else:
        filled = {k: sum(bool(field) for field in row) for k, row in rows.items()}
        whole = [k for k in rows if filled[k] == width or (filled[k] > 1 and rows[k][-1])]
        if not whole:
            names = [f"column_{k + 1}" for k in range(width)]
            return _Header(tuple(names), tuple(names), {}, (), False)
        last = max(whole, key=lambda k: (filled[k], k))
        above = [k for k in whole if k < last]
        if above and _all_units(rows[last]):
            last = above[-1]
        names, below = rows[last], [rows[k] for k in rows if k > last]
    unit_row = next((row for row in below if _all_units(row)), [""] * width)
    # Labels are above the first column of a group: "002: [01-05-26 09:28]".
    marked = (row for row in (*below, *rows.values()) if row not in (names, unit_row))
    labels = next((row for row in marked if 1 < sum(map(bool, row)) < width and not row[0]), [])
    units: dict[str, str] = {}
    plain: list[str] = []
    labels_of = [label if (label := label_of(name)).is_bracketed else Label(name) for name in names]
    short = [label.word for label in dict.fromkeys(labels_of)]
    for k, (name, label) in enumerate(zip(names, labels_of, strict=True)):
        # Names that differ only by their units are kept as written.
        is_short = label.word and short.count(label.word) == 1
        word, unit = (label.word, label.unit) if is_short else (name, "")
        word = word or f"column_{k + 1}"
        while word in plain:
            word = f"{word}_{k + 1}"
        plain.append(word)
        unit = unit or unit_row[k].strip("[]() ")
        units |= {word: unit} if unit else {}
    return _Header(tuple(plain), tuple(names), units, tuple(labels), True)


def _names_in(line: str, separator: str, width: int) -> list[str]:
    """The fields of a line above the numbers, without an empty one before the first name."""
    fields = fields_of(line.lstrip("#%!/ "), separator)
    return fields[1:] if len(fields) == width + 1 and not fields[0] else fields


def _runs_side_by_side(
    header: _Header, columns: Mapping[str, np.ndarray | list[str]]
) -> tuple[dict[str, np.ndarray | list[str]], Mapping[str, str], tuple[str, ...]] | None:
    """Stack runs in adjacent column groups into one table with the run number; None without runs.

    Runs are recognised by repeated names: "f, v, phase, v, phase" with a common frequency, or
    "f, v, phase, f, v, phase" with one for each. A single repeated name is a second channel unless
    labels are above it.
    """
    names, written, labels = header.names, header.written, header.labels
    if not header.is_found or any(isinstance(column, list) for column in columns.values()):
        return None
    # Leading columns (frequency, control channel) may be common to all runs.
    for shared in range(len(names) - 1):
        groups = _repeated(written[shared:], 1 if labels and shared else 2)
        if groups > 1:
            break
    else:
        return None
    width = (len(names) - shared) // groups
    parts: dict[str, list[np.ndarray]] = {name: [] for name in names[: shared + width]}
    number: list[np.ndarray] = []
    for group in range(groups):
        at = shared + group * width
        group_columns = [np.asarray(columns[name]) for name in names[at : at + width]]
        there = np.isfinite(np.stack(group_columns)).any(axis=0)
        for name, column in zip(names[shared : shared + width], group_columns, strict=True):
            parts[name].append(column[there])
        for name in names[:shared]:
            parts[name].append(np.asarray(columns[name])[there])
        number.append(np.full(int(there.sum()), group + 1.0))
    run = np.concatenate(number)
    stacked: dict[str, np.ndarray | list[str]] = {
        name: np.concatenate(each) for name, each in parts.items()
    }
    run_labels = [
        next((word for word in labels[at : at + width] if word), "")
        for at in range(shared, len(names), width)
    ] * bool(labels)
    words = {"run label": [run_labels[int(k) - 1] for k in run]} if any(run_labels) else {}
    units = {name: unit for name, unit in header.units.items() if name in stacked}
    return {"run": run} | stacked | words, units, tuple(run_labels)


def _repeated(names: Sequence[str], fewest: int) -> int:
    """Number of repetitions of a group of at least `fewest` names that gives all names."""
    for width in range(fewest, len(names) // 2 + 1):
        if len(names) % width == 0 and list(names) == list(names[:width]) * (len(names) // width):
            return len(names) // width
    return 1


def _all_units(fields: list[str]) -> bool:
    """Whether all fields of a row are units or empty, with letters in at least one."""
    for field in fields:
        unit = field.strip("()")
        if level_reference(unit) is None and meaning_or_none(unit) is None:
            return False
    return any(re.search("[A-Za-z]", field) for field in fields)
