"""A CSV as columns of checked numbers, the reader of all our tables.

The rules are strict: a doubtful field is refused with its row, where `pandas` would guess (1_000,
full-width digits, short rows).
"""

import csv
import io
import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.io.files import FilePath, file_name, read_bytes, read_text, shown
from snrmjax.numerics.rules import InputError, Rule

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_LIKE_GROUPED_NUMBER = re.compile(r"[+-]?[0-9][0-9.,'_\s]*(?:[eE][+-]?[0-9]+)?")
_SPACE_BEHIND_QUOTES = re.compile(r'("[^"]*+(?:""[^"]*+)*+")(?:[ \t]+(?=[,\r\n]|\Z))?')
_PLAIN_NUMBER = re.compile(r"[+-]?[0-9.]+(?:[eE][+-]?[0-9]+)?")


class Row(NamedTuple):
    """A row's fields and its line number."""

    number: int  # of its first line in the file, from one
    fields: list[str]


class Cells(NamedTuple):
    """The rows below a header, accessed by column."""

    names: list[str]  # of the columns, as the header has them
    rows: list[Row]
    file: str

    def require_rows(self) -> None:
        """Raises `ValueError` without rows, or where a row's width differs from the header's."""
        width, file = len(self.names), self.file
        for row in self.rows:
            if len(row.fields) != width:
                marks = " (numbers need a point as decimal sign and no thousands separators)"
                raise InputError(
                    f"each row must have {width} fields as the header has, but row {row.number} "
                    f"of {file} has {len(row.fields)}{marks if len(row.fields) > width else ''}."
                )
        if not self.rows:
            raise InputError(f"{file} has a header, but no rows below it.")

    def has(self, column: str) -> bool:
        """Whether there is such a column."""
        return column in self.names

    def texts(self, column: str) -> list[str]:
        """The fields of one column."""
        k = self.names.index(column)
        return [row.fields[k] for row in self.rows]

    def refusal(self, column: str, expected: str, row: int) -> InputError:
        """The error for one field."""
        field = self.texts(column)[row]
        if field == "":
            value = "an empty field"
        else:
            value = field if _NUMBER.fullmatch(field) and len(field) <= 40 else shown(field)
        return InputError(
            f"`{column}` must be {expected}, but row {self.rows[row].number} of {self.file} "
            f"has {value}."
        )

    def numbers(
        self, column: str, rules: Sequence[Rule] = (), *, empty_allowed: bool = False
    ) -> Float[np.ndarray, " row"]:
        """One column as numbers that satisfy the rules; NaN where a field is empty."""
        texts = self.texts(column)
        empty = ("",) if empty_allowed else ()
        values = _plain_numbers([text for text in texts if text not in empty])
        if values is None:
            k = next(k for k, text in enumerate(texts) if not (text in empty or _is_number(text)))
            raise self.refusal(column, _expected_number(texts[k]), k)
        at = np.array([k for k, text in enumerate(texts) if text not in empty], dtype=int)
        for k, value in zip(at.tolist(), values.tolist(), strict=True) if rules else ():
            for rule in rules:
                if not rule.good(value):
                    raise self.refusal(column, rule.expected, k)
        column_values = np.full(len(texts), np.nan)
        column_values[at] = values
        return column_values


def _plain_numbers(texts: list[str]) -> Float[np.ndarray, " text"] | None:
    """All texts as finite numbers, or None where one is no number.

    Restricted to these characters, since `float` also accepts 1_000 and full-width digits.
    """
    if not set("".join(texts)) <= set("0123456789+-.eE"):
        return None
    try:
        values = np.array(list(map(float, texts)))
    except ValueError:
        return None
    return values if np.isfinite(values).all() else None


def _is_number(text: str) -> bool:
    return _NUMBER.fullmatch(text) is not None and bool(np.isfinite(float(text)))


def _expected_number(text: str) -> str:
    if _NUMBER.fullmatch(text) or text.lstrip("+-").lower() in ("nan", "inf", "infinity"):
        return "a finite number"
    if _LIKE_GROUPED_NUMBER.fullmatch(text):
        return "a number with a point as decimal sign and no thousands separators"
    return "a number"


def read_cells(path: FilePath) -> Cells:
    """The header and the rows of a CSV; raises `ValueError` as `cells_of` does."""
    return cells_of(read_text(path), file_name(path))


def header_of(path: FilePath) -> list[str]:
    """The names in the first non-blank line of a CSV; invalid UTF-8 is replaced."""
    text = read_bytes(path).decode("utf-8-sig", errors="replace")
    first = text.lstrip().split("\n", 1)[0]
    return [name for field in first.split(",") if (name := field.strip().strip('"').strip())]


def cells_of(text: str, file: str) -> Cells:
    """The header and the rows of a CSV's text; `file` is its name in messages.

    Raises `ValueError` where it is not a CSV with a header, has a blank line in the middle, or a
    column twice. Check the rows by `Cells.require_rows` once the header is known.

    >>> cells_of('level, "sensor" \\r\\n 1,"tip"\\r\\n\\r\\n', "beam.csv").rows
    [Row(number=2, fields=['1', 'tip'])]
    """
    header, *rows = _split(text, file)
    names = header.fields
    if len(names) == 1 and re.search(r"[;\t]", names[0]):
        mark = "semicolons" if ";" in names[0] else "tabs"
        raise InputError(
            f"the fields of {file} must be separated by commas, but its header row has {mark}."
        )
    if all(_PLAIN_NUMBER.fullmatch(name) for name in names):
        raise InputError(
            f"row 1 of {file} must be a header row with the names of the columns, "
            f"but has {shown(names[0])}."
        )
    for k, name in enumerate(names):
        if name and name in names[:k]:
            raise InputError(
                f"each column must occur once, but {file} has the column `{shortened_name(name)}` "
                f"twice (columns {names.index(name) + 1} and {k + 1})."
            )
    return Cells(names, rows, file)


def shortened_name(name: str) -> str:
    """A column's name, printable and shortened."""
    text = name if name.isprintable() else ascii(name)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _split(text: str, file: str) -> list[Row]:
    """The rows of a CSV without spaces around fields and trailing blank lines."""
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
                raise InputError(
                    f"blank lines are only allowed at the end, but row {blank} of {file} is blank."
                )
            else:
                rows.append(Row(number, stripped))
    except csv.Error as error:
        raise InputError(f"row {last + 1} of {file} is not valid CSV: {error}.") from error
    if not rows:
        raise InputError(f"{file} is empty: a header row and rows of numbers are expected.")
    return rows
