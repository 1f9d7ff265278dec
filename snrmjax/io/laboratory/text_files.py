"""Texts of laboratories as they lie on the disk: encodings, fields, decimal marks."""

import csv
import re
from pathlib import Path

from snrmjax.io.files import shown

_LARGEST = 2**28  # bytes
SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}
"""The separators of columns by their names."""


def text_of(path: Path) -> str:
    """The text of a file: UTF-8 or, where it is none, Windows' Western letters (µ, ², °).

    Raises `ValueError` for a file of more than 256 MiB, and for one that is no text.
    """
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


def fields_of(line: str, separator: str) -> list[str]:
    """The fields of a line, without the empty ones that separators at its end make.

    Raises `ValueError` for a line that breaks the quotes.
    """
    if separator == " ":
        return line.split()
    try:
        fields = [field.strip() for field in next(csv.reader([line], delimiter=separator), [])]
    except csv.Error as error:
        raise ValueError(f"a line of the file breaks the quotes: {shown(line)}.") from error
    while fields and not fields[-1]:
        fields.pop()
    return fields


def number_in(field: str, decimal: str) -> float | None:
    """The number in a field, or None: it is a text, or empty."""
    plain = field.strip()
    shape = _POINT if decimal == "point" else _COMMA
    if not shape.fullmatch(plain):
        return None
    return float(re.sub("[dD]", "e", plain.replace(",", "."))) if plain.lower() != "nan" else None


_POINT = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eEdD][+-]?[0-9]+)?|nan", re.I)
_COMMA = re.compile(r"[+-]?(?:[0-9]+,?[0-9]*|,[0-9]+)(?:[eE][+-]?[0-9]+)?|nan", re.I)


def is_number(field: str, decimal: str) -> bool:
    """Whether a field is written as a number, "nan" included."""
    return bool((_POINT if decimal == "point" else _COMMA).fullmatch(field.strip()))
