"""MATLAB files: v4 read here, v5 to v7 by scipy, v7.3 by h5py."""

from pathlib import Path
from typing import Any

import numpy as np

from snrmjax.io.laboratory.arrays.hdf5_tree import open_tree
from snrmjax.io.laboratory.arrays.matlab4_files import begins_as_v4, tree_of_v4
from snrmjax.io.laboratory.arrays.matlab_headers import walk_variables
from snrmjax.io.laboratory.arrays.tree_contents import file_of_tree
from snrmjax.io.laboratory.arrays.value_tree import Node, held
from snrmjax.io.laboratory.contents import LaboratoryFile
from snrmjax.io.laboratory.libraries import damaged_if_it_fails

_LARGEST = 2**29  # bytes of a file before v7.3, which is read whole


def read_matlab(path: Path) -> LaboratoryFile:
    """A MATLAB file. Raises `ValueError` as `read_laboratory_file` does."""
    with open(path, "rb") as file:
        head = file.read(520)
    if head.startswith(b"MATLAB 5"):
        tree, notes = _tree_of_v5(path)
    elif begins_as_v4(head):
        _check_size(path)
        tree, notes = tree_of_v4(path)
    else:
        tree, notes = open_tree(path)
    return file_of_tree(path.name, "matlab", tree, notes)


def _tree_of_v5(path: Path) -> tuple[dict[str, Node], list[str]]:
    """The variables of a v5 file as a tree, and what was not read."""
    import scipy.io

    _check_size(path)
    file = path.name
    variables = walk_variables(path.read_bytes(), file)
    notes = [
        f"variable {one.name} is {one.why_not}, which is not read: save numbers, text, structs "
        "and cells instead."
        for one in variables
        if one.why_not and one.name
    ]
    names = [one.name for one in variables if one.name and not one.why_not]
    if not names:
        return {}, notes
    with damaged_if_it_fails(file, "a MATLAB file"):
        loaded: dict[str, Any] = scipy.io.loadmat(
            path, variable_names=names, squeeze_me=False, mat_dtype=False
        )
    tree: dict[str, Node] = {}
    for name in names:
        node = _node(loaded.get(name), name, notes)
        if node is not None:
            tree[name] = node
    return tree, notes


def _check_size(path: Path) -> None:
    """Refuse to hold very long files whole."""
    size = path.stat().st_size
    if size > _LARGEST:
        raise ValueError(
            f"{path.name} has {size / 2**20:.0f} MiB, more than the {_LARGEST / 2**20:.0f} MiB "
            "that are read of a file before v7.3: save it with `-v7.3`, which is read piece by "
            "piece."
        )


def _node(value: Any, name: str, notes: list[str]) -> Node | None:
    """A loaded value as a node, or None with a note unless it is empty."""
    if value is None:
        return None
    if not isinstance(value, np.ndarray) or type(value) is not np.ndarray:
        notes.append(f"{name} is {type(value).__name__}, which is not read.")
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
