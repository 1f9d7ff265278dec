"""Separated text (CSV and its relatives): separator, decimal mark and header found or told."""

import csv
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas

from snrmjax.io.files import shown
from snrmjax.io.laboratory.arrays.structs import read_struct
from snrmjax.io.laboratory.arrays.value_tree import Node, held
from snrmjax.io.laboratory.contents import LaboratoryFile, TextFormat
from snrmjax.io.laboratory.physical_units import unit_meaning
from snrmjax.numerics.facts import Fact

_LARGEST = 2**28  # bytes
_LOOKED_AT = 200  # lines in which the header ends
_MOST_COLUMNS = 4096
_COMMENTS = ("#", "%", "//", "!")
_POINT = re.compile(
    r"\s*[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eEdD][+-]?[0-9]+)?\s*|\s*nan\s*", re.I
)
_COMMA = re.compile(r"\s*[+-]?(?:[0-9]+,?[0-9]*|,[0-9]+)(?:[eE][+-]?[0-9]+)?\s*")
_IN_BRACKETS = re.compile(r"^(.*?)\s*[\[(]([^\])]*)[\])]\s*$")
_SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}


def read_separated_text(path: Path, text_format: TextFormat | None = None) -> LaboratoryFile:
    """A table of text. Raises `ValueError` as `read_laboratory_file` does."""
    stated, file = text_format or TextFormat(), path.name
    lines = _text(path).splitlines()
    separator, decimal = _marks(lines, stated, file)
    first = _first_row(lines, separator, decimal, stated, file)
    width = len(_split(lines[first], separator))
    names, units = _header(lines, first, separator, stated)
    notes: list[Fact] = []
    if len(names) != width:
        names, units = [f"column_{k + 1}" for k in range(width)], {}
        notes.append(Fact("columns_numbered"))
    below = [(k, line) for k, line in enumerate(lines[first:], first + 1) if line.strip()]
    rows = [(k, line) for k, line in below if not line.lstrip().startswith(_COMMENTS)]
    if len(below) > len(rows):
        notes.append(Fact("comments_not_read", n=len(below) - len(rows)))
    tree: dict[str, Node] = {}
    for name, column in _columns(rows, separator, decimal, names, file).items():
        if isinstance(column, list):
            tree[name] = list[Node](column)
            continue
        missing = int(np.isnan(column).sum())
        if missing == len(column):
            notes.append(Fact("not_read", name=f"column {name}", why="empty"))
            continue
        if missing:
            notes.append(Fact("empty_fields", name=name, n=missing))
        tree[name] = held(column, {"unit": units[name]} if units.get(name) else {})
    mark = next(word for word, each in _SEPARATORS.items() if each == separator)
    notes.append(Fact("text_read", separator=mark, decimal=decimal, first_row=first + 1))
    contents = read_struct("", tree, entry=len(rows) == 1)
    tables = tuple(table._replace(name=path.stem or "table") for table in contents.numbered())
    records = tuple(contents.recordings)
    return LaboratoryFile(file, "csv", records, (), tables, (*notes, *contents.notes))


def _text(path: Path) -> str:
    """The text of a file: UTF-8 or, where it is none, Windows' Western letters (µ, ², °)."""
    size = path.stat().st_size
    if size > _LARGEST:
        raise ValueError(
            f"{path.name} has {size / 2**20:.0f} MiB, more than the {_LARGEST / 2**20:.0f} MiB "
            "that are read of a text: take HDF5, MATLAB v7.3 or TDMS for long records."
        )
    content = path.read_bytes()
    wide = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    if not wide and b"\0" in content:
        raise ValueError(f"{path.name} is of no known format (it has NUL bytes).")
    for encoding in ("utf-16",) if wide else ("utf-8-sig", "cp1252"):
        try:
            return content.decode(encoding)
        except UnicodeDecodeError:
            continue
    raise ValueError(f"{path.name} is of no known format (it is no text).")


def _split(line: str, separator: str) -> list[str]:
    """The fields of a line."""
    if separator == " ":
        return line.split()
    try:
        return [field.strip() for field in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error as error:
        raise ValueError(f"a line of the file breaks the quotes: {shown(line)}.") from error


def _marks(lines: list[str], stated: TextFormat, file: str) -> tuple[str, str]:
    """Separator and decimal mark: those with which most lines are rows of numbers."""
    separators = [_SEPARATORS[stated.separator]] if stated.separator else _SEPARATORS.values()
    decimals = [stated.decimal] if stated.decimal else ["point", "comma"]
    looked = [line for line in lines[:_LOOKED_AT] if line.strip()]
    scores = {
        (separator, decimal): score
        for separator in separators
        for decimal in decimals
        if (separator, decimal) != (",", "comma")
        and (score := _score(looked, separator, decimal)) is not None
    }
    if not scores:
        begins = f": it begins with {shown(looked[0].strip())}" if looked else ""
        raise ValueError(f"{file} has no row of numbers in its first {_LOOKED_AT} lines{begins}.")
    return max(scores, key=lambda marks: scores[marks])


def _score(lines: list[str], separator: str, decimal: str) -> int | None:
    """How many numbers these marks give in rows of the widest kind, or None: no row at all.

    A field that is no number counts against them twice: "79,5" cut at its comma gives numbers too.
    """
    split = [_split(line, separator) for line in lines]
    rows = [fields for fields in split if _is_row(fields, decimal)]
    if not rows:
        return None
    widest = max(map(len, rows))
    fields = [field for row in rows if len(row) == widest for field in row if field]
    good = _count_numbers(fields, decimal)
    return good - 2 * (len(fields) - good)


def _count_numbers(fields: list[str], decimal: str) -> int:
    shape = _POINT if decimal == "point" else _COMMA
    return sum(bool(shape.fullmatch(field)) for field in fields)


def _is_row(fields: list[str], decimal: str) -> bool:
    """Whether fields are a row of a table: numbers, with a text or an empty one here and there."""
    good = _count_numbers(fields, decimal)
    return good > 0 and 2 * good >= len(fields)


def _first_row(
    lines: list[str], separator: str, decimal: str, stated: TextFormat, file: str
) -> int:
    """The first row of numbers (from zero): from there on rows have its width."""
    start = stated.header_row or 0
    split = ((k, _split(lines[k], separator)) for k in range(start, len(lines))[:_LOOKED_AT])
    widths = {k: len(fields) for k, fields in split if _is_row(fields, decimal)}
    if not widths:
        raise ValueError(f"{file} has no row of numbers below row {start}.")
    width = max(widths.values())
    if width > _MOST_COLUMNS:
        raise ValueError(f"{file} has {width} columns, more than {_MOST_COLUMNS}.")
    return next(k for k in widths if widths[k] == width)


def _header(
    lines: list[str], first: int, separator: str, stated: TextFormat
) -> tuple[list[str], dict[str, str]]:
    """Names and units of the rows above the numbers."""
    width = len(_split(lines[first], separator))
    at = (stated.header_row or 0) - 1
    rows = {
        k: fields
        for k in range(max(0, first - _LOOKED_AT), first)
        if len(fields := _split(lines[k].lstrip("#%!/ "), separator)) == width or k == at
    }
    if not rows:
        return [], {}
    *above, last = rows
    names, below = rows[last], list[str]()
    if at >= 0:
        names, below = rows.get(at, names), rows[last] if last > at else []
    elif above and _all_units(names):
        names, below = rows[above[-1]], names
    units: dict[str, str] = {}
    plain: list[str] = []
    for k, name in enumerate(names):
        match = _IN_BRACKETS.match(name.strip())
        word, unit = (match[1], match[2]) if match and match[1] else (name.strip(), "")
        word = word or f"column_{k + 1}"
        while word in plain:
            word = f"{word}_{k + 1}"
        plain.append(word)
        unit = unit or (below[k].strip("[]() ") if k < len(below) else "")
        units |= {word: unit} if unit else {}
    return plain, units


def _all_units(fields: list[str]) -> bool:
    """Whether a row is one of units: each is understood or empty, and one at least has letters."""
    for field in fields:
        try:
            unit_meaning(field.strip("()"))
        except ValueError:
            return False
    return any(re.search("[A-Za-z]", field) for field in fields)


def _columns(
    rows: list[tuple[int, str]], separator: str, decimal: str, names: list[str], file: str
) -> dict[str, np.ndarray | list[str]]:
    """Columns of numbers or of text by name."""
    width = len(names)
    for k, line in rows:
        count = len(line.split()) if separator == " " else line.count(separator) + 1
        if count > width and not ('"' in line or not line.rstrip(separator + " ")):
            count -= line.endswith(separator)
        if count != width and '"' not in line:
            raise ValueError(
                f"row {k} of {file} has {count} fields, but the first row of numbers has {width}."
            )
    # From 3.1 on pandas reads numbers to the last bit by itself, and says so of the option.
    exact = tuple(map(int, pandas.__version__.split(".")[:2])) >= (3, 1)
    precision: dict[str, Any] = {} if exact else {"float_precision": "round_trip"}
    try:
        table = pandas.read_csv(
            io.StringIO("\n".join(line for _, line in rows)),
            sep=r"\s+" if separator == " " else separator,
            decimal="." if decimal == "point" else ",",
            header=None,
            names=names,
            index_col=False,
            skipinitialspace=True,
            **precision,
        )
    except (ValueError, OverflowError) as error:  # pandas' own errors are among them
        said = " ".join(str(error).split())[:160]
        raise ValueError(f"{file} is damaged or no table of text ({said}).") from error
    columns: dict[str, np.ndarray | list[str]] = {}
    for name, column in table.items():
        if column.dtype.kind in "biuf":
            columns[name] = column.to_numpy(dtype=float, na_value=np.nan)
            continue
        values = pandas.to_numeric(column, errors="coerce").to_numpy(dtype=float)
        words = np.flatnonzero(np.isnan(values) & column.notna().to_numpy())
        if 2 * words.size < values.size:
            row, word = rows[int(words[0])][0], str(column.iloc[int(words[0])])
            raise ValueError(
                f"column {name} must be numbers, but row {row} of {file} has {shown(word)}."
            )
        columns[name] = ["" if pandas.isna(word) else str(word) for word in column]
    return columns
