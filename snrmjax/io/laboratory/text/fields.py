"""Laboratory text files: encodings, fields, decimal marks."""

import csv
import re
from pathlib import Path

from snrmjax.io.files import shown
from snrmjax.numerics.rules import InputError

_LARGEST = 2**28  # bytes
SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}
"""Column separators by name."""


def text_of(path: Path) -> str:
    """The text of a file in UTF-8 or else Windows-1252 (µ, ², °).

    Raises `ValueError` for a file of more than 256 MiB, and for a file that is no text.
    """
    size = path.stat().st_size
    if size > _LARGEST:
        raise InputError(
            f"{path.name} has {size / 2**20:.0f} MiB, more than the {_LARGEST / 2**20:.0f} MiB "
            "limit of a text: use HDF5, MATLAB v7.3 or TDMS for long records."
        )
    content = path.read_bytes()
    wide = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    if not wide and b"\0" in content:
        raise InputError(f"{path.name} is of no known format (it has NUL bytes).")
    for encoding in ("utf-16",) if wide else ("utf-8-sig", "cp1252"):
        try:
            return content.decode(encoding)
        except UnicodeDecodeError:
            continue
    raise InputError(f"{path.name} is of no known format (it is no text).")


def fields_of(line: str, separator: str) -> list[str]:
    """The fields of a line, without empty ones from trailing separators.

    Raises `ValueError` for unbalanced quotes.
    """
    if separator == " ":
        return line.split()
    try:
        fields = [field.strip() for field in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error as error:
        raise InputError(f"a line of the file has unbalanced quotes: {shown(line)}.") from error
    while fields and not fields[-1]:
        fields.pop()
    return fields


def number_in(field: str, decimal: str, *, thousands: bool = False) -> float | None:
    """The number in a field; None for text or an empty field.

    Arguments: `thousands` also accepts thousands separators (the other mark, an apostrophe, a blank
    or a thin one), as written by spreadsheets but not by instruments.

    >>> number_in("1.729,21", "comma", thousands=True), number_in("1.729,21", "comma")
    (1729.21, None)
    """
    match = _FORMATS[decimal, thousands].fullmatch(field.strip())
    if match is None or match[0].lower() == "nan":
        return None
    plain = match[0].replace(match["mark"], "") if thousands and match["mark"] else match[0]
    return float(re.sub("[dD]", "e", plain.replace(",", ".")))


def is_number(field: str, decimal: str) -> bool:
    """Whether a field is a number, including "nan" and thousands separators."""
    return bool(_FORMATS[decimal, True].fullmatch(field.strip()))


def has_thousands(field: str, decimal: str) -> bool:
    """Whether a number has thousands separators, with this decimal mark."""
    match = _FORMATS[decimal, True].fullmatch(field.strip())
    return match is not None and match["mark"] is not None


def may_be_thousands(field: str, mark: str) -> bool:
    """Whether `mark` may be either a thousands separator or the decimal mark of a field.

    >>> [may_be_thousands(field, ".") for field in ("1.000", "-12.345", "0.500", "1.25", "998")]
    [True, True, False, False, False]
    """
    return bool(_AMBIGUOUS[mark].fullmatch(field.strip()))


_MARKS = {"point": ".", "comma": ","}
_GROUP = "'’ \u00a0\u2009\u202f"


def _format(decimal: str, *, thousands: bool) -> re.Pattern[str]:
    mark = re.escape(_MARKS[decimal])
    (other,) = (each for name, each in _MARKS.items() if name != decimal)
    groups = rf"|[1-9][0-9]{{0,2}}(?P<mark>[{other}{_GROUP}])[0-9]{{3}}(?:(?P=mark)[0-9]{{3}})*"
    whole = rf"(?:[0-9]+{groups if thousands else ''})"
    number = rf"(?:{whole}(?:{mark}[0-9]*)?|{mark}[0-9]+)"
    return re.compile(rf"[+-]?{number}(?:[eEdD][+-]?[0-9]+)?|nan", re.IGNORECASE)


_FORMATS = {
    (decimal, thousands): _format(decimal, thousands=thousands)
    for decimal in _MARKS
    for thousands in (False, True)
}
_AMBIGUOUS = {mark: re.compile(rf"[+-]?[1-9][0-9]{{0,2}}\{mark}[0-9]{{3}}") for mark in ".,"}
