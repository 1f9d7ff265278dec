"""The laboratory's files behind a test, and options that read their numbers as what they are."""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from snrmjax.doctor.findings import Repair
from snrmjax.io.exchange.import_map import (
    ImportMap,
    ResponseMap,
    files_of_map,
    read_import_map,
)
from snrmjax.io.laboratory.physical_units import UnitMeaning, unit_meaning

MAP = "map.toml"
_UNITS: dict[str, tuple[str, ...]] = {
    "displacement": ("m", "mm", "um", "in"),
    "velocity": ("m/s", "mm/s", "um/s", "in/s"),
    "acceleration": ("m/s2", "g", "mm/s2", "um/s2", "in/s2"),
    "force": ("N", "mN", "kN", "lbf"),
}
"""The units of commands, the SI unit of each quantity first."""
_PER_SECOND = {"displacement": "", "velocity": "/s", "acceleration": "/s2"}
_UNNAMED = re.compile(r"|sensor \d+")  # sensors whose name nobody stated
_SAME = 1e-6  # relative difference of two factors that are one unit's


class LaboratoryFiles(NamedTuple):
    """Files of a laboratory and all that is known of how a table was made of them.

    `told` differs from `first`, which `map_file` says, where the table was restated since.
    """

    files: tuple[Path, ...]
    map_file: Path
    first: ImportMap
    told: ImportMap


def files_behind(map_file: Path) -> LaboratoryFiles | None:
    """The laboratory's files of which a table was made, in one import or in several.

    Arguments: `map_file` beside the table. None where the map tells none, where they are gone, or
    where a table was restated on the way in what an import of them cannot state.
    """
    return _behind(map_file, ())


def _behind(map_file: Path, seen: tuple[Path, ...]) -> LaboratoryFiles | None:
    if not map_file.is_file() or map_file.resolve() in seen:
        return None
    told, files = read_import_map(map_file), files_of_map(map_file)
    if not files:
        return None
    if told.responses:
        return LaboratoryFiles(files, map_file, told, told)
    before = _behind(files[0].parent / MAP, (*seen, map_file.resolve()))
    if before is None or len(files) > 1:
        return None
    both = _restated(before.told, told)
    return None if both is None else before._replace(told=both)


def _restated(first: ImportMap, since: ImportMap) -> ImportMap | None:
    """The first import's map with what was said of its table since; None where it cannot be."""
    silent = since._replace(unit="", force_unit="", level="", dataset="", separator="", decimal="")
    if silent._replace(amplitude="", phase_sign="", header_row=0) != ImportMap():
        return None
    if since.amplitude not in ("", "peak") or since.phase_sign == "lag":
        return None
    return read_anew(first, since.unit, since.force_unit)


def read_anew(told: ImportMap, unit: str, force_unit: str) -> ImportMap | None:
    """The map by which a table comes out as it does now, restated with these units.

    Arguments: `unit` of its velocity columns and `force_unit` of its force, empty where they are
    right. None where no unit of the laboratory's numbers is known to say it.
    """
    responses = [_response_anew(one, unit) for one in told.responses]
    if any(one is None for one in responses):
        return None
    force = told.force_unit
    if force_unit:
        was, now = _meaning(force), _meaning(force_unit)
        if was is None or now is None or not was.dimension == now.dimension == "force":
            return None
        force = name_of_unit("force", was.factor * now.factor)
    return told._replace(
        responses=tuple(one for one in responses if one is not None), force_unit=force
    )


def _response_anew(one: ResponseMap, unit: str) -> ResponseMap | None:
    if not unit:
        return one
    was, now = _meaning(one.unit), _meaning(unit)
    if was is None or now is None or "velocity" not in (was.dimension, now.dimension):
        return None  # what was integrated already, and is to be once more, is no motion
    quantity = now.dimension if was.dimension == "velocity" else was.dimension
    if quantity not in _PER_SECOND:
        return None
    return one._replace(quantity=quantity, unit=name_of_unit(quantity, was.factor * now.factor))


def _meaning(unit: str) -> UnitMeaning | None:
    """What a unit says; None for none, for a sensitivity and for one that says rms or peak."""
    try:
        found = unit_meaning(unit)
    except ValueError:
        return None
    return None if not unit or found.per_volt or found.size else found


def name_of_unit(quantity: str, factor: float) -> str:
    """A unit's name by its quantity and its size in SI; with a number where it has no name."""
    for name in _UNITS[quantity]:
        if math.isclose(unit_meaning(name).factor, factor, rel_tol=_SAME):
            return name
    return f"{factor:.8g} {_UNITS[quantity][0]}"


def unit_of_repair(repair: Repair) -> str:
    """What the velocity columns of our own table are; empty where they are right."""
    if repair.quantity:
        return name_of_unit(repair.quantity, repair.response)
    return f"{repair.response:.8g} m/s" if repair.response != 1 else ""


def force_unit_of_repair(repair: Repair) -> str:
    """Likewise of its force."""
    return f"{repair.force:.8g} N" if repair.force != 1 else ""


def options_of_repair(repair: Repair, first: ImportMap, told: ImportMap) -> list[str]:
    """Options by which the laboratory's files are read anew; none where they cannot say it.

    Arguments: `told` how they were read, `first` how they are without these options.
    """
    if repair.conjugate:
        return []
    if repair.phase_unit:
        changes = told.phase_unit not in ("", repair.phase_unit)
        anew = told._replace(phase_unit=repair.phase_unit) if changes else None
        return [] if anew is None else changed_options(first, anew)
    if repair.fit_gain:
        return changed_options(first, told._replace(force_unit=repair.force_unit))
    unit, force_unit = unit_of_repair(repair), force_unit_of_repair(repair)
    anew = read_anew(told, unit, force_unit) if unit or force_unit else None
    if anew is not None:
        return changed_options(first, anew)
    return _by_name(repair, told) if first == told else []


def _by_name(repair: Repair, told: ImportMap) -> list[str]:
    """A unit that a finding names, where the files state their own, which no map has."""
    if repair.quantity:
        return []
    if repair.force_unit:
        return ["--force-unit", repair.force_unit]
    kinds = {one.quantity for one in told.responses}
    if not repair.unit or len(kinds) != 1:
        return []
    (kind,) = kinds
    if repair.unit in ("g", "m/s2"):
        return ["--unit", repair.unit] if kind == "acceleration" else []
    return ["--unit", f"{repair.unit}{_PER_SECOND[kind]}"] if kind in _PER_SECOND else []


def changed_options(first: ImportMap, anew: ImportMap) -> list[str]:
    """The options of an import by one map that make it one by another."""
    words: list[str] = []
    old, new = first.responses, anew.responses
    units = {one.unit for one in new}
    if new != old:
        named = len(units) > 1 or any(
            was.quantity != now.quantity for was, now in zip(old, new, strict=True)
        )
        words += _response_options(new, with_units=len(units) > 1) if named else []
        if named and not words:
            return []
        words += ["--unit", *units] if len(units) == 1 else []
    if anew.force_unit != first.force_unit:
        words += ["--force-unit", anew.force_unit]
    if anew.phase_unit != first.phase_unit:
        words += ["--phase-unit", anew.phase_unit]
    return words


def _response_options(responses: Sequence[ResponseMap], *, with_units: bool) -> list[str]:
    """All of the responses, as an option forgets those of a map; none where some lack a column."""
    words: list[str] = []
    for one in responses:
        unit = f":{one.unit}" if with_units else ""
        words += ["--response", f"{one.channel}:{one.quantity}{unit}"]
    for key in ("sensor", "phase", "imaginary", "amplitude_std", "phase_std"):
        values = [getattr(one, key) for one in responses]
        if key == "sensor" and all(map(_UNNAMED.fullmatch, values)):
            continue
        if any(values) and not all(values):
            return []
        for value in filter(None, values):
            words += [f"--{key.replace('_', '-')}", value]
    return words
