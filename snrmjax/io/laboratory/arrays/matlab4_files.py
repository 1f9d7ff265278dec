"""MATLAB v4 files, as older analysers write them.

Format: MathWorks, "MAT-File Format" (level 4): matrices of a header of five whole numbers, a name,
and the numbers column by column, real parts first.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from snrmjax.io.laboratory.arrays.value_tree import Node, held

_HEADER = 20  # bytes
_KINDS = ("f8", "f4", "i4", "i2", "u2", "u1")
_FULL, _TEXT, _SPARSE = 0, 1, 2
_LONGEST_NAME = 64


class _Header(NamedTuple):
    order: str  # "<" or ">"
    kind: str
    matter: int  # full, text, sparse
    sides: tuple[int, int]
    is_complex: bool
    name: str
    size: int  # bytes of header and name

    @property
    def numbers(self) -> int:
        """Numbers in the file."""
        return self.sides[0] * self.sides[1] * (2 if self.is_complex else 1)


def begins_as_v4(head: bytes) -> bool:
    """Whether a file begins with the header of a v4 matrix and its name."""
    return _header(head) is not None


def tree_of_v4(path: Path) -> tuple[dict[str, Node], list[str]]:
    """The variables of a v4 file as a tree, and what was not read.

    Raises `ValueError` for a matrix that is cut short and for anything but matrices.
    """
    content, file = path.read_bytes(), path.name
    tree: dict[str, Node] = {}
    notes: list[str] = []
    at = 0
    while at < len(content):
        header = _header(content[at : at + _HEADER + _LONGEST_NAME])
        if header is None:
            raise ValueError(f"{file} is damaged: at byte {at} no matrix of MATLAB v4 begins.")
        start = at + header.size
        at = start + header.numbers * int(header.kind[1])
        if at > len(content):
            raise ValueError(
                f"{file} is damaged: {header.name} states {header.sides[0]} by {header.sides[1]} "
                f"numbers, of which {at - len(content)} bytes are missing."
            )
        if header.matter == _SPARSE:
            notes.append(f"variable {header.name} is a sparse matrix, which is not read.")
            continue
        kind = np.dtype(header.order + header.kind)
        numbers = np.frombuffer(content, kind, header.numbers, start).astype(kind.newbyteorder("="))
        tree[header.name] = (
            _text(numbers, header) if header.matter == _TEXT else _held(numbers, header)
        )
    return tree, notes


def _header(head: bytes) -> _Header | None:
    """The header at the beginning of some bytes, or None where they are none."""
    if len(head) < _HEADER:
        return None
    for order, machine in (("<", 0), (">", 1)):
        code, rows, columns, imaginary, length = struct.unpack(f"{order}5i", head[:_HEADER])
        thousands, rest = divmod(code, 1000)
        kind, matter = divmod(rest, 10)
        if thousands != machine or kind >= len(_KINDS) or matter > _SPARSE:
            continue
        if min(rows, columns) < 0 or imaginary not in (0, 1) or not 1 < length <= _LONGEST_NAME:
            continue
        name, end, beyond = head[_HEADER : _HEADER + length].partition(b"\0")
        text = name.decode("latin-1")
        if not end or beyond.strip(b"\0") or not text.isidentifier() or not text.isascii():
            continue
        sides, size = (rows, columns), _HEADER + length
        return _Header(order, _KINDS[kind], matter, sides, bool(imaginary), text, size)
    return None


def _held(numbers: np.ndarray, header: _Header) -> Node:
    """A matrix."""
    if not header.is_complex:
        return held(numbers.reshape(header.sides, order="F"))
    half = numbers.size // 2
    values = np.empty(half, dtype=complex)
    values.real, values.imag = numbers[:half], numbers[half:]
    return held(values.reshape(header.sides, order="F"))


def _text(numbers: np.ndarray, header: _Header) -> Node:
    """A text, or a list of texts: one a row."""
    rows = numbers.reshape(header.sides, order="F").astype(int)
    texts: list[Node] = ["".join(map(chr, np.clip(row, 0, 255))).rstrip() for row in rows]
    return texts if len(texts) > 1 else "".join(map(str, texts))
