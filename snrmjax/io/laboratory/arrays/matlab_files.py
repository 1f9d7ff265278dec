"""MATLAB files: v4 to v7 by scipy, v7.3 by h5py.

scipy trusts the declared sizes, types and counts, so that a damaged file can crash the process. So
each array of a MATLAB 5 file is checked against its class before scipy reads it: dimensions, name,
contents of known types, as many numbers, cells or fields as its dimensions state, and no data after
them.

Reference: MathWorks, *MAT-File Format* (2019), chapter 1.
"""

import struct
import warnings
import zlib
from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from snrmjax.io.laboratory.arrays.even_axis import EvenAxis
from snrmjax.io.laboratory.arrays.hdf5_tree import open_tree
from snrmjax.io.laboratory.arrays.structs import file_of_tree
from snrmjax.io.laboratory.arrays.value_tree import Node, in_memory
from snrmjax.io.laboratory.contents import LaboratoryFile
from snrmjax.io.laboratory.libraries import damaged_if_it_fails
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_CHAR, _SIGNED, _UNSIGNED, _MATRIX, _COMPRESSED, _UTF8 = 1, 5, 6, 14, 15, 16  # types of elements
_BYTES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
_CELL, _STRUCT, _OBJECT, _TEXT, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17  # of arrays
_NUMERIC = range(6, 16)  # classes of arrays
_COMPLEX = 0x800  # flag of an array
_INFLATES = 1100  # largest compression ratio of deflate
_MOST_DIMENSIONS = 32
_MOST_WITHOUT_BYTES = 2**16  # characters of a text, or structs without fields
_DEEPEST = 100
_LARGEST = 2**29  # bytes of a file before v7.3, which is read at once, and numbers in a variable


class MatlabVariable(NamedTuple):
    """Name of a variable, and the class of an object (a table, a string, a datetime)."""

    name: str
    object_class: str = ""


class _Element(NamedTuple):
    kind: int
    content: memoryview


def checked_variables(content: bytes) -> list[MatlabVariable]:
    """The variables of a MATLAB 5 file, in order.

    Raises `ValueError` for arrays whose contents do not match their headers, at any depth, and for
    compressed ones with an invalid checksum. Objects, which scipy skips, are not checked.
    """
    order = "<" if content[126:128] == b"IM" else ">"
    variables = []
    for kind, body in _elements(memoryview(content)[128:], order):
        if kind == _COMPRESSED:
            kind, body = _inflated(body, order)
        if kind != _MATRIX:
            raise InputError(f"it has an element of the type {kind} among its variables")
        variables.append(_variable(body, order))
    return [one for one in variables if one is not None]


def _inflated(body: memoryview, order: str) -> _Element:
    """A compressed variable, inflated if its declared size is possible."""
    kind, size = struct.unpack(f"{order}II", zlib.decompressobj().decompress(body, 8))
    if size > _INFLATES * len(body):
        raise InputError(f"it states {size} bytes that {len(body)} compressed ones cannot hold")
    stream = zlib.decompressobj()
    inflated = stream.decompress(body, 8 + size + 8)
    if not stream.eof or len(inflated) < 8 + size:
        raise InputError("it has a compressed variable of another size than stated")
    return _Element(kind, memoryview(inflated)[8 : 8 + size])


def _elements(content: memoryview, order: str) -> Iterator[_Element]:
    """Consecutive elements, each entirely within `content`."""
    position = 0
    while position + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, position)
        start = position + 8
        if kind >> 16:  # small data element format
            kind, size, start = kind & 0xFFFF, kind >> 16, position + 4
        if kind not in _BYTES and kind not in (_MATRIX, _COMPRESSED):
            raise InputError(f"it has an element of the type {kind}")
        if start + size > len(content) or (start == position + 4 and (size > 4 or kind == _MATRIX)):
            raise InputError(f"it has an element of {size} bytes where fewer are left")
        yield _Element(kind, content[start : start + size])
        position += (
            8 if start == position + 4 else 8 + (size if kind == _COMPRESSED else -(-size // 8) * 8)
        )


def _variable(body: memoryview, order: str) -> MatlabVariable | None:
    """A variable's name; None without a class."""
    parts = _elements(body, order)
    array_class = _flags(parts, order) & 0xFF
    if array_class == _OPAQUE:
        name, _, object_class = (_name(parts) for _ in range(3))
        return MatlabVariable(name, object_class or "object")
    if not array_class:
        return None
    _dimensions(parts, order)
    name = _name(parts)
    _check_array(body, order, 0)
    return MatlabVariable(name)


def _check_array(body: memoryview, order: str, depth: int) -> None:
    """Raises `ValueError` unless an array's contents match its class, flags and dimensions."""
    if depth > _DEEPEST:
        raise InputError(f"it has arrays within arrays, more than {_DEEPEST} deep")
    if not body:
        return  # an empty one
    parts = _elements(body, order)
    flags = _flags(parts, order)
    array_class = flags & 0xFF
    count = 1 if array_class == _OPAQUE else prod(_dimensions(parts, order))
    _name(parts)
    if array_class in _NUMERIC:
        for _ in range(2 if flags & _COMPLEX else 1):
            if _numbers(parts) != count:
                raise InputError(f"it has an array without its numbers, which are {count}")
    elif array_class == _TEXT:
        if not _numbers(parts) and count > _MOST_WITHOUT_BYTES:
            raise InputError(f"it has a text of {count} characters and no byte")
    elif array_class == _SPARSE:
        for _ in range(4 if flags & _COMPLEX else 3):
            _numbers(parts)
    else:
        for _ in range(_inner_arrays(parts, array_class, count, order)):
            kind, inner = _next(parts)
            if kind != _MATRIX:
                raise InputError(f"it has an array with the type {kind} for one of its entries")
            _check_array(inner, order, depth + 1)
    if depth and next(parts, None) is not None:
        raise InputError("it has an array with more than its contents")


def _inner_arrays(parts: Iterator[_Element], array_class: int, count: int, order: str) -> int:
    """Number of arrays in a cell array, a struct or an object."""
    if array_class == _CELL:
        return count
    if array_class == _FUNCTION:
        return 1
    if array_class == _OPAQUE:
        _name(parts), _name(parts)  # names of its type system and class
        return 1
    if array_class not in (_STRUCT, _OBJECT):
        raise InputError(f"it has an array of the class {array_class}")
    if array_class == _OBJECT:
        _name(parts)
    lengths = _integers(parts, order)
    if len(lengths) != 1 or lengths[0] < 1:
        raise InputError(f"it has a struct whose names have {lengths} characters")
    fields = len(_text(parts)) // lengths[0]
    if not fields and count > _MOST_WITHOUT_BYTES:
        raise InputError(f"it has {count} structs and no field")
    return count * fields


def _next(parts: Iterator[_Element]) -> _Element:
    """The next element; raises `ValueError` where there is none."""
    element = next(parts, None)
    if element is None:
        raise InputError("it has an array without its contents")
    return element


def _flags(parts: Iterator[_Element], order: str) -> int:
    kind, content = _next(parts)
    if kind != _UNSIGNED or len(content) != 8:
        raise InputError("it has an array without its flags")
    flags: int = struct.unpack_from(f"{order}I", content)[0]
    return flags


def _integers(parts: Iterator[_Element], order: str) -> tuple[int, ...]:
    kind, content = _next(parts)
    if kind not in (_SIGNED, _UNSIGNED) or len(content) % 4:
        raise InputError(f"it has whole numbers of the type {kind}, {len(content)} bytes of them")
    return struct.unpack(f"{order}{len(content) // 4}i", content)


def _dimensions(parts: Iterator[_Element], order: str) -> tuple[int, ...]:
    dimensions = _integers(parts, order)
    if not 2 <= len(dimensions) <= _MOST_DIMENSIONS or min(dimensions) < 0:
        raise InputError(f"it has an array with the dimensions {dimensions}")
    return dimensions


def _text(parts: Iterator[_Element]) -> memoryview:
    kind, content = _next(parts)
    if kind not in (_CHAR, _UTF8):
        raise InputError(f"it has a name of the type {kind}")
    return content


def _name(parts: Iterator[_Element]) -> str:
    return bytes(_text(parts)).decode("latin1")


def _numbers(parts: Iterator[_Element]) -> int:
    """Number of values in the next element."""
    element = next(parts, None)
    if element is None or element.kind not in _BYTES:
        raise InputError("it has an array without its numbers")
    return len(element.content) // _BYTES[element.kind]


def is_old_matlab(head: bytes, suffix: str) -> bool:
    """Whether a file is MATLAB before v7.3; v4 begins with an integer below 5000."""
    first = (int.from_bytes(head[:4], order) for order in ("little", "big"))
    return head.startswith(b"MATLAB 5") or (suffix.lower() == ".mat" and min(first) < 5000)


def read_matlab(path: Path, axis: EvenAxis | None = None) -> LaboratoryFile:
    """A MATLAB file. Raises `ValueError` as `read_laboratory_file` does."""
    with open(path, "rb") as file:
        is_old = is_old_matlab(file.read(8), path.suffix)
    tree, notes = _tree_of_old(path) if is_old else open_tree(path)
    return file_of_tree(path.name, tree, notes, axis)


def _tree_of_old(path: Path) -> tuple[dict[str, Node], list[Fact]]:
    """The variables of a file before v7.3 as a tree, and notes on those not read."""
    import scipy.io

    n_bytes = path.stat().st_size
    if n_bytes > _LARGEST:
        raise InputError(
            f"{path.name} has {n_bytes / 2**20:.0f} MiB, more than the {_LARGEST / 2**20:.0f} MiB "
            "limit of a file before v7.3: save it with `-v7.3`, which is read block by "
            "block."
        )
    with damaged_if_it_fails(path.name, "a MATLAB file"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about several objects without a name
        content = path.read_bytes()
        if content.startswith(b"MATLAB 5"):
            variables = checked_variables(content)
        else:
            variables = _of_level_4(path)
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


def _of_level_4(path: Path) -> list[MatlabVariable]:
    """Variables of a MATLAB 4 file. Raises `ValueError` above the size limit."""
    import scipy.io

    variables = scipy.io.whosmat(path)
    for name, dimensions, _ in variables:
        if np.prod(dimensions, dtype=float) > _LARGEST:
            raise InputError(f"{name} states {' by '.join(map(str, dimensions))} numbers")
    return [MatlabVariable(name) for name, _, _ in variables]


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
    if value.dtype == object:  # a cell array: a list, or a list of rows if two-dimensional
        if value.ndim == 2 and min(value.shape) > 1:
            return [_cells(row, name, notes) for row in value]
        return _cells(value.reshape(-1, order="F"), name, notes)
    if value.dtype.kind in "US":
        texts = [str(text).rstrip() for text in value.reshape(-1)]
        return list(texts) if len(texts) > 1 else "".join(texts)
    if value.dtype.kind not in "biufc":
        notes.append(Fact("not_read", name=name, why="type"))
        return None
    return in_memory(value) if value.size else None


def _cells(cells: np.ndarray, name: str, notes: list[Fact]) -> list[Node]:
    nodes = [_node(cell, f"{name}{{{k + 1}}}", notes) for k, cell in enumerate(cells)]
    return [node for node in nodes if node is not None]
