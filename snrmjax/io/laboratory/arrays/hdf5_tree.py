"""HDF5, netCDF 4 and MATLAB v7.3 as a tree of named arrays that are read on demand.

Malicious files may exhaust memory: a few bytes may declare arrays larger than any memory, and links
may be circular or lead to other files. So declared sizes are compared with what the file can hold
before anything is read, and only its own content is followed.
"""

import mmap
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from snrmjax.io.laboratory.arrays.even_axis import EvenAxis
from snrmjax.io.laboratory.arrays.structs import file_of_tree
from snrmjax.io.laboratory.arrays.value_tree import Node, Numbers, Selection, in_memory
from snrmjax.io.laboratory.contents import LaboratoryFile
from snrmjax.io.laboratory.libraries import damaged_if_it_fails, library
from snrmjax.io.laboratory.names import role_of
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_MOST_OBJECTS = 20_000
_DEEPEST = 24
_LONGEST_TEXT = 2**17  # characters, or strings of a list
_INFLATES = 1100  # largest compression ratio of deflate
_LARGEST_CHUNK = 2**26  # bytes
_HEAP = b"GCOL\x01\0\0\0"  # signature and version of a global heap
_HEAP_HEADER = 16  # bytes, of a heap and of each object in it
_LENGTHS = np.dtype(
    [("length", "<u4"), ("heap", "<u8"), ("index", "<u4")]
)  # of a variable-length string
_LARGEST_SEARCHED = 2**28  # largest file (bytes) searched for damaged heaps
_HIDDEN = ("#refs#", "#subsystem#")
_UNITS = ("units", "unit", "Unit", "Units", "unit_string", "UNIT")
_WORDS = ("quantity", "point", "direction")


class _Traversal(NamedTuple):
    h5py: Any
    path: Path
    size: int
    notes: list[Fact]
    parents: list[Any]  # addresses of parent groups, to detect circular links
    objects: list[int]

    def leave_out(self, name: str, why: str) -> None:
        """Record an object that is not read."""
        self.notes.append(Fact("not_read", name=name, why=why))

    def add_object(self) -> None:
        """Count an object. Raises `ValueError` above the limit."""
        self.objects[0] += 1
        if self.objects[0] > _MOST_OBJECTS:
            raise InputError(f"it has more than {_MOST_OBJECTS} objects")


def open_tree(path: Path) -> tuple[dict[str, Node], list[Fact]]:
    """The tree of an HDF5 file, and notes on objects not read. The file is closed again.

    Links to other files and virtual or external data are not followed.
    Raises `ValueError` for a damaged file and for more than 20 000 objects.
    """
    h5py = library("h5py", "reading HDF5, netCDF and MATLAB v7.3")
    notes: list[Fact] = []
    traversal = _Traversal(h5py, path, os.path.getsize(path), notes, [], [0])
    with damaged_if_it_fails(path.name, "an HDF5 file"):
        if traversal.size < _LARGEST_SEARCHED:
            with (
                open(path, "rb") as raw,
                mmap.mmap(raw.fileno(), 0, access=mmap.ACCESS_READ) as content,
            ):
                _check_heaps(content)
        with h5py.File(path, "r") as file:
            return _group(traversal, file), notes


def _check_heaps(content: mmap.mmap) -> None:
    """Raises `ValueError` for a global heap whose free space has size zero.

    The HDF5 library would search for its end forever.
    """
    start = content.find(_HEAP)
    while start >= 0:
        end = min(start + int.from_bytes(content[start + 8 : start + 16], "little"), len(content))
        position = start + _HEAP_HEADER
        while position + _HEAP_HEADER <= end:
            size = int.from_bytes(content[position + 8 : position + 16], "little")
            if not int.from_bytes(content[position : position + 2], "little"):
                if size < _HEAP_HEADER:
                    raise InputError("it has a global heap without an end")
                break
            position += _HEAP_HEADER + -(-size // 8) * 8
        start = content.find(_HEAP, start + 1)


def read_hdf5(path: Path, axis: EvenAxis | None = None) -> LaboratoryFile:
    """An HDF5 or netCDF 4 file. Raises `ValueError` as `read_laboratory_file` does."""
    return file_of_tree(path.name, *open_tree(path), axis)


def _group(traversal: _Traversal, group: Any) -> dict[str, Node]:
    """A group as a struct, including attributes that state a sampling rate."""
    address = traversal.h5py.h5o.get_info(group.id).addr
    if address in traversal.parents or len(traversal.parents) > _DEEPEST:
        traversal.leave_out(group.name, "circle")
        return {}
    traversal.parents.append(address)
    fields: dict[str, Node] = dict(_rates(group))
    for name in group:
        if name in _HIDDEN:
            continue
        traversal.add_object()
        link = group.get(name, getlink=True)
        if isinstance(link, traversal.h5py.ExternalLink):
            traversal.leave_out(name, "other_file")
            continue
        item = group.get(name)
        node = None if item is None else _object(traversal, item, name)
        if node is not None:
            fields[name] = node
        if isinstance(item, traversal.h5py.Dataset):
            for key, rate in _rates(item).items():
                fields.setdefault(key, rate)
    traversal.parents.pop()
    return fields


def _rates(item: Any) -> dict[str, Numbers]:
    """Attributes that state a sampling rate or step, or the start of a record."""
    rates = {}
    for key in item.attrs:
        if role_of(key) in ("rate", "step") or key == "start_time_s":
            value = np.asarray(item.attrs[key])
            if value.size == 1 and value.dtype.kind in "iuf":
                rates[key] = in_memory(value.astype(float).reshape(1))
    return rates


def _object(traversal: _Traversal, item: Any, name: str) -> Node | None:
    """A group or data set as a node, or None with a note."""
    kind = _attribute(item, "MATLAB_class")
    if "MATLAB_object_decode" in item.attrs or kind in ("function_handle", "opaque"):
        traversal.notes.append(Fact("object_not_read", name=name, kind=kind or "object"))
        return None
    if isinstance(item, traversal.h5py.Group):
        return _structs(_group(traversal, item)) if kind == "struct" else _group(traversal, item)
    if not isinstance(item, traversal.h5py.Dataset) or "MATLAB_empty" in item.attrs:
        return None
    if _attribute(item, "NAME").startswith("This is a netCDF dimension but not"):
        return None
    reference = traversal.h5py.check_ref_dtype(item.dtype) is traversal.h5py.Reference
    if reference:
        return _references(traversal, item, name)
    if traversal.h5py.check_string_dtype(item.dtype) is not None or kind == "char":
        why = "too_many_texts" if item.size > _LONGEST_TEXT else _cannot_hold(traversal, item)
        if why:
            return traversal.leave_out(name, why)
        _check_lengths(traversal, item, name)
        return _text(item, is_matlab=kind == "char")
    why = _cannot_hold(traversal, item)
    if why:
        return traversal.leave_out(name, why)
    if item.dtype.names and set(item.dtype.names) not in ({"real", "imag"}, {"r", "i"}):
        return {
            field: _numbers(traversal, item, field=field)
            for field in item.dtype.names
            if item.dtype[field].kind in "biuf" and item.ndim == 1
        }
    if item.dtype.names is None and item.dtype.kind not in "biufc":
        return traversal.leave_out(name, "type")
    return _numbers(traversal, item, transposed=bool(kind)) if item.size else None


def _structs(fields: dict[str, Node]) -> Node:
    """A MATLAB struct array (each field a list) as a list of structs; other structs unchanged."""
    lists = [len(node) for node in fields.values() if isinstance(node, _ArrayField)]
    if len(lists) != len(fields) or not lists or len(set(lists)) > 1:
        return fields
    columns = {key: node for key, node in fields.items() if isinstance(node, list)}
    return [{key: nodes[k] for key, nodes in columns.items()} for k in range(lists[0])]


class _ArrayField(list):
    """Values of one field of a struct array: references without a MATLAB class."""


def _references(traversal: _Traversal, item: Any, name: str) -> Node | None:
    """A cell array, or a field of a struct array."""
    if item.size > _MOST_OBJECTS:
        raise InputError(f"{name} lists {item.size} entries")
    nodes: list[list[Node]] = []
    # MATLAB arrays are stored transposed.
    for row in np.atleast_2d(item[()]).T:
        line: list[Node] = []
        for reference in row:
            traversal.add_object()
            inner = item.file[reference] if reference else None
            node = None if inner is None else _object(traversal, inner, name)
            if node is not None:
                line.append(node)
        nodes.append(line)
    if item.ndim == 2 and min(item.shape) > 1:
        return list(nodes)
    flat = [node for line in nodes for node in line]
    return flat if _attribute(item, "MATLAB_class") == "cell" else _ArrayField(flat)


def _text(item: Any, *, is_matlab: bool) -> Node:
    """Text, or a list of texts."""
    value = item[()]
    if is_matlab:
        codes = np.asarray(value).T.reshape(-1)
        return "".join(chr(int(code)) for code in codes if 0 < int(code) < 0xD800)
    texts = [
        text.decode("utf-8", errors="replace") if isinstance(text, bytes) else str(text)
        for text in np.atleast_1d(value).reshape(-1)
    ]
    return texts[0] if np.ndim(value) == 0 else list(texts)


def _check_lengths(traversal: _Traversal, item: Any, name: str) -> None:
    """Raises `ValueError` for a variable-length string longer than the file.

    The HDF5 library allocates the declared length. Filtered chunks are not checked: damaged ones
    fail in the filter.
    """
    if item.dtype.kind != "O":
        return
    chunks = [(item.id.get_offset(), item.size)]
    if item.chunks:
        infos = [item.id.get_chunk_info(k) for k in range(item.id.get_num_chunks())]
        has_filters = item.id.get_create_plist().get_nfilters() > 0
        chunks = [(one.byte_offset, one.size // _LENGTHS.itemsize) for one in infos]
        chunks *= not has_filters
    with open(traversal.path, "rb") as raw:
        for start, count in chunks:
            if start is None or start + count * _LENGTHS.itemsize > traversal.size:
                continue  # stored in the object header, or refused by the library
            raw.seek(start)
            lengths = np.frombuffer(raw.read(count * _LENGTHS.itemsize), _LENGTHS)["length"]
            if (lengths > traversal.size).any():
                raise InputError(f"{name} has a string of {lengths.max()} characters")


def _cannot_hold(traversal: _Traversal, item: Any) -> str:
    """Why the data of a data set cannot be in this file; empty if they can."""
    if item.is_virtual or item.external:
        return "elsewhere"
    stored, wanted = item.id.get_storage_size(), item.size * item.dtype.itemsize
    if item.size and not stored:
        return "never_written"
    if stored > traversal.size or wanted > (_INFLATES * stored if item.chunks else stored):
        return "larger_than_file"
    chunks = int(np.prod(item.chunks, dtype=object)) if item.chunks else 0
    return "large_pieces" if chunks * item.dtype.itemsize > _LARGEST_CHUNK else ""


def _numbers(
    traversal: _Traversal, item: Any, *, transposed: bool = False, field: str = ""
) -> Numbers:
    """A data set as numbers that are read by reopening the file."""
    scale, offset = _single(item, "scale_factor", 1.0), _single(item, "add_offset", 0.0)
    fill = _single(item, "_FillValue", np.nan)
    words = {key: _attribute(item, key) for key in _WORDS if key in item.attrs}
    unit = next((_attribute(item, key) for key in _UNITS if key in item.attrs), "")
    kind = item.dtype[field] if field else item.dtype
    is_complex = kind.names is not None or kind.kind == "c"
    packed = (scale, offset) != (1.0, 0.0) or (kind.kind in "iu" and not np.isnan(fill))
    read = _reader(traversal.path, item.name, field, transposed)

    def unpacked(selection: Selection) -> np.ndarray:
        raw = read(selection)
        values = raw * scale + offset
        return np.where(raw == fill, np.nan, values)

    return Numbers(
        item.shape[::-1] if transposed else item.shape,
        unpacked if packed and not is_complex else read,
        is_complex,
        {**words, "unit": unit} if unit else words,
    )


def _reader(
    path: Path, name: str, field: str, transposed: bool
) -> Callable[[Selection], np.ndarray]:
    """A function that reads a part of a data set, opening the file for each call."""

    def read(selection: Selection) -> np.ndarray:
        h5py = library("h5py", "reading HDF5")
        with damaged_if_it_fails(path.name, "an HDF5 file"), h5py.File(path, "r") as file:
            source = file[name].fields(field) if field else file[name]
            values = np.asarray(source[selection[::-1] if transposed else selection])
        if values.dtype.names:
            real, imaginary = values.dtype.names
            values = values[real] + 1j * values[imaginary]
        return values.T if transposed else values

    return read


def _attribute(item: Any, key: str) -> str:
    """A string attribute; empty where it is missing or no string."""
    if key not in item.attrs:
        return ""
    value = item.attrs[key]
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace")
    return value if isinstance(value, str) else ""


def _single(item: Any, key: str, default: float) -> float:
    """A scalar attribute."""
    if key not in item.attrs:
        return default
    value = np.asarray(item.attrs[key])
    return float(value.reshape(-1)[0]) if value.size == 1 and value.dtype.kind in "iuf" else default
