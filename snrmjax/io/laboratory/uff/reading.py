"""Universal files: functions become recordings, frequency responses and tables; shapes shapes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snrmjax.io.laboratory.contents import (
    LaboratoryFile,
    MeasuredShapes,
    NumberTable,
    measured_shapes,
    number_table,
)
from snrmjax.io.laboratory.uff.axis_units import UnitSystem, unit_system
from snrmjax.io.laboratory.uff.data_sets import (
    DataSets,
    direction_of,
    read_data_sets,
    stated,
)
from snrmjax.io.laboratory.uff.functions import read_functions

_HERTZ = 2 * np.pi


def read_uff(path: Path) -> LaboratoryFile:
    """A universal file. Raises `ValueError` as `read_laboratory_file` does."""
    sets = read_data_sets(path)
    units = unit_system(sets.of_type(164))
    functions = read_functions(sets.of_type(58), units, path.name)
    shapes = _shapes(sets.of_type(55), path.name)
    nodes = _nodes(sets, units)
    names = [stated(one.get("model_name", "")) for one in sets.of_type(151)]
    used = any(len(sets.of_type(number)) for number in (15, 55, 58, 2411))
    notes = [*sets.notes, *(units.notes if used else ()), *functions.notes]
    notes += [f"model {name}." for name in names if name]
    return LaboratoryFile(
        path.name,
        "uff",
        functions.recordings,
        functions.responses,
        functions.tables,
        shapes,
        tuple(dict.fromkeys(notes)),
        functions.levels,
        nodes,
    )


def _nodes(sets: DataSets, units: UnitSystem) -> tuple[NumberTable, ...]:
    """The points of the structure, in m."""
    found = []
    for k, one in enumerate((*sets.of_type(15), *sets.of_type(2411))):
        columns = {"node": np.asarray(one["node_nums"], float)} | {
            f"{axis}_m": np.asarray(one[axis], float) / units.length for axis in ("x", "y", "z")
        }
        if columns["node"].size:
            name = f"nodes {k + 1}" if k else "nodes"
            found.append(number_table(name, columns, {f"{axis}_m": "m" for axis in "xyz"}))
    return tuple(found)


def _shapes(sets: Sequence[Mapping[str, Any]], file: str) -> tuple[MeasuredShapes, ...]:
    """Mode shapes, those at the same nodes together."""
    groups: dict[tuple[float, ...], list[Mapping[str, Any]]] = {}
    for one in sets:
        if one["analysis_type"] in (2, 3, 7):
            groups.setdefault(tuple(one["node_nums"]), []).append(one)
    return tuple(
        _shapes_of_group(modes, f"shapes {k + 1} of {file}")
        for k, modes in enumerate(groups.values())
    )


def _shapes_of_group(modes: Sequence[Mapping[str, Any]], name: str) -> MeasuredShapes:
    """Modes at the same nodes; directions in which nothing moves in any mode are left out."""
    nodes = [str(int(node)) for node in modes[0]["node_nums"]]
    axes = [k for k in range(1, 7) if all(f"r{k}" in one for one in modes)]
    every = np.array([[one[f"r{k}"] for k in axes] for one in modes], dtype=complex)
    if every.ndim != 3 or every.shape[2] != len(nodes) or not every.size:
        raise ValueError(f"{name}: each mode needs its values at each of {len(nodes)} nodes.")
    moving = np.flatnonzero(np.any(every != 0, axis=(0, 2)))
    if not moving.size:
        raise ValueError(f"{name}: all values are zero.")
    values = [_modal_values(one) for one in modes]
    return measured_shapes(
        np.array([one[0] for one in values]),
        np.array([one[1] for one in values]),
        every[:, moving].transpose(0, 2, 1).reshape(len(modes), -1),
        [node for node in nodes for _ in moving],
        [direction_of(axes[k]) for _ in nodes for k in moving],
        modal_mass=np.array([one[2] for one in values]),
        name=name,
    )


def _modal_values(one: Mapping[str, Any]) -> tuple[float, float, float]:
    """Natural frequency (rad/s), damping ratio and modal mass; 0 of a mass says nothing."""
    if one["analysis_type"] == 2:
        mass = float(one["modal_m"])
        return _HERTZ * one["freq"], float(one["modal_damp_vis"]), mass if mass > 0 else np.nan
    root = abs(one["eig"])
    return root, -one["eig"].real / root if root else np.nan, np.nan
