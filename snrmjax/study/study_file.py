"""Studies as TOML files."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np

from snrmjax.io.files import FilePath, file_name, read_text
from snrmjax.io.models import read_model
from snrmjax.io.reduction.beam_file import is_beam_file, read_beam_models
from snrmjax.io.tables import read_steady_states
from snrmjax.io.toml_table import TomlTable, parsed_toml
from snrmjax.model.structures import Structure
from snrmjax.numerics.rules import NOT_NEGATIVE, POSITIVE, InputError
from snrmjax.numerics.units import DEGREE, HERTZ
from snrmjax.simulate.virtual_test.recording import MeasurementErrors
from snrmjax.study.computations.base import AbstractComputation, OfForces
from snrmjax.study.computations.modes import DampedModes, NormalModes
from snrmjax.study.computations.responses import Curves, Peaks, ResponseRange
from snrmjax.study.computations.tests import Diagnoses, Identifications, VirtualTests
from snrmjax.study.sampling import Method, Sampling
from snrmjax.study.study import FORCE, Study
from snrmjax.study.variations import (
    AbstractVariation,
    Discrete,
    LogNormal,
    MultivariateNormal,
    Normal,
    Uniform,
)

_METHODS = get_args(Method)
_RANGE = ("from_hz", "to_hz")
_ERRORS = ("amplitude", "phase_deg", "force", "level_gain", "level_phase_deg")
# Required and optional keys of each kind of computation, in addition to those of every study.
_KEYS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "peaks": (_RANGE, ("forces_n", "harmonics", "stability", "grid_points", "sensor")),
    "curves": (_RANGE, ("forces_n", "harmonics", "stability", "sensor")),
    "nnm": (("to_hz",), ("harmonics", "sensor")),
    "damped_nnm": (("to_velocity_m_s",), ("harmonics", "sensor")),
    "virtual_test": (_RANGE, ("forces_n", "harmonics", "errors", "points_per_level")),
    "identify": (("data",), ()),
    "diagnose": (("data",), ()),
}
_EVERY = ("vary", "sample", "seed", "name", "members_a_chunk")


def read_study(path: FilePath) -> Study:
    """Read a study from a TOML: model, varied quantities and computation.

    The model's path (and that of data) is relative to the study's folder. It may be a beam file:
    every member is then condensed from the finite elements of its own beam.
    Returns the study. Raises `ValueError` with file, table, key, value and the expected value; the
    members are drawn and checked too.
    """
    file = file_name(path)
    top = parsed_toml(read_text(path), file)
    kind = top.choice("compute", _KEYS) if "compute" in top.entries else None
    if kind is None:
        raise InputError(f"{file} lacks the key `compute`, one of {', '.join(_KEYS)}.")
    needed, possible = _KEYS[kind]
    # Also refuses a key of another computation.
    top.check_keys(("model", "compute", *needed), (*possible, *_EVERY))
    folder = Path(path).parent
    path_of_model = folder / top.text("model")
    beam = read_beam_models(path_of_model) if is_beam_file(path_of_model) else None
    model = read_model(path_of_model) if beam is None else beam({})
    variations = tuple(_variation(table) for table in top.tables("vary", file))
    study = Study(
        name=top.text("name", Path(path).stem),
        model=model,
        computation=_computation(kind, top, folder, model, variations),
        variations=variations,
        sampling=_sampling(top, file, variations),
        seed=top.whole("seed", 0, 0),
        members_a_chunk=top.whole("members_a_chunk", 0, 0) or None,
        model_of=beam,
        sensor=top.text("sensor") if "sensor" in top.entries else None,
    )
    try:
        study.ensemble()
    except InputError as error:
        raise InputError.located(file, error) from error
    return study


def _sampling(top: TomlTable, file: str, variations: tuple[AbstractVariation, ...]) -> Sampling:
    table = top.table("sample", f"[sample] of {file}")
    table.check_keys((), ("method", "members"))
    valued = all(variation.grid() is not None for variation in variations) and bool(variations)
    method = table.choice("method", _METHODS, "grid" if valued else "random")
    members = table.whole("members", 1) if "members" in table.entries else None
    return Sampling(method, members)  # type: ignore[arg-type]


def _variation(table: TomlTable) -> AbstractVariation:
    if "parameters" in table.entries:
        return _joint(table)
    if "parameter" not in table.entries:
        raise InputError(f"{table.location} lacks the key `parameter`.")
    return _single(table)


def _made(
    table: TomlTable, kind: Callable[..., AbstractVariation], *arguments: Any
) -> AbstractVariation:
    """A variation; its errors are reported with the table's location."""
    try:
        return kind(*arguments)
    except InputError as error:
        raise InputError(f"{table.location} cannot be read: {error}") from error


def _single(table: TomlTable) -> AbstractVariation:
    name = (table.text("parameter"),)
    ways = [key for key in ("values", "range", "distribution") if key in table.entries]
    if len(ways) != 1:
        given = " and ".join(f"`{key}`" for key in ways) or "none of them"
        raise InputError(
            f"{table.location} ({name[0]}) needs one of `values`, `range`, `distribution`, but has "
            f"{given}."
        )
    if ways == ["values"]:
        table.check_keys(("parameter", "values"))
        return _made(table, Discrete, name, np.array(table.numbers("values", each="value")))
    if ways == ["range"]:
        table.check_keys(("parameter", "range"), ("points",))
        ends = table.numbers("range", each="end")
        if len(ends) != 2:
            raise table.refusal("range", "two numbers", table.entries["range"])
        points = table.whole("points", 2) if "points" in table.entries else None
        return _made(table, Uniform, name, *ends, points)
    if table.choice("distribution", ("uniform", "normal", "lognormal")) == "uniform":
        table.check_keys(("parameter", "distribution", "low", "high"))
        return _made(table, Uniform, name, table.number("low"), table.number("high"))
    table.check_keys(("parameter", "distribution", "mean", "std"))
    make = Normal if table.text("distribution") == "normal" else LogNormal
    return _made(table, make, name, table.number("mean"), table.number("std"))


def _joint(table: TomlTable) -> AbstractVariation:
    table.check_keys(("parameters", "mean", "covariance"))
    names, rows = table.entries["parameters"], table.entries["covariance"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names) or not names:
        raise table.refusal("parameters", "a list of names", names)
    if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
        raise table.refusal("covariance", "a list of rows", rows)
    each = [
        TomlTable({"covariance": row}, f"{table.location}, row {k + 1},").numbers(
            "covariance", each="entry"
        )
        for k, row in enumerate(rows)
    ]
    if len(each) != len(names) or any(len(row) != len(names) for row in each):
        raise table.refusal("covariance", f"{len(names)} rows of {len(names)} numbers", rows)
    mean = np.array(table.numbers("mean", each="entry"))
    return _made(table, MultivariateNormal, tuple(names), mean, np.array(each))


def _computation(
    kind: str,
    top: TomlTable,
    folder: Path,
    model: Structure,
    variations: tuple[AbstractVariation, ...],
) -> AbstractComputation:
    harmonics = top.whole("harmonics", 1, 9)
    if kind == "nnm":
        return NormalModes(top.number("to_hz", POSITIVE) * HERTZ, harmonics)
    if kind == "damped_nnm":
        return DampedModes(top.number("to_velocity_m_s", POSITIVE), harmonics)
    if kind in ("identify", "diagnose"):
        data = read_steady_states(os.fspath(folder / top.text("data")), model)
        return Identifications(data) if kind == "identify" else Diagnoses(data)
    ends = [top.number(key, POSITIVE) for key in _RANGE]
    if not ends[0] < ends[1]:
        raise InputError(
            f"`from_hz` must be below `to_hz`, but {top.location} has {ends[0]:g} and {ends[1]:g}."
        )
    stability = top.entries.get("stability", True)
    if not isinstance(stability, bool):
        raise top.refusal("stability", "true or false", stability)
    within = ResponseRange(ends[0] * HERTZ, ends[1] * HERTZ, harmonics, stability)
    forces = _forces(top)
    varied = any(FORCE in variation.names for variation in variations)
    if forces is None and not varied and model.modes.unbalance is not None:
        forces = np.ones(1)
    if forces is None and not varied:
        raise InputError(f"{top.location} lacks the key `forces_n`, and {FORCE} does not vary.")
    if kind == "virtual_test":
        levels = np.zeros(0) if forces is None else forces
        per_level = top.whole("points_per_level", 1, 5)
        return VirtualTests(within, levels, _errors(top), per_level)
    if kind == "curves":
        return Curves(within, OfForces(forces))
    return Peaks(within, OfForces(forces), top.whole("grid_points", 0, 0))


def _forces(top: TomlTable) -> np.ndarray | None:
    if "forces_n" not in top.entries:
        return None
    forces = top.numbers("forces_n", POSITIVE, each="force")
    if not forces or len(set(forces)) < len(forces):
        raise top.refusal("forces_n", "different forces, at least one", top.entries["forces_n"])
    return np.array(forces)


def _errors(top: TomlTable) -> MeasurementErrors:
    table = top.table("errors", f"[errors] of {top.location}")
    table.check_keys((), _ERRORS)
    stds = {key: table.number(key, NOT_NEGATIVE, default=0.0) for key in _ERRORS}
    return MeasurementErrors(
        stds["amplitude"],
        stds["phase_deg"] * DEGREE,
        stds["force"],
        stds["level_gain"],
        stds["level_phase_deg"] * DEGREE,
    )
