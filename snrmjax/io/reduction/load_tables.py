"""Load cases from another code, as a folder of tables.

The folder has `modes.toml` and `cases.csv`. `modes.toml`:

    name = "panel"                        # optional
    frequency_hz = [79.02, 427.46]        # of the modes kept
    numbers = [1, 3]                      # optional: their numbers in the finite-element model
    damping_ratio = [0.01, 0.01]          # optional, one number or one a mode; 0.01 is assumed
    shapes = "shapes.csv"                 # mass-normalised: `shape_1, shape_2`, a row a dof
    mass = "mass.csv"                     # optional: `mass_1 … mass_n`, or one column `mass`
    participation = [247.8, 108.5]        # optional: a point force at the first sensor
    [sensors]                             # optional with shapes: where mode 1 is largest
    midspan = [11.84, -10.49]             # mass-normalised shape there, one number a mode

`cases.csv` has a row a case and the columns `case` (a name), the modal forces `f_1 …` of
F = M Φ f, and modal displacements `q_1 …` or nodal ones `u_1 …` in the order of the rows of the
shapes; optionally `energy` (J), as a check. Empty displacements mark a case without
solution. All numbers are SI.

A code that writes only nodal displacements needs `case, f_1 …, u_1 …` and the shapes at the same
degrees of freedom, such as

    case,f_1,u_1,u_2,u_3                  (cases.csv)
    up,12.5,1.14e-4,2.31e-4,1.14e-4
    down,-12.5,-1.14e-4,-2.31e-4,-1.14e-4
    shape_1                               (shapes.csv: at u_1, u_2, u_3)
    5.95
    12.04
    5.95

Modal coordinates are q = ΦᵀM u where a mass matrix is given, else the least-squares fit q = Φ⁺u at
the written degrees of freedom. That is exact where the displacement outside the modal space is
orthogonal to the shapes there, as the stretching of a flat structure is; else state a mass matrix,
or write `q_1 …`. For arrays in Python use `snrmjax.condense.reduced_model`.
"""

import os
import re
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.condense.reduction import ASSUMED_DAMPING, ReductionSource
from snrmjax.io.files import FilePath, read_text, shown
from snrmjax.io.rows import Cells, read_cells
from snrmjax.io.tables import write_table
from snrmjax.io.toml_table import TomlTable, parsed_toml
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.names import suggestion
from snrmjax.numerics.rules import BELOW_ONE, IN_RANGE_HZ, POSITIVE, InputError
from snrmjax.numerics.units import HERTZ

_KEYS = ("name", "numbers", "damping_ratio", "shapes", "mass", "participation", "sensors")
_NUMBERED = re.compile(r"([a-z]+)_([1-9][0-9]{0,5})")
_ORTHOGONAL = 1e-3  # tolerance of ΦᵀMΦ − I: files have few digits


class _Matrix(NamedTuple):
    """A matrix and its file name."""

    values: np.ndarray
    file: str


def read_load_tables(folder: FilePath) -> ReductionSource:
    """Read a folder of load-case tables in the format at the top of this module.

    Returns modes and cases. Raises `ValueError` that names file, row, column and expectation, also
    for shapes that are not mass-normalised, load vectors that the modes cannot balance and
    inconsistent tables.
    """
    folder_path = Path(folder)
    if not folder_path.is_dir():
        what = "is a file, but a folder is expected" if folder_path.exists() else "does not exist"
        raise InputError(f"{os.fspath(folder)} {what}.")
    top = parsed_toml(read_text(folder_path / "modes.toml"), "modes.toml")
    top.check_keys(("frequency_hz",), _KEYS)
    frequency = np.array(top.numbers("frequency_hz", POSITIVE, IN_RANGE_HZ, each="mode")) * HERTZ
    n = frequency.size
    if not n:
        raise InputError("`frequency_hz` of modes.toml must have at least one mode, but is empty.")
    shapes, mass = (
        _matrix(top, folder_path, "shapes", "shape"),
        _matrix(top, folder_path, "mass", "mass"),
    )
    if mass is not None and shapes is None:
        raise InputError("modes.toml has a `mass`, but no `shapes`.")
    if shapes is not None and shapes.values.shape[1] != n:
        raise InputError(
            f"{shapes.file} has {shapes.values.shape[1]} shapes for the {n} modes of modes.toml."
        )
    stated = "numbers" in top.entries
    numbers = top.mode_numbers("numbers") if stated else tuple(range(1, n + 1))
    if len(numbers) != n:
        raise top.refusal("numbers", f"{n} numbers, one a mode", list(numbers))
    basis = _basis(frequency, numbers, shapes, mass)
    sensors, notes = _sensors(top, n, None if shapes is None else shapes.values)
    name, first = next(iter(sensors.items()))
    participation = top.numbers_of_modes("participation", n)
    if participation is None:
        notes.append(Fact("point_force_assumed", sensor=name))
    damping = top.numbers_of_modes("damping_ratio", n, BELOW_ONE)
    if damping is None:
        notes.append(Fact("damping_assumed", ratio=ASSUMED_DAMPING))
    return ReductionSource(
        name=top.text("name", folder_path.resolve().name),
        basis=basis,
        damping_ratio=np.array(damping or [ASSUMED_DAMPING] * n),
        sensors=sensors,
        participation=np.array(participation or first),
        cases=_read_cases(folder_path / "cases.csv", basis, shapes),
        notes=tuple(notes),
    )


def _read_cases(path: Path, basis: ReductionBasis, shapes: _Matrix | None) -> StaticCases:
    n = len(basis.numbers)
    table = _read_table(path, ("f", "q", "u"), ("case", "energy"))
    for needed in (("f",), ("q", "u")):
        if not any(stem in table.groups for stem in needed):
            named = " or ".join(f"`{stem}_1 …`" for stem in needed)
            raise InputError(f"{path.name} has no {named}.")
    for stem in ("f", "q"):
        if table.groups.get(stem, n) != n:
            raise InputError(
                f"{path.name} has {table.groups[stem]} modes in `{stem}_1 …`, but modes.toml {n}."
            )
    names = tuple(table.cells.texts("case")) if table.cells.has("case") else ()
    for k, name in enumerate(names):
        if name in names[:k]:
            raise InputError(f"{path.name} has the case {name!r} twice.")
    displacement = table.group("u", empty_allowed=True) if "u" in table.groups else None
    if displacement is not None:
        if shapes is None:
            raise InputError(f"{path.name} has `u_1 …` of nodes, but modes.toml has no `shapes`.")
        if displacement.shape[1] != len(shapes.values):
            raise InputError(
                f"{path.name} has {displacement.shape[1]} degrees of freedom in `u_1 …`, but "
                f"{shapes.file} has {len(shapes.values)} rows."
            )
        empty = np.isnan(displacement).any(axis=1, keepdims=True)
        displacement = np.where(empty, np.nan, displacement)
    if "q" in table.groups:
        modal_displacement = table.group("q", empty_allowed=True)
    else:
        modal_displacement = np.asarray(displacement) @ np.asarray(basis.filter).T
    energy = (
        table.cells.numbers("energy", empty_allowed=True) if table.cells.has("energy") else None
    )
    if energy is not None and np.isnan(energy).all():
        energy = None
    return StaticCases(
        jnp.asarray(table.group("f")),
        jnp.asarray(modal_displacement),
        jnp.asarray(np.all(np.isfinite(modal_displacement), axis=1)),
        None if energy is None else jnp.asarray(energy),
        None if displacement is None else jnp.asarray(displacement),
        names,
    )


def _matrix(top: TomlTable, folder_path: Path, key: str, stem: str) -> _Matrix | None:
    """The table named by a key; None where not stated. A mass may be one column."""
    if key not in top.entries:
        return None
    file = top.text(key)
    table = _read_table(folder_path / file, (stem,), ("dof", *(("mass",) * (key == "mass"))))
    if key == "mass" and table.cells.has("mass"):
        return _Matrix(table.cells.numbers("mass"), file)
    if stem not in table.groups:
        raise InputError(f"{file} lacks the column `{stem}_1`.")
    return _Matrix(table.group(stem), file)


def _basis(
    frequency: np.ndarray,
    numbers: tuple[int, ...],
    given: _Matrix | None,
    mass: _Matrix | None,
) -> ReductionBasis:
    n = frequency.size
    if given is None:  # not needed for modal displacements
        return _reduction_basis(frequency, np.eye(n), np.eye(n), numbers)
    shapes, file = given
    n_dof = len(shapes)
    if n_dof < n:
        raise InputError(f"{file} has {n_dof} rows, fewer than the {n} modes.")
    if mass is not None:
        if mass.values.shape not in ((n_dof,), (n_dof, n_dof)):
            raise InputError(
                f"{mass.file} has the shape {mass.values.shape}, but {file} has {n_dof} rows."
            )
        diagonal = mass.values.ndim == 1
        product = mass.values[:, None] * shapes if diagonal else mass.values @ shapes
        _check_identity(shapes.T @ product, numbers, f"{file} and {mass.file}")
        return _reduction_basis(frequency, shapes, product.T, numbers)
    values = np.linalg.svd(shapes / np.linalg.norm(shapes, axis=0), compute_uv=False)
    if not values[-1] > 1e-6 * values[0]:
        raise InputError(f"the shapes of {file} are not linearly independent.")
    return _reduction_basis(frequency, shapes, np.linalg.pinv(shapes), numbers)


def _reduction_basis(
    frequency: np.ndarray, shapes: np.ndarray, modal: np.ndarray, numbers: tuple[int, ...]
) -> ReductionBasis:
    return ReductionBasis(jnp.asarray(frequency), jnp.asarray(shapes), jnp.asarray(modal), numbers)


def _check_identity(product: np.ndarray, numbers: tuple[int, ...], files: str) -> None:
    error = np.abs(product - np.eye(len(product)))
    row, column = sorted(int(k) for k in np.unravel_index(np.argmax(error), error.shape))
    if error[row, column] <= _ORTHOGONAL:
        return
    what = "not mass-normalised" if row == column else "not orthogonal"
    which = (
        f"mode {numbers[row]}" if row == column else f"modes {numbers[row]} and {numbers[column]}"
    )
    raise InputError(
        f"the shapes are {what}: ΦᵀMΦ of {which} is {product[row, column]:.4g} where "
        f"{float(row == column):g} is expected ({files})."
    )


def _sensors(
    top: TomlTable, n: int, shapes: np.ndarray | None
) -> tuple[dict[str, np.ndarray], list[Fact]]:
    table = top.table("sensors", "[sensors] of modes.toml")
    if table.entries:
        named = {name: table.numbers(name, each="mode", count=n) for name in table.entries}
        return {name: np.array(shape) for name, shape in named.items()}, []
    if shapes is None:
        raise InputError("modes.toml has neither [sensors] nor `shapes`: state one of them.")
    row = int(np.argmax(np.abs(shapes[:, 0])))
    name = f"dof {row + 1}"
    return {name: shapes[row]}, [Fact("sensor_assumed", name=name)]


class _Table(NamedTuple):
    """The rows of a CSV by column; `groups` are the numbered columns, by their stem."""

    cells: Cells
    groups: dict[str, int]  # number of columns stem_1 … stem_n

    def group(self, stem: str, *, empty_allowed: bool = False) -> np.ndarray:
        """The numbered columns of one stem, (row, column)."""
        columns = [f"{stem}_{k + 1}" for k in range(self.groups[stem])]
        return np.stack(
            [self.cells.numbers(name, empty_allowed=empty_allowed) for name in columns], axis=1
        )


def _read_table(path: FilePath, stems: tuple[str, ...], single: tuple[str, ...] = ()) -> _Table:
    """Read a CSV with columns `stem_1 … stem_n` for some stems, and some single ones.

    Raises `ValueError` that names file, row or column for an unknown or missing column of a group,
    and as `read_cells` does.
    """
    cells = read_cells(path)
    groups: dict[str, int] = {}
    for name in cells.names:
        numbered = _NUMBERED.fullmatch(name)
        if numbered and numbered[1] in stems:
            groups[numbered[1]] = max(groups.get(numbered[1], 0), int(numbered[2]))
        elif name not in single:
            known = (*single, *(f"{stem}_1" for stem in stems))
            near = suggestion(name, known)
            raise InputError(f"{cells.file} has the unknown column {shown(name)}{near}.")
    for stem, count in groups.items():
        for k in range(count):
            if not cells.has(f"{stem}_{k + 1}"):
                raise InputError(f"{cells.file} lacks the column `{stem}_{k + 1}`.")
    cells.require_rows()
    return _Table(cells, groups)


def write_load_cases(path: FilePath, cases: StaticCases) -> None:
    """Write load cases: `case, f_1…, q_1…[, energy]`, as `--tables` reads them.

    The modes count from one in the order of the reduced model. Fields of a case without solution
    are empty.
    """
    n_cases, n_modes = cases.force.shape
    force = np.asarray(cases.force)
    modal_displacement = np.where(cases.usable[:, None], cases.modal_displacement, np.nan)
    columns = {"case": list(cases.names) or [str(k + 1) for k in range(n_cases)]}
    columns |= {f"f_{m + 1}": _texts(force[:, m]) for m in range(n_modes)}
    columns |= {f"q_{m + 1}": _texts(modal_displacement[:, m]) for m in range(n_modes)}
    if cases.energy is not None:
        columns["energy"] = _texts(np.where(cases.usable, cases.energy, np.nan))
    write_table(path, columns)


def _texts(values: np.ndarray) -> list[str]:
    """Numbers in full precision, since small differences matter; an empty field for NaN."""
    return ["" if np.isnan(value) else repr(value) for value in values.tolist()]
