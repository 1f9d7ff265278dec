"""Steady states of frequency responses and spectra (UFF 58 and its relatives)."""

from collections.abc import Sequence

import numpy as np

from snrmjax.io.exchange.import_levels import MeasuredPart
from snrmjax.io.exchange.import_map import Assumptions, ImportMap
from snrmjax.io.exchange.import_units import Force, force_meaning, require_name
from snrmjax.io.exchange.table_import import import_table
from snrmjax.io.laboratory.contents import NumberTable
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.numerics.facts import Fact

_FREQUENCY, _FORCE, _SET = "frequency of the lines", "force behind the responses", "set"
_RULES = ("force", "runs", "file")


def import_responses(
    sets: Sequence[FrequencyResponses],
    z: Sequence[float],
    mapping: ImportMap,
    file: str,
    assumed: Assumptions,
) -> tuple[MeasuredPart, ImportMap, Force, list[Fact]]:
    """States of sets of frequency responses, one set a level.

    The force is a channel among the responses (spectra, or responses over a generator), or the
    reference, whose amplitude the map states: one for all, one a set, or the z axis.
    Raises `ValueError` with a question that names the option for what cannot be told.
    """
    if not mapping.responses:
        named = ", ".join(dict.fromkeys(c.name for level_set in sets for c in level_set.responses))
        raise ValueError(
            f"which channel of {file} is the response? --response CHANNEL names it, of {named}."
        )
    if mapping.level not in ("", "z", "order", *_RULES):
        raise ValueError(
            f"--level must be order, z, force or file of {file}, not {mapping.level!r}."
        )
    if mapping.level == "z" and not np.isfinite(z).all():
        raise ValueError(f"--level z: {file} states no value on the z axis: --level order.")
    spectra = bool(mapping.force) and all(
        mapping.force in _names(level_set.responses) for level_set in sets
    )
    keys = z if mapping.level == "z" else np.arange(1.0, len(sets) + 1)
    columns = {_FREQUENCY: np.concatenate([_or_nothing(level_set.frequency) for level_set in sets])}
    columns[_SET] = np.repeat(keys, [level_set.frequency.size for level_set in sets])
    units = {_FREQUENCY: "rad/s"}
    rule = mapping.level if mapping.level in _RULES else _SET
    as_table = mapping._replace(frequency=_FREQUENCY, frequency_unit="", level=rule)
    if not spectra:
        amplitude = _amplitudes(sets, z, mapping, file)
        pairs = zip(amplitude, sets, strict=True)
        columns[_FORCE] = np.concatenate(
            [np.full(level_set.frequency.size, size) for size, level_set in pairs]
        )
        units[_FORCE] = "V" if _reference_force(sets, mapping, file).is_voltage else "N"
        as_table = as_table._replace(
            force=_FORCE, force_unit="", force_amplitude=(), over_force=True
        )
    asked = [(response.channel, response.unit, "--response") for response in mapping.responses]
    for name, unit, option in [
        *asked,
        *([(mapping.force, mapping.force_unit, "--force")] * spectra),
    ]:
        parts = []
        for level_set in sets:
            names = _names(level_set.responses)
            require_name(option, name, names, "responses", file)
            row = names.index(name)
            channel = level_set.responses[row]
            # A known channel's values are in SI already: its own unit, or the one that is stated.
            values = level_set.values[row, _reference(level_set, mapping, file, spectra=spectra)]
            parts.append(values / channel.calibration if unit else values)
        columns[name] = (
            np.concatenate(parts) if option == "--response" else _or_nothing(np.concatenate(parts))
        )
        if channel.quantity not in ("unknown", "voltage") or option == "--force":
            units[name] = channel.unit if unit else _si(channel)
    table = NumberTable(file, columns, {name: unit for name, unit in units.items() if unit})
    part, found, force, notes = import_table(table, as_table, file, assumed)
    del assumed["frequency_unit"]
    if spectra:
        assumed.add("force_amplitude", Fact("spectra_of_one_reference"))
    else:
        del assumed["force_unit"]
        reference = sets[0].references[_reference(sets[0], mapping, file, spectra=False)]
        if not _si(reference) and not mapping.force_unit:
            assumed.add("force_unit", Fact("reference_without_unit"), "N")
    if not mapping.level:
        assumed.add("level", Fact("level_a_set"))
    mapping = mapping._replace(responses=found.responses, level=mapping.level or "order")
    return part, mapping, force, notes


def _or_nothing(values: np.ndarray) -> np.ndarray:
    """Values with NaN for zero: lines without a force, or of no frequency, are left out."""
    return np.where(values == 0, np.nan, values)


def _reference_force(sets: Sequence[FrequencyResponses], mapping: ImportMap, file: str) -> Force:
    """What the responses are over."""
    for level_set in sets:
        channel = level_set.references[_reference(level_set, mapping, file, spectra=False)]
        if mapping.force_unit and _si(channel) not in ("", mapping.force_unit):
            raise ValueError(
                f"--force-unit says {mapping.force_unit}, but the responses of {file} are over "
                f"{channel.name} in {_si(channel)}, in which --force-amplitude is stated too: "
                "leave --force-unit out."
            )
    return force_meaning(mapping, _si(channel) or "N", f"{channel.name} of {file}")


def _amplitudes(
    sets: Sequence[FrequencyResponses], z: Sequence[float], mapping: ImportMap, file: str
) -> np.ndarray:
    stated = mapping.force_amplitude
    if not stated:
        levels = ", ".join(f"{value:g}" for value in z)
        has_z = bool(np.isfinite(z).all())
        way = f"z if they are the z axis' ({levels}), else N" if has_z else "N, one for all or"
        raise ValueError(
            f"which amplitude had the force of {file}, whose responses are over it? "
            f"--force-amplitude {way} one a set ({len(sets)}); `snrmjax modes` takes frequency "
            "responses as they are."
        )
    if stated == ("z",):
        if not (np.isfinite(z).all() and np.all(np.asarray(z) > 0)):
            raise ValueError(
                f"--force-amplitude z needs positive values on the z axis, which {file} lacks: "
                "state N."
            )
        values = np.asarray(z, dtype=float)
    else:
        values = np.asarray([float(newtons) for newtons in stated])
    if values.size not in (1, len(sets)):
        raise ValueError(
            f"--force-amplitude must be one for all or one for each of the {len(sets)} sets of "
            f"{file}, but {values.size} are stated."
        )
    return np.broadcast_to(values, (len(sets),))


def _si(channel: Channel) -> str:
    return channel.si_unit if channel.quantity != "unknown" else ""


def _names(channels: Sequence[Channel]) -> list[str]:
    return [channel.name for channel in channels]


def _reference(
    level_set: FrequencyResponses, mapping: ImportMap, file: str, *, spectra: bool
) -> int:
    names = _names(level_set.references)
    if mapping.force and not spectra:
        what = f"responses {', '.join(_names(level_set.responses))}, and over the references"
        require_name("--force", mapping.force, names, what, file)
        return names.index(mapping.force)
    if len(names) > 1:
        raise ValueError(
            f"which reference of {file} is the force? --force names it, of {', '.join(names)}."
        )
    return 0
