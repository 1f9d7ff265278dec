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
    told, file = text_format or TextFormat(), path.name
    text = _text(path)
    lines = text.splitlines()
    separator, decimal = _marks(lines, told, file)
    first = _first_row(lines, separator, decimal, told, file)
    names, units = _header(lines, first, separator, told)
    notes: list[Fact] = []
    fields = _split("\n".join(lines[first : first + 1]), separator)
    if len(names) != len(fields):
        names = [f"column_{k + 1}" for k in range(len(fields))]
        units = {}
        notes.append(Fact("columns_numbered"))
    rows = [
        (k, line)
        for k, line in enumerate(lines[first:], first + 1)
        if line.strip() and not line.lstrip().startswith(_COMMENTS)
    ]
    dropped = sum(bool(line.strip()) for line in lines[first:]) - len(rows)
    if dropped:
        notes.append(Fact("comments_not_read", n=dropped))
    values = _numbers(rows, separator, decimal, names, file)
    tree: dict[str, Node] = {}
    for name, column in zip(names, values, strict=True):
        if isinstance(column, list):
            tree[name] = list[Node](column)
            continue
        if column is None:
            notes.append(Fact("not_read", name=f"column {name}", why="empty"))
            continue
        missing = int(np.isnan(column).sum())
        if missing:
            notes.append(Fact("empty_fields", name=name, n=missing))
        tree[name] = held(column, {"unit": units[name]} if units.get(name) else {})
    marks = {mark: word for word, mark in _SEPARATORS.items()}
    how = {"separator": marks[separator], "decimal": decimal, "first_row": first + 1}
    notes.append(Fact("text_read", **how))
    found = read_struct("", tree, entry=len(rows) == 1)
    stem = path.stem or "table"
    tables = tuple(table._replace(name=stem) for table in found.numbered())
    records = tuple(found.recordings)
    return LaboratoryFile(file, "csv", records, (), tables, (*notes, *found.notes))


def _exact() -> dict[str, Any]:
    """What makes pandas read numbers to the last bit: from 3.1 on it does so by itself."""
    major, minor = (int(part) for part in pandas.__version__.split(".")[:2])
    return {} if (major, minor) >= (3, 1) else {"float_precision": "round_trip"}


def _text(path: Path) -> str:
    """The text of a file: UTF-8 or, where it is none, Windows' Western letters (µ, ², °)."""
    size = path.stat().st_size
    if size > _LARGEST:
        raise ValueError(
            f"{path.name} has {size / 2**20:.0f} MiB, more than the {_LARGEST / 2**20:.0f} MiB "
            "that are read of a text: take HDF5, MATLAB v7.3 or TDMS for long records."
        )
    content = path.read_bytes()
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        try:
            return content.decode("utf-16")
        except UnicodeDecodeError as error:
            raise ValueError(f"{path.name} is damaged: it is no UTF-16 text.") from error
    if b"\0" in content:
        raise ValueError(f"{path.name} is of no known format (it has NUL bytes).")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        pass
    try:
        return content.decode("cp1252")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path.name} is of no known format (byte {error.start + 1} is of no text)."
        ) from error


def _split(line: str, separator: str) -> list[str]:
    """The fields of a line."""
    if separator == " ":
        return line.split()
    try:
        fields = next(csv.reader([line], delimiter=separator), [])
    except csv.Error as error:
        raise ValueError(f"a line of the file breaks the quotes: {shown(line)}.") from error
    return [field.strip() for field in fields]


def _marks(lines: list[str], told: TextFormat, file: str) -> tuple[str, str]:
    """Separator and decimal mark: those with which most lines are rows of numbers."""
    separators = [_SEPARATORS[told.separator]] if told.separator else list(_SEPARATORS.values())
    decimals = [told.decimal] if told.decimal else ["point", "comma"]
    looked = [line for line in lines[:_LOOKED_AT] if line.strip()]
    best: tuple[int, str, str] | None = None
    for separator in separators:
        for decimal in decimals:
            if separator == "," and decimal == "comma":
                continue
            score = _score(looked, separator, decimal)
            if score is not None and (best is None or score > best[0]):
                best = (score, separator, decimal)
    if best is None:
        begins = f": it begins with {shown(looked[0].strip())}" if looked else ""
        raise ValueError(f"{file} has no row of numbers in its first {_LOOKED_AT} lines{begins}.")
    return best[1:]


def _score(lines: list[str], separator: str, decimal: str) -> int | None:
    """How many numbers these marks give in rows of the widest kind, or None: no row at all.

    A field that is no number counts against them twice: "79,5" cut at its comma gives numbers too.
    """
    split = [_split(line, separator) for line in lines]
    rows = [fields for fields in split if fields and _is_row(fields, decimal)]
    if not rows:
        return None
    widest = max(map(len, rows))
    shape = _POINT if decimal == "point" else _COMMA
    bad = good = 0
    for fields in rows:
        if len(fields) == widest:
            numbers = sum(bool(shape.fullmatch(field)) for field in fields)
            good += numbers
            bad += sum(bool(field) for field in fields) - numbers
    return good - 2 * bad


def _is_row(fields: list[str], decimal: str) -> bool:
    """Whether fields are a row of a table: numbers, with a text or an empty one here and there."""
    shape = _POINT if decimal == "point" else _COMMA
    good = sum(bool(shape.fullmatch(field)) for field in fields)
    return good > 0 and 2 * good >= len(fields)


def _first_row(lines: list[str], separator: str, decimal: str, told: TextFormat, file: str) -> int:
    """The first row of numbers (from zero): from there on rows have its width."""
    start = told.header_row or 0
    rows = [
        (k, fields)
        for k, line in enumerate(lines[: start + _LOOKED_AT])
        if k >= start and (fields := _split(line, separator)) and _is_row(fields, decimal)
    ]
    if not rows:
        raise ValueError(f"{file} has no row of numbers below row {start}.")
    width = max(len(fields) for _, fields in rows)
    if width > _MOST_COLUMNS:
        raise ValueError(f"{file} has {width} columns, more than {_MOST_COLUMNS}.")
    return next(k for k, fields in rows if len(fields) == width)


def _header(
    lines: list[str], first: int, separator: str, told: TextFormat
) -> tuple[list[str], dict[str, str]]:
    """Names and units of the rows above the numbers."""
    width = len(_split(lines[first], separator))
    rows: list[tuple[int, list[str]]] = []
    for k in range(max(0, first - _LOOKED_AT), first):
        fields = _split(lines[k].lstrip("#%!/ "), separator)
        if len(fields) == width or k == (told.header_row or 0) - 1:
            rows.append((k, fields))
    if not rows:
        return [], {}
    names, below = rows[-1][1], list[str]()
    if told.header_row:
        names = next((one for k, one in rows if k == told.header_row - 1), names)
        below = rows[-1][1] if rows[-1][0] > told.header_row - 1 else []
    elif len(rows) > 1 and _all_units(names):
        names, below = rows[-2][1], names
    names = [name.strip() for name in names]
    units: dict[str, str] = {}
    plain: list[str] = []
    for k, name in enumerate(names):
        match = _IN_BRACKETS.match(name)
        word, unit = (match[1], match[2]) if match and match[1] else (name, "")
        word = word or f"column_{k + 1}"
        while word in plain:
            word = f"{word}_{k + 1}"
        plain.append(word)
        told_unit = unit or (below[k].strip("[]() ") if k < len(below) else "")
        if told_unit:
            units[word] = told_unit
    return plain, units


def _all_units(fields: list[str]) -> bool:
    """Whether a row is one of units: each is understood or empty, and one at least has letters."""
    for field in fields:
        try:
            unit_meaning(field.strip("()"))
        except ValueError:
            return False
    return any(re.search("[A-Za-z]", field) for field in fields)


def _numbers(
    rows: list[tuple[int, str]], separator: str, decimal: str, names: list[str], file: str
) -> list[np.ndarray | list[str] | None]:
    """Columns of numbers or of text; None for an empty one."""
    width = len(names)
    for k, line in rows:
        count = len(line.split()) if separator == " " else line.count(separator) + 1
        if count > width and not ('"' in line or not line.rstrip(separator + " ")):
            count -= line.endswith(separator)
        if count != width and '"' not in line:
            raise ValueError(
                f"row {k} of {file} has {count} fields, but the first row of numbers has {width}."
            )
    try:
        table = pandas.read_csv(
            io.StringIO("\n".join(line for _, line in rows)),
            sep=r"\s+" if separator == " " else separator,
            decimal="." if decimal == "point" else ",",
            header=None,
            names=names,
            index_col=False,
            skipinitialspace=True,
            **_exact(),
        )
    except (ValueError, OverflowError) as error:  # pandas' own errors are among them
        said = " ".join(str(error).split())[:160]
        raise ValueError(f"{file} is damaged or no table of text ({said}).") from error
    found: list[np.ndarray | list[str] | None] = []
    for name in names:
        column = table[name]
        if column.dtype.kind in "biuf":
            values = column.to_numpy(dtype=float, na_value=np.nan)
            found.append(None if np.isnan(values).all() else values)
            continue
        values = pandas.to_numeric(column, errors="coerce").to_numpy(dtype=float)
        words = np.flatnonzero(np.isnan(values) & column.notna().to_numpy())
        if 2 * words.size < values.size:
            k = int(words[0])
            raise ValueError(
                f"column {name} must be numbers, but row {rows[k][0]} of {file} has "
                f"{shown(str(column.iloc[k]))}."
            )
        found.append(
            [
                "" if missing else str(word)
                for word, missing in zip(column, column.isna(), strict=True)
            ]
        )
    return found
