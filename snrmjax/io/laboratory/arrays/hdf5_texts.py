"""Texts of varying length of an HDF5 file, read past the library.

The library believes what a damaged heap says: it loops for ever over objects of no size, and takes
memory for lengths that the file cannot have. So lists of texts are read here from the heap's bytes,
and attributes only where every heap of the file is sound.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_SIGNATURE = b"GCOL"
_HEAD, _ENTRY = 16, 16  # bytes of a collection's and of an object's header
_ELEMENT = 16  # bytes of a text in a data set: length, address of its collection, number in it
_PIECE = 2**24
_LONGEST = 2**16  # bytes of one text
_MOST = 2**26  # bytes of all texts of a list


def texts_of_heap(path: Path, offset: int, count: int, base: int) -> list[str]:
    """The texts whose elements stand at `offset` of the file.

    Arguments: `base` is where the file's addresses count from (its user block).
    Raises `ValueError` for elements and heaps that point nowhere.
    """
    size = path.stat().st_size
    heaps: dict[int, dict[int, tuple[int, int]]] = {}
    found, total = [], 0
    with open(path, "rb") as file:
        file.seek(offset)
        raw = file.read(_ELEMENT * count)
        if len(raw) < _ELEMENT * count:
            raise ValueError("a list of texts ends beyond the file")
        for length, address, number in struct.iter_unpack("<IQI", raw):
            total += length
            if length == 0:
                found.append("")
                continue
            if length > _LONGEST or total > _MOST or base + address >= size:
                raise ValueError("a text is longer than it can be, or lies beyond the file")
            if address not in heaps:
                file.seek(base + address)
                objects = _objects(file.read(_HEAD), base + address, size, file)
                if objects is None:
                    raise ValueError("a heap of texts is damaged")
                heaps[address] = objects
            where, room = heaps[address].get(number, (0, 0))
            if length > room:
                raise ValueError("a text is not in the heap in which it should be")
            file.seek(where)
            found.append(file.read(length).split(b"\0")[0].decode("utf-8", errors="replace"))
    return found


def heaps_are_sound(path: Path) -> bool:
    """Whether every heap of the file has objects that end inside it."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        for start in _signatures(path):
            file.seek(start)
            if _objects(file.read(_HEAD), start, size, file) is None:
                return False
    return True


def _signatures(path: Path) -> Iterator[int]:
    """Where heaps begin."""
    with open(path, "rb") as file:
        start, kept = 0, b""
        while piece := file.read(_PIECE):
            data = kept + piece
            at = data.find(_SIGNATURE)
            while at >= 0:
                yield start - len(kept) + at
                at = data.find(_SIGNATURE, at + 1)
            start += len(piece)
            kept = data[-len(_SIGNATURE) + 1 :]


def _objects(
    head: bytes, start: int, size: int, file: BinaryIO
) -> dict[int, tuple[int, int]] | None:
    """Place and size of each object of a heap by its number, or None where it is damaged."""
    if len(head) < _HEAD or head[:4] != _SIGNATURE or head[4] != 1:
        return None
    (length,) = struct.unpack("<Q", head[8:16])
    if not _HEAD <= length <= size - start:
        return None
    body = file.read(length - _HEAD)
    found: dict[int, tuple[int, int]] = {}
    at = 0
    while at + _ENTRY <= len(body):
        number, _, _, room = struct.unpack_from("<HHIQ", body, at)
        if number == 0:  # free space up to the end
            return found if room <= len(body) - at else None
        place = at + _ENTRY
        step = _ENTRY + (room + 7) // 8 * 8
        if number in found or room > len(body) - place:
            return None
        found[number] = (start + _HEAD + place, room)
        at += step
    return found
