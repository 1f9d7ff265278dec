"""Load cases that another code has run, as a folder of tables.

The folder has `modes.toml` and `cases.csv` (or `cases.npz`). `modes.toml`:

    name = "panel"                        # optional
    frequency_hz = [79.02, 427.46]        # of the modes kept
    numbers = [1, 3]                      # optional: their numbers in the finite-element model
    damping_ratio = [0.01, 0.01]          # optional, one number or one a mode; 0.01 is assumed
    shapes = "shapes.csv"                 # mass-normalised: `shape_1, shape_2`, a row a freedom
    mass = "mass.csv"                     # optional: `mass_1 … mass_n`, or one column `mass`
    filter = "filter.csv"                 # optional, in place of a mass matrix: `filter_1 …`
    participation = [247.8, 108.5]        # optional: a point force at the first sensor
    [sensors]                             # optional with shapes: where mode 1 is largest
    midspan = [11.84, -10.49]             # mass-normalised shape there, one number a mode

`cases.csv` has a row a case and the columns `case` (a name), the modal forces `f_1 …` of
F = M Φ f or the nodal load vector `load_1 …` (then f = Φᵀ load), and modal displacements `q_1 …`
or nodal ones `u_1 …` in the order of the rows of the shapes; optionally `energy` (J), which is a
free check. Empty displacements mark a case without solution. All numbers are SI.

A code that writes only nodal displacements needs `case, f_1 …, u_1 …` and the shapes at the same
degrees of freedom, such as

    case,f_1,u_1,u_2,u_3                  (cases.csv)
    up,12.5,1.14e-4,2.31e-4,1.14e-4
    down,-12.5,-1.14e-4,-2.31e-4,-1.14e-4
    shape_1                               (shapes.csv: at the freedoms u_1, u_2, u_3)
    5.95
    12.04
    5.95

Modal coordinates are q = ΦᵀM u where a mass matrix is given, else q = filter u, else the
least-squares fit q = Φ⁺u at the freedoms that were written. That is exact where what the load cases
add to the modes is orthogonal to the shapes there, as the stretching of a flat structure is; else
state a mass matrix or a filter.

`cases.npz` holds the same as arrays: `force` (case, mode) or `load` (case, dof),
`modal_displacement` or `displacement`, and optionally `energy`, `names`, `shapes` (dof, mode),
`mass` (dof,) or (dof, dof), `filter` (mode, dof).
"""

import os
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.io.files import FilePath, read_text
from snrmjax.io.reduction.number_tables import read_arrays, read_number_table
from snrmjax.io.reduction.source import ASSUMED_DAMPING, ReductionSource
from snrmjax.io.toml_table import TomlTable, parsed_toml
from snrmjax.io.units import HERTZ
from snrmjax.numerics.rules import BELOW_ONE, IN_RANGE_HZ, NOT_ZERO, POSITIVE, Rule

_KEYS = (
    *("name", "numbers", "damping_ratio", "shapes", "mass", "filter", "participation", "sensors"),
)
_ARRAYS = (
    *("force", "load", "modal_displacement", "displacement", "energy", "names"),
    *("shapes", "mass", "filter"),
)
_ORTHOGONAL = 1e-3  # of ΦᵀMΦ − I and filter Φ − I: files have few digits
_OUTSIDE = 1e-2  # of a load vector, that may lie outside M Φ f


class _Matrices(NamedTuple):
    """Matrices of the folder, each with the file it is from."""

    values: dict[str, np.ndarray]
    files: dict[str, str]


def read_load_tables(folder: FilePath) -> ReductionSource:
    """Read a folder of load-case tables; its format is told at the top of this module.

    Returns modes and cases. Raises `ValueError` that names file, row, column and what was
    expected; shapes that are not mass-normalised, load vectors that the modes cannot balance and
    tables that do not fit together are refused too.
    """
    place = Path(folder)
    if not place.is_dir():
        what = "is a file, but a folder is expected" if place.exists() else "does not exist"
        raise ValueError(f"{os.fspath(folder)} {what}.")
    top = parsed_toml(read_text(place / "modes.toml"), "modes.toml")
    top.check_keys(("frequency_hz",), _KEYS)
    frequency = np.array(top.numbers("frequency_hz", POSITIVE, IN_RANGE_HZ, each="mode")) * HERTZ
    n = frequency.size
    if not n:
        raise ValueError("`frequency_hz` of modes.toml must have at least one mode, but is empty.")
    stated, table = _read_cases(place, n)
    matrices = _read_matrices(top, place, stated)
    shapes = matrices.values.get("shapes")
    if shapes is not None and shapes.shape[1] != n:
        raise ValueError(
            f"{matrices.files['shapes']} has {shapes.shape[1]} shapes for the {n} modes of "
            "modes.toml."
        )
    basis = _basis(frequency, _mode_numbers(top, n), matrices)
    sensors, notes = _sensors(top, n, shapes)
    first = next(iter(sensors.values()))
    participation = _of_modes(top, "participation", n, NOT_ZERO)
    if participation is None:
        participation = first
        notes.append(f"no participation is stated: a point force at {next(iter(sensors))} is taken")
    damping = _of_modes(top, "damping_ratio", n, BELOW_ONE)
    if damping is None:
        damping = np.full(n, ASSUMED_DAMPING)
        notes.append(f"no damping is stated: {ASSUMED_DAMPING:g} is taken for every mode")
    return ReductionSource(
        name=top.text("name", place.resolve().name),
        basis=basis,
        damping_ratio=damping,
        sensors=sensors,
        participation=participation,
        cases=_cases(stated, table, basis, matrices),
        notes=tuple(notes),
    )


def _read_cases(place: Path, n: int) -> tuple[dict[str, np.ndarray], str]:
    """What `cases.csv` or `cases.npz` has, under the names of the latter."""
    csv, npz = place / "cases.csv", place / "cases.npz"
    if csv.exists() and npz.exists():
        raise ValueError(f"{os.fspath(place)} has both cases.csv and cases.npz: remove one.")
    if npz.exists():
        stated = read_arrays(npz, _ARRAYS)
        file = npz.name
    else:
        file = csv.name
        table = read_number_table(csv, ("f", "q", "u", "load"), ("case", "energy"))
        stated = {}
        if table.has("case"):
            stated["names"] = np.array(table.cells.texts("case"))
        for stem, name in (("f", "force"), ("load", "load")):
            if stem in table.groups:
                stated[name] = table.group(stem)
        for stem, name in (("q", "modal_displacement"), ("u", "displacement")):
            if stem in table.groups:
                stated[name] = table.group(stem, empty_allowed=True)
        if table.has("energy"):
            stated["energy"] = table.cells.numbers("energy", empty_allowed=True)
    for pair, columns in (
        (("force", "load"), ("f_1", "load_1")),
        (("modal_displacement", "displacement"), ("q_1", "u_1")),
    ):
        if not any(one in stated for one in pair):
            a, b = pair if file == npz.name else columns
            raise ValueError(f"{file} has neither `{a} …` nor `{b} …`.")
    _check_sizes(stated, n, file)
    return stated, file


def _check_sizes(stated: dict[str, np.ndarray], n: int, file: str) -> None:
    for name in ("force", "modal_displacement"):
        if name in stated and (stated[name].ndim != 2 or stated[name].shape[1] != n):
            raise ValueError(
                f"{file} has {stated[name].shape[-1]} modes in `{name}`, but modes.toml {n}."
            )
    count = len(stated["force"] if "force" in stated else stated["load"])
    for name in ("load", "modal_displacement", "displacement", "energy", "names"):
        if name in stated and len(stated[name]) != count:
            raise ValueError(f"`{name}` of {file} has {len(stated[name])} rows for {count} cases.")
    for name in ("force", "load"):
        if name in stated and not np.all(np.isfinite(stated[name])):
            raise ValueError(f"`{name}` of {file} must be finite, but has NaN or infinity.")
    if "names" in stated:
        names = [str(name) for name in stated["names"]]
        for k, name in enumerate(names):
            if name in names[:k]:
                raise ValueError(f"{file} has the case {name!r} twice.")


def _read_matrices(top: TomlTable, place: Path, stated: dict[str, np.ndarray]) -> _Matrices:
    values, files = {}, {}
    for name, stem in (("shapes", "shape"), ("mass", "mass"), ("filter", "filter")):
        if name in top.entries:
            if name in stated:
                raise ValueError(f"`{name}` is both in modes.toml and in cases.npz.")
            file = top.text(name)
            table = read_number_table(
                place / file, (stem,), ("dof", *(("mass",) * (name == "mass")))
            )
            single = name == "mass" and table.has("mass")
            if not single and stem not in table.groups:
                raise ValueError(f"{file} lacks the column `{stem}_1`.")
            values[name] = table.cells.numbers("mass") if single else table.group(stem)
            files[name] = file
        elif name in stated:
            values[name], files[name] = stated[name], "cases.npz"
    if "mass" in values and "filter" in values:
        raise ValueError("modes.toml has both a `mass` and a `filter`: one of them is enough.")
    for name in ("mass", "filter"):
        if name in values and "shapes" not in values:
            raise ValueError(f"modes.toml has a `{name}`, but no `shapes`.")
    for name, matrix in values.items():
        if not np.all(np.isfinite(matrix)):
            raise ValueError(f"`{name}` of {files[name]} must be finite, but has NaN or infinity.")
    return _Matrices(values, files)


def _basis(frequency: np.ndarray, numbers: tuple[int, ...], given: _Matrices) -> ReductionBasis:
    n = frequency.size
    if "shapes" not in given.values:  # modal displacements need none
        return _of(frequency, np.eye(n), np.eye(n), numbers)
    shapes = given.values["shapes"]
    n_dof, file = len(shapes), given.files["shapes"]
    if n_dof < n:
        raise ValueError(f"{file} has {n_dof} rows, fewer than the {n} modes.")
    if "mass" in given.values:
        mass, mass_file = given.values["mass"], given.files["mass"]
        if mass.shape not in ((n_dof,), (n_dof, n_dof)):
            raise ValueError(
                f"{mass_file} has the shape {mass.shape}, but {file} has {n_dof} rows."
            )
        product = mass[:, None] * shapes if mass.ndim == 1 else mass @ shapes
        _check_identity(shapes.T @ product, numbers, "ΦᵀMΦ", f"{file} and {mass_file}")
        return _of(frequency, shapes, product.T, numbers)
    if "filter" in given.values:
        modal, filter_file = given.values["filter"], given.files["filter"]
        if modal.shape != (n, n_dof):
            raise ValueError(
                f"{filter_file} has the shape {modal.shape}, but {n} modes and {n_dof} degrees of "
                "freedom are expected."
            )
        _check_identity(modal @ shapes, numbers, "filter Φ", f"{file} and {filter_file}")
        return _of(frequency, shapes, modal, numbers)
    values = np.linalg.svd(shapes / np.linalg.norm(shapes, axis=0), compute_uv=False)
    if not values[-1] > 1e-6 * values[0]:
        raise ValueError(f"the shapes of {file} are not linearly independent.")
    return _of(frequency, shapes, np.linalg.pinv(shapes), numbers)


def _of(
    frequency: np.ndarray, shapes: np.ndarray, modal: np.ndarray, numbers: tuple[int, ...]
) -> ReductionBasis:
    return ReductionBasis(jnp.asarray(frequency), jnp.asarray(shapes), jnp.asarray(modal), numbers)


def _check_identity(product: np.ndarray, numbers: tuple[int, ...], name: str, files: str) -> None:
    off = np.abs(product - np.eye(len(product)))
    row, column = sorted(int(k) for k in np.unravel_index(np.argmax(off), off.shape))
    if off[row, column] <= _ORTHOGONAL:
        return
    what = "not mass-normalised" if row == column else "not orthogonal"
    which = (
        f"mode {numbers[row]}" if row == column else f"modes {numbers[row]} and {numbers[column]}"
    )
    raise ValueError(
        f"the shapes are {what}: {name} of {which} is {product[row, column]:.4g} where "
        f"{float(row == column):g} is expected ({files})."
    )


def _cases(
    stated: dict[str, np.ndarray], file: str, basis: ReductionBasis, given: _Matrices
) -> StaticCases:
    n_dof = len(basis.shapes)
    for name in ("load", "displacement"):
        if name not in stated:
            continue
        if "shapes" not in given.values:
            raise ValueError(f"{file} has `{name}` of nodes, but modes.toml has no `shapes`.")
        if stated[name].ndim != 2 or stated[name].shape[1] != n_dof:
            raise ValueError(
                f"{file} has {stated[name].shape[-1]} degrees of freedom in `{name}`, but "
                f"{given.files['shapes']} has {n_dof} rows."
            )
    names = tuple(str(name) for name in stated.get("names", ()))
    if "force" in stated:
        force = stated["force"]
    else:
        force = stated["load"] @ np.asarray(basis.shapes)
        if "mass" in given.values:
            _check_loads(stated["load"], force @ np.asarray(basis.filter), names, file)
    displacement = stated.get("displacement")
    if displacement is not None and np.isnan(displacement).any():
        empty = np.isnan(displacement)
        displacement = np.where(empty.any(axis=1, keepdims=True), np.nan, displacement)
    moved = stated.get("modal_displacement")
    if moved is None:
        moved = displacement @ np.asarray(basis.filter).T
    energy = stated.get("energy")
    if energy is not None and np.isnan(energy).any():
        energy = None if np.isnan(energy).all() else energy
    converged = np.all(np.isfinite(moved), axis=1)
    return StaticCases(
        jnp.asarray(force),
        jnp.asarray(moved),
        jnp.asarray(converged),
        None if energy is None else jnp.asarray(energy),
        None if displacement is None else jnp.asarray(displacement),
        names,
    )


def _check_loads(
    loads: np.ndarray, balanced: np.ndarray, names: tuple[str, ...], file: str
) -> None:
    """Load vectors must be M Φ f: others move what the model does not keep."""
    off = np.linalg.norm(loads - balanced, axis=1) / np.linalg.norm(loads, axis=1)
    worst = int(np.argmax(off))
    if off[worst] > _OUTSIDE:
        name = repr(names[worst]) if names else f"in row {worst + 2}"
        raise ValueError(
            f"load vectors must be combinations of M Φ, but that of the case {name} of {file} is "
            f"{100 * off[worst]:.2g} % outside them."
        )


def _mode_numbers(top: TomlTable, n: int) -> tuple[int, ...]:
    if "numbers" not in top.entries:
        return tuple(range(1, n + 1))
    values = top.entries["numbers"]
    found = [k for k in values if isinstance(k, int)] if isinstance(values, list) else []
    good = isinstance(values, list) and len(values) == n == len(set(found))
    if not good or any(isinstance(k, bool) or k < 1 for k in found):
        raise top.refusal("numbers", f"{n} different whole numbers from 1 on", values)
    return tuple(found)


def _of_modes(top: TomlTable, key: str, n: int, *rules: Rule) -> np.ndarray | None:
    """A number for each mode, or one for all; None where it is not stated."""
    if key not in top.entries:
        return None
    if not isinstance(top.entries[key], list):
        return np.full(n, top.number(key, *rules))
    values = top.numbers(key, *rules, each="mode")
    if len(values) != n:
        raise top.refusal(key, f"{n} numbers, one a mode", top.entries[key])
    return np.array(values)


def _sensors(
    top: TomlTable, n: int, shapes: np.ndarray | None
) -> tuple[dict[str, np.ndarray], list[str]]:
    table = top.table("sensors", "[sensors] of modes.toml")
    if table.entries:
        found = {}
        for name in table.entries:
            values = table.numbers(name, each="mode")
            if len(values) != n:
                raise table.refusal(name, f"{n} numbers, one a mode", table.entries[name])
            found[name] = np.array(values)
        return found, []
    if shapes is None:
        raise ValueError("modes.toml has neither [sensors] nor `shapes`: state one of them.")
    row = int(np.argmax(np.abs(shapes[:, 0])))
    name = f"dof {row + 1}"
    return {name: shapes[row]}, [f"no sensor is stated: {name}, where mode 1 is largest, is taken"]
