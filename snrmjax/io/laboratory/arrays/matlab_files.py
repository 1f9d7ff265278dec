"""MATLAB files: v4 to v7 by scipy, v7.3 by h5py."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from snrmjax.io.laboratory.arrays.hdf5_tree import open_tree
from snrmjax.io.laboratory.arrays.tree_contents import file_of_tree
from snrmjax.io.laboratory.arrays.value_tree import Node, held
from snrmjax.io.laboratory.contents import LaboratoryFile
from snrmjax.io.laboratory.libraries import damaged_if_it_fails

_LARGEST = 2**29  # bytes of a file before v7.3, which is read whole, and numbers of its variables


def is_old_matlab(head: bytes, suffix: str) -> bool:
    """Whether a file is of MATLAB before v7.3: v4 begins with a whole number below 5000."""
    first = (int.from_bytes(head[:4], order) for order in ("little", "big"))
    return head.startswith(b"MATLAB 5") or (suffix.lower() == ".mat" and min(first) < 5000)


def read_matlab(path: Path) -> LaboratoryFile:
    """A MATLAB file. Raises `ValueError` as `read_laboratory_file` does."""
    with open(path, "rb") as file:
        is_old = is_old_matlab(file.read(8), path.suffix)
    tree, notes = _tree_of_old(path) if is_old else open_tree(path)
    return file_of_tree(path.name, "matlab", tree, notes)


def _tree_of_old(path: Path) -> tuple[dict[str, Node], list[str]]:
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
        for name, sides, _ in scipy.io.whosmat(path):
            if np.prod(sides, dtype=float) > _LARGEST:
                raise ValueError(f"{name} states {' by '.join(map(str, sides))} numbers")
        loaded: dict[str, Any] = scipy.io.loadmat(path, mat_dtype=False)
    tree: dict[str, Node] = {}
    notes: list[str] = []
    for name, value in loaded.items():
        node = None if name.startswith("__") else _node(value, name, notes)
        if node is not None:
            tree[name] = node
    return tree, notes


def _node(value: Any, name: str, notes: list[str]) -> Node | None:
    """A loaded value as a node, or None with a note unless it is empty."""
    if type(value) is not np.ndarray:
        what = "a sparse matrix" if hasattr(value, "tocoo") else "an object or a function handle"
        which = "a variable" if name == "None" else f"variable {name}"  # objects lose theirs
        notes.append(
            f"{which} is {what}, which is not read: save numbers, text, structs and cells instead."
        )
        return None
    if value.dtype.names:
        structs = []
        for record in value.reshape(-1, order="F"):
            fields = {}
            for field in value.dtype.names:
                node = _node(record[field], f"{name}.{field}", notes)
                if node is not None:
                    fields[field] = node
            structs.append(fields)
        return structs[0] if len(structs) == 1 else list(structs)
    if value.dtype == object:
        return _cells(value, name, notes)
    if value.dtype.kind in "US":
        texts = [str(text).rstrip() for text in value.reshape(-1)]
        return list(texts) if len(texts) > 1 else "".join(texts)
    if value.dtype.kind not in "biufc":
        notes.append(f"{name} is of type {value.dtype}, which is not read.")
        return None
    return held(value) if value.size else None


def _cells(value: np.ndarray, name: str, notes: list[str]) -> Node:
    """A cell array: a list, or a list of rows where it has two sides."""

    def known(cells: np.ndarray) -> list[Node]:
        nodes = [_node(cell, f"{name}{{{k + 1}}}", notes) for k, cell in enumerate(cells)]
        return [node for node in nodes if node is not None]

    if value.ndim == 2 and min(value.shape) > 1:
        return [known(row) for row in value]
    return known(value.reshape(-1, order="F"))
