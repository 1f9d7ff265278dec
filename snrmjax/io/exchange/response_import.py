"""Steady states from frequency responses and spectra (UFF 58 and similar)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from snrmjax.io.exchange.import_levels import MeasuredPart
from snrmjax.io.exchange.import_map import BY_NAME, Assumptions, ImportMap
from snrmjax.io.exchange.import_units import (
    Force,
    amplitude_of_name,
    force_meaning,
    load_meaning,
    require_name,
)
from snrmjax.io.exchange.table_import import import_table
from snrmjax.io.laboratory.contents import NumberTable
from snrmjax.io.laboratory.physical_units import level_reference
from snrmjax.measure.recordings.channels import SI_UNIT, Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_FREQUENCY, _FORCE, _SET = "frequency of the lines", "reference force", "set"
_RULES = ("force", "runs", "file")


class _Sets(NamedTuple):
    """Frequency responses of a file, one set a level, with their map."""

    sets: Sequence[FrequencyResponses]
    z: Sequence[float]
    mapping: ImportMap
    file: str

    @property
    def has_force(self) -> bool:
        """Whether the force is one of the responses (spectra, or relative to a generator)."""
        named = [self.mapping.load in _names(each.responses) for each in self.sets]
        return bool(self.mapping.load) and all(named)

    def references(self) -> list[int]:
        """Index of the reference of the responses in each set."""
        force, file, indices = self.mapping.load, self.file, []
        option = "--base" if self.mapping.base else "--force"
        for each in self.sets:
            names = _names(each.references)
            if force and not self.has_force:
                what = f"responses {', '.join(_names(each.responses))}, and the references"
                require_name(option, force, names, what, file)
                indices.append(names.index(force))
            elif len(names) > 1:
                listed = ", ".join(names)
                if self.has_force:
                    raise InputError(
                        f"{force} of {file} has {len(names)} references ({listed}): export it "
                        f"and the responses relative to one of them, or name a reference by "
                        f"{option}."
                    )
                raise InputError(
                    f"which reference of {file} is the force? --force names it, of {listed} "
                    "(--base NAME:acceleration, if it is the motion of a base)."
                )
            else:
                indices.append(0)
        return indices

    def column(self, name: str, unit: str, option: str) -> tuple[np.ndarray, Channel]:
        """All lines of a response, in SI or, with a stated unit, in the numbers of the file."""
        parts = []
        for each, reference in zip(self.sets, self.references(), strict=True):
            require_name(option, name, _names(each.responses), "responses", self.file)
            row = _names(each.responses).index(name)
            channel = each.responses[row]
            values = each.values[row, reference]
            parts.append(values / channel.calibration if unit else values)
        return np.concatenate(parts), channel

    def amplitudes(self) -> np.ndarray:
        """The stated amplitude of the force of each set."""
        if self.mapping.base:
            return self._base_amplitudes()
        stated, file, n = self.mapping.force_amplitude, self.file, len(self.sets)
        if stated == (BY_NAME,):
            amplitude = amplitude_of_name(file)
            if amplitude is None or amplitude[1] != "N":
                raise InputError(
                    f"the name of {file} must state one amplitude in newtons, as frf_0.4N.uff does."
                )
            return np.full(n, amplitude[0])
        has_z = bool(np.isfinite(self.z).all())
        if not stated:
            levels = ", ".join(f"{value:g}" for value in self.z)
            way = f"z if they are the z axis' ({levels}), else N" if has_z else "N, one for all or"
            raise InputError(
                f"which force amplitude had {file}, whose responses are per unit force? "
                f"--force-amplitude {way} one a set ({n}); `snrmjax modes` reads frequency "
                "responses directly."
            )
        if stated == ("z",) and not (has_z and np.all(np.asarray(self.z) > 0)):
            raise InputError(
                f"--force-amplitude z needs positive values on the z axis, which {file} lacks: "
                "state N."
            )
        values = np.asarray(self.z if stated == ("z",) else [float(word) for word in stated])
        if values.size not in (1, n):
            raise InputError(
                f"--force-amplitude must be one for all or one for each of the {n} sets of "
                f"{file}, but {values.size} are stated."
            )
        return np.broadcast_to(values, (n,))

    def _base_amplitudes(self) -> np.ndarray:
        """The stated amplitude of the base's motion of each set."""
        stated, n = self.mapping.base_amplitudes, len(self.sets)
        if len(stated) not in (1, n):
            raise InputError(
                f"which amplitude had the base of {self.file}, whose responses are per base "
                "motion? --base 0.5:acceleration:g states one for all"
                + (f", or one for each of the {n} sets with commas." if n > 1 else ".")
            )
        return np.broadcast_to(np.asarray(stated), (n,))

    def reference_force(self) -> tuple[Force, bool]:
        """The denominator of the responses, and whether the file states its unit."""
        mapping, file = self.mapping, self.file
        if mapping.base:
            base, known = load_meaning(mapping, "", "the base"), False
            for each, reference in zip(self.sets, self.references(), strict=True):
                channel = each.references[reference]
                if channel.quantity not in ("unknown", base.motion):
                    raise InputError(
                        f"--base states {base.motion}, but the responses of {file} are relative to "
                        f"{channel.name}, of {channel.quantity}: which of both is right?"
                    )
                known = known or channel.quantity != "unknown"
            return base, known
        pairs = zip(self.sets, self.references(), strict=True)
        for channel in [each.references[reference] for each, reference in pairs]:
            if mapping.force_unit and channel.si_unit not in ("", mapping.force_unit):
                raise InputError(
                    f"--force-unit states {mapping.force_unit}, but the responses of {file} are "
                    f"per {channel.name} in {channel.si_unit}, also the unit of --force-amplitude: "
                    "leave --force-unit out."
                )
        force = force_meaning(mapping, channel.si_unit or "N", f"{channel.name} of {file}")
        return force, bool(channel.si_unit)


def import_responses(
    sets: Sequence[FrequencyResponses],
    z: Sequence[float],
    mapping: ImportMap,
    file: str,
    assumed: Assumptions,
) -> tuple[MeasuredPart, ImportMap, Force, list[Fact]]:
    """States of sets of frequency responses, one set a level.

    The force is a channel among the responses (spectra, or responses per generator signal), or the
    reference, with the amplitude of the map: one for all, one a set, or the z axis.
    Raises `ValueError` with a question that names the option for anything undetermined.
    """
    if not mapping.responses:
        named = ", ".join(dict.fromkeys(name for each in sets for name in _names(each.responses)))
        raise InputError(
            f"which channel of {file} is the response? --response CHANNEL names it, of {named}."
        )
    if mapping.level not in ("", "z", "order", *_RULES):
        raise InputError(
            f"--level must be order, z, force or file of {file}, not {mapping.level!r}."
        )
    if mapping.level == "z" and not np.isfinite(z).all():
        raise InputError(f"--level z: {file} states no value on the z axis: --level order.")
    source = _Sets(sets, z, mapping, file)
    n_lines = [each.frequency.size for each in sets]
    numbers = z if mapping.level == "z" else np.arange(1.0, len(sets) + 1)
    columns = {
        _FREQUENCY: _nan_for_zero(np.concatenate([each.frequency for each in sets])),
        _SET: np.repeat(numbers, n_lines),
    }
    units = {_FREQUENCY: "rad/s"}
    rule = mapping.level if mapping.level in _RULES else _SET
    as_table = mapping._replace(frequency=_FREQUENCY, frequency_unit="", level=rule)
    if source.has_force:
        if mapping.force_amplitude:
            raise InputError(
                f"--force-amplitude has no effect: {mapping.load} of {file} has the amplitudes."
            )
        name = mapping.load
        unit = mapping.base_motion.unit if mapping.base else mapping.force_unit
        values, channel = source.column(name, unit, "--force")
        columns[name] = _nan_for_zero(values)
        units[name] = channel.unit if unit else channel.si_unit
        assumed.add("force_amplitude", Fact("spectra_of_one_reference"))
    else:
        force, is_stated = source.reference_force()
        amplitudes = np.repeat(source.amplitudes(), n_lines)
        if is_stated and force.motion is not None:  # the reference is in SI
            columns[_FORCE], units[_FORCE] = amplitudes * force.factor, SI_UNIT[force.motion]
        else:
            columns[_FORCE], units[_FORCE] = amplitudes, force.unit
        if force.motion is not None:
            as_table = as_table._replace(base=f"{_FORCE}:{force.motion}:{units[_FORCE]}")
        as_table = as_table._replace(
            force="" if mapping.base else _FORCE,
            force_unit="",
            force_amplitude=(),
            over_force=True,
        )
    for response in mapping.responses:
        name = response.channel
        columns[name], channel = source.column(name, response.unit, "--response")
        is_level = level_reference(channel.unit) is not None
        if is_level or channel.quantity not in ("unknown", "voltage"):
            units[name] = channel.unit if is_level or response.unit else channel.si_unit
    table = NumberTable(file, columns, {name: unit for name, unit in units.items() if unit})
    part, used, force, notes = import_table(table, as_table, file, assumed)
    del assumed["frequency_unit"]
    if not source.has_force:
        assumed.pop("force_unit", None)
        if not (is_stated or mapping.force_unit or mapping.base):
            assumed.add("force_unit", Fact("reference_without_unit"), "N")
    if not mapping.level:
        assumed.add("level", Fact("level_a_set"))
    mapping = mapping._replace(responses=used.responses, level=mapping.level or "order")
    return part, mapping, force, notes


def _nan_for_zero(values: np.ndarray) -> np.ndarray:
    """Values with NaN for zero, so that lines of zero force or frequency are left out."""
    return np.where(values == 0, np.nan, values)


def _names(channels: Sequence[Channel]) -> list[str]:
    return [channel.name for channel in channels]
