"""Models: a structure in and out, as TOML."""

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
import tomli_w

from snrmjax.io.files import (
    FilePath,
    file_name,
    near_miss,
    read_text,
    shown,
    suggestion,
    write_atomically,
)
from snrmjax.io.toml_table import TomlTable, parsed_toml
from snrmjax.io.units import DEGREE, HERTZ, in_unit
from snrmjax.model.effect_base import AbstractEffect
from snrmjax.model.effect_metadata import Entries
from snrmjax.model.effects import EFFECTS, LAWS, effect_class, make_effect
from snrmjax.model.modes import (
    UNSTATED_MODAL_MASS_STD,
    LinearModes,
    LinearModesStd,
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
from snrmjax.numerics.rules import BELOW_ONE, IN_RANGE_HZ, NOT_NEGATIVE, NOT_ZERO, POSITIVE

_MODE_KEYS = ("frequency_hz", "damping_ratio", "shape", "participation")
_MODE_STD_KEYS = ("frequency_std_hz", "damping_ratio_std", "modal_mass_std")
_RIGID_BODY_KEYS = ("shape", "participation")
_MEASUREMENT_KEYS = (
    *("level_gain_std", "level_phase_std_deg"),
    *("level_frequency_std_hz", "level_damping_ratio_std"),
)
_TOP_KEYS = (
    "name",
    "mode_of_interest",
    "mode",
    "rigid_body_mode",
    "potential",
    "effect",
    "measurement",
)


def read_model(path: FilePath) -> Structure:
    """Read a structure from a TOML: its modes, potential, effects and shared errors.

    Files are in Hz and degrees and count modes from one; the result is in rad/s and rad and
    counts from zero. The sensors are those of the modes' shapes, in the first mode's order; a
    model without a name takes the file's. A mode may state the 1σ of its linear test:
    `frequency_std_hz`, `damping_ratio_std` and, relative, `modal_mass_std`.

    Returns the structure. Raises `ValueError` that names file, table, key, value and what was
    expected; a near miss is suggested for an unknown name.
    """
    return _read(read_text(path), file_name(path), Path(path).stem)


def _read(text: str, file: str, stem: str) -> Structure:
    top = parsed_toml(text, file)
    entries = top.entries
    top.check_keys((), _TOP_KEYS)
    name = entries.get("name", stem)
    if not isinstance(name, str):
        raise top.refusal("name", "a text", name)
    modes = _modes(top, file)
    measurement = top.table("measurement", f"[measurement] of {file}")
    measurement.check_keys((), _MEASUREMENT_KEYS)
    return structure(
        modes,
        _potential(top.table("potential", f"[potential] of {file}"), modes.n_modes),
        effects=tuple(_effect(table) for table in top.tables("effect", file)),
        level_gain_std=measurement.number("level_gain_std", NOT_NEGATIVE, default=0.0),
        level_phase_std=measurement.number("level_phase_std_deg", NOT_NEGATIVE, default=0.0)
        * DEGREE,
        level_frequency_std=measurement.number("level_frequency_std_hz", NOT_NEGATIVE, default=0.0)
        * HERTZ,
        level_damping_std=measurement.number("level_damping_ratio_std", NOT_NEGATIVE, default=0.0),
        name=name,
    )


def _modes(top: TomlTable, file: str) -> LinearModes:
    flexible, rigid = top.tables("mode", file), top.tables("rigid_body_mode", file)
    if not flexible:
        raise ValueError(f"{file} must have at least one mode with a shape, under [[mode]].")
    of_interest = top.entries.get("mode_of_interest", 1)
    if isinstance(of_interest, bool) or not isinstance(of_interest, int):
        raise top.refusal("mode_of_interest", "a whole number", of_interest)
    if not 1 <= of_interest <= len(flexible):
        expected = f"from 1 to the number of modes ({len(flexible)})"
        raise top.refusal("mode_of_interest", expected, of_interest)
    for table in flexible:
        table.check_keys(_MODE_KEYS, _MODE_STD_KEYS)
    for table in rigid:
        table.check_keys(_RIGID_BODY_KEYS)
    shapes = [_shape(table) for table in (*flexible, *rigid)]
    sensors = tuple(shapes[0])
    for table, shape in zip((*flexible, *rigid), shapes, strict=True):
        for sensor in sensors:
            if sensor not in shape:
                near = near_miss(sensor, set(shape) - set(sensors))
                raise ValueError(
                    f"the shape of {table.place} lacks the sensor {shown(sensor)}, which mode 1 "
                    f"has{'' if near is None else f' (is it {shown(near)}?)'}."
                )
        for sensor in shape:
            if sensor not in sensors:
                raise ValueError(
                    f"the shape of {table.place} has the sensor {shown(sensor)}, which mode 1 "
                    "lacks."
                )
    if not any(shapes[of_interest - 1].values()):
        raise ValueError(
            f"{file} must have at least one mode with a shape, but the mode of interest "
            f"({of_interest}) is zero at every sensor."
        )
    mode_shape = np.array([[shape[name] for shape in shapes] for name in sensors])
    return linear_modes(
        [table.number("frequency_hz", POSITIVE, IN_RANGE_HZ) * HERTZ for table in flexible],
        [table.number("damping_ratio", BELOW_ONE) for table in flexible],
        mode_shape[:, : len(flexible)],
        [table.number("participation", NOT_ZERO) for table in flexible],
        sensors=sensors,
        mode_of_interest=of_interest - 1,
        rigid_body=RigidBodyModes(
            mode_shape[:, len(flexible) :],
            np.array([table.number("participation", NOT_ZERO) for table in rigid]),
        ),
        std=LinearModesStd(
            [
                table.number("frequency_std_hz", NOT_NEGATIVE, IN_RANGE_HZ, default=0.0) * HERTZ
                for table in flexible
            ],
            [table.number("damping_ratio_std", NOT_NEGATIVE, default=0.0) for table in flexible],
            _modal_mass_std(flexible),
        ),
    )


def _shape(mode: TomlTable) -> dict[str, float]:
    """The shape of one mode: its value at each sensor."""
    table = mode.table("shape", f"the shape of {mode.place}")
    if not table.entries:
        raise ValueError(f"the shape of {mode.place} must have at least one sensor.")
    for sensor in table.entries:
        if sensor != sensor.strip() or sensor == "" or not sensor.isprintable():
            raise ValueError(
                f"the name of a sensor must be a text without spaces around it, "
                f"but {table.place} has {sensor!r}."
            )
    return {sensor: table.number(sensor) for sensor in table.entries}


def _potential(table: TomlTable, n_modes: int) -> PolynomialPotential:
    coefficients: dict[Monomial, float] = {}
    spread: dict[Monomial, float] = {}
    for key, value in table.entries.items():
        try:
            monomial = parse_monomial(key, n_modes)
        except ValueError as error:
            raise ValueError(f"{table.place} cannot be read: {error}") from error
        if monomial in coefficients:
            raise ValueError(
                f"{table.place} has the monomial {key!r} twice (the order of the modes is free)."
            )
        if isinstance(value, dict):
            entry = TomlTable(value, f"monomial {key!r} in {table.place}")
            entry.check_keys(("coefficient",), ("std",))
            coefficients[monomial] = entry.number("coefficient")
            spread[monomial] = entry.number("std", NOT_NEGATIVE, default=0.0)
        else:
            coefficients[monomial] = table.number(key)
    return polynomial_potential(coefficients, n_modes, coefficient_std=spread)


def _effect(table: TomlTable) -> AbstractEffect:
    if "kind" not in table.entries:
        raise ValueError(f"{table.place} lacks the key `kind`.")
    kind = table.entries["kind"]
    if not isinstance(kind, str):
        raise table.refusal("kind", "a text", kind)
    every = (*EFFECTS, *LAWS)
    if kind in every:
        wanted = effect_class(kind).parameters()
        table = TomlTable(table.entries, f"{table.place} ({kind})")
        table.check_keys(("kind", *wanted))
        values: dict[str, float | np.ndarray] = {
            name: table.number(name, *one.rules)
            if one.entries is Entries.ONE
            else np.array(table.numbers(name, *one.rules))
            for name, one in wanted.items()
        }
        try:
            return make_effect(kind, values)
        except ValueError as error:
            raise ValueError(f"{table.place} cannot be read: {error}") from error
    near = suggestion(kind, every)
    known = "" if near else f" (known are {', '.join(sorted(every))})"
    raise ValueError(f"{table.place} has the unknown kind {shown(kind)}{near}{known}.")


def write_model(path: FilePath, model: Structure) -> None:
    """Write a structure as the TOML that `read_model` reads.

    Numbers are written in full, so that reading gives them back exactly, angular frequencies and
    phases to one rounding of the unit conversion. The test order is not in it: that is the data's.
    The file appears whole or not at all.

    Raises `ValueError` when a file could not hold the model: the rules of the reader apply.
    """
    if model.modes.natural_frequency.ndim != 1:
        raise ValueError("`model` must be one structure, but is a batch of them.")
    text = tomli_w.dumps(_entries(jax.tree.map(np.asarray, model)))
    _read(text, file_name(path), Path(path).stem)
    write_atomically(path, text)


def _modal_mass_std(flexible: Sequence[TomlTable]) -> list[float] | None:
    """As stated, for a mode without it as where nobody stated any; None if no mode has one."""
    if not any("modal_mass_std" in table.entries for table in flexible):
        return None
    default = UNSTATED_MODAL_MASS_STD
    return [table.number("modal_mass_std", NOT_NEGATIVE, default=default) for table in flexible]


def _entries(model: Structure) -> dict[str, object]:
    modes = model.modes
    flexible = []
    for k in range(modes.n_modes):
        entry: dict[str, object] = {
            "frequency_hz": in_unit(float(modes.natural_frequency[k]), HERTZ),
            "damping_ratio": float(modes.damping_ratio[k]),
            "participation": float(modes.participation[k]),
        }
        if modes.natural_frequency_std[k] != 0:
            entry["frequency_std_hz"] = in_unit(float(modes.natural_frequency_std[k]), HERTZ)
        if modes.damping_ratio_std[k] != 0:
            entry["damping_ratio_std"] = float(modes.damping_ratio_std[k])
        if modes.modal_mass_std is not None:
            entry["modal_mass_std"] = float(modes.modal_mass_std[k])
        entry["shape"] = _shape_entry(modes, modes.mode_shape[:, k])
        flexible.append(entry)
    rigid = [
        {
            "participation": float(modes.rigid_body_participation[k]),
            "shape": _shape_entry(modes, modes.rigid_body_shape[:, k]),
        }
        for k in range(modes.rigid_body_participation.shape[0])
    ]
    potential: dict[str, object] = {}
    for monomial, value, std in zip(
        model.potential.monomials,
        model.potential.coefficient.tolist(),
        model.potential.coefficient_std.tolist(),
        strict=True,
    ):
        potential[monomial_key(monomial)] = {"coefficient": value, "std": std} if std else value
    measurement = {
        "level_gain_std": _one("level_gain_std", model.level_gain_std),
        "level_phase_std_deg": in_unit(_one("level_phase_std", model.level_phase_std), DEGREE),
        "level_frequency_std_hz": in_unit(
            _one("level_frequency_std", model.level_frequency_std), HERTZ
        ),
        "level_damping_ratio_std": _one("level_damping_std", model.level_damping_std),
    }
    parts: dict[str, object] = {
        "name": model.name,
        "mode_of_interest": modes.mode_of_interest + 1,
        "mode": flexible,
        "rigid_body_mode": rigid,
        "potential": potential,
        "effect": [_effect_entry(effect) for effect in model.effects],
        "measurement": {key: value for key, value in measurement.items() if value != 0},
    }
    return {key: value for key, value in parts.items() if value not in ([], {})}


def _shape_entry(modes: LinearModes, shape: object) -> dict[str, float]:
    return dict(zip(modes.sensors, np.asarray(shape).tolist(), strict=True))


def _effect_entry(effect: AbstractEffect) -> dict[str, object]:
    if effect.kind not in (*EFFECTS, *LAWS):
        raise ValueError(f"an effect to be written must be of a known kind, not {effect.kind!r}.")
    entry: dict[str, object] = {"kind": effect.kind}
    for name, one in effect_class(effect.kind).parameters().items():
        value = getattr(effect, name)
        entry[name] = _one(name, value) if one.entries is Entries.ONE else np.ravel(value).tolist()
    return entry


def _one(name: str, value: object) -> float:
    number = np.asarray(value, dtype=np.float64)
    if number.ndim != 0:
        raise ValueError(f"`{name}` must be one number, but has shape {number.shape}.")
    return float(number)
