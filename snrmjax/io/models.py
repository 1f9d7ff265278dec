"""Reading and writing of structures as TOML."""

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
import scipy.linalg
import tomli_w

from snrmjax.io.files import FilePath, file_name, read_text, shown, write_atomically
from snrmjax.io.structure_matrices import (
    element_participation,
    influence_vector_of,
    listed_sensors,
    moving_base,
    structure_of_matrices,
    unbalance,
)
from snrmjax.io.toml_table import TomlTable, parsed_toml
from snrmjax.model import effects as known
from snrmjax.model.builders.free_coordinates import coupled_first
from snrmjax.model.effect_base import AbstractEffect, AbstractForce
from snrmjax.model.effect_metadata import Entries
from snrmjax.model.modes import (
    UNSTATED_MODAL_MASS_STD,
    LinearModes,
    LinearModesStd,
    OptionalModalData,
    RigidBodyModes,
    linear_modes,
)
from snrmjax.model.potential import (
    Monomial,
    PolynomialPotential,
    monomial_key,
    parse_monomial,
    polynomial_potential,
)
from snrmjax.model.structures import Structure, structure
from snrmjax.numerics.names import near_miss, suggestion
from snrmjax.numerics.rules import BELOW_ONE, IN_RANGE_HZ, NOT_NEGATIVE, POSITIVE, InputError, Rule
from snrmjax.numerics.units import DEGREE, HERTZ, in_unit

_TOP_KEYS = (
    *("name", "mode_of_interest", "mode", "rigid_body_mode", "damping_coupling"),
    *("potential", "effect", "measurement", "sensors", "structure", "force", "base"),
)
_OF_MODES = ("mode", "rigid_body_mode", "damping_coupling", "potential")

_Rules = dict[str, tuple[Rule, ...]]
# The keys of numbers of each table with their rules; standard deviations may be missing.
_MODE: _Rules = {
    "frequency_hz": (POSITIVE, IN_RANGE_HZ),
    "damping_ratio": (BELOW_ONE,),
    "shape": (),
    "participation": (),
}
_MODE_STD: _Rules = {
    "frequency_std_hz": (NOT_NEGATIVE, IN_RANGE_HZ),
    "damping_ratio_std": (NOT_NEGATIVE,),
    "modal_mass_std": (NOT_NEGATIVE,),
}
_MODE_FURTHER: _Rules = {"participation_lag": ()}
_RIGID_BODY_MODE: _Rules = {"shape": (), "participation": ()}
_MEASUREMENT: _Rules = dict.fromkeys(
    (
        *("level_gain_std", "level_phase_std_deg"),
        *("level_frequency_std_hz", "level_damping_ratio_std"),
    ),
    (NOT_NEGATIVE,),
)


def read_model(path: FilePath) -> Structure:
    """Read a structure from a TOML: its modes, potential, effects and shared errors.

    Files are in Hz and degrees and count modes from one; the result is in rad/s and rad and
    counts from zero. The sensors are those of the modes' shapes, in the first mode's order; a
    model without a name takes the file's. A mode may state the 1σ of its linear test:
    `frequency_std_hz`, `damping_ratio_std` and, relative, `modal_mass_std`. Effects act on the mode
    of interest, or at points by `at` or `between`, in N and m; `normal_at` or `normal_between` give
    the normal direction of a contact. In place of modes a file may have matrices (see
    `from_matrices`; or `file`, an NPZ or MAT file with such arrays):

        [structure]
        points = ["a", "b"]
        mass = [[1.0, 0.0], [0.0, 1.0]]            # kg
        stiffness = [[2.0, -1.0], [-1.0, 2.0]]     # N/m
        damping_ratio = 0.01                       # or damping, a matrix in N s/m
        [force]
        at = { a = 1.0 }                           # newtons per newton; or [base], as above
        [[effect]]
        kind = "one_sided_stop"
        between = ["b", "a"]                       # acts on x_b − x_a
        stiffness = 100.0
        gap = 0.01

    Returns the structure. Raises `ValueError` that names file, table, key, value and expectation,
    with a suggestion for a misspelt name.
    """
    return _read(read_text(path), file_name(path), Path(path))


def _read(text: str, file: str, path: Path) -> Structure:
    top = parsed_toml(text, file)
    top.check_keys((), _TOP_KEYS)
    errors = _numbers(top.table("measurement", f"[measurement] of {file}"), {}, _MEASUREMENT)
    effects = tuple(_effect(table) for table in top.tables("effect", file))
    if "structure" in top.entries:
        for key in _OF_MODES:
            if key in top.entries:
                raise InputError(f"{file} has both [structure] and `{key}`: matrices or modes.")
        built = structure_of_matrices(top, file, path.parent, effects)
        modes, potential = built.modes, built.potential
    else:
        modes = _modes(top, file, effects)
        potential = _potential(top.table("potential", f"[potential] of {file}"), modes.n_modes)
        for k, effect in enumerate(effects, 1):
            vectors = effect.influence_vectors if isinstance(effect, AbstractForce) else ()
            for point, _ in (pair for vector in vectors if vector is not None for pair in vector):
                _check_point(modes, point, f"effect {k} of {file}")
    return structure(
        modes,
        potential,
        effects=effects,
        level_gain_std=errors.get("level_gain_std", 0.0),
        level_phase_std=errors.get("level_phase_std_deg", 0.0) * DEGREE,
        level_frequency_std=errors.get("level_frequency_std_hz", 0.0) * HERTZ,
        level_damping_std=errors.get("level_damping_ratio_std", 0.0),
        name=top.text("name", path.stem),
    )


def _check_point(modes: LinearModes, point: str, location: str) -> None:
    try:
        modes.shape_at(point)
    except InputError as error:
        raise InputError(f"{location} cannot be read: {error}") from error


def _numbers(table: TomlTable, required: _Rules, optional: _Rules) -> dict[str, float]:
    """The numbers present in a table, checked."""
    table.check_keys(required, optional)
    rules = {key: rule for key, rule in (required | optional).items() if key != "shape"}
    return {key: table.number(key, *rules[key]) for key in rules if key in table.entries}


def _modes(top: TomlTable, file: str, effects: Sequence[AbstractEffect]) -> LinearModes:
    tables, rigid_tables = top.tables("mode", file), top.tables("rigid_body_mode", file)
    flexible = [_numbers(table, _MODE, _MODE_STD | _MODE_FURTHER) for table in tables]
    rigid = [_numbers(table, _RIGID_BODY_MODE, {}) for table in rigid_tables]
    if not flexible:
        raise InputError(f"{file} must have at least one mode with a shape, under [[mode]].")
    of_interest = top.whole("mode_of_interest", 1, 1)
    if of_interest > len(flexible):
        expected = f"from 1 to the number of modes ({len(flexible)})"
        raise top.refusal("mode_of_interest", expected, of_interest)
    shapes = [_shape(table) for table in (*tables, *rigid_tables)]
    sensors = tuple(shapes[0].entries)
    for shape in shapes:
        for sensor in sensors:
            if sensor not in shape.entries:
                near = near_miss(sensor, set(shape.entries) - set(sensors))
                raise InputError(
                    f"{shape.location} lacks the sensor {shown(sensor)}, which mode 1 "
                    f"has{'' if near is None else f' (is it {shown(near)}?)'}."
                )
        for sensor in shape.entries:
            if sensor not in sensors:
                raise InputError(
                    f"{shape.location} has the sensor {shown(sensor)}, which mode 1 lacks."
                )
    mode_shape = np.array([[shape.number(name) for shape in shapes] for name in sensors])
    if not np.any(mode_shape[:, of_interest - 1]):
        raise InputError(
            f"{file} must have at least one mode with a shape, but the mode of interest "
            f"({of_interest}) is zero at every sensor."
        )

    if not any(m["participation"] or m.get("participation_lag") for m in (*flexible, *rigid)):
        raise InputError(
            f"{file} has no mode that the force excites: expected a `participation` other than "
            "zero for at least one mode."
        )
    base = moving_base(top, file)
    if base is not None and rigid_tables:
        raise InputError(
            f"{file} has both [base] and [[rigid_body_mode]]: a base constrains rigid-body motion."
        )
    n, participation = len(flexible), np.array([m["participation"] for m in (*flexible, *rigid)])
    # Rigid-body modes coupled to nonlinear elements are kept as modes of zero frequency.
    coupling_of_elements = element_participation(effects, sensors, mode_shape[:, n:])
    rotation, n_free = coupled_first(
        coupling_of_elements, np.abs(mode_shape[:, n:]).max(axis=0, initial=0.0)
    )
    mode_shape[:, n:] = mode_shape[:, n:] @ rotation
    participation[n:] = participation[n:] @ rotation
    coupling = _coupling(top, n, len(rigid))
    if coupling is not None:
        whole = scipy.linalg.block_diag(np.eye(n), rotation)
        coupling = (whole.T @ coupling @ whole)[: n + n_free, : n + n_free]
    n_modes = n + n_free
    names, listed = sensors, listed_sensors(top, file)
    if listed is not None:
        for sensor in listed:
            if sensor not in names:
                near = suggestion(sensor, names)
                raise InputError(
                    f"[sensors] of {file} lists {shown(sensor)}, which no mode has{near}."
                )
        sensors = tuple(listed)
    sensor_index = [names.index(sensor) for sensor in sensors]
    others = {name: row for name, row in zip(names, mode_shape, strict=True) if name not in sensors}
    mode_shape = mode_shape[sensor_index]

    def stds(key: str, default: float = 0.0) -> list[float]:
        return [mode.get(key, default) for mode in flexible] + [default] * n_free

    known_mass = any("modal_mass_std" in mode for mode in flexible)
    return linear_modes(
        [*(mode["frequency_hz"] * HERTZ for mode in flexible), *[0.0] * n_free],
        [*(mode["damping_ratio"] for mode in flexible), *[0.0] * n_free],
        mode_shape[:, :n_modes],
        participation[:n_modes],
        sensors=sensors,
        mode_of_interest=of_interest - 1,
        rigid_body=RigidBodyModes(mode_shape[:, n_modes:], participation[n_modes:]),
        std=LinearModesStd(
            [std * HERTZ for std in stds("frequency_std_hz")],
            stds("damping_ratio_std"),
            stds("modal_mass_std", UNSTATED_MODAL_MASS_STD) if known_mass else None,
        ),
        optional=OptionalModalData(
            {name: row[:n_modes].tolist() for name, row in others.items()},
            coupling,
            lag if any(lag := stds("participation_lag")) else None,
            base,
            unbalance(top, file),
        ),
    )


def _coupling(top: TomlTable, n_modes: int, n_rigid: int) -> np.ndarray | None:
    """Damping coupling of the modes, 1/s; rigid-body modes last, zero where not stated."""
    if "damping_coupling" not in top.entries:
        return None
    rows, whole = top.entries["damping_coupling"], n_modes + n_rigid
    if not isinstance(rows, list) or len(rows) not in (n_modes, whole):
        raise top.refusal("damping_coupling", f"{n_modes} rows of numbers, one a mode", rows)
    coupling = [
        TomlTable({"damping_coupling": row}, f"{top.location}, row {k},").numbers(
            "damping_coupling", each="mode", count=len(rows)
        )
        for k, row in enumerate(rows, 1)
    ]
    return np.pad(np.array(coupling), (0, whole - len(rows)))


def _shape(mode: TomlTable) -> TomlTable:
    """The shape of one mode, its value at each sensor, checked."""
    table = mode.table("shape", f"the shape of {mode.location}")
    if not table.entries:
        raise InputError(f"{table.location} must have at least one sensor.")
    for sensor in table.entries:
        if sensor != sensor.strip() or sensor == "" or not sensor.isprintable():
            must = "the name of a sensor must be a text without spaces around it"
            raise InputError(f"{must}, but {table.location} has {sensor!r}.")
        table.number(sensor)
    return table


def _potential(table: TomlTable, n_modes: int) -> PolynomialPotential:
    coefficients: dict[Monomial, float] = {}
    spread: dict[Monomial, float] = {}
    for name, value in table.entries.items():
        try:
            monomial = parse_monomial(name, n_modes)
        except InputError as error:
            raise InputError(f"{table.location} cannot be read: {error}") from error
        if monomial in coefficients:
            twice = f"{table.location} has the monomial {name!r} twice"
            raise InputError(f"{twice} (the order of modes is free).")
        if isinstance(value, dict):
            entry = TomlTable(value, f"monomial {name!r} in {table.location}")
            entry.check_keys(("coefficient",), ("std",))
            coefficients[monomial] = entry.number("coefficient")
            spread[monomial] = entry.number("std", NOT_NEGATIVE, default=0.0)
        else:
            coefficients[monomial] = table.number(name)
    return polynomial_potential(coefficients, n_modes, coefficient_std=spread)


def _effect(table: TomlTable) -> AbstractEffect:
    if "kind" not in table.entries:
        raise InputError(f"{table.location} lacks the key `kind`.")
    at_points = bool(table.entries.keys() & {"at", "between"})
    try:
        kind, entries = known.present_names(table.text("kind"), table.entries, at_points=at_points)
    except InputError as error:
        raise InputError.located(table.location, error) from error
    kinds = known.known_effects()
    if kind not in kinds:
        near = suggestion(kind, kinds) or f" (known are {', '.join(sorted(kinds))})"
        raise InputError(f"{table.location} has the unknown kind {shown(kind)}{near}.")
    wanted = known.effect_class(kind).parameters()
    table = TomlTable(entries, f"{table.location} ({kind})")
    across = ("normal_at", "normal_between") if kind in known.SURFACES else ()
    table.check_keys(("kind", *wanted), ("at", "between", *across))
    values: dict[str, float | np.ndarray] = {
        name: table.number(name, *parameter.rules)
        if parameter.entries is Entries.ONE
        else np.array(table.numbers(name, *parameter.rules))
        for name, parameter in wanted.items()
    }
    try:
        return known.make_effect(
            kind,
            values,
            at=influence_vector_of(table),
            normal_at=influence_vector_of(table, "normal_"),
        )
    except InputError as error:
        raise InputError(f"{table.location} cannot be read: {error}") from error


def write_model(path: FilePath, model: Structure) -> None:
    """Write a structure as the TOML that `read_model` reads.

    Numbers are written in full precision: reading restores them exactly, angular frequencies and
    phases to one rounding of the unit conversion. The test order is not included; it belongs to the
    data. The file is written atomically.

    Raises `ValueError` for a model that the reader would refuse.
    """
    if model.modes.natural_frequency.ndim != 1:
        raise InputError("`model` must be one structure, but is a batch of them.")
    # Without signed zeros: matrices of one column lose the sign of zero in reading.
    unsigned = jax.tree.map(lambda leaf: np.asarray(leaf) + 0.0, model)
    text = tomli_w.dumps(_entries(unsigned))
    _read(text, file_name(path), Path(path))
    write_atomically(path, text)


def _entries(model: Structure) -> dict[str, object]:
    modes, potential = model.modes, model.potential
    names = (*modes.sensors, *modes.points)
    shapes = np.asarray(modes.mode_shape)
    if modes.point_shape is not None:
        shapes = np.concatenate([shapes, np.asarray(modes.point_shape)])

    def shape(of: object) -> dict[str, float]:
        return dict(zip(names, np.asarray(of).tolist(), strict=False))

    flexible: list[dict[str, object]] = []
    elastic = np.flatnonzero(modes.natural_frequency).tolist()
    free = np.flatnonzero(np.asarray(modes.natural_frequency) == 0).tolist()
    for k in elastic:
        stds = {
            "frequency_std_hz": in_unit(modes.natural_frequency_std.item(k), HERTZ),
            "damping_ratio_std": modes.damping_ratio_std.item(k),
        }
        entry = {
            "frequency_hz": in_unit(modes.natural_frequency.item(k), HERTZ),
            "damping_ratio": modes.damping_ratio.item(k),
            "participation": modes.participation.item(k),
            **{key: value for key, value in stds.items() if value},
        }
        if modes.modal_mass_std is not None:
            entry["modal_mass_std"] = modes.modal_mass_std.item(k)
        if modes.participation_lag is not None:
            entry["participation_lag"] = modes.participation_lag.item(k)
        flexible.append({**entry, "shape": shape(shapes[:, k])})
    rigid = [
        {"participation": modes.participation.item(k), "shape": shape(shapes[:, k])} for k in free
    ] + [
        {"participation": float(participation), "shape": shape(modes.rigid_body_shape[:, k])}
        for k, participation in enumerate(modes.rigid_body_participation)
    ]
    coefficients = zip(
        potential.monomials,
        potential.coefficient.tolist(),
        potential.coefficient_std.tolist(),
        strict=True,
    )
    frequency_std = _one("level_frequency_std", model.level_frequency_std)
    errors = {
        "level_gain_std": _one("level_gain_std", model.level_gain_std),
        "level_phase_std_deg": in_unit(_one("level_phase_std", model.level_phase_std), DEGREE),
        "level_frequency_std_hz": in_unit(frequency_std, HERTZ),
        "level_damping_ratio_std": _one("level_damping_std", model.level_damping_std),
    }
    parts: dict[str, object] = {
        "name": model.name,
        "mode_of_interest": modes.mode_of_interest + 1,
        "mode": flexible,
        "rigid_body_mode": rigid,
        "potential": {
            monomial_key(monomial): {"coefficient": value, "std": std} if std else value
            for monomial, value, std in coefficients
        },
        "effect": [_effect_entry(effect) for effect in model.effects],
        "measurement": {key: value for key, value in errors.items() if value},
        "sensors": {"points": list(modes.sensors)} if modes.points else {},
        "base": {}
        if modes.base is None
        else {"motion": modes.base.motion, "along": dict(modes.base.along)},
        "force": {}
        if modes.unbalance is None
        else {"unbalance_kg_m": _one("unbalance", modes.unbalance)},
        "damping_coupling": []
        if modes.damping_coupling is None
        else np.pad(modes.damping_coupling, (0, len(rigid) - len(free))).tolist(),
    }
    return {name: value for name, value in parts.items() if value not in ([], {})}


def _effect_entry(effect: AbstractEffect) -> dict[str, object]:
    if effect.kind not in known.known_effects():
        raise InputError(f"an effect to be written must be of a known kind, not {effect.kind!r}.")
    entry: dict[str, object] = {"kind": effect.kind}
    for side in ("at", "normal_at"):
        row = getattr(effect, side, None)
        if row is not None:
            entry[side] = row[0][0] if len(row) == 1 and row[0][1] == 1 else dict(row)
    for name, parameter in known.effect_class(effect.kind).parameters().items():
        value = getattr(effect, name)
        entry[name] = (
            _one(name, value) if parameter.entries is Entries.ONE else np.ravel(value).tolist()
        )
    return entry


def _one(name: str, value: object) -> float:
    number = np.asarray(value, dtype=np.float64)
    if number.ndim != 0:
        raise InputError(f"`{name}` must be one number, but has shape {number.shape}.")
    return float(number)
