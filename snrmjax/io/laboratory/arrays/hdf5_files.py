"""HDF5 and netCDF 4 files."""

from pathlib import Path

from snrmjax.io.laboratory.arrays.hdf5_tree import open_tree
from snrmjax.io.laboratory.arrays.tree_contents import file_of_tree
from snrmjax.io.laboratory.contents import Kind, LaboratoryFile


def read_hdf5(path: Path) -> LaboratoryFile:
    """An HDF5 file. Raises `ValueError` as `read_laboratory_file` does."""
    return _read(path, "hdf5")


def read_netcdf(path: Path) -> LaboratoryFile:
    """A netCDF 4 file. Raises `ValueError` as `read_laboratory_file` does."""
    return _read(path, "netcdf")


def _read(path: Path, kind: Kind) -> LaboratoryFile:
    tree, notes = open_tree(path)
    return file_of_tree(path.name, kind, tree, notes)
