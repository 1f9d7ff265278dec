"""MATLAB files: v4 to v7 by scipy, v7.3 by h5py."""

import struct
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from snrmjax.io.laboratory.arrays.even_axis import EvenAxis
from snrmjax.io.laboratory.arrays.hdf5_tree import open_tree
from snrmjax.io.laboratory.arrays.structs import file_of_tree
from snrmjax.io.laboratory.arrays.value_tree import Node, held
from snrmjax.io.laboratory.contents import LaboratoryFile
from snrmjax.io.laboratory.libraries import damaged_if_it_fails
from snrmjax.numerics.facts import Fact

_MATRIX, _COMPRESSED = 14, 15  # types of elements
_OPAQUE = 17  # class of an object's array
_NUMBERS_OF = dict.fromkeys(range(6, 16), 1) | {4: 1, 5: 3}  # elements of numbers by class
_COMPLEX = 0x800  # flag of an array
_OF_NUMBERS = frozenset((*range(1, 8), 9, 12, 13, 16, 17, 18))  # types of elements
_HEADER = 4096  # bytes in which a variable's header ends
_LARGEST = 2**29  # bytes of a file before v7.3, which is read whole, and numbers of its variables


def is_old_matlab(head: bytes, suffix: str) -> bool:
    """Whether a file is of MATLAB before v7.3: v4 begins with a whole number below 5000."""
    first = (int.from_bytes(head[:4], order) for order in ("little", "big"))
    return head.startswith(b"MATLAB 5") or (suffix.lower() == ".mat" and min(first) < 5000)


def read_matlab(path: Path, axis: EvenAxis | None = None) -> LaboratoryFile:
    """A MATLAB file. Raises `ValueError` as `read_laboratory_file` does."""
    with open(path, "rb") as file:
        is_old = is_old_matlab(file.read(8), path.suffix)
    tree, notes = _tree_of_old(path) if is_old else open_tree(path)
    return file_of_tree(path.name, "matlab", tree, notes, axis)


def _tree_of_old(path: Path) -> tuple[dict[str, Node], list[Fact]]:
    """The variables of a file before v7.3 as a tree, and what was not read."""
    import scipy.io

    size = path.stat().st_size
    if size > _LARGEST:
        raise ValueError(
            f"{path.name} has {size / 2**20:.0f} MiB, more than the {_LARGEST / 2**20:.0f} MiB "
            "that are read of a file before v7.3: save it with `-v7.3`, which is read piece by "
            "piece."
        )
    with damaged_if_it_fails(path.name, "a MATLAB file"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of several objects, which all have no name
        # Headers first: a compressed variable may state more than any memory holds.
        content = path.read_bytes()
        if content.startswith(b"MATLAB 5"):
            order = "<" if content[126:128] == b"IM" else ">"
            _check_elements(memoryview(content)[128:], order)
            variables = list(_headers(memoryview(content)[128:], order))
        else:
            variables = [_Header(name, sides) for name, sides, _ in scipy.io.whosmat(path)]
        for name, sides, _ in variables:
            if np.prod(sides, dtype=float) > _LARGEST:
                raise ValueError(f"{name} states {' by '.join(map(str, sides))} numbers")
        plain = [one.name for one in variables if not one.object_class]
        loaded: dict[str, Any] = scipy.io.loadmat(path, mat_dtype=False, variable_names=plain)
    notes = [
        Fact("object_not_read", name=one.name, kind=one.object_class)
        for one in variables
        if one.object_class and one.name
    ]
    nodes = {
        key: _node(variable, key, notes) for key, variable in loaded.items() if key[:2] != "__"
    }
    return {key: node for key, node in nodes.items() if node is not None}, notes


class _Header(NamedTuple):
    """Name and sides of a variable, or the class of an object (a table, a string, a datetime)."""

    name: str
    sides: tuple[int, ...] = ()
    object_class: str = ""


def _headers(content: memoryview, order: str) -> Iterator[_Header]:
    """What stands before the numbers of every variable of a file of level 5.

    An object has no sides: behind its name stand "MCOS" (or "java") and its class.
    """
    at = 0
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        body = content[at + 8 : at + 8 + size]
        if kind == _COMPRESSED:
            body = memoryview(zlib.decompressobj().decompress(body, _HEADER))[8:]
        parts = _parts(body, order)
        flags = next(parts)
        array_class = struct.unpack_from(f"{order}I", flags)[0] & 0xFF if len(flags) > 3 else 0
        if array_class == _OPAQUE:
            name, _, object_class = (bytes(next(parts)).decode("latin1") for _ in range(3))
            yield _Header(name, (), object_class or "object")
        elif array_class:
            sides = next(parts)
            numbers = struct.unpack(f"{order}{len(sides) // 4}i", sides[: len(sides) // 4 * 4])
            yield _Header(bytes(next(parts)).decode("latin1"), numbers)
        at += 8 + (size if kind == _COMPRESSED else -(-size // 8) * 8)


def _parts(content: memoryview, order: str) -> Iterator[memoryview]:
    """The contents of the elements that stand one behind another; empty ones at the end."""
    at = 0
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        if kind >> 16:
            yield content[at + 4 : at + 4 + (kind >> 16)]
            at += 8
        else:
            yield content[at + 8 : at + 8 + size]
            at += 8 + -(-size // 8) * 8
    while True:
        yield memoryview(b"")


def _check_elements(content: memoryview, order: str) -> list[int]:
    """Raises `ValueError` for elements that end the process within scipy; returns their types.

    They are of no known type, or stand where an array lacks its numbers (its imaginary part, where
    a damaged flag says that there is one). What is compressed has a checksum of its own.
    """
    kinds: list[int] = []
    at = 0
    while at + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, at)
        if kind >> 16:  # a small one, within its tag
            kind, size = kind & 0xFFFF, 0
        if not 1 <= kind <= 18:
            raise ValueError(f"it has an element of the type {kind}")
        if kind == _MATRIX and size:
            body = content[at + 8 : at + 8 + size]
            within = _check_elements(body, order)
            flags = struct.unpack_from(f"{order}I", body, 8)[0] if len(body) >= 12 else 0
            count = _NUMBERS_OF.get(flags & 0xFF, 0)
            count += int(count > 0 and bool(flags & _COMPLEX))
            parts = within[3 : 3 + count]
            if len(parts) < count or not _OF_NUMBERS.issuperset(parts):
                raise ValueError("it has an array without its numbers")
        kinds.append(kind)
        at += 8 + (size if kind == _COMPRESSED else -(-size // 8) * 8)
    return kinds


def _node(value: Any, name: str, notes: list[Fact]) -> Node | None:
    """A loaded value as a node, or None with a note unless it is empty."""
    if type(value) is not np.ndarray:
        if value is None or hasattr(value, "tocoo"):
            why = "empty" if value is None else "sparse"
            notes.append(Fact("not_read", name=name, why=why))
            return None
        names = value.dtype.names or ()
        kind = value.reshape(-1)[0]["s2"].decode("latin1") if "s2" in names else ""
        kind = kind or getattr(value, "classname", "") or "function_handle"
        notes.append(Fact("object_not_read", name=name, kind=kind))
        return None
    if value.dtype.names:
        structs = []
        for record in value.reshape(-1, order="F"):
            nodes = {key: _node(record[key], f"{name}.{key}", notes) for key in value.dtype.names}
            structs.append({key: node for key, node in nodes.items() if node is not None})
        return structs[0] if len(structs) == 1 else list(structs)
    if value.dtype == object:  # a cell array: a list, or one of rows where it has two sides
        if value.ndim == 2 and min(value.shape) > 1:
            return [_cells(row, name, notes) for row in value]
        return _cells(value.reshape(-1, order="F"), name, notes)
    if value.dtype.kind in "US":
        texts = [str(text).rstrip() for text in value.reshape(-1)]
        return list(texts) if len(texts) > 1 else "".join(texts)
    if value.dtype.kind not in "biufc":
        notes.append(Fact("not_read", name=name, why="type"))
        return None
    return held(value) if value.size else None


def _cells(cells: np.ndarray, name: str, notes: list[Fact]) -> list[Node]:
    nodes = [_node(cell, f"{name}{{{k + 1}}}", notes) for k, cell in enumerate(cells)]
    return [node for node in nodes if node is not None]
