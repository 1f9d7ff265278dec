"""The rows of a CSV, and columns of checked numbers in them."""

import csv
import io
import re
from typing import NamedTuple

import numpy as np

from snrmjax.io.columns import Header
from snrmjax.io.files import shown
from snrmjax.numerics.rules import FRACTION, IN_RANGE_HZ, NOT_NEGATIVE, POSITIVE, SHORT, WHOLE, Rule

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_LIKE_GROUPED_NUMBER = re.compile(r"[+-]?[0-9][0-9.,'_\s]*(?:[eE][+-]?[0-9]+)?")
_SPACE_BEHIND_QUOTES = re.compile(r'("[^"]*+(?:""[^"]*+)*+")(?:[ \t]+(?=[,\r\n]|\Z))?')

_RULES: dict[str, tuple[Rule, ...]] = {
    "level": (WHOLE, SHORT),
    "frequency_hz": (POSITIVE, IN_RANGE_HZ),
    "force_n": (POSITIVE,),
    "drive_v": (POSITIVE,),
    "velocity_m_s": (POSITIVE,),
    "velocity_std_m_s": (NOT_NEGATIVE,),
    "phase_std_deg": (NOT_NEGATIVE,),
    "force_std_n": (NOT_NEGATIVE,),
    "harmonic_std_m_s": (NOT_NEGATIVE,),
    "order": (FRACTION,),
}


class Row(NamedTuple):
    """A row's fields, and its place in the file."""

    number: int  # of its first line in the file, from one
    fields: list[str]


class Cells(NamedTuple):
    """The rows below a header, read a column at a time."""

    rows: list[Row]
    header: Header
    file: str

    def texts(self, column: str) -> list[str]:
        """The fields of one column."""
        k = self.header.position[column]
        return [row.fields[k] for row in self.rows]

    def refusal(self, column: str, expected: str, row: int) -> ValueError:
        """The error for one field."""
        found = self.rows[row].fields[self.header.position[column]]
        if found == "":
            value = "an empty field"
        else:
            value = found if _NUMBER.fullmatch(found) and len(found) <= 40 else shown(found)
        return ValueError(
            f"`{column}` must be {expected}, but row {self.rows[row].number} of {self.file} "
            f"has {value}."
        )

    def numbers(self, column: str, *, empty_allowed: bool = False) -> np.ndarray:
        """One column as numbers that keep its rules; NaN where a field is empty."""
        values = np.full(len(self.rows), np.nan)
        rules = _RULES.get(column, ())
        for k, text in enumerate(self.texts(column)):
            if text == "" and empty_allowed:
                continue
            if not _NUMBER.fullmatch(text):
                raise self.refusal(column, _expected_number(text), k)
            value = float(text)
            if not np.isfinite(value):
                raise self.refusal(column, "a finite number", k)
            for rule in rules:
                if not rule.good(value):
                    raise self.refusal(column, rule.expected, k)
            values[k] = value
        return values


def _expected_number(text: str) -> str:
    if text.lstrip("+-").lower() in ("nan", "inf", "infinity"):
        return "a finite number"
    if _LIKE_GROUPED_NUMBER.fullmatch(text):
        return "a number with a point as decimal sign and no thousands separators"
    return "a number"


def split_rows(text: str, file: str) -> list[Row]:
    """Split a CSV into rows, header included, without spaces around fields and blank lines behind.

    Arguments: `text` of the whole file; `file` as messages name it.
    Raises `ValueError` when the text is not a CSV or has a blank line in the middle.

    >>> split_rows('level, "sensor" \\r\\n 1,"tip"\\r\\n\\r\\n', "beam.csv")[1]
    Row(number=2, fields=['1', 'tip'])
    """
    tidy = _SPACE_BEHIND_QUOTES.sub(r"\1", text)
    reader = csv.reader(io.StringIO(tidy, newline=""), strict=True, skipinitialspace=True)
    rows: list[Row] = []
    blank = last = 0
    try:
        for fields in reader:
            number, last = last + 1, reader.line_num
            stripped = [field.strip() for field in fields]
            if stripped in ([], [""]):
                blank = blank or number
            elif blank:
                raise ValueError(
                    f"blank lines may only stand at the end, but row {blank} of {file} is blank."
                )
            else:
                rows.append(Row(number, stripped))
    except csv.Error as error:
        raise ValueError(f"row {last + 1} of {file} is not valid CSV: {error}.") from error
    if not rows:
        raise ValueError(f"{file} is empty: a header row and rows of numbers are expected.")
    return rows
