"""Steady states from laboratory tables: amplitude and phase, or real and imaginary part."""

import re
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.io.exchange.import_levels import MeasuredPart
from snrmjax.io.exchange.import_map import BY_NAME, Assumptions, ImportMap, ResponseMap
from snrmjax.io.exchange.import_units import (
    Force,
    amplitude_factor,
    amplitude_of_name,
    frequency_in_rad,
    load_meaning,
    motion_meaning,
    phase_in_rad,
    require_name,
    with_stated_references,
)
from snrmjax.io.laboratory.contents import NumberTable
from snrmjax.io.laboratory.names import label_of, role_of
from snrmjax.io.laboratory.physical_units import level_reference
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.velocity_states import velocity_factors
from snrmjax.measure.states import UNNAMED_SENSOR
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.names import near_miss
from snrmjax.numerics.rules import InputError

_DECIBELS = re.compile(r"(?<![^\W\d_])d[Bb](?![^\W\d_])")
_DEVIATION = re.compile(r"stdev|stddev|std|sigma|deviation|dev")


class _Source(NamedTuple):
    """A table with its map and the assumptions made."""

    table: NumberTable
    mapping: ImportMap
    file: str
    assumed: Assumptions
    levels: frozenset[str] = frozenset()  # columns that are in dB in the file

    def unit(self, name: str) -> str:
        """A column's unit as written in the file."""
        return self.table.units.get(name, "")

    def column(self, name: str, option: str) -> np.ndarray:
        """The column that an option names."""
        require_name(option, name, self.table.columns, "columns", self.file)
        return np.asarray(self.table.columns[name])

    def real(self, name: str, option: str) -> Float[np.ndarray, " row"]:
        """A column of real numbers that an option names."""
        values = self.column(name, option)
        if np.iscomplexobj(values):
            raise InputError(f"{option} must name a column of real numbers, but {name} is complex.")
        return values.astype(float)

    def phasors(self, values: np.ndarray) -> np.ndarray:
        """Phasors for e^(+iωt), conjugated where the map states the other phase sign."""
        if np.iscomplexobj(values) and not self.mapping.phase_sign:
            self.assumed.add("phase_sign", Fact("phasors_turn_forward"), "lead")
        phasors = values.astype(complex)
        return phasors.conj() if self.mapping.phase_sign == "lag" else phasors

    def phase(self, name: str, option: str) -> Float[np.ndarray, " row"]:
        """A column of phases in rad, positive where the response leads."""
        values = self.real(name, option)
        return phase_in_rad(values, name, self.mapping, self.unit(name), self.assumed)

    def with_role(self, *roles: str) -> list[str]:
        """Columns with one of these roles by name or unit."""
        return [name for name in self.table.columns if self.table.role(name) in roles]

    @property
    def listed(self) -> str:
        """The column names, for messages."""
        return ", ".join(self.table.columns)


def import_table(
    table: NumberTable, mapping: ImportMap, file: str, assumed: Assumptions
) -> tuple[MeasuredPart, ImportMap, Force, list[Fact]]:
    """States of a table, the completed map, the force's unit, and notes.

    Raises `ValueError` with a question that names the option for anything undetermined.
    """
    mapping = mapping.with_names({name: table.units.get(name, "") for name in table.columns})
    table, mapping, notes = with_stated_references(table, mapping, file)
    levels = frozenset(note["name"] for note in notes)
    source = _Source(table, mapping, file, assumed, levels)
    mapping = mapping._replace(frequency=mapping.frequency or _frequency_column(source))
    source = source._replace(mapping=mapping)
    omega = frequency_in_rad(
        source.real(mapping.frequency, "--frequency"),
        mapping,
        source.unit(mapping.frequency),
        assumed,
    )
    if not mapping.responses:
        raise InputError(
            f"which column of {file} is the response? --response COLUMN:velocity (or acceleration, "
            f"displacement) names it, of {source.listed}."
        )
    force_phasor, force = _force(source)
    lead = force.acceleration(omega)
    units = {
        response.channel: response.unit or source.unit(response.channel)
        for response in mapping.responses
    }
    units = {} if mapping.over_force else units
    is_column = bool(mapping.load)
    units |= {mapping.load: force.unit} if is_column else {}
    peak = amplitude_factor(mapping, units, assumed) if units else 1.0
    force_phasor = force_phasor * peak if is_column or mapping.amplitude else force_phasor
    # Responses per force need only its amplitude; else its phase is subtracted. For a base, phases
    # are relative to its acceleration, whichever motion was recorded.
    phase_factor = (
        np.abs(force_phasor) if mapping.over_force else peak * np.exp(-1j * np.angle(force_phasor))
    )
    phase_factor, force_phasor = phase_factor * np.exp(-1j * np.angle(lead)), force_phasor * lead
    _refuse_doubled(source)
    velocity, responses, errors = [], [], []
    for k, response in enumerate(mapping.responses):
        response = _with_errors_by_name(source, response, k + 1)
        row, filled, scale = _response(source, response, force, omega, k + 1)
        velocity.append(row * phase_factor)
        responses.append(filled)
        errors.append(_errors(source, filled, np.abs(scale * phase_factor)))
    phasors = np.stack(velocity, axis=1)
    amplitude_std, phase_std = np.moveaxis(np.array(errors), (0, 1, 2), (2, 0, 1))
    level, key = _level(source)
    mapping = mapping._replace(responses=tuple(responses), level=level)
    good = np.isfinite(omega) & np.isfinite(force_phasor) & np.isfinite(phasors).any(axis=1)
    _check(omega[good], np.abs(force_phasor[good]), file)
    part = MeasuredPart(
        omega[good],
        np.abs(force_phasor[good]),
        phasors[good],
        None if key is None else key[good],
        amplitude_std[good],
        phase_std[good],
    )
    left_out = int(np.sum(~good))
    notes += [Fact("rows_incomplete", n=left_out, of=len(good), file=file)] if left_out else []
    return part, mapping, force, notes


def _frequency_column(source: _Source) -> str:
    """The unique column that is a frequency by name or unit."""
    columns = source.with_role("frequency")
    if len(columns) != 1:
        raise InputError(
            f"which column of {source.file} is the frequency? --frequency names it, of "
            f"{', '.join(columns) or source.listed}; --frequency-start and --frequency-step state "
            "frequencies without a column."
        )
    source.assumed.add("frequency", Fact("column_by_name"))
    return columns[0]


def _force(source: _Source) -> tuple[Complex[np.ndarray, " row"], Force]:
    """The force (or base motion) of every row, from a column or as stated."""
    mapping, file = source.mapping, source.file
    option = "--base" if mapping.base else "--force"
    name = mapping.load
    if not name:
        amplitudes = mapping.base_amplitudes or mapping.force_amplitude
        by_name = BY_NAME in (mapping.base.split(":")[0], *mapping.force_amplitude)
        if by_name:
            return _by_name(source)
        if amplitudes and (len(amplitudes) > 1 or amplitudes[0] == "z"):
            option = "--base" if mapping.base else "--force-amplitude"
            raise InputError(
                f"{option} must be one number for {file}, a table of states without sets or a z "
                f"axis, but is {','.join(map(str, amplitudes))}."
            )
        if not amplitudes:
            raise InputError(
                f"which column of {file} is the force? --force COLUMN names it, of "
                f"{source.listed}; --force-amplitude N states one without a column, and --base "
                "COLUMN:acceleration the motion of a base."
            )
        force = load_meaning(mapping, "" if mapping.base else "N", "--force-amplitude")
        stated = float(amplitudes[0]) * force.factor
        return np.full(source.table.n_rows, stated, dtype=complex), force
    raw = source.column(name, option)
    if not mapping.base:
        source.assumed.unit("force_unit", mapping.force_unit, source.unit(name))
    force = load_meaning(mapping, source.unit(name), f"{name} of {file}")
    if not np.iscomplexobj(raw) and np.nanmin(raw, initial=1.0) < 0:
        raise InputError(
            f"{name} of {file} has negative amplitudes: {option} names another column."
        )
    force_phasor = source.phasors(raw) * force.factor
    if mapping.force_phase:
        force_phasor = force_phasor * np.exp(
            1j * source.phase(mapping.force_phase, "--force-phase")
        )
    return force_phasor, force


def _by_name(source: _Source) -> tuple[Complex[np.ndarray, " row"], Force]:
    """The force (or base motion) stated by the file name."""
    mapping, file = source.mapping, source.file
    stated = amplitude_of_name(file)
    if stated is None:
        raise InputError(
            f"the name of {file} must state one amplitude with its unit, as sine_0.4N.csv does: "
            "rename it, or give --force-amplitude a number."
        )
    amplitude, unit = stated
    force = load_meaning(mapping, unit, f"the amplitude in the name of {file}")
    return np.full(source.table.n_rows, amplitude * force.factor, dtype=complex), force


def _response(
    source: _Source,
    response: ResponseMap,
    force: Force,
    omega: Float[np.ndarray, " row"],
    number: int,
) -> tuple[Complex[np.ndarray, " row"], ResponseMap, Complex[np.ndarray, " row"]]:
    """Velocity phasors of one response (per force where the table has them so).

    Also the completed map, and the factor from the response's numbers to velocity.
    """
    mapping, file, assumed, name = source.mapping, source.file, source.assumed, response.channel
    values = source.column(name, "--response")
    quantity, factor, unit = motion_meaning(
        response.quantity,
        response.unit,
        source.unit(name),
        name,
        over=force if mapping.over_force else None,
    )
    assumed.unit(f"response {number}.unit", response.unit, source.unit(name))
    if not response.quantity:
        assumed.add(f"response {number}.quantity", Fact("quantity_by_unit", unit=unit))
    imaginary, phase = response.imaginary, response.phase
    if phase and (imaginary or np.iscomplexobj(values)):
        raise InputError(
            f"--phase {phase} has no effect: {name} of {file} "
            + (f"has the imaginary part {imaginary}." if imaginary else "is complex.")
        )
    if not (np.iscomplexobj(values) or imaginary or phase):
        imaginary, phase = _partner(source, name)
        if not (imaginary or phase):
            raise InputError(
                f"where is the phase of {name} of {file}? --phase COLUMN names it, or "
                f"--imaginary COLUMN where {name} is a real part; there are {source.listed}."
            )
        key = "imaginary" if imaginary else "phase"
        assumed.add(f"response {number}.{key}", Fact("by_names_of_columns"))
    if np.iscomplexobj(values):
        phasor = source.phasors(values)
    elif imaginary:
        phasor = np.empty(len(values), dtype=complex)
        phasor.real, phasor.imag = values, source.real(imaginary, "--imaginary")
        phasor = phasor.conj() if mapping.phase_sign == "lag" else phasor
        if not mapping.phase_sign:
            assumed.add("phase_sign", Fact("imaginary_ahead_of_the_force"), "lead")
    else:
        if np.nanmin(values, initial=0.0) < 0:
            raise InputError(
                f"{name} of {file} has negative amplitudes: is it a real part? "
                "--imaginary COLUMN names the other one."
            )
        phasor = values * np.exp(1j * source.phase(phase, "--phase"))
    sensor = sensor_of(response, mapping, number, assumed)
    to_velocity = velocity_factors([Channel(name, quantity)], [1], omega)[:, 0, 0]
    filled = response._replace(quantity=quantity, sensor=sensor, phase=phase, imaginary=imaginary)
    return phasor * factor * to_velocity, filled, factor * to_velocity


def sensor_of(response: ResponseMap, mapping: ImportMap, number: int, assumed: Assumptions) -> str:
    """The sensor of a response: stated, the only one, or named like its channel."""
    if not response.sensor:
        assumed.add(f"response {number}.sensor", Fact("sensor_not_stated"))
    return response.sensor or (
        UNNAMED_SENSOR[0] if len(mapping.responses) == 1 else response.channel
    )


def _partner(source: _Source, channel: str) -> tuple[str, str]:
    """The column of the imaginary part or of the phase, by name; empty unless unique."""
    if role_of(channel) == "real":
        swapped = _swap(channel)
        if swapped in source.table.columns:
            return swapped, ""
        others = source.with_role("imaginary")
        if len(others) == 1:
            return others[0], ""
    phases = [name for name in source.with_role("phase") if name != source.mapping.force_phase]
    return "", (phases[0] if len(phases) == 1 and len(source.mapping.responses) == 1 else "")


def _swap(name: str) -> str:
    """The name of the imaginary part that belongs to the name of a real part."""
    for old, new in (("real", "imag"), ("Real", "Imag"), ("re", "im"), ("Re", "Im")):
        swapped = re.sub(rf"(?<![A-Za-z]){old}(?![A-Za-z])|(?<=_){old}(?=_|$)", new, name)
        if swapped != name:
            return swapped
    word = label_of(name).word
    last = {"X": "Y", "x": "y"}.get(word[-1:], "")
    return last and word[:-1] + last + name.removeprefix(word)


def _refuse_doubled(source: _Source) -> None:
    """Raise `ValueError` where one column is both excitation and response."""
    for response in source.mapping.responses:
        if response.channel == source.mapping.load:
            raise InputError(
                f"{response.channel} of {source.file} is named both as the response and as the "
                "excitation."
            )


def _level(source: _Source) -> tuple[str, np.ndarray | None]:
    """The rule for levels, and the level column where there is one."""
    rule, columns = source.mapping.level, source.table.columns
    if rule in ("force", "runs", "file"):
        return rule, None
    if rule in columns:
        return rule, source.real(rule, "--level")
    if rule:
        near = near_miss(rule, columns)
        raise InputError(
            f"--level must be force, runs, file or a column of {source.file} "
            f"({source.listed}), but is {rule!r}{f' (did you mean {near}?)' if near else ''}."
        )
    named = source.with_role("level")
    if len(named) == 1 and np.isfinite(keys := source.real(named[0], "--level")).all():
        source.assumed.add("level", Fact("column_by_name"))
        return named[0], keys
    return "", None


def _check(omega: Float[np.ndarray, " row"], force: Float[np.ndarray, " row"], file: str) -> None:
    if not omega.size:
        raise InputError(f"no row of {file} has frequency, force and response.")
    for what, values in (("frequencies", omega), ("forces", force)):
        bad = np.flatnonzero(~(values > 0))
        if bad.size:
            raise InputError(
                f"{what} must be above zero, but row {bad[0] + 1} of the complete rows of {file} "
                f"has {values[bad[0]]:g}."
            )


# Standard deviations as listed by lock-in amplifiers.


def _with_errors_by_name(source: _Source, response: ResponseMap, number: int) -> ResponseMap:
    """A response with its error columns, those named after it and its phase."""
    phases = source.with_role("phase")
    phase = response.phase or (phases[0] if len(phases) == 1 else "")
    named_columns: dict[str, Any] = {}
    for key, of in {"amplitude_std": response.channel, "phase_std": phase}.items():
        named = [
            name for name in source.with_role("deviation") if _base_name(name) == _base_name(of)
        ]
        if of and not getattr(response, key) and len(named) == 1:
            named_columns[key] = named[0]
            source.assumed.add(f"response {number}.{key}", Fact("deviation_of_one_row"))
    return response._replace(**named_columns)


def _errors(
    source: _Source, response: ResponseMap, scale: Float[np.ndarray, " row"]
) -> Float[np.ndarray, "2 row"]:
    """1σ of the velocity (m/s) and of the phase (rad) of every row; NaN where not stated.

    Arguments: `scale` is the factor from the table's amplitudes to velocity; phase errors are in
    the unit of the phases.
    """
    to_radians = 1.0 if _in_radians(source, response) else np.pi / 180
    of_level, name = response.channel in source.levels, response.amplitude_std
    is_level = bool(_DECIBELS.search(name)) or level_reference(source.unit(name)) is not None
    if name and of_level != is_level and (is_level or source.unit(name)):
        raise InputError(
            f"{name} of {source.file} must be standard deviations in the unit of "
            f"{response.channel}, but one of both is in dB: --amplitude-std names another column."
        )
    if of_level:  # δv = v δL ln(10)/20
        scale = scale * np.log(10) / 20 * np.abs(source.column(response.channel, "--response"))
    stated = (
        (response.amplitude_std, "--amplitude-std", scale),
        (response.phase_std, "--phase-std", np.asarray(to_radians)),
    )
    missing = np.full(source.table.n_rows, np.nan)
    return np.stack(
        [_deviations(source, *each) * by if each[0] else missing for *each, by in stated]
    )


def _in_radians(source: _Source, response: ResponseMap) -> bool:
    """Whether a phase error is in radians, by its own unit or that of the phase."""
    of_phase = source.mapping.phase_unit or source.unit(response.phase)
    return (source.unit(response.phase_std) or of_phase).lower().startswith("rad")


def _base_name(name: str) -> str:
    """A name in lower case without its unit and any word for a deviation.

    >>> [_base_name(text) for text in ("R", "R_std", "Theta [deg]", "ThetaDev", "phase_std_deg")]
    ['r', 'r', 'theta', 'theta', 'phase']
    """
    return re.sub(r"[\s_.\-]", "", _DEVIATION.sub("", label_of(name).word.lower()))


def _deviations(source: _Source, name: str, option: str) -> Float[np.ndarray, " row"]:
    values = np.real(source.column(name, option)).astype(float)
    bad = np.flatnonzero(values < 0)
    if bad.size:
        raise InputError(
            f"{name} of {source.file} must be standard deviations, not negative, but row "
            f"{bad[0] + 1} has {values[bad[0]]:g}: {option} names another column."
        )
    return values
