"""Output of CalculiX: eigenvalues, printed displacements and forces, energies, errors."""

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from snrmjax.numerics.rules import InputError

_HEADER = re.compile(
    r"^ (displacements|forces) \(.*\) for set \S+ and time\s+(\S+)\s*$", re.MULTILINE
)
_ENERGY = re.compile(r"total internal energy .* and time\s+(\S+)\s*$", re.MULTILINE)
_EIGENVALUE = re.compile(r"^\s*(\d+)\s+(\S+)\s+(\S+)\s+(\S+)\s+(\S+)\s*$")
_E_DROPPED = re.compile(r"(\d)([+-]\d{3})$")  # Fortran drops the E of three-digit exponents
_ERROR = re.compile(r"\*ERROR[^\n]*(?:\n(?!\s*\n|\s*\*)[^\n]*)*")


class PrintedTable(NamedTuple):
    """One table of *NODE PRINT: displacements (m) or forces (N) at a time."""

    quantity: str
    time: float
    values: Float[np.ndarray, "node 3"]


def printed_tables(text: str, nodes: Int[np.ndarray, " node"]) -> Iterator[PrintedTable]:
    """Tables of displacements and forces in a `.dat` file, rows in the order of `nodes`.

    Raises `ValueError` where a table does not have each node once or a number is malformed.
    """
    heads = list(_HEADER.finditer(text))
    for head in heads:
        rows = []
        for line in text[head.end() :].lstrip("\n").splitlines():
            parts = line.split()
            if len(parts) != 4 or not parts[0].isdigit():
                break
            rows.append([_E_DROPPED.sub(r"\1e\2", part) for part in parts])
        table = np.array(rows, dtype=float).reshape(-1, 4)
        order = np.argsort(table[:, 0])
        if not np.array_equal(table[order, 0], nodes):
            raise InputError(
                f"a table of {head[1]} has {len(table)} rows for {len(nodes)} nodes: "
                "it is incomplete."
            )
        yield PrintedTable(head[1], float(head[2]), table[order, 1:])


def eigenvalues(text: str) -> Float[np.ndarray, " mode"]:
    """Eigenvalues ω² (rad²/s²) of a `.dat` file's first table, negative ones included."""
    begin = text.find("E I G E N V A L U E   O U T P U T")
    if begin < 0:
        return np.zeros(0)
    squares: list[float] = []
    for line in text[begin:].splitlines()[1:]:
        row = _EIGENVALUE.match(line)
        if row and int(row[1]) == len(squares) + 1:
            squares.append(float(row[2]))
        elif squares and line.strip():
            break
    return np.array(squares)


def last_energy(text: str) -> float | None:
    """The total internal energy (J) at the last time of a `.dat` file, or None."""
    heads = list(_ENERGY.finditer(text))
    if not heads:
        return None
    parts = text[heads[-1].end() :].split()
    return float(parts[0]) if parts else None


def first_error(log: str) -> str:
    """The first *ERROR of CalculiX's log on one line, or an empty text."""
    match = _ERROR.search(log)
    return " ".join(match[0].split()) if match else ""
