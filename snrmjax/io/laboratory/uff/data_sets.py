"""The data sets of a universal file, read by pyuff with additional checks."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from snrmjax.io.laboratory.libraries import damaged_if_it_fails, library
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_LARGEST = 2**29  # bytes: pyuff reads the whole file, with a temporary object per number
_READ = {58: "function", 151: "header", 164: "units"}
_OTHERS = {
    **{15: "nodes", 2411: "nodes", 55: "data at nodes, as of mode shapes"},
    **{18: "coordinate systems", 82: "lines of a drawing", 2400: "header of a model"},
    **{2412: "elements", 2414: "results at nodes or elements", 2420: "coordinate systems"},
    **{2429: "groups", 2467: "groups", 1858: "qualifiers of functions"},
    151: "header, cut short",
}
_TAG = re.compile(rb"    -1(?=[\r\n]| {74}|\Z)")
_HEAD = 2**11  # bytes of a function's header lines
_SHORTEST = 8  # bytes of the shortest number, a binary double; in text even a single has 13
_DIRECTIONS = {0: ""} | {
    sign * (k + 1): f"{'+' if sign > 0 else '-'}{name}"
    for k, name in enumerate(("x", "y", "z", "rx", "ry", "rz"))
    for sign in (1, -1)
}


class DataSets(NamedTuple):
    """Data sets of a universal file in order, as pyuff's dictionaries, and notes on unread ones."""

    sets: tuple[Mapping[str, Any], ...]
    notes: tuple[Fact, ...]

    def of_type(self, number: int) -> tuple[Mapping[str, Any], ...]:
        """The data sets of one type."""
        return tuple(function for function in self.sets if function["type"] == number)


def read_data_sets(path: Path) -> DataSets:
    """The data sets of a universal file with functions, header and units.

    Raises `ValueError` for a file that is damaged, ends within a data set, or declares more numbers
    than it has.
    """
    pyuff = library("pyuff", "reading universal files")
    file, n_bytes = path.name, path.stat().st_size
    if n_bytes > _LARGEST:
        raise InputError(
            f"{file} has {n_bytes / 2**20:.0f} MiB, more than the {_LARGEST / 2**20:.0f} MiB limit "
            "of a universal file: split it, or use HDF5 or TDMS for long records."
        )
    content = path.read_bytes()
    if len(_TAG.findall(content)) % 2:
        raise InputError(f"{file} is damaged: it ends within a data set (no closing -1).")
    sets: list[Mapping[str, Any]] = []
    left_out: dict[int, int] = {}
    with damaged_if_it_fails(file, "a universal file"):
        source = pyuff.UFF(str(path))
        types = [int(number) for number in source.get_set_types()]
    starts = [tag.start() for tag in _TAG.finditer(content)][::2]
    heads = [content[at : at + _HEAD] for at in starts] + [b""] * len(types)
    for k, number in enumerate(types):
        if number not in _READ:
            left_out[number] = left_out.get(number, 0) + 1
            continue
        where = f"a universal file: its data set {k + 1} ({_READ[number]}, type {number})"
        if number == 58:
            with damaged_if_it_fails(file, where):
                header = source.read_sets(k, header_only=True)
            _check_count(header, n_bytes, file, k + 1)
        try:
            with damaged_if_it_fails(file, where):
                function = source.read_sets(k)
        except InputError:
            if number != 151:
                raise
            # No numbers depend on the header.
            left_out[number] = left_out.get(number, 0) + 1
            continue
        if number == 58:
            function = _with_letters(_checked_function(function, file, k + 1), heads[k])
        sets.append(function)
    notes = [
        Fact("data_sets_not_read", n=count, type=number, meaning=_OTHERS.get(number, ""))
        for number, count in sorted(left_out.items())
    ]
    return DataSets(tuple(sets), tuple(notes))


def direction_of(code: int) -> str:
    """The direction of a code: 1 is +x, −3 is −z, 4 is +rx, 0 is unknown.

    >>> direction_of(-3)
    '-z'
    """
    return _DIRECTIONS.get(code, "")


def stated(text: str) -> str:
    """A text field; empty for NONE."""
    plain = text.strip().strip("\0").strip()
    return "" if plain.upper() == "NONE" else plain


def _with_letters(function: dict[str, Any], head: bytes) -> dict[str, Any]:
    """A function with Windows-1252 characters (², µ, °) restored, which pyuff replaces."""
    broken = {
        key for key, value in function.items() if isinstance(value, str) and "\ufffd" in value
    }
    restored = {}
    for line in head.splitlines() if broken else ():
        shown_line, decoded_line = line.decode("utf-8", "replace"), line.decode("cp1252", "replace")
        for key in broken:
            at = shown_line.find(function[key])
            if at >= 0 and len(shown_line) == len(decoded_line):
                restored[key] = decoded_line[at : at + len(function[key])]
    return {**function, **restored}


def _check_count(header: Mapping[str, Any], n_bytes: int, file: str, number: int) -> None:
    """Refuse a function that declares more points than the file can hold."""
    points, code = header["num_pts"], header["ord_data_type"]
    if code not in (2, 4, 5, 6):
        raise InputError(
            f"data set {number} of {file} has the ordinate type {code}, but 2, 4, 5 and 6 exist."
        )
    each = (2 if code > 4 else 1) * (4 if code in (2, 5) else _SHORTEST)
    if points < 1 or points * each > n_bytes:
        raise InputError(
            f"data set {number} of {file} states {points} points, which a file of {n_bytes} bytes "
            "cannot hold."
        )


def _checked_function(function: dict[str, Any], file: str, number: int) -> dict[str, Any]:
    """A function with the declared number of values. Trailing bytes (line ends) are dropped."""
    points = function["num_pts"]
    x, data = np.asarray(function["x"], float), np.asarray(function["data"])
    if min(x.size, data.size) < points:
        raise InputError(
            f"data set {number} of {file} states {points} points, but has {data.size}."
        )
    if not np.isfinite(x[:points]).all() or not np.isfinite(function["z_axis_value"]):
        raise InputError(f"data set {number} of {file} has an abscissa that is not finite.")
    return {**function, "x": x[:points], "data": data[:points], "number": number}
