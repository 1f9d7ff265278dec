"""HDF5 and netCDF 4 files."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from snrmjax.io.laboratory.arrays.hdf5_tree import open_tree
from snrmjax.io.laboratory.arrays.structs import read_struct
from snrmjax.io.laboratory.arrays.value_tree import Node, Numbers
from snrmjax.io.laboratory.contents import Kind, LaboratoryFile
from snrmjax.io.laboratory.libraries import Budget
from snrmjax.io.units import HERTZ
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses, frequency_responses


def read_hdf5(path: Path) -> LaboratoryFile:
    """An HDF5 file. Raises `ValueError` as `read_laboratory_file` does."""
    return _read(path, "hdf5")


def read_netcdf(path: Path) -> LaboratoryFile:
    """A netCDF 4 file. Raises `ValueError` as `read_laboratory_file` does."""
    return _read(path, "netcdf")


def _read(path: Path, kind: Kind) -> LaboratoryFile:
    tree, notes = open_tree(path)
    budget = Budget(path.name)
    own = _own_responses(tree, budget)
    if own is not None:
        return LaboratoryFile(path.name, kind, responses=(own,), levels=(np.nan,))
    found = read_struct("", tree, budget)
    return LaboratoryFile(
        path.name,
        kind,
        tuple(found.recordings),
        tuple(found.responses),
        found.numbered(),
        (),
        tuple(dict.fromkeys((*notes, *found.notes))),
        (np.nan,) * len(found.responses),
    )


def _own_responses(tree: Mapping[str, Node], budget: Budget) -> FrequencyResponses | None:
    """Frequency responses as `FrequencyResponses.to_xarray` names them, or None."""
    arrays = [tree.get(key) for key in ("frequency_hz", "value_re", "value_im", "coherence")]
    names = [tree.get(key) for key in ("response", "reference")]
    if not all(isinstance(one, Numbers) for one in arrays):
        return None
    if not all(isinstance(one, list) for one in names):
        return None
    hertz, real, imaginary, coherence = (
        one.all(budget, "responses") for one in arrays if isinstance(one, Numbers)
    )
    outputs, inputs = (
        [_own_channel(str(name)) for name in one] for one in names if isinstance(one, list)
    )
    values = np.empty(real.shape, dtype=complex)
    values.real, values.imag = real, imaginary
    return frequency_responses(
        np.ravel(hertz) * HERTZ, values, outputs, inputs, coherence=coherence
    )


def _own_channel(text: str) -> Channel:
    """A channel of the line `name|quantity|unit|point|direction` that the writer makes."""
    parts = text.split("|")
    if len(parts) != 5:
        return Channel(text)
    name, quantity, unit, point, direction = parts
    known = {"force", "displacement", "velocity", "acceleration", "voltage"}
    return Channel(
        name,
        quantity if quantity in known else "unknown",  # type: ignore[arg-type]
        unit,
        1.0,
        point,
        direction,
    )
