"""The tags of a MATLAB v5 file, walked before anything is read.

Format: MathWorks, "MAT-File Format" (level 5): elements of a tag (type, bytes) and data; matrices
hold flags, dimensions, a name and further elements.
"""

import math
import struct
import zlib
from typing import NamedTuple

_MATRIX, _COMPRESSED = 14, 15
_SIZES = {1: 1, 2: 1, 3: 2, 4: 2, 5: 4, 6: 4, 7: 4, 9: 8, 12: 8, 13: 8, 16: 1, 17: 2, 18: 4}
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17
_STRANGE = {
    _OBJECT: "an object",
    _SPARSE: "a sparse matrix",
    _FUNCTION: "a function handle",
    _OPAQUE: "an object (string, table, datetime, …)",
}
_DEEPEST = 24
_MOST_BLANKS = 2**16
_ALWAYS_INFLATED = 2**25  # bytes; beyond, a file may grow by the factor below
_INFLATES = 20


class Variable5(NamedTuple):
    """A variable of a v5 file; `why_not` says why it is not read."""

    name: str
    why_not: str


class _Walk(NamedTuple):
    data: memoryview
    order: str  # "<" or ">"
    file: str

    def tag(self, at: int, end: int) -> tuple[int, int, int, int]:
        """Type, bytes, first byte of the data and of the next element."""
        if at + 8 > end:
            raise self.damage("an element is cut short")
        word, size = struct.unpack_from(f"{self.order}II", self.data, at)
        if word >> 16:  # a small element: its data stand in the tag
            kind, size = word & 0xFFFF, word >> 16
            if size > 4:
                raise self.damage("a small element states more than 4 bytes")
            return kind, size, at + 4, at + 8
        if size > end - at - 8:
            raise self.damage(f"an element states {size} bytes where {end - at - 8} are left")
        step = size if word == _COMPRESSED else -(-size // 8) * 8
        return word, size, at + 8, min(at + 8 + step, end)

    def damage(self, why: str) -> ValueError:
        """The error for a file that is not as the format says."""
        return ValueError(f"{self.file} is damaged: {why}.")


def walk_variables(content: bytes, file: str) -> list[Variable5]:
    """The variables of a v5 file. Raises `ValueError` where sizes do not fit into one another."""
    marks = {b"IM": "<", b"MI": ">"}
    order = marks.get(content[126:128])
    if len(content) < 136 or order is None:
        raise ValueError(f"{file} is damaged: its header of 128 bytes is not whole.")
    walk = _Walk(memoryview(content), order, file)
    most = max(_ALWAYS_INFLATED, _INFLATES * len(content))
    found, at, inflated = [], 128, 0
    while at < len(content):
        if len(content) - at < 8 and not any(content[at:]):
            break
        kind, size, start, following = walk.tag(at, len(content))
        if kind == _COMPRESSED:
            inner = _inflate(content[start : start + size], most - inflated, file)
            inflated += len(inner)
            found.append(_variable(_Walk(memoryview(inner), order, file)))
        elif kind == _MATRIX:
            found.append(_variable(_Walk(walk.data[at:following], order, file)))
        else:
            raise walk.damage(f"an element of type {kind} is no variable")
        at = following
    return found


def _inflate(packed: bytes, most: int, file: str) -> bytes:
    """A compressed element in full, if it does not grow too much."""
    unpacker = zlib.decompressobj()
    try:
        inner = unpacker.decompress(packed, max(1, most))
    except zlib.error as error:
        raise ValueError(f"{file} is damaged: a compressed variable breaks ({error}).") from error
    if unpacker.unconsumed_tail or len(inner) >= most:
        raise ValueError(
            f"{file} grows by more than {_INFLATES} times when it is unpacked: save it with "
            "`-v7.3`, or without compression by `-v6`."
        )
    if not unpacker.eof:
        raise ValueError(f"{file} is damaged: a compressed variable is cut short.")
    return inner


def _variable(walk: _Walk) -> Variable5:
    """One variable at the top of a file."""
    kind, size, start, _ = walk.tag(0, len(walk.data))
    if kind != _MATRIX:
        raise walk.damage(f"an element of type {kind} is no variable")
    name, strange = _matrix(walk, start, start + size, 0)
    return Variable5(name, strange)


def _matrix(walk: _Walk, at: int, end: int, depth: int) -> tuple[str, str]:
    """Name of a matrix and what it is that is not read; its sizes are checked on the way."""
    if depth > _DEEPEST:
        raise walk.damage(f"variables nest deeper than {_DEEPEST}")
    if at == end:
        return "", ""  # an empty matrix, as in unset fields
    _, size, start, at = walk.tag(at, end)
    if size < 8:
        raise walk.damage("a matrix lacks its flags")
    (flags,) = struct.unpack_from(f"{walk.order}I", walk.data, start)
    kind, is_complex = flags & 0xFF, bool(flags & 0x0800)
    if kind == _OPAQUE:
        _, size, start, _ = walk.tag(at, end)
        return _text(walk, start, size), _STRANGE[kind]
    _, size, start, at = walk.tag(at, end)
    if size < 8 or size % 4 or size > 4 * 32:
        raise walk.damage("a matrix has no two dimensions, or too many")
    sides = struct.unpack_from(f"{walk.order}{size // 4}i", walk.data, start)
    if min(sides) < 0:
        raise walk.damage("a matrix has a negative side")
    count = math.prod(sides)
    _, size, start, at = walk.tag(at, end)
    name = _text(walk, start, size)
    if kind in _STRANGE:
        return name, _STRANGE[kind]
    if kind in (_CELL, _STRUCT):
        each = 1
        if kind == _STRUCT:
            each, at = _fields(walk, at, end)
        if count * each * 8 > end - at:
            raise walk.damage(f"{name or 'a list'} states {count} entries, which it cannot hold")
        for _ in range(count * each):
            inner, size, start, at = walk.tag(at, end)
            if inner != _MATRIX:
                raise walk.damage("an entry of a list is no matrix")
            _matrix(walk, start, start + size, depth + 1)
        return name, ""
    if not 4 <= kind <= 15:
        raise walk.damage(f"a matrix is of the unknown class {kind}")
    for _ in range(1 + is_complex):
        if kind == _CHAR and not count and at == end:
            break
        inner, size, _, at = walk.tag(at, end)
        if inner not in _SIZES or (kind != _CHAR and size != count * _SIZES[inner]):
            raise walk.damage(
                f"{name or 'a matrix'} states {' by '.join(map(str, sides))} numbers, but has "
                f"{size} bytes of type {inner}"
            )
        # MATLAB writes blanks without their bytes.
        if kind == _CHAR and count > (size or _MOST_BLANKS):
            raise walk.damage(f"{name or 'a text'} states {count} letters in {size} bytes")
    return name, ""


def _fields(walk: _Walk, at: int, end: int) -> tuple[int, int]:
    """How many fields a struct has, and where its entries begin."""
    _, size, start, at = walk.tag(at, end)
    if size != 4:
        raise walk.damage("a struct lacks the length of its fields' names")
    (length,) = struct.unpack_from(f"{walk.order}i", walk.data, start)
    _, size, _, at = walk.tag(at, end)
    if not 1 <= length <= 256 or size % length:
        raise walk.damage("the names of a struct's fields do not fit")
    return size // length, at


def _text(walk: _Walk, start: int, size: int) -> str:
    """A name."""
    return bytes(walk.data[start : start + size]).split(b"\0")[0].decode("latin-1")
