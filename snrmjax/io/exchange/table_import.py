"""Steady states of a table of a laboratory: amplitude and phase, real and imaginary part."""

import re

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.io.exchange.import_errors import response_errors, with_errors_by_name
from snrmjax.io.exchange.import_levels import MeasuredPart
from snrmjax.io.exchange.import_map import Assumption, Assumptions, ImportMap, ResponseMap
from snrmjax.io.exchange.import_units import (
    Force,
    amplitude_factor,
    force_meaning,
    frequency_in_rad,
    motion_meaning,
    phase_in_rad,
    require_name,
)
from snrmjax.io.files import near_miss
from snrmjax.io.laboratory.contents import NumberTable
from snrmjax.io.laboratory.names import role_of
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.velocity_states import velocity_factors
from snrmjax.measure.states import UNNAMED_SENSOR


def columns_by_role(table: NumberTable, *roles: str) -> list[str]:
    """Columns whose names say that they have one of these roles."""
    return [name for name in table.columns if role_of(name) in roles]


def import_table(
    table: NumberTable, told: ImportMap, file: str, assumed: Assumptions
) -> tuple[MeasuredPart, ImportMap, Force, list[str]]:
    """States of a table, the map with what was found, the force's unit, and notes.

    Raises `ValueError` with a question that names the option for what cannot be told.
    """
    frequency_name = told.frequency or _only(
        table, ("frequency",), file, "frequency", "--frequency", assumed
    )
    told = told._replace(frequency=frequency_name)
    omega = frequency_in_rad(
        _real(table, frequency_name, file, "--frequency"),
        told,
        table.units.get(frequency_name, ""),
        assumed,
    )
    if not told.responses:
        raise ValueError(_ask_response(table, file))
    force_name = told.force
    force = Force(1.0, False, "N")
    if force_name:
        assumed.unit("force_unit", told.force_unit, table.units.get(force_name, ""))
        force = force_meaning(told, table.units.get(force_name, ""), f"{force_name} of {file}")
        raw = _column(table, force_name, file, "--force")
        if not np.iscomplexobj(raw) and np.nanmin(raw, initial=1.0) < 0:
            raise ValueError(
                f"{force_name} of {file} has negative amplitudes: --force names another column."
            )
        size = _complex(raw, told, assumed) * force.factor
        if told.force_phase:
            angle = _phase(table, told.force_phase, told, file, assumed, "--force-phase")
            size = size * np.exp(1j * angle)
    elif len(told.force_amplitude) == 1 and told.force_amplitude[0] != "z":
        size = np.full(table.n_rows, float(told.force_amplitude[0]), dtype=complex)
    else:
        raise ValueError(_ask_force(table, file))
    units = {} if told.over_force else _response_units(table, told)
    if force_name:
        units[force_name] = force.unit
    peak = amplitude_factor(told, units, assumed) if units else 1.0
    if force_name:
        size = size * peak
    # Over the force only its amplitude counts; else phases are of one clock with the force's own.
    turn = np.abs(size) if told.over_force else peak * np.exp(-1j * np.angle(size))
    velocity, responses, errors = [], [], []
    for k, one in enumerate(told.responses):
        one = with_errors_by_name(table, one, assumed, k + 1)
        row, filled, scale = _response(table, one, told, omega, file, assumed, k + 1)
        velocity.append(row * turn)
        responses.append(filled)
        errors.append(response_errors(table, filled, told, file, np.abs(scale * turn)))
    phasors = np.stack(velocity, axis=1)
    amplitude_std, phase_std = np.moveaxis(np.array(errors), (0, 1, 2), (2, 0, 1))
    level, key = _level(table, told, file, assumed)
    told = told._replace(responses=tuple(responses), level=level)
    good = np.isfinite(omega) & np.isfinite(size) & np.isfinite(phasors).any(axis=1)
    notes = []
    if not good.all():
        notes.append(
            f"{int(np.sum(~good))} of {len(good)} rows of {file} are incomplete, left out."
        )
    _check(omega[good], np.abs(size[good]), file)
    part = MeasuredPart(
        *(omega[good], np.abs(size[good]), phasors[good], None if key is None else key[good]),
        *(amplitude_std[good], phase_std[good]),
    )
    return part, told, force, notes


def _response_units(table: NumberTable, told: ImportMap) -> dict[str, str]:
    """The unit of each response, stated or of the file."""
    return {one.channel: one.unit or table.units.get(one.channel, "") for one in told.responses}


def _response(
    table: NumberTable,
    one: ResponseMap,
    told: ImportMap,
    omega: Float[np.ndarray, " row"],
    file: str,
    assumed: Assumptions,
    number: int,
) -> tuple[Complex[np.ndarray, " row"], ResponseMap, Complex[np.ndarray, " row"]]:
    """The velocity phasors of one response (over the force where the table has it so).

    And the map with what was found, and what a number of the response is multiplied with.
    """
    values = _column(table, one.channel, file, "--response")
    quantity, factor, unit = motion_meaning(
        one.quantity,
        one.unit,
        table.units.get(one.channel, ""),
        one.channel,
        is_ratio=told.over_force,
    )
    assumed.unit(f"response {number}.unit", one.unit, table.units.get(one.channel, ""))
    if not one.quantity:
        assumed[f"response {number}.quantity"] = Assumption(f"the unit {unit} says so")
    role = role_of(one.channel)
    imaginary, phase = one.imaginary, one.phase
    if np.iscomplexobj(values):
        phasor = _complex(values, told, assumed)
    else:
        if not imaginary and not phase:
            imaginary, phase = _partner(table, one.channel, role, told)
            found = imaginary or phase
            if not found:
                raise ValueError(
                    f"where is the phase of {one.channel} of {file}? --phase COLUMN names it, or "
                    f"--imaginary COLUMN where {one.channel} is a real part; there are "
                    f"{', '.join(table.columns)}."
                )
            key = "imaginary" if imaginary else "phase"
            assumed[f"response {number}.{key}"] = Assumption("by the names of the columns")
        if imaginary:
            phasor = np.empty(len(values), dtype=complex)
            phasor.real, phasor.imag = values, _real(table, imaginary, file, "--imaginary")
            if told.phase_sign == "lag":
                phasor = phasor.conj()
            elif not told.phase_sign:
                assumed["phase_sign"] = Assumption(
                    "a positive imaginary part is ahead of the force", "lead"
                )
        else:
            if np.nanmin(values, initial=0.0) < 0:
                raise ValueError(
                    f"{one.channel} of {file} has negative amplitudes: is it a real part? "
                    "--imaginary COLUMN names the other one."
                )
            phasor = values * np.exp(1j * _phase(table, phase, told, file, assumed, "--phase"))
    sensor = one.sensor or (UNNAMED_SENSOR[0] if len(told.responses) == 1 else one.channel)
    if not one.sensor:
        assumed[f"response {number}.sensor"] = Assumption("not stated; --sensor names it")
    turn = velocity_factors([Channel(one.channel, quantity)], [1], omega)[:, 0, 0]  # type: ignore[arg-type]
    filled = one._replace(quantity=quantity, sensor=sensor, phase=phase, imaginary=imaginary)
    return phasor * factor * turn, filled, factor * turn


def _complex(values: np.ndarray, told: ImportMap, assumed: Assumptions) -> np.ndarray:
    """Phasors as e^(+iwt), conjugated where the sign of their phases is said to be the other."""
    if np.iscomplexobj(values) and not told.phase_sign:
        assumed["phase_sign"] = Assumption("phasors are e^(+iwt)", "lead")
    phasors = values.astype(complex)
    return phasors.conj() if told.phase_sign == "lag" else phasors


def _partner(table: NumberTable, channel: str, role: str, told: ImportMap) -> tuple[str, str]:
    """The column of the imaginary part, or of the phase, by names: nothing unless it is one."""
    if role == "real":
        swapped = _swap(channel)
        if swapped in table.columns:
            return swapped, ""
        others = columns_by_role(table, "imaginary")
        return (others[0] if len(others) == 1 else ""), ""
    phases = [name for name in columns_by_role(table, "phase") if name != told.force_phase]
    return "", (phases[0] if len(phases) == 1 and len(told.responses) == 1 else "")


def _swap(name: str) -> str:
    """The name of an imaginary part beside that of a real part."""
    for old, new in (("real", "imag"), ("Real", "Imag"), ("re", "im"), ("Re", "Im")):
        found = re.sub(rf"(?<![A-Za-z]){old}(?![A-Za-z])|(?<=_){old}(?=_|$)", new, name)
        if found != name:
            return found
    return {"X": "Y", "x": "y"}.get(name[-1:], "") and name[:-1] + {"X": "Y", "x": "y"}[name[-1]]


def _phase(
    table: NumberTable, column: str, told: ImportMap, file: str, assumed: Assumptions, option: str
) -> Float[np.ndarray, " row"]:
    values = _real(table, column, file, option)
    return phase_in_rad(values, column, told, table.units.get(column, ""), assumed)


def _level(
    table: NumberTable, told: ImportMap, file: str, assumed: Assumptions
) -> tuple[str, np.ndarray | None]:
    """The rule for levels, and the numbers of a column where one has them."""
    if told.level in ("force", "runs", "file"):
        return told.level, None
    if told.level in table.columns:
        return told.level, _real(table, told.level, file, "--level")
    if told.level:
        near = near_miss(told.level, table.columns)
        raise ValueError(
            f"--level must be force, runs, file or a column of {file} "
            f"({', '.join(table.columns)}), but is {told.level!r}"
            f"{f' (did you mean {near}?)' if near else ''}."
        )
    columns = columns_by_role(table, "level")
    if len(columns) == 1 and np.isfinite(_real(table, columns[0], file, "--level")).all():
        assumed["level"] = Assumption("the column's name says so")
        return columns[0], _real(table, columns[0], file, "--level")
    return "", None


def _check(omega: Float[np.ndarray, " row"], force: Float[np.ndarray, " row"], file: str) -> None:
    if not omega.size:
        raise ValueError(f"no row of {file} has frequency, force and response.")
    for what, values in (("frequencies", omega), ("forces", force)):
        bad = np.flatnonzero(~(values > 0))
        if bad.size:
            raise ValueError(
                f"{what} must be above zero, but row {bad[0] + 1} of the complete rows of {file} "
                f"has {values[bad[0]]:g}."
            )


def _column(table: NumberTable, name: str, file: str, option: str) -> np.ndarray:
    require_name(option, name, table.columns, "columns", file)
    return np.asarray(table.columns[name])


def _real(table: NumberTable, name: str, file: str, option: str) -> np.ndarray:
    values = _column(table, name, file, option)
    if np.iscomplexobj(values):
        raise ValueError(f"{option} must name a column of real numbers, but {name} is complex.")
    return values.astype(float)


def _only(
    table: NumberTable,
    roles: tuple[str, ...],
    file: str,
    what: str,
    option: str,
    assumed: Assumptions,
) -> str:
    """The only column with a role. Raises `ValueError` with a question otherwise."""
    found = columns_by_role(table, *roles)
    if len(found) != 1:
        listed = ", ".join(found or table.columns)
        raise ValueError(f"which column of {file} is the {what}? {option} names it, of {listed}.")
    assumed[what] = Assumption("the column's name says so")
    return found[0]


def _ask_response(table: NumberTable, file: str) -> str:
    return (
        f"which column of {file} is the response? --response COLUMN:velocity (or acceleration, "
        f"displacement) names it, of {', '.join(table.columns)}."
    )


def _ask_force(table: NumberTable, file: str) -> str:
    return (
        f"which column of {file} is the force? --force COLUMN names it, of "
        f"{', '.join(table.columns)}; --force-amplitude N states one that no column has."
    )
