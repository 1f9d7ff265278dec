"""Steady states read from and written to CSV, and results written to CSV."""

import csv
import dataclasses
import io
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from numbers import Integral, Real
from typing import SupportsFloat

import jax
import numpy as np

from snrmjax.io.columns import (
    AMPLITUDE,
    BASE,
    BASE_STD,
    FORCES,
    OPTIONAL,
    PHASOR,
    REQUIRED,
    harmonic_columns,
    read_header,
)
from snrmjax.io.files import FilePath, file_name, read_text, shown, write_atomically
from snrmjax.io.rows import Cells, cells_of
from snrmjax.measure.base_excitation import as_recorded, base_excited_states
from snrmjax.measure.states import (
    NO_PHASE,
    UNNAMED_SENSOR,
    OptionalColumns,
    SteadyStates,
    steady_states,
)
from snrmjax.model.modes import LinearModes
from snrmjax.model.moving_base import BaseMotion
from snrmjax.model.structures import Structure, modes_of
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.names import suggestion
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import DEGREE, HERTZ, in_unit


def read_steady_states(
    path: FilePath,
    model: Structure | LinearModes | None = None,
    *,
    sensors: tuple[str, ...] | None = None,
) -> SteadyStates:
    """Read measured steady states from a CSV, one row a steady state and sensor.

    Rows of the same level, frequency, force (or drive voltage) and test order are one state
    measured by several sensors; a repeated sensor starts a new state. Files are in Hz and degrees,
    the result is in rad/s and rad. An empty field in an optional column is "not stated". In place
    of the two parts of the velocity's phasor a table may have `velocity_m_s`, the amplitude of its
    fundamental: the phases are then unknown (`SteadyStates.phase_unknown`). In place of a force it
    may have the acceleration of a base, whose motion is subtracted where the model's `[base]`
    states absolute sensors.

    Arguments: `model` is the measured structure, whose sensors the table must have; alternatively
    `sensors` names them. Without either, the sensors are those of the table in order of appearance,
    and velocities measured with a base acceleration are not changed.
    Returns the steady states with the sensors in the model's order;
    their `notes` report what was not used or not stated.
    Raises `ValueError` that names file, row, column, value and expectation.

    Typical use: `data = read_steady_states("measured.csv", read_model("model.toml"))`.
    """
    if model is None:
        return _read(read_text(path), file_name(path), sensors)
    modes = modes_of(model)
    unbalance = None if modes.unbalance is None else float(modes.unbalance)
    data = _read(read_text(path), file_name(path), modes.sensors, modes.base, unbalance)
    check_driven_alike(data, modes, file_name(path))
    return data


def check_driven_alike(data: SteadyStates, modes: LinearModes, file: str) -> None:
    """Refuse an excitation other than the model's, or none of the mode of interest."""
    one = modes.mode_of_interest
    if not modes.driven()[one]:
        raise InputError(
            f"{file} is a test of mode {one + 1}, the model's `mode_of_interest`, which its force "
            f"does not excite (`participation` {modes.participation.item(one):g}): expected "
            "another `mode_of_interest`, or the participation of this one."
        )
    if (data.base is None) == (modes.base is None):
        return
    if modes.base is None:
        raise InputError(
            f"{file} has the acceleration of a base, but the model has no [base]: add "
            '`[base]` with `motion = "absolute"` (or "relative") to it, participations then being '
            "those of the base's acceleration (`snrmjax modes --base` writes both)."
        )
    column = "drive_v" if np.isfinite(np.asarray(data.drive)).any() else "force_n"
    raise InputError(
        f"{file} has `{column}`, but the model has base excitation ([base]): expected the "
        f"columns `{BASE[0]}` and `{BASE[1]}`."
    )


def _read(
    text: str,
    file: str,
    sensors: tuple[str, ...] | None,
    base: BaseMotion | None = None,
    unbalance: float | None = None,
) -> SteadyStates:
    cells = cells_of(text, file)
    header = read_header(cells, force_known=unbalance is not None)
    cells.require_rows()
    notes = list(header.notes)
    rules = REQUIRED | FORCES | OPTIONAL | dict.fromkeys((*header.harmonics, *BASE), ())
    rules[BASE_STD] = OPTIONAL["force_std_n"]
    columns: dict[str, np.ndarray] = {}
    for name in [name for name in rules if name in header.used]:
        optional = name in OPTIONAL or name in header.harmonics or name == BASE_STD
        columns[name] = cells.numbers(name, rules[name], empty_allowed=optional)
        empty = np.flatnonzero(np.isnan(columns[name]))
        if empty.size:
            first = cells.rows[empty[0]].number
            of = {"of": len(cells.rows), "file": file, "first_row": first}
            notes.append(Fact("column_partly_stated", name=name, n=len(empty), **of))
    if "harmonic_std_m_s" in columns and not header.harmonic_order:
        notes.append(Fact("error_of_no_harmonics", file=file))
    if AMPLITUDE in header.used:
        amplitude = cells.numbers(AMPLITUDE, FORCES["force_n"])
        notes.append(Fact("amplitudes_without_phases", file=file))
        if "phase_std_deg" in columns:
            notes.append(Fact("error_of_no_phases", file=file))
        columns["phase_std_deg"] = np.full(len(amplitude), NO_PHASE / DEGREE)
        columns |= dict(zip(PHASOR, (amplitude, np.zeros(len(amplitude))), strict=True))
    if unbalance is not None and header.used.isdisjoint((*FORCES, *BASE)):
        columns["force_n"] = unbalance * (HERTZ * columns["frequency_hz"]) ** 2
    velocity = _phasors(*(columns[name] for name in PHASOR))
    if not np.any(velocity):
        raise InputError(f"{file} has only zero velocities.")

    names, sensor = _sensors(cells, sensors)
    force = "drive_v" if "drive_v" in columns else "force_n"
    base_excited = BASE[0] in columns
    if base_excited and not np.all(columns[BASE[0]] ** 2 + columns[BASE[1]] ** 2 > 0):
        row = int(np.argmin(columns[BASE[0]] ** 2 + columns[BASE[1]] ** 2))
        raise cells.refusal(BASE[0], f"above zero together with `{BASE[1]}`", row)
    loads = BASE if base_excited else (force,)
    key_columns = [columns[name] for name in ("level", "frequency_hz", *loads)]
    if "order" in columns:
        key_columns.append(np.nan_to_num(columns["order"], nan=-1.0))
    state = group_states(np.column_stack(key_columns).tolist(), sensor)
    n_states = max(state) + 1
    first_row = np.unique(state, return_index=True)[1]
    at = (np.asarray(state), np.asarray(sensor))

    def per_state(name: str) -> np.ndarray | None:
        return columns[name][first_row] if name in columns else None

    def per_sensor(values: np.ndarray, missing: complex = np.nan) -> np.ndarray:
        array = np.full((n_states, len(names)), missing, dtype=values.dtype)
        array[at] = values
        return array

    harmonics = np.full((n_states, len(names), len(header.harmonic_order)), complex(np.nan, np.nan))
    for k, order in enumerate(header.harmonic_order):
        harmonics[(*at, k)] = _harmonic(cells, columns, order)
    not_stated = np.full(len(sensor), np.nan)
    level = columns["level"][first_row].astype(np.int64)
    frequency = columns["frequency_hz"][first_row] * HERTZ
    optional_columns: OptionalColumns = {
        "measured": per_sensor(np.ones(len(sensor), dtype=bool), False),
        "velocity_std": per_sensor(columns.get("velocity_std_m_s", not_stated)),
        "phase_std": per_sensor(columns.get("phase_std_deg", not_stated)) * DEGREE,
        "force_std": _force_std(cells, columns, state),
        "drive": per_state("drive_v"),
        "order": per_state("order"),
        "harmonics": harmonics,
        "harmonic_std": per_sensor(columns.get("harmonic_std_m_s", not_stated)),
        "harmonic_order": header.harmonic_order,
    }
    if base_excited:
        # Without a model, treat the sensors as relative: velocities stay unchanged.
        known = base or BaseMotion("relative")
        data = base_excited_states(
            level,
            frequency,
            _phasors(*(columns[name][first_row] for name in BASE)),
            per_sensor(velocity, 0.0),
            sensors=names,
            along=dict(known.along),
            relative=known.motion == "relative",
            **optional_columns,
        )
    else:
        newtons = columns["force_n"][first_row] if force == "force_n" else np.full(n_states, np.nan)
        data = steady_states(
            level, frequency, newtons, per_sensor(velocity, 0.0), sensors=names, **optional_columns
        )
    return dataclasses.replace(data, notes=tuple(notes))


def _harmonic(cells: Cells, columns: Mapping[str, np.ndarray], order: int) -> np.ndarray:
    """One harmonic of every row, NaN where it is not stated."""
    names = harmonic_columns(order)
    real = columns[names[0]]
    if order == 0:
        return _phasors(real, np.where(np.isnan(real), np.nan, 0.0))
    imaginary = columns[names[1]]
    half = np.flatnonzero(np.isnan(real) != np.isnan(imaginary))
    if half.size:
        column = names[0] if np.isnan(real[half[0]]) else names[1]
        other = names[1] if column == names[0] else names[0]
        raise cells.refusal(column, f"a number where `{other}` has one", int(half[0]))
    return _phasors(real, imaginary)


def _phasors(real: np.ndarray, imaginary: np.ndarray) -> np.ndarray:
    phasors = np.empty(real.shape, dtype=np.complex128)
    phasors.real, phasors.imag = real, imaginary
    return phasors


def _force_std(
    cells: Cells, columns: Mapping[str, np.ndarray], state: Sequence[int]
) -> np.ndarray | None:
    """The force standard deviation of every state, which must be equal in its rows."""
    name = BASE_STD if BASE_STD in columns else "force_std_n"
    if name not in columns:
        return None
    values = columns[name]
    of_state = np.full(max(state) + 1, np.nan)
    for row, (k, value) in enumerate(zip(state, values, strict=True)):
        if np.isnan(of_state[k]):
            of_state[k] = value
        elif value != of_state[k] and not np.isnan(value):
            expected = f"{of_state[k]:g} as in the other rows of this steady state"
            raise cells.refusal(name, expected, row)
    return of_state


def _sensors(cells: Cells, sensors: tuple[str, ...] | None) -> tuple[tuple[str, ...], list[int]]:
    """The sensors of the result, and the sensor index of each row."""
    if not cells.has("sensor"):
        if sensors is not None and len(sensors) != 1:
            listed = ", ".join(f"`{name}`" for name in sensors)
            raise InputError(
                f"{cells.file} lacks the column `sensor`, which is required because the model "
                f"has the sensors {listed}."
            )
        return sensors or UNNAMED_SENSOR, [0] * len(cells.rows)
    texts = cells.texts("sensor")
    names = tuple(dict.fromkeys(texts)) if sensors is None else sensors
    index = {name: k for k, name in enumerate(names)}
    for row, text in enumerate(texts):
        if text == "":
            raise cells.refusal("sensor", "the name of a sensor", row)
        if text not in index:
            listed = ", ".join(f"`{name}`" for name in names)
            raise InputError(
                f"`sensor` must be one of the model's ({listed}), but row "
                f"{cells.rows[row].number} of {cells.file} has {shown(text)}"
                f"{suggestion(text, names)}."
            )
    return names, [index[text] for text in texts]


def group_states(keys: Iterable[Sequence[float]], sensor: Iterable[int]) -> list[int]:
    """The state of each row: rows with equal key and different sensors share it.

    The n-th row of a sensor with a key belongs to the n-th state with that key, so that rows may
    be sorted by state or by sensor.

    Arguments: for each row its `keys` (level, frequency, force or drive, order) and `sensor`.
    Returns state numbers from zero, in the order in which the states first appear.

    >>> group_states([(1, 80.0), (1, 80.0), (1, 80.0), (1, 81.0)], [0, 1, 0, 0])
    [0, 0, 1, 2]
    """
    states: dict[tuple[tuple[float, ...], int], int] = {}
    repeats = Counter[tuple[tuple[float, ...], int]]()
    result = []
    for values, which in zip(keys, sensor, strict=True):
        key = tuple(values)
        repeats[key, which] += 1
        result.append(states.setdefault((key, repeats[key, which]), len(states)))
    return result


def write_steady_states(path: FilePath, data: SteadyStates) -> None:
    """Write steady states as the CSV that `read_steady_states` reads, one row a state and sensor.

    Numbers are written in full precision: reading restores them exactly, angular frequencies and
    phases to one rounding of the unit conversion. Columns without values are left out.

    Arguments: `data` with the forces of all states, or with the drive voltages of all where no
    force is known; voltages in addition to forces are left out. For base excitation the base
    acceleration and the recorded velocities are written.
    Raises `ValueError` for data that the reader would refuse.
    """
    write_atomically(path, _table_text(_fields(data, file_name(path))))


def _fields(data: SteadyStates, file: str) -> dict[str, list[str]]:
    """The fields of a table of steady states by column, as text; `file` is its name in messages."""
    host: SteadyStates = jax.tree.map(np.asarray, as_recorded(data))
    if not np.all(np.any(host.measured, axis=1)):
        raise InputError("each steady state must be measured by a sensor, but one is by none.")
    state, sensor = np.nonzero(host.measured)
    columns: dict[str, list[str]] = {"level": [str(int(value)) for value in host.level[state]]}
    if host.sensors != UNNAMED_SENSOR:  # a model's only sensor may have another name
        columns["sensor"] = [host.sensors[k] for k in sensor]
    columns["frequency_hz"] = _in_units(host.frequency[state], HERTZ)
    has_force, has_drive = ~np.isnan(host.force), ~np.isnan(host.drive)
    if np.all(has_force) and data.base is not None:
        columns |= dict(zip(BASE, (_texts(host.force[state]), ["0.0"] * len(state)), strict=True))
    elif np.all(has_force):
        columns["force_n"] = _texts(host.force[state])
    elif np.all(has_drive) and not np.any(has_force):
        columns["drive_v"] = _texts(host.drive[state])
    else:
        raise InputError(
            "steady states to be written must have all forces or, where no force is known, all "
            "drive voltages."
        )
    columns["velocity_re_m_s"] = _texts(host.velocity.real[state, sensor])
    columns["velocity_im_m_s"] = _texts(host.velocity.imag[state, sensor])
    optional = {
        "velocity_std_m_s": _texts(host.velocity_std[state, sensor]),
        "phase_std_deg": _in_units(host.phase_std[state, sensor], DEGREE),
        "force_std_n" if data.base is None else BASE_STD: _texts(host.force_std[state]),
        "order": _texts(host.order[state]),
        "harmonic_std_m_s": _texts(host.harmonic_std[state, sensor]),
    }
    columns |= {name: values for name, values in optional.items() if any(values)}
    for k, order in enumerate(host.harmonic_order):
        harmonic = np.asarray(host.harmonics[state, sensor, k])
        if order == 0 and np.any(np.nan_to_num(harmonic.imag)):
            raise InputError("harmonic 0 is a mean and must be real, but has an imaginary part.")
        for name, part in zip(harmonic_columns(order), ("real", "imag"), strict=False):
            columns[name] = _texts(getattr(harmonic, part))
    back = _read(_table_text(columns), file, host.sensors)
    if back.n_states != data.n_states or not np.array_equal(back.measured, host.measured):
        raise InputError(
            f"{file} could not distinguish some steady states that have the same level, "
            "frequency and force, but different sensors: give each its own `order`."
        )
    return columns


def _in_units(values: np.ndarray | jax.Array, unit: float) -> list[str]:
    return _texts(in_unit(float(value), unit) for value in np.asarray(values))


def steady_states_of_fields(columns: Mapping[str, Sequence[str]], file: str) -> SteadyStates:
    """Steady states from a table's fields (text by column), under the rules of the CSV.

    Raises `ValueError` as `read_steady_states` does; row numbers include the header.
    """
    return _read(_table_text(columns), file, None)


def _texts(values: Iterable[SupportsFloat]) -> list[str]:
    """Numbers in full precision; an empty field for NaN."""
    return ["" if np.isnan(value) else repr(value) for value in map(float, values)]


def write_table(
    path: FilePath, columns: Mapping[str, Sequence[object] | np.ndarray | jax.Array]
) -> None:
    """Write results as a CSV: a header row, commas, `\\n` line ends, 12 significant digits.

    The file is written atomically. NaN is written as `nan`, a boolean as 0 or 1, integers and texts
    unchanged.

    Arguments: `columns` maps the name of each column to its values, all of one length.
    Raises `ValueError` for columns of unequal length, for values that are neither number nor text,
    and when the file cannot be written.
    """
    fields = {}
    for name, values in columns.items():
        if isinstance(values, str):
            raise InputError(f"the column `{name}` must be a sequence of values, not a text.")
        items = values.tolist() if isinstance(values, np.ndarray | jax.Array) else values
        if not isinstance(items, Sequence):
            raise InputError(f"the column `{name}` must be a vector, but is one value.")
        fields[name] = [_field(name, value) for value in items]
    write_atomically(path, _table_text(fields))


def _field(name: str, value: object) -> str:
    """A value as text of a table."""
    item = value.item() if isinstance(value, np.generic | jax.Array) else value
    if isinstance(item, str):
        return item
    if isinstance(item, Integral):
        return str(int(item))
    if isinstance(item, Real):
        return format(float(item) + 0.0, ".12g")  # adding zero turns -0 into 0
    raise InputError(f"the column `{name}` must hold real numbers or texts, but has {shown(item)}.")


def _table_text(columns: Mapping[str, Sequence[str]]) -> str:
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"`{name}` {length}" for name, length in lengths.items())
        raise InputError(f"all columns of a table must have one length, but have {listed}.")
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return buffer.getvalue()
