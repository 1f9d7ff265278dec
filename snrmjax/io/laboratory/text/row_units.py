"""Units in the rows of a text: after each number, or in a column of their own."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.io.files import shown
from snrmjax.io.laboratory.physical_units import level_reference, meaning_or_none, unit_meaning
from snrmjax.io.laboratory.text.fields import SEPARATORS, fields_of
from snrmjax.numerics.rules import InputError

_NUMBER_AND_UNIT = re.compile(r"([+-]?[\d.,'’]*\d[.,]?(?:[eE][+-]?\d+)?)\s*([^\W\d_].*|[°%])")
_UNIT_COLUMN = re.compile(r"(units?|einheit(en)?)(_\d+)?", re.IGNORECASE)


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
