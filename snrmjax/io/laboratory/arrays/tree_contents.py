"""What a tree of named arrays holds, whichever format it is from."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from snrmjax.io.laboratory.arrays.hdf5_tree import open_tree
from snrmjax.io.laboratory.arrays.structs import read_struct
from snrmjax.io.laboratory.arrays.value_tree import Node
from snrmjax.io.laboratory.contents import Kind, LaboratoryFile

_MOST_NAMED = 6
_NOTHING = "it has only texts, single numbers and empty arrays"


def read_hdf5(path: Path) -> LaboratoryFile:
    """An HDF5 file. Raises `ValueError` as `read_laboratory_file` does."""
    return file_of_tree(path.name, "hdf5", *open_tree(path))


def read_netcdf(path: Path) -> LaboratoryFile:
    """A netCDF 4 file. Raises `ValueError` as `read_laboratory_file` does."""
    return file_of_tree(path.name, "netcdf", *open_tree(path))


def file_of_tree(
    name: str, kind: Kind, tree: Mapping[str, Node], notes: Sequence[str]
) -> LaboratoryFile:
    """All that is found in a tree; `notes` say what of the file is not in it."""
    found = read_struct("", tree)
    if not (found.recordings or found.responses or found.tables):
        listed = f" ({', '.join(list(tree)[:_MOST_NAMED])})" if tree else ""
        notes = [*notes, *(() if notes or found.notes else (f"{_NOTHING}{listed}.",))]
    return LaboratoryFile(
        name,
        kind,
        tuple(found.recordings),
        tuple(found.responses),
        found.numbered(),
        tuple(dict.fromkeys((*notes, *found.notes))),
        tuple(np.nan for _ in found.responses),
    )
