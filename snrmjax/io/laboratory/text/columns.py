"""Columns of a text: numbers, also with thousands separators or decimal commas, or words."""

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas

from snrmjax.io.files import shown
from snrmjax.io.laboratory.contents import TextFormat
from snrmjax.io.laboratory.text.fields import (
    fields_of,
    has_thousands,
    is_number,
    may_be_thousands,
    number_in,
)
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError


def read_columns(
    rows: list[tuple[int, str]],
    separator: str,
    stated: TextFormat,
    decimal: str,
    width: int,
    names: Sequence[str],
    file: str,
    notes: list[Fact],
) -> dict[str, np.ndarray | list[str]]:
    """Columns of numbers or of text by name.

    Raises `ValueError` for rows of another length, a text among numbers, and ambiguous
    decimal and thousands marks.
    """
    if stated.decimal is None:
        _refuse_ambiguous(rows, separator, file)
    for k, line in rows:
        stripped = line.rstrip(separator + " ") if separator != "\t" else line.rstrip()
        least = len(line.split()) if separator == " " else stripped.count(separator) + 1
        most = least if separator == " " else line.count(separator) + 1
        if (least > width or most < width) and '"' not in line:
            raise InputError(
                f"row {k} of {file} has {least} fields, but the first row of numbers has {width}."
            )
    stripped_rows = [_cut(line, separator, width) for _, line in rows]
    # From 3.1 on pandas reads numbers exactly by default and warns about the option.
    exact = tuple(map(int, pandas.__version__.split(".")[:2])) >= (3, 1)
    precision: dict[str, Any] = {} if exact else {"float_precision": "round_trip"}
    try:
        table = pandas.read_csv(
            io.StringIO("\n".join(stripped_rows)),
            sep=r"\s+" if separator == " " else separator,
            decimal="." if decimal == "point" else ",",
            header=None,
            names=list(names),
            index_col=False,
            skipinitialspace=True,
            **precision,
        )
    except (ValueError, OverflowError) as error:  # includes the errors of pandas
        message = " ".join(str(error).split())[:160]
        raise InputError(f"{file} is damaged or no table of text ({message}).") from error
    columns: dict[str, np.ndarray | list[str]] = {}
    for name, column in table.items():
        if column.dtype.kind in "biuf":
            columns[name] = values = column.to_numpy(dtype=float, na_value=np.nan)
            column_index = list(names).index(name)
            is_asked = stated.decimal is None and column.dtype.kind == "f"
            if is_asked and _may_have_thousands(values):
                fields = {k: _field(line, separator, column_index) for k, line in rows}
                _refuse_thousands(fields, decimal, name, file)
            continue
        entries = zip(rows, column, column.notna(), strict=True)
        texts = {k: str(word) for (k, _), word, is_present in entries if is_present}
        numbers = _numbers_of_texts(texts, decimal, name, file, notes)
        words = [k for k in texts if k not in numbers]
        if 2 * len(words) < len(rows):
            if words:
                raise InputError(
                    f"column {name} must be numbers, but row {words[0]} of {file} has "
                    f"{shown(texts[words[0]])}."
                )
            columns[name] = np.array([numbers.get(k, np.nan) for k, _ in rows])
        else:
            columns[name] = [texts.get(k, "") for k, _ in rows]
    return columns


def _numbers_of_texts(
    texts: Mapping[int, str], decimal: str, name: str, file: str, notes: list[Fact]
) -> dict[int, float]:
    """Numbers in texts by row, with thousands separators or in a column with the other decimal
    mark."""
    other = "comma" if decimal == "point" else "point"
    numbers = {k: number_in(text, decimal, thousands=True) for k, text in texts.items()}
    foreign = [
        k
        for k, text in texts.items()
        if numbers[k] is None and number_in(text, other, thousands=True) is not None
    ]
    if foreign:
        by_other = {k: number_in(text, other, thousands=True) for k, text in texts.items()}
        odd = next((k for k in texts if numbers[k] is not None and by_other[k] is None), None)
        if odd is not None:
            raise InputError(
                f"column {name} of {file} has decimal commas and decimal points: row {odd} has "
                f"{shown(texts[odd])}, row {foreign[0]} {shown(texts[foreign[0]])}."
            )
        numbers, decimal = by_other, other
        notes.append(Fact("other_decimal", name=name, decimal=decimal))
    grouped = [k for k, text in texts.items() if has_thousands(text, decimal)]
    if grouped:
        first = grouped[0]
        notes.append(Fact("thousands", name=name, text=texts[first], number=numbers[first]))
    values = {k: value for k, value in numbers.items() if value is not None}
    for k in texts.keys() - values.keys():  # "inf"
        if (value := pandas.to_numeric(texts[k], errors="coerce")) == value:
            values[k] = float(value)
    return values


def _refuse_ambiguous(rows: list[tuple[int, str]], separator: str, file: str) -> None:
    """Raise `ValueError` where a file leaves open whether "1.250" is 1.25 or 1250.

    That is so if every number is whole and below 1000 or has a mark before three digits, and both
    occur. Numbers that all have three digits after the mark are decimals, as are those with points
    in a comma-separated file.
    """
    marks = "," if separator == "," else ".,"
    if not any(mark in line for _, line in rows for mark in marks):
        return
    first: tuple[int, str] | None = None
    has_whole = False
    for k, line in rows:
        for field in fields_of(line, separator):
            if any(may_be_thousands(field, mark) for mark in marks):
                first = first or (k, field)
            elif field.lstrip("+-").isdigit() and len(field) < 4:
                has_whole = True
            elif any(is_number(field, decimal) for decimal in ("point", "comma")):
                return
    if first is not None and has_whole:
        row, field = first
        raise InputError(
            f"is {field} in row {row} of {file} {float(field.replace(',', '.')):g} or "
            f"{re.sub('[.,]', '', field)}? Its other numbers do not show it: --decimal point or "
            "comma."
        )


def _may_have_thousands(values: np.ndarray) -> bool:
    """Whether thousands in a column may have been read as decimals."""
    magnitude = np.abs(values[np.isfinite(values)])
    thousandths = 1e3 * magnitude
    return bool(
        magnitude.size
        and magnitude.max() < 1000
        and not np.any((magnitude > 0) & (magnitude < 1))
        and np.all(np.abs(thousandths - np.round(thousandths)) < 1e-6)
    )


def _refuse_thousands(fields: Mapping[int, str], decimal: str, name: str, file: str) -> None:
    """Raise `ValueError` for "998" and "1.000" in one column, whose formats contradict."""
    mark = "." if decimal == "point" else ","
    ambiguous = {k: field for k, field in fields.items() if may_be_thousands(field, mark)}
    whole = [field for k, field in fields.items() if k not in ambiguous and field]
    row = next((k for k, field in ambiguous.items() if field.endswith("0")), None)
    if whole and row is not None and not any(mark in field for field in whole):
        raise InputError(
            f"is {ambiguous[row]} in row {row} of {file} a thousand or more? Column {name} has "
            f"{whole[0]}, too, as if {shown(mark)} separated thousands, and is elsewhere the "
            "decimal mark: --decimal point or comma."
        )


def _field(line: str, separator: str, column_index: int) -> str:
    """One field of a line; empty if missing."""
    fields = fields_of(line, separator)
    return fields[column_index] if column_index < len(fields) else ""


def _cut(line: str, separator: str, width: int) -> str:
    """A row without the empty columns of trailing separators."""
    if separator == " " or line.count(separator) < width or '"' in line:
        return line
    return separator.join(line.split(separator)[:width])
