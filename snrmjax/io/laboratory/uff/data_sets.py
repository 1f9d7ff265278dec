"""The data sets of a universal file by pyuff, with the checks that it leaves out."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from snrmjax.io.laboratory.libraries import damaged_if_it_fails, library
from snrmjax.numerics.facts import Fact

_LARGEST = 2**29  # bytes: pyuff holds all of a file, and each number as an object for a while
_READ = {58: "function", 151: "header", 164: "units"}
_OTHERS = {
    **{15: "nodes", 2411: "nodes", 55: "data at nodes, as of mode shapes"},
    **{18: "coordinate systems", 82: "lines of a drawing", 2400: "header of a model"},
    **{2412: "elements", 2414: "results at nodes or elements", 2420: "coordinate systems"},
    **{2429: "groups", 2467: "groups", 1858: "qualifiers of functions"},
    151: "header, cut short",
}
_TAG = re.compile(rb"    -1(?=[\r\n]| {74}|\Z)")
_HEAD = 2**11  # bytes of a function's lines of text
_SHORTEST = 8  # bytes of the shortest number: a double in binary; of text even a single has 13
_DIRECTIONS = {0: ""} | {
    sign * (k + 1): f"{'+' if sign > 0 else '-'}{name}"
    for k, name in enumerate(("x", "y", "z", "rx", "ry", "rz"))
    for sign in (1, -1)
}


class DataSets(NamedTuple):
    """Data sets of a universal file in order, as pyuff's dictionaries, and what was not read."""

    sets: tuple[Mapping[str, Any], ...]
    notes: tuple[Fact, ...]

    def of_type(self, number: int) -> tuple[Mapping[str, Any], ...]:
        """Those of one type."""
        return tuple(function for function in self.sets if function["type"] == number)


def read_data_sets(path: Path) -> DataSets:
    """The data sets of a universal file that are of use here.

    Raises `ValueError` for a file that is damaged, ends within a data set, or states more numbers
    than it holds.
    """
    pyuff = library("pyuff", "reading universal files")
    file, size = path.name, path.stat().st_size
    if size > _LARGEST:
        raise ValueError(
            f"{file} has {size / 2**20:.0f} MiB, more than the {_LARGEST / 2**20:.0f} MiB that are "
            "read of a universal file: split it, or take HDF5 or TDMS for long records."
        )
    content = path.read_bytes()
    if len(_TAG.findall(content)) % 2:
        raise ValueError(f"{file} is damaged: it ends within a data set (no closing -1).")
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
            _check_count(header, size, file, k + 1)
        try:
            with damaged_if_it_fails(file, where):
                function = source.read_sets(k)
        except ValueError:
            if number != 151:
                raise
            # A header has nothing that numbers depend on.
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
    """The direction of a code: 1 is +x, −3 is −z, 4 is +rx, 0 says nothing.

    >>> direction_of(-3)
    '-z'
    """
    return _DIRECTIONS.get(code, "")


def stated(text: str) -> str:
    """A field of text, empty where it says NONE."""
    plain = text.strip().strip("\0").strip()
    return "" if plain.upper() == "NONE" else plain


def _with_letters(function: dict[str, Any], head: bytes) -> dict[str, Any]:
    """A function whose texts have Windows' Western letters (², µ, °), which pyuff replaces."""
    broken = {
        key for key, value in function.items() if isinstance(value, str) and "\ufffd" in value
    }
    restored = {}
    for line in head.splitlines() if broken else ():
        seen, meant = line.decode("utf-8", "replace"), line.decode("cp1252", "replace")
        for key in broken:
            at = seen.find(function[key])
            if at >= 0 and len(seen) == len(meant):
                restored[key] = meant[at : at + len(function[key])]
    return {**function, **restored}


def _check_count(header: Mapping[str, Any], size: int, file: str, number: int) -> None:
    """Refuse a function that states more points than the file has bytes for."""
    points, code = header["num_pts"], header["ord_data_type"]
    if code not in (2, 4, 5, 6):
        raise ValueError(
            f"data set {number} of {file} has the ordinate type {code}, but 2, 4, 5 and 6 exist."
        )
    each = (2 if code > 4 else 1) * (4 if code in (2, 5) else _SHORTEST)
    if points < 1 or points * each > size:
        raise ValueError(
            f"data set {number} of {file} states {points} points, which a file of {size} bytes "
            "cannot hold."
        )


def _checked_function(function: dict[str, Any], file: str, number: int) -> dict[str, Any]:
    """A function with as many values as it states. Trailing bytes (line ends) are dropped."""
    points = function["num_pts"]
    x, data = np.asarray(function["x"], float), np.asarray(function["data"])
    if min(x.size, data.size) < points:
        raise ValueError(
            f"data set {number} of {file} states {points} points, but holds {data.size}."
        )
    if not np.isfinite(x[:points]).all() or not np.isfinite(function["z_axis_value"]):
        raise ValueError(f"data set {number} of {file} has an abscissa that is not finite.")
    return {**function, "x": x[:points], "data": data[:points], "number": number}
