"""HDF5, netCDF 4 and MATLAB v7.3 as a tree of named arrays, which stay in the file.

Files may be made to burst a reader: a few bytes may state numbers that no memory holds, and links
may lead in circles or to other files. So sizes are compared with what the file can hold before
anything is read, and only its own content is followed.
"""

import mmap
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from snrmjax.io.laboratory.arrays.even_axis import EvenAxis
from snrmjax.io.laboratory.arrays.structs import file_of_tree
from snrmjax.io.laboratory.arrays.value_tree import Node, Numbers, Selection, held
from snrmjax.io.laboratory.contents import LaboratoryFile
from snrmjax.io.laboratory.libraries import damaged_if_it_fails, library
from snrmjax.io.laboratory.names import role_of
from snrmjax.numerics.facts import Fact

_NETCDF = (".nc", ".nc4", ".cdf")  # endings of HDF5 files that are called netCDF
_MOST_OBJECTS = 20_000
_DEEPEST = 24
_LONGEST_TEXT = 2**17  # letters, or texts of a list
_INFLATES = 1100  # deflate cannot shrink by more
_LARGEST_CHUNK = 2**26  # bytes
_HEAP = b"GCOL\x01\0\0\0"  # signature and version of a heap of texts
_HEAP_HEADER = 16  # bytes, of a heap and of each object in it
_LENGTHS = np.dtype([("length", "<u4"), ("heap", "<u8"), ("index", "<u4")])  # of a text elsewhere
_LARGEST_SEARCHED = 2**28  # bytes of a file that is searched for damaged heaps
_HIDDEN = ("#refs#", "#subsystem#")
_UNITS = ("units", "unit", "Unit", "Units", "unit_string", "UNIT")
_WORDS = ("quantity", "point", "direction")


class _Walk(NamedTuple):
    h5py: Any
    path: Path
    size: int
    notes: list[Fact]
    seen: list[Any]  # addresses of groups above, against links in a circle
    objects: list[int]

    def leave_out(self, name: str, why: str) -> None:
        """Note that something is not read."""
        self.notes.append(Fact("not_read", name=name, why=why))

    def add_object(self) -> None:
        """One more object. Raises `ValueError` where that are too many."""
        self.objects[0] += 1
        if self.objects[0] > _MOST_OBJECTS:
            raise ValueError(f"it has more than {_MOST_OBJECTS} objects")


def open_tree(path: Path) -> tuple[dict[str, Node], list[Fact]]:
    """The tree of an HDF5 file and what was not read. The file is closed again.

    Links to other files, virtual and external data are not followed: a file is read alone.
    Raises `ValueError` for a damaged file and for more than 20 000 objects.
    """
    h5py = library("h5py", "reading HDF5, netCDF and MATLAB v7.3")
    notes: list[Fact] = []
    walk = _Walk(h5py, path, os.path.getsize(path), notes, [], [0])
    with damaged_if_it_fails(path.name, "an HDF5 file"):
        if walk.size < _LARGEST_SEARCHED:
            with (
                open(path, "rb") as raw,
                mmap.mmap(raw.fileno(), 0, access=mmap.ACCESS_READ) as content,
            ):
                _check_heaps(content)
        with h5py.File(path, "r") as file:
            return _group(walk, file), notes


def _check_heaps(content: mmap.mmap) -> None:
    """Raises `ValueError` for a heap of texts whose free space has no size.

    The library of HDF5 looks for its end forever.
    """
    start = content.find(_HEAP)
    while start >= 0:
        end = min(start + int.from_bytes(content[start + 8 : start + 16], "little"), len(content))
        at = start + _HEAP_HEADER
        while at + _HEAP_HEADER <= end:
            size = int.from_bytes(content[at + 8 : at + 16], "little")
            if not int.from_bytes(content[at : at + 2], "little"):
                if size < _HEAP_HEADER:
                    raise ValueError("it has a heap of texts without an end")
                break
            at += _HEAP_HEADER + -(-size // 8) * 8
        start = content.find(_HEAP, start + 1)


def read_hdf5(path: Path, axis: EvenAxis | None = None) -> LaboratoryFile:
    """An HDF5 or netCDF 4 file. Raises `ValueError` as `read_laboratory_file` does."""
    netcdf = path.suffix.lower() in _NETCDF
    return file_of_tree(path.name, "netcdf" if netcdf else "hdf5", *open_tree(path), axis)


def _group(walk: _Walk, group: Any) -> dict[str, Node]:
    """A group as a struct. Its attributes that state a rate are numbers of it."""
    address = walk.h5py.h5o.get_info(group.id).addr
    if address in walk.seen or len(walk.seen) > _DEEPEST:
        walk.leave_out(group.name, "circle")
        return {}
    walk.seen.append(address)
    fields: dict[str, Node] = dict(_rates(group))
    for name in group:
        if name in _HIDDEN:
            continue
        walk.add_object()
        link = group.get(name, getlink=True)
        if isinstance(link, walk.h5py.ExternalLink):
            walk.leave_out(name, "other_file")
            continue
        item = group.get(name)
        node = None if item is None else _object(walk, item, name)
        if node is not None:
            fields[name] = node
        if isinstance(item, walk.h5py.Dataset):
            for key, rate in _rates(item).items():
                fields.setdefault(key, rate)
    walk.seen.pop()
    return fields


def _rates(item: Any) -> dict[str, Numbers]:
    """Attributes that state a sampling rate or step, or the start of a record."""
    rates = {}
    for key in item.attrs:
        if role_of(key) in ("rate", "step") or key == "start_time_s":
            value = np.asarray(item.attrs[key])
            if value.size == 1 and value.dtype.kind in "iuf":
                rates[key] = held(value.astype(float).reshape(1))
    return rates


def _object(walk: _Walk, item: Any, name: str) -> Node | None:
    """A group or data set as a node, or None with a note."""
    kind = _attribute(item, "MATLAB_class")
    if "MATLAB_object_decode" in item.attrs or kind in ("function_handle", "opaque"):
        walk.notes.append(Fact("object_not_read", name=name, kind=kind or "object"))
        return None
    if isinstance(item, walk.h5py.Group):
        return _structs(_group(walk, item)) if kind == "struct" else _group(walk, item)
    if not isinstance(item, walk.h5py.Dataset) or "MATLAB_empty" in item.attrs:
        return None
    if _attribute(item, "NAME").startswith("This is a netCDF dimension but not"):
        return None
    reference = walk.h5py.check_ref_dtype(item.dtype) is walk.h5py.Reference
    if reference:
        return _references(walk, item, name)
    if walk.h5py.check_string_dtype(item.dtype) is not None or kind == "char":
        why = "too_many_texts" if item.size > _LONGEST_TEXT else _cannot_hold(walk, item)
        if why:
            return walk.leave_out(name, why)
        _check_lengths(walk, item, name)
        return _text(item, is_matlab=kind == "char")
    why = _cannot_hold(walk, item)
    if why:
        return walk.leave_out(name, why)
    if item.dtype.names and set(item.dtype.names) not in ({"real", "imag"}, {"r", "i"}):
        return {
            field: _numbers(walk, item, field=field)
            for field in item.dtype.names
            if item.dtype[field].kind in "biuf" and item.ndim == 1
        }
    if item.dtype.names is None and item.dtype.kind not in "biufc":
        return walk.leave_out(name, "type")
    return _numbers(walk, item, transposed=bool(kind)) if item.size else None


def _structs(fields: dict[str, Node]) -> Node:
    """A struct array of MATLAB (each field a list) as a list of structs, else the struct."""
    lists = [len(node) for node in fields.values() if isinstance(node, _ArrayField)]
    if len(lists) != len(fields) or not lists or len(set(lists)) > 1:
        return fields
    columns = {key: node for key, node in fields.items() if isinstance(node, list)}
    return [{key: nodes[k] for key, nodes in columns.items()} for k in range(lists[0])]


class _ArrayField(list):
    """The values of one field of a struct array: references without a class of their own."""


def _references(walk: _Walk, item: Any, name: str) -> Node | None:
    """A cell array, or a field of a struct array."""
    if item.size > _MOST_OBJECTS:
        raise ValueError(f"{name} lists {item.size} entries")
    nodes: list[list[Node]] = []
    # MATLAB's columns are the rows of the file.
    for row in np.atleast_2d(item[()]).T:
        line: list[Node] = []
        for reference in row:
            walk.add_object()
            inner = item.file[reference] if reference else None
            node = None if inner is None else _object(walk, inner, name)
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


def _check_lengths(walk: _Walk, item: Any, name: str) -> None:
    """Raises `ValueError` for a text of varying length that states more than the file holds.

    The library of HDF5 takes the memory that it states. A piece behind a filter is not looked at:
    what is damaged there does not pass the filter.
    """
    if item.dtype.kind != "O":
        return
    pieces = [(item.id.get_offset(), item.size)]
    if item.chunks:
        infos = [item.id.get_chunk_info(k) for k in range(item.id.get_num_chunks())]
        has_filters = item.id.get_create_plist().get_nfilters() > 0
        pieces = [(one.byte_offset, one.size // _LENGTHS.itemsize) for one in infos]
        pieces *= not has_filters
    with open(walk.path, "rb") as raw:
        for start, count in pieces:
            if start is None or start + count * _LENGTHS.itemsize > walk.size:
                continue  # beside its description, or refused by the library
            raw.seek(start)
            lengths = np.frombuffer(raw.read(count * _LENGTHS.itemsize), _LENGTHS)["length"]
            if (lengths > walk.size).any():
                raise ValueError(f"{name} has a text of {lengths.max()} letters")


def _cannot_hold(walk: _Walk, item: Any) -> str:
    """Why the numbers of a data set cannot be in this file, or nothing."""
    if item.is_virtual or item.external:
        return "elsewhere"
    stored, wanted = item.id.get_storage_size(), item.size * item.dtype.itemsize
    if item.size and not stored:
        return "never_written"
    if stored > walk.size or wanted > (_INFLATES * stored if item.chunks else stored):
        return "larger_than_file"
    pieces = int(np.prod(item.chunks, dtype=object)) if item.chunks else 0
    return "large_pieces" if pieces * item.dtype.itemsize > _LARGEST_CHUNK else ""


def _numbers(walk: _Walk, item: Any, *, transposed: bool = False, field: str = "") -> Numbers:
    """A data set as numbers, which are read by opening the file again."""
    scale, offset = _single(item, "scale_factor", 1.0), _single(item, "add_offset", 0.0)
    fill = _single(item, "_FillValue", np.nan)
    words = {key: _attribute(item, key) for key in _WORDS if key in item.attrs}
    unit = next((_attribute(item, key) for key in _UNITS if key in item.attrs), "")
    kind = item.dtype[field] if field else item.dtype
    is_complex = kind.names is not None or kind.kind == "c"
    packed = (scale, offset) != (1.0, 0.0) or (kind.kind in "iu" and not np.isnan(fill))
    read = _reader(walk.path, item.name, field, transposed)

    def unpacked(at: Selection) -> np.ndarray:
        raw = read(at)
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
    """Reads a part of a data set; the file is open for that long only."""

    def read(at: Selection) -> np.ndarray:
        h5py = library("h5py", "reading HDF5")
        with damaged_if_it_fails(path.name, "an HDF5 file"), h5py.File(path, "r") as file:
            source = file[name].fields(field) if field else file[name]
            values = np.asarray(source[at[::-1] if transposed else at])
        if values.dtype.names:
            real, imaginary = values.dtype.names
            values = values[real] + 1j * values[imaginary]
        return values.T if transposed else values

    return read


def _attribute(item: Any, key: str) -> str:
    """A text among the attributes, empty where it is none."""
    if key not in item.attrs:
        return ""
    value = item.attrs[key]
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace")
    return value if isinstance(value, str) else ""


def _single(item: Any, key: str, default: float) -> float:
    """A single number among the attributes."""
    if key not in item.attrs:
        return default
    value = np.asarray(item.attrs[key])
    return float(value.reshape(-1)[0]) if value.size == 1 and value.dtype.kind in "iuf" else default
