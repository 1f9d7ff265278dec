"""MATLAB files: v4 to v7 by scipy, v7.3 by h5py."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from snrmjax.io.laboratory.arrays.even_axis import EvenAxis
from snrmjax.io.laboratory.arrays.hdf5_tree import open_tree
from snrmjax.io.laboratory.arrays.matlab_elements import MatlabVariable, checked_variables
from snrmjax.io.laboratory.arrays.structs import file_of_tree
from snrmjax.io.laboratory.arrays.value_tree import Node, in_memory
from snrmjax.io.laboratory.contents import LaboratoryFile
from snrmjax.io.laboratory.libraries import damaged_if_it_fails
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_LARGEST = 2**29  # bytes of a file before v7.3, which is read at once, and numbers in a variable


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
