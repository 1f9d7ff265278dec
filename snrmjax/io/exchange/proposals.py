"""The command that would import a laboratory's files: proposed in full only where it runs."""

import re
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from snrmjax.io.columns import is_ours
from snrmjax.io.exchange.import_map import BY_NAME, Assumptions, ImportMap, map_of_options
from snrmjax.io.exchange.import_units import amplitude_of_name
from snrmjax.io.exchange.importing import import_files, joined_files
from snrmjax.io.exchange.record_import import mapped_record
from snrmjax.io.laboratory.contents import LaboratoryFile, NumberTable
from snrmjax.io.laboratory.names import is_of_base, role_of
from snrmjax.io.laboratory.physical_units import (
    UnitMeaning,
    level_reference,
    size_of,
    unit_meaning,
)
from snrmjax.measure.recordings.channels import DERIVATIVE, Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.time_recording import TimeRecording

_TO_FILL_IN = re.compile(r"\b(COLUMN|CHANNEL|QUANTITY|UNIT|NEWTONS|AMPLITUDE|SENSOR)\b")
_OTHERS = (
    *("frequency", "force", "drive", "phase", "imaginary", "level", "deviation", "time", "mark"),
    "coherence",
)
_TRIED = 2**21  # samples of a record that is read to see whether it is of steps or sweeps
_RADIANS = 1.01 * np.pi  # which phases in radians do not exceed
_A_TURN = 1.0  # rad that phases of a resonance cover at least

_Content = TimeRecording | NumberTable | FrequencyResponses


class _Options(dict[str, Any]):
    """Options by their keys: a word, or a list of words of an option that is given again."""

    def add(self, key: str, word: str) -> None:
        """Give an option once more."""
        self.setdefault(key, []).append(word)

    def words(self) -> Iterator[str]:
        """As they are written on a command line."""
        for key, value in self.items():
            for word in value if isinstance(value, list) else [value]:
                yield f"--{key.replace('_', '-')}" + (
                    "" if word is True else f" {shlex.quote(word)}"
                )

    def mapping(self) -> ImportMap:
        """As the map of an import."""
        return map_of_options(None, self)


def proposed_commands(paths: Sequence[Path], files: Sequence[LaboratoryFile]) -> list[str]:
    """Lines with the command that imports files of one test, and with what it still asks.

    Capitals are to be filled in: what neither the files nor the names of their columns say. A
    command without them was tried on the files.
    """
    named = " ".join(shlex.quote(str(path)) for path in paths)
    held = joined_files(files)[0]
    if held.tables and is_ours(held.tables[0].columns):
        return [f"it has our own columns: `snrmjax check`, `identify` and `test` take {held.name}."]
    is_lost = any(note.kind == "responses_without_axis" for note in held.notes)
    with_axis = [one for one in held.tables if _may_have_axis(one)]
    if is_lost and not (with_axis or held.responses or held.recordings):
        words = f"snrmjax import {named} --frequency-start HZ --frequency-step HZ"
        return ["state the frequencies of the responses (fill in HZ):", f"  {words}"]
    contents: list[_Content] = [*held.recordings, *with_axis, *held.responses, *held.tables]
    content = contents[0]
    found = _options_of(content)
    _take_amplitudes_of_names(found, files)
    if len(held.recordings) + len(held.tables) + bool(held.responses) > 1:
        is_responses = isinstance(content, FrequencyResponses)
        found["dataset"] = "responses" if is_responses else content.name or "record"
    open_words = list(dict.fromkeys(_TO_FILL_IN.findall(" ".join(found.words()))))
    question = "" if open_words else _question(paths, content, found)
    if question and isinstance(content, TimeRecording) and "record" not in found:
        # Neither steps nor a sweep: what is left stays a record.
        as_record = _Options(found | {"record": "broadband"})
        other = _question(paths, content, as_record)
        found, question = (found, question) if other else (as_record, other)
    line = " ".join(["snrmjax import", named, *found.words(), "--out imported"])
    lines = [
        f"import it (fill in {', '.join(open_words)}, which the file does not say):"
        if open_words
        else "import it (check the names):",
        f"  {line}",
    ]
    lines += [f"  it will ask: {question}"] if question else []
    return [*lines, *(_modes(named, content) if held.responses else ())]


def _may_have_axis(table: NumberTable) -> bool:
    """Whether a column of a table may be its frequencies."""
    return any(
        not np.iscomplexobj(column) and table.role(name) not in ("mark", "coherence")
        for name, column in table.columns.items()
    )


def _take_amplitudes_of_names(found: _Options, files: Sequence[LaboratoryFile]) -> None:
    """Amplitudes in the names of files, where nothing else states any."""
    said = [amplitude_of_name(file.name) for file in files]
    if found.get("force_amplitude") != ["NEWTONS"] or None in said:
        return
    (unit, *others) = {unit_meaning(one[1]).dimension for one in said if one is not None}
    if others:
        return
    if unit in DERIVATIVE:
        del found["force_amplitude"]
        found["base"] = f"{BY_NAME}:{unit}"
    elif unit in ("force", "voltage"):
        found["force_amplitude"] = [BY_NAME]


def _question(paths: Sequence[Path], content: _Content, found: _Options) -> str:
    """What an import with these options would ask; of a long record only channels are tried."""
    try:
        mapping = found.mapping()
        if isinstance(content, TimeRecording) and content.n_samples > _TRIED:
            mapped_record(content, mapping, content.name or "the record", Assumptions())
        else:
            import_files(list(paths), mapping, tuple(found))
    except ValueError as error:
        return str(error)
    return ""


def _options_of(content: _Content) -> _Options:
    if isinstance(content, NumberTable):
        return _of_table(content)
    if isinstance(content, TimeRecording):
        return _of_record(content)
    return _of_responses(content)


class _Motion(NamedTuple):
    """A column or channel that is to be a motion, in the words of an option."""

    name: str
    quantity: str
    meaning: UnitMeaning | None
    is_stated: bool  # quantity and unit are the file's
    unit_word: str = "UNIT"

    @property
    def base_word(self) -> str:
        """As `--base` wants it, with the quantity always."""
        known = self.quantity if self.quantity in DERIVATIVE else "QUANTITY"
        return f"{self.name}:{known}" + ("" if self.is_stated else f":{self.unit_word}")

    @property
    def word(self) -> str:
        """As NAME, or NAME:QUANTITY:UNIT where the file does not say what it is."""
        return self.name if self.is_stated else self.base_word


def _motion_of(name: str, unit: str, role: str) -> _Motion:
    reference = level_reference(unit)
    try:
        meaning = unit_meaning(unit if reference is None else reference)
    except ValueError:
        return _Motion(name, role, None, False)
    if reference == "":
        return _Motion(name, role, None, False, "dB re UNIT")
    is_motion = meaning.quantity in DERIVATIVE and not meaning.per_volt
    return _Motion(name, meaning.quantity if is_motion else role, meaning, is_motion)


def _of_table(table: NumberTable) -> _Options:
    """Options for a table: by the names and units of its columns, and their order."""
    found, roles = _Options(), {name: table.role(name) for name in table.columns}

    def of(*wanted: str) -> list[str]:
        return [name for name, role in roles.items() if role in wanted]

    if len(of("frequency")) != 1:
        found["frequency"] = next(iter(of("frequency")), "COLUMN")
    numbers = [name for name in table.columns if roles[name] not in _OTHERS]
    named = [_motion_of(name, table.units.get(name, ""), roles[name]) for name in numbers]
    loads = of("force") or of("drive")
    moved = [] if loads else [one for one in named if is_of_base(one.name)][:1]
    others = [one for one in named if one not in moved]
    responses = (
        [one for one in others if one.is_stated]
        or [one for one in others if roles[one.name] in DERIVATIVE]
        or [one for one in others if roles[one.name] in ("amplitude", "real")][:1]
        or others[:1]
    )
    if moved:
        found["base"] = moved[0].base_word
    elif loads:
        found["force"] = loads[0]
        if not table.units.get(loads[0]):
            found["force_unit"] = "V" if roles[loads[0]] == "drive" else "UNIT"
    else:
        found.add("force_amplitude", "NEWTONS")
    if any(one.meaning is not None and one.meaning.per_force for one in responses):
        found["over_force"] = True
    for one in responses or [_Motion("COLUMN", "", None, False)]:
        found.add("response", one.word)
    phases = of("phase")
    if not any(np.iscomplexobj(table.columns[one.name]) for one in responses):
        pairs = _phases(list(table.columns), [one.name for one in responses], phases)
        if len(responses) > 1 and pairs:
            found["phase"] = pairs
    sizes = {
        size_of(f"{table.units.get(name, '')} {name}")
        for name in (*loads[:1], *(one.name for one in (*moved, *responses)))
    }
    if len(sizes) == 1 and sizes.isdisjoint(("", "peak")):
        found["amplitude"] = sizes.pop()
    if unit := _phase_unit(table, phases):
        found["phase_unit"] = unit
    return found


def _phases(columns: list[str], responses: list[str], phases: list[str]) -> list[str]:
    """The column of the phase of each response: the first one behind it; or none."""
    found = []
    for name in responses:
        behind = [one for one in phases if columns.index(one) > columns.index(name)]
        found += behind[:1]
    return found if len(set(found)) == len(responses) else []


def _phase_unit(table: NumberTable, phases: Sequence[str]) -> str:
    """The unit of phases where nothing but their size tells it; nothing where that is not needed.

    Phases over a whole resonance that stay within ±π are of radians: in degrees they would not
    turn by more than 6.
    """
    for name in phases[:1]:
        values = np.asarray(table.columns[name], dtype=float)
        is_told = name in table.units or not np.isfinite(values).any()
        if is_told or np.nanmax(np.abs(values)) > 2 * np.pi:
            return ""
        turns = float(np.nanmax(values) - np.nanmin(values))
        return "rad" if np.nanmax(np.abs(values)) <= _RADIANS and turns > _A_TURN else "UNIT"
    return ""


def _of_record(record: TimeRecording) -> _Options:
    """Options for a time record: by what its channels are, or are called."""
    found = _Options()
    loads = [one for one in record.channels if one.quantity == "force"] or [
        one for one in record.channels if one.quantity == "voltage" and not is_of_base(one.name)
    ]
    named = [
        _Motion(one.name, one.quantity, None, True)
        if one.quantity in DERIVATIVE
        else _motion_of(one.name, one.unit, _role(one))
        for one in record.channels
        if one not in loads[:1]
    ]
    if not loads:
        loads = [one for one in record.channels if _role(one) == "force"]
        named = [one for one in named if one.name not in {each.name for each in loads}]
    moved = [] if loads else [one for one in named if is_of_base(one.name)][:1]
    responses = [one for one in named if one not in moved and one.is_stated] or [
        one for one in named if one not in moved
    ][:1]
    if loads:
        found["force"] = loads[0].name
        if loads[0].quantity == "unknown" or (loads[0].quantity == "force" and not loads[0].unit):
            found["force_unit"] = "UNIT"
    elif moved:
        found["base"] = moved[0].base_word
    else:
        found["record"] = "decay"
    for one in responses or [_Motion("CHANNEL", "", None, False)]:
        found.add("response", one.word)
    return found


def _role(channel: Channel) -> str:
    return role_of(channel.name, channel.unit)


def _of_responses(sets: FrequencyResponses) -> _Options:
    """Options for frequency responses as steady states of known forces."""
    found = _Options()
    load = next((one for one in sets.responses if one.quantity in ("force", "voltage")), None)
    reference = sets.references[0]
    if load is not None:
        found["force"] = load.name
    elif reference.quantity in DERIVATIVE:
        found["base"] = f"AMPLITUDE:{reference.quantity}:{reference.unit or reference.si_unit}"
    else:
        found.add("force_amplitude", "NEWTONS")
        if len(sets.references) > 1:
            found["force"] = reference.name
    named = [
        _Motion(one.name, one.quantity, None, one.quantity in DERIVATIVE)
        for one in sets.responses
        if one is not load
    ]
    for one in [one for one in named if one.is_stated] or named[:1]:
        found.add("response", one.word)
    return found


def _modes(named: str, sets: object) -> list[str]:
    """The command for linear modes of frequency responses, if it can be run."""
    if not isinstance(sets, FrequencyResponses):
        return []
    if any(one.quantity not in DERIVATIVE for one in sets.responses):
        return [
            "`snrmjax modes` needs to know which motions these are, and the file states no unit: "
            "import them as above with the force 1, and give it measured.csv."
        ]
    reference = sets.references[0]
    of_base = reference.quantity in DERIVATIVE
    at_force = [
        one
        for one in sets.responses
        if one.name == reference.name
        or (one.point and (one.point, one.direction) == (reference.point, reference.direction))
    ]
    scale = f"--drive-point {shlex.quote(at_force[0].name)}" if at_force else "--drive-point SENSOR"
    scale = "--base absolute --unscaled" if of_base else scale
    which = f" --reference {shlex.quote(reference.name)}" if len(sets.references) > 1 else ""
    return [
        "or, of an impact or broadband test, linear modes"
        + ("" if at_force or of_base else " (SENSOR is the one at the force)")
        + ":",
        f"  snrmjax modes {named}{which} {scale} --out model.toml",
    ]
