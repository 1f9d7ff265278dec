"""Load cases that another code has run, as a folder of tables.

The folder has `modes.toml` and `cases.csv`. `modes.toml`:

    name = "panel"                        # optional
    frequency_hz = [79.02, 427.46]        # of the modes kept
    numbers = [1, 3]                      # optional: their numbers in the finite-element model
    damping_ratio = [0.01, 0.01]          # optional, one number or one a mode; 0.01 is assumed
    shapes = "shapes.csv"                 # mass-normalised: `shape_1, shape_2`, a row a freedom
    mass = "mass.csv"                     # optional: `mass_1 … mass_n`, or one column `mass`
    participation = [247.8, 108.5]        # optional: a point force at the first sensor
    [sensors]                             # optional with shapes: where mode 1 is largest
    midspan = [11.84, -10.49]             # mass-normalised shape there, one number a mode

`cases.csv` has a row a case and the columns `case` (a name), the modal forces `f_1 …` of
F = M Φ f, and modal displacements `q_1 …` or nodal ones `u_1 …` in the order of the rows of the
shapes; optionally `energy` (J), which is a free check. Empty displacements mark a case without
solution. All numbers are SI.

A code that writes only nodal displacements needs `case, f_1 …, u_1 …` and the shapes at the same
degrees of freedom, such as

    case,f_1,u_1,u_2,u_3                  (cases.csv)
    up,12.5,1.14e-4,2.31e-4,1.14e-4
    down,-12.5,-1.14e-4,-2.31e-4,-1.14e-4
    shape_1                               (shapes.csv: at the freedoms u_1, u_2, u_3)
    5.95
    12.04
    5.95

Modal coordinates are q = ΦᵀM u where a mass matrix is given, else the least-squares fit q = Φ⁺u at
the freedoms that were written. That is exact where what the load cases add to the modes is
orthogonal to the shapes there, as the stretching of a flat structure is; else state a mass matrix,
or write `q_1 …`. From arrays in Python, `snrmjax.condense.reduced_model` starts at once.
"""

import os
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.io.files import FilePath, read_text
from snrmjax.io.reduction.number_tables import read_number_table
from snrmjax.io.reduction.source import ASSUMED_DAMPING, ReductionSource
from snrmjax.io.toml_table import TomlTable, parsed_toml
from snrmjax.io.units import HERTZ
from snrmjax.numerics.rules import BELOW_ONE, IN_RANGE_HZ, NOT_ZERO, POSITIVE, Rule

_KEYS = ("name", "numbers", "damping_ratio", "shapes", "mass", "participation", "sensors")
_ORTHOGONAL = 1e-3  # of ΦᵀMΦ − I: files have few digits


class _Matrix(NamedTuple):
    """A matrix of the folder, and the file it is from."""

    values: np.ndarray
    file: str


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
    shapes, mass = _matrix(top, place, "shapes", "shape"), _matrix(top, place, "mass", "mass")
    if mass is not None and shapes is None:
        raise ValueError("modes.toml has a `mass`, but no `shapes`.")
    if shapes is not None and shapes.values.shape[1] != n:
        raise ValueError(
            f"{shapes.file} has {shapes.values.shape[1]} shapes for the {n} modes of modes.toml."
        )
    basis = _basis(frequency, _mode_numbers(top, n), shapes, mass)
    sensors, notes = _sensors(top, n, None if shapes is None else shapes.values)
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
        cases=_read_cases(place / "cases.csv", basis, shapes),
        notes=tuple(notes),
    )


def _read_cases(path: Path, basis: ReductionBasis, shapes: _Matrix | None) -> StaticCases:
    n = len(basis.numbers)
    table = read_number_table(path, ("f", "q", "u"), ("case", "energy"))
    for needed in (("f",), ("q", "u")):
        if not any(stem in table.groups for stem in needed):
            named = " or ".join(f"`{stem}_1 …`" for stem in needed)
            raise ValueError(f"{path.name} has no {named}.")
    for stem in ("f", "q"):
        if table.groups.get(stem, n) != n:
            raise ValueError(
                f"{path.name} has {table.groups[stem]} modes in `{stem}_1 …`, but modes.toml {n}."
            )
    names = tuple(table.cells.texts("case")) if table.has("case") else ()
    for k, name in enumerate(names):
        if name in names[:k]:
            raise ValueError(f"{path.name} has the case {name!r} twice.")
    displacement = table.group("u", empty_allowed=True) if "u" in table.groups else None
    if displacement is not None:
        if shapes is None:
            raise ValueError(f"{path.name} has `u_1 …` of nodes, but modes.toml has no `shapes`.")
        if displacement.shape[1] != len(shapes.values):
            raise ValueError(
                f"{path.name} has {displacement.shape[1]} degrees of freedom in `u_1 …`, but "
                f"{shapes.file} has {len(shapes.values)} rows."
            )
        empty = np.isnan(displacement).any(axis=1, keepdims=True)
        displacement = np.where(empty, np.nan, displacement)
    if "q" in table.groups:
        moved = table.group("q", empty_allowed=True)
    else:
        moved = np.asarray(displacement) @ np.asarray(basis.filter).T
    energy = table.cells.numbers("energy", empty_allowed=True) if table.has("energy") else None
    if energy is not None and np.isnan(energy).all():
        energy = None
    return StaticCases(
        jnp.asarray(table.group("f")),
        jnp.asarray(moved),
        jnp.asarray(np.all(np.isfinite(moved), axis=1)),
        None if energy is None else jnp.asarray(energy),
        None if displacement is None else jnp.asarray(displacement),
        names,
    )


def _matrix(top: TomlTable, place: Path, key: str, stem: str) -> _Matrix | None:
    """The table that a key names; None where it is not stated. A mass may be one column."""
    if key not in top.entries:
        return None
    file = top.text(key)
    table = read_number_table(place / file, (stem,), ("dof", *(("mass",) * (key == "mass"))))
    if key == "mass" and table.has("mass"):
        return _Matrix(table.cells.numbers("mass"), file)
    if stem not in table.groups:
        raise ValueError(f"{file} lacks the column `{stem}_1`.")
    return _Matrix(table.group(stem), file)


def _basis(
    frequency: np.ndarray,
    numbers: tuple[int, ...],
    given: _Matrix | None,
    mass: _Matrix | None,
) -> ReductionBasis:
    n = frequency.size
    if given is None:  # modal displacements need none
        return _of(frequency, np.eye(n), np.eye(n), numbers)
    shapes, file = given
    n_dof = len(shapes)
    if n_dof < n:
        raise ValueError(f"{file} has {n_dof} rows, fewer than the {n} modes.")
    if mass is not None:
        if mass.values.shape not in ((n_dof,), (n_dof, n_dof)):
            raise ValueError(
                f"{mass.file} has the shape {mass.values.shape}, but {file} has {n_dof} rows."
            )
        diagonal = mass.values.ndim == 1
        product = mass.values[:, None] * shapes if diagonal else mass.values @ shapes
        _check_identity(shapes.T @ product, numbers, f"{file} and {mass.file}")
        return _of(frequency, shapes, product.T, numbers)
    values = np.linalg.svd(shapes / np.linalg.norm(shapes, axis=0), compute_uv=False)
    if not values[-1] > 1e-6 * values[0]:
        raise ValueError(f"the shapes of {file} are not linearly independent.")
    return _of(frequency, shapes, np.linalg.pinv(shapes), numbers)


def _of(
    frequency: np.ndarray, shapes: np.ndarray, modal: np.ndarray, numbers: tuple[int, ...]
) -> ReductionBasis:
    return ReductionBasis(jnp.asarray(frequency), jnp.asarray(shapes), jnp.asarray(modal), numbers)


def _check_identity(product: np.ndarray, numbers: tuple[int, ...], files: str) -> None:
    off = np.abs(product - np.eye(len(product)))
    row, column = sorted(int(k) for k in np.unravel_index(np.argmax(off), off.shape))
    if off[row, column] <= _ORTHOGONAL:
        return
    what = "not mass-normalised" if row == column else "not orthogonal"
    which = (
        f"mode {numbers[row]}" if row == column else f"modes {numbers[row]} and {numbers[column]}"
    )
    raise ValueError(
        f"the shapes are {what}: ΦᵀMΦ of {which} is {product[row, column]:.4g} where "
        f"{float(row == column):g} is expected ({files})."
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
