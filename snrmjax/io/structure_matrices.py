"""Structures given by matrices, under [structure] of a model file."""

import dataclasses
import io
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse
from jaxtyping import Float

from snrmjax.io.files import shown
from snrmjax.io.laboratory.arrays.matlab_files import checked_variables
from snrmjax.io.laboratory.libraries import damaged_if_it_fails
from snrmjax.io.toml_table import TomlTable
from snrmjax.model.attachment import InfluenceVector, between, influence_vector
from snrmjax.model.builders.matrices import check_names, from_matrices
from snrmjax.model.effect_base import AbstractEffect, AbstractForce
from snrmjax.model.moving_base import MOTIONS, BaseMotion, base_motion
from snrmjax.model.structures import Structure
from snrmjax.numerics.names import suggestion
from snrmjax.numerics.rules import BELOW_ONE, NOT_ZERO, POSITIVE, InputError
from snrmjax.numerics.units import DEGREE

_MATRICES = ("mass", "stiffness", "damping")
_SPARSE = ("data", "indices", "indptr", "row", "col", "offsets", "shape", "format")
_UNREADABLE = (OSError, ValueError, KeyError, NotImplementedError, zipfile.BadZipFile)


def structure_of_matrices(
    top: TomlTable, file: str, folder: Path, effects: tuple[AbstractEffect, ...]
) -> Structure:
    """The structure of [structure], [force] or [base], and [sensors].

    Matrices are in the table or in a separate file: NPZ or MAT with arrays `mass`, `stiffness`,
    `points` and optionally `damping`. A sparse one in an NPZ file has the arrays of
    `scipy.sparse.save_npz`, here `mass_data`, `mass_indices`, …; or each is in its own `save_npz`
    file, given by name: `mass = "mass.npz"`; the points are then x1, x2, … unless named.
    Raises `ValueError` that names file, table and key.
    """
    table = top.table("structure", f"[structure] of {file}")
    table.check_keys((), (*_MATRICES, "points", "file", "damping_ratio", "modes"))
    parts = dict(table.entries)
    if "file" in parts:
        for key in (*_MATRICES, "points"):
            if key in parts:
                raise InputError(f"{table.location} has both `file` and `{key}`.")
        parts |= _arrays(folder / table.text("file"), table)
    in_files = [key for key in _MATRICES if isinstance(parts.get(key), str)]
    for key in in_files:
        parts[key] = _sparse_file(folder / table.text(key), key, table)
    if "damping" in parts and "damping_ratio" in parts:
        raise InputError(f"{table.location} has both `damping` and `damping_ratio`.")
    for key in ("mass", "stiffness", *(() if in_files else ("points",))):
        if key not in parts:
            raise InputError(f"{table.location} lacks the key `{key}`.")
    matrices = {key: _matrix(key, parts[key], table) for key in _MATRICES if key in parts}
    points = parts.get("points", [f"x{k + 1}" for k in range(matrices["mass"].shape[0])])
    if not isinstance(points, list) or not all(isinstance(p, str) and p.strip() for p in points):
        raise table.refusal("points", "a list of names, one for each unknown", points)
    try:
        check_names(points, matrices["mass"].shape[0])
    except InputError as error:
        raise InputError(f"{table.location} cannot be read: {error}") from error
    damping: Any = matrices.get("damping")
    if "damping_ratio" in parts:
        damping = table.number("damping_ratio", BELOW_ONE)
    base = moving_base(top, file)
    if base is not None and "force" in top.entries:
        raise InputError(f"{file} has both [force] and [base]: a force or a base that moves.")
    force = None if base else top.table("force", f"[force] of {file}")
    at = {} if force is None else _force(force)
    sensors, n_modes = listed_sensors(top, file), None
    if "modes" in parts:
        n_modes = table.whole("modes", 1)
        if n_modes > len(points):
            raise table.refusal(
                "modes", f"between 1 and {len(points)}, the number of unknowns", n_modes
            )
    _check_named(points, at, f"`at` in [force] of {file}")
    _check_named(points, sensors or (), f"`points` in [sensors] of {file}")
    _check_named(points, dict(base.along if base else ()), f"`along` in [base] of {file}")
    for k, effect in enumerate(effects, 1):
        vectors = effect.influence_vectors if isinstance(effect, AbstractForce) else ()
        named = [point for vector in vectors if vector is not None for point, _ in vector]
        _check_named(points, named, f"effect {k} of {file}")
    try:
        built = from_matrices(
            matrices["mass"],
            damping,
            matrices["stiffness"],
            points,
            force=at or None,
            base=base,
            unbalance=force.number("unbalance_kg_m", POSITIVE)
            if force is not None and "unbalance_kg_m" in force.entries
            else None,
            effects=effects,
            n_modes=n_modes,
            sensors=sensors,
            name=top.text("name", folder.stem),
        )
    except InputError as error:
        raise InputError(f"{table.location} cannot be read: {error}") from error
    of_interest = top.whole("mode_of_interest", 1, 1)
    if of_interest > built.n_modes:
        raise top.refusal(
            "mode_of_interest", f"from 1 to the number of modes ({built.n_modes})", of_interest
        )
    chosen = dataclasses.replace(built.modes, mode_of_interest=of_interest - 1)
    return dataclasses.replace(built, modes=chosen)


def _check_named(points: list[str], named: Iterable[str], location: str) -> None:
    for point in named:
        if point not in points:
            near = suggestion(point, points) or f"; known are {', '.join(points[:12])}"
            raise InputError(
                f"{location} names the point {shown(point)}, which does not exist{near}."
            )


def moving_base(top: TomlTable, file: str) -> BaseMotion | None:
    """The base motion of [base]; None for force excitation."""
    if "base" not in top.entries:
        return None
    table = top.table("base", f"[base] of {file}")
    table.check_keys(("motion",), ("along",))
    stated = table.text("motion")
    motion = next((kind for kind in MOTIONS if kind == stated), None)
    if motion is None:
        raise table.refusal("motion", "what the sensors record, absolute or relative", stated)
    along = (
        table.table("along", f"`along` of {table.location}") if "along" in table.entries else None
    )
    cosines = {} if along is None else {point: along.number(point) for point in along.entries}
    return base_motion(motion, cosines)


def unbalance(top: TomlTable, file: str) -> float | None:
    """The unbalance of [force], kg m; None for a prescribed force."""
    if "force" not in top.entries:
        return None
    table = top.table("force", f"[force] of {file}")
    if "at" in table.entries:
        raise InputError(
            f"{file} has `at` of [force] without [structure]: modes have participations."
        )
    if "base" in top.entries:
        raise InputError(f"{file} has both [force] and [base]: a force or a base that moves.")
    table.check_keys(("unbalance_kg_m",))
    return table.number("unbalance_kg_m", POSITIVE)


def element_participation(
    effects: Sequence[AbstractEffect], names: Sequence[str], rigid: np.ndarray
) -> np.ndarray:
    """Participation wᵀφ of rigid-body modes in each nonlinear element, (element, mode)."""
    forces = [effect for effect in effects if isinstance(effect, AbstractForce)]
    vectors = [
        dict(vector) for force in forces for vector in force.influence_vectors if vector is not None
    ]
    weights = np.array([[vector.get(name, 0.0) for name in names] for vector in vectors])
    return weights.reshape(-1, len(names)) @ rigid


def listed_sensors(top: TomlTable, file: str) -> list[str] | None:
    """The points listed in [sensors]; None without the table."""
    if "sensors" not in top.entries:
        return None
    table = top.table("sensors", f"[sensors] of {file}")
    table.check_keys(("points",))
    names = table.entries["points"]
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise table.refusal("points", "a list of names, at least one", names)
    if len(set(names)) < len(names):
        raise table.refusal("points", "different names", names)
    return names


def _arrays(path: Path, table: TomlTable) -> dict[str, Any]:
    """Arrays of an NPZ or MAT file by name; points as a list of names."""
    if not path.is_file():
        raise table.refusal("file", "a file next to the model's", path.name)
    reader = {".npz": _of_npz, ".mat": _of_mat}.get(path.suffix.lower())
    if reader is None:
        raise table.refusal("file", "an .npz or .mat file", path.name)
    try:
        arrays = dict(reader(path))
    except _UNREADABLE as error:
        kind = f"an {path.suffix[1:].upper()} file of arrays (MAT up to version 7)"
        raise InputError(
            f"{shown(path.name)} of {table.location} cannot be read: it is damaged or not {kind}; "
            "a sparse matrix, which `numpy.savez` stores as an object, needs its own file by "
            '`scipy.sparse.save_npz`, stated as `mass = "mass.npz"`.'
        ) from error
    selected = {key: arrays[key] for key in (*_MATRICES, "points") if key in arrays}
    if "points" in selected:
        names = np.ravel(selected["points"])
        selected["points"] = [
            str(np.ravel(name)[0] if np.size(name) else "").strip() for name in names
        ]
    return selected


def _of_mat(path: Path) -> Mapping[str, Any]:
    """The arrays of a file, checked first, since a damaged file can crash scipy."""
    with damaged_if_it_fails(path.name, "a MAT file"):
        content, names = path.read_bytes(), None
        if content.startswith(b"MATLAB 5"):
            names = [one.name for one in checked_variables(content) if not one.object_class]
        variables: dict[str, Any] = scipy.io.loadmat(path, variable_names=names)
        for value in filter(scipy.sparse.issparse, variables.values()):
            value.check_format()
        return variables


def _of_npz(path: Path) -> Mapping[str, Any]:
    """The arrays of a file, with those of a sparse matrix (common prefix) assembled."""
    with np.load(path) as arrays:
        contents: dict[str, Any] = {key: arrays[key] for key in arrays.files}
    for key in _MATRICES:
        parts = {name: contents[f"{key}_{name}"] for name in _SPARSE if f"{key}_{name}" in contents}
        if key not in contents and "data" in parts:
            # Rename the arrays as in `save_npz`, so that `load_npz` assembles the matrix.
            parts.setdefault("format", np.array("csr" if "indptr" in parts else "coo"))
            file = io.BytesIO()
            np.savez(file, **parts)
            file.seek(0)
            contents[key] = scipy.sparse.load_npz(file)
    return contents


def _sparse_file(path: Path, key: str, table: TomlTable) -> Any:
    """The matrix of a file that `scipy.sparse.save_npz` wrote."""
    if not path.is_file():
        raise table.refusal(
            key, "rows of numbers, or the name of a file next to the model's", path.name
        )
    try:
        return scipy.sparse.load_npz(path)
    except _UNREADABLE as error:
        raise InputError(
            f"`{key}` = {shown(path.name)} of {table.location} cannot be read: it is not a sparse "
            "matrix by `scipy.sparse.save_npz`."
        ) from error


def _matrix(key: str, value: Any, table: TomlTable) -> Float[np.ndarray, "unknown unknown"]:
    if scipy.sparse.issparse(value):
        return value
    try:
        matrix = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise table.refusal(key, "rows of numbers, all of one length", value) from None
    if matrix.ndim != 2:
        raise table.refusal(key, "rows of numbers, all of one length", value)
    return matrix


def _force(table: TomlTable) -> dict[str, complex]:
    """Newtons at points per newton of the recorded force, as phasors."""
    table.check_keys(("at",), ("unbalance_kg_m",))
    at = table.entries["at"]
    if isinstance(at, str):
        return {at: 1.0}
    weights = table.table("at", f"`at` in {table.location}")
    if not weights.entries:
        raise table.refusal("at", "a point, or points with newtons per newton", at)
    force: dict[str, complex] = {}
    for point, value in weights.entries.items():
        if isinstance(value, dict):
            entry = weights.table(point, f"{shown(point)} in {weights.location}")
            entry.check_keys(("amplitude",), ("phase_deg",))
            phase = entry.number("phase_deg", default=0.0) * DEGREE
            force[point] = entry.number("amplitude", NOT_ZERO) * np.exp(1j * phase)
        else:
            force[point] = weights.number(point, NOT_ZERO)
    return force


def influence_vector_of(table: TomlTable, side: str = "") -> InfluenceVector | None:
    """Influence vector of an effect: `at` a point or weighted points, `between` two points."""
    one, pair = f"{side}at", f"{side}between"
    if one in table.entries and pair in table.entries:
        raise InputError(f"{table.location} has both `{one}` and `{pair}`.")
    if pair in table.entries:
        two = table.entries[pair]
        if not isinstance(two, list) or len(two) != 2 or not all(isinstance(p, str) for p in two):
            raise table.refusal(pair, "two points", two)
        if two[0] == two[1]:
            raise table.refusal(pair, "two different points", two)
        return between(*two)
    at = table.entries.get(one)
    if at is None or isinstance(at, str):
        return None if at is None else influence_vector(at)
    weights = table.table(one, f"`{one}` of {table.location}")
    return influence_vector({point: weights.number(point) for point in weights.entries})
