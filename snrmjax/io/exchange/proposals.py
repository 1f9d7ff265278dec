"""Proposed command to import laboratory files, complete only where a trial run succeeded."""

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
    amplitude_kind,
    level_reference,
    meaning_or_none,
    unit_meaning,
)
from snrmjax.measure.recordings.channels import DERIVATIVE, Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.numerics.rules import InputError

_TO_FILL_IN = re.compile(r"\b(COLUMN|CHANNEL|QUANTITY|UNIT|NEWTONS|AMPLITUDE|SENSOR)\b")
_OTHERS = (
    *("frequency", "force", "drive", "phase", "imaginary", "level", "deviation", "time", "mark"),
    "coherence",
)
_OF_READING = (
    *("separator", "decimal", "header_row", "dataset", "rate"),
    *("frequency_start", "frequency_step"),
)
_TRIED = 2**21  # longest record (samples) for a trial import as steps or sweeps
_RADIANS = 1.01 * np.pi  # largest magnitude of wrapped phases in radians
_LEAST_PHASE_RANGE = 1.0  # least phase range (rad) across a resonance

_Content = TimeRecording | NumberTable | FrequencyResponses


class _Options(dict[str, Any]):
    """Options by their keys: a value, or a list of values of a repeated option."""

    def add(self, key: str, word: str) -> None:
        """Append a value of a repeated option."""
        self.setdefault(key, []).append(word)

    def words(self) -> Iterator[str]:
        """As command-line arguments."""
        for key, value in self.items():
            for word in value if isinstance(value, list) else [value]:
                text = f"{word:.10g}" if isinstance(word, float) else str(word)
                yield f"--{key.replace('_', '-')}" + (
                    "" if word is True else f" {shlex.quote(text)}"
                )

    def mapping(self) -> ImportMap:
        """As the map of an import."""
        return map_of_options(None, self)


def proposed_commands(
    paths: Sequence[Path], files: Sequence[LaboratoryFile], stated: ImportMap | None = None
) -> list[str]:
    """Lines with the command that imports the files of one test, and its open questions.

    Words in capitals are to be filled in: neither the files nor their column names state them. A
    command without such words was tried on the files. It repeats the options `stated` for the
    reading of the files.
    """
    named = " ".join(shlex.quote(str(path)) for path in paths)
    source = joined_files(files)[0]
    if source.tables and is_ours(source.tables[0].columns):
        return [
            f"it has our own columns: `snrmjax check`, `identify` and `test` read {source.name}."
        ]
    is_lost = any(note.kind == "responses_without_axis" for note in source.notes)
    with_axis = [one for one in source.tables if _may_have_axis(one)]
    if is_lost and not (with_axis or source.responses or source.recordings):
        words = f"snrmjax import {named} --frequency-start HZ --frequency-step HZ"
        return ["state the frequencies of the responses (fill in HZ):", f"  {words}"]
    contents: list[_Content] = [*source.recordings, *with_axis, *source.responses, *source.tables]
    content = contents[0]
    if isinstance(content, NumberTable) and _is_uneven_record(content):
        return ["it is neither a record nor a table of steady states: see the note on its times."]
    options = _options_of(content)
    for key in _OF_READING if stated is not None else ():
        if getattr(stated, key) != getattr(ImportMap(), key):
            options[key] = getattr(stated, key)
    _take_amplitudes_of_names(options, files)
    several = len(source.recordings) + len(source.tables) + bool(source.responses) > 1
    if several and "dataset" not in options:
        is_responses = isinstance(content, FrequencyResponses)
        options["dataset"] = "responses" if is_responses else content.name or "record"
    open_words = list(dict.fromkeys(_TO_FILL_IN.findall(" ".join(options.words()))))
    question = "" if open_words else _question(paths, content, options)
    if question and isinstance(content, TimeRecording) and "record" not in options:
        # Neither steps nor a sweep: kept as a record.
        as_record = _Options(options | {"record": "broadband"})
        other = _question(paths, content, as_record)
        options, question = (options, question) if other else (as_record, other)
    line = " ".join(["snrmjax import", named, *options.words(), "--out imported"])
    lines = [
        f"import it (fill in {', '.join(open_words)}, which the file does not state):"
        if open_words
        else "import it (check the names):",
        f"  {line}",
    ]
    lines += [f"  it will ask: {question}"] if question else []
    return [*lines, *(_modes(named, content) if source.responses else ())]


def _may_have_axis(table: NumberTable) -> bool:
    """Whether a column of a table may be the frequency."""
    return any(
        not np.iscomplexobj(column) and table.role(name) not in ("mark", "coherence")
        for name, column in table.columns.items()
    )


def _is_uneven_record(table: NumberTable) -> bool:
    """Whether a table has a time, motions and forces only: no column may be the frequency."""
    roles = {table.role(name) for name in table.columns}
    return "time" in roles and roles <= {"time", "force", "drive", *DERIVATIVE}


def _take_amplitudes_of_names(options: _Options, files: Sequence[LaboratoryFile]) -> None:
    """Use amplitudes in file names where nothing else states them."""
    amplitudes = [amplitude_of_name(file.name) for file in files]
    if options.get("force_amplitude") != ["NEWTONS"] or None in amplitudes:
        return
    (unit, *others) = {unit_meaning(one[1]).dimension for one in amplitudes if one is not None}
    if others:
        return
    if unit in DERIVATIVE:
        del options["force_amplitude"]
        options["base"] = f"{BY_NAME}:{unit}"
    elif unit in ("force", "voltage"):
        options["force_amplitude"] = [BY_NAME]


def _question(paths: Sequence[Path], content: _Content, options: _Options) -> str:
    """The question that an import with these options would ask; long records: channels only."""
    try:
        mapping = options.mapping()
        if isinstance(content, TimeRecording) and content.n_samples > _TRIED:
            mapped_record(content, mapping, content.name or "the record", Assumptions())
        else:
            import_files(list(paths), mapping, tuple(options))
    except InputError as error:
        return str(error)
    return ""


def _options_of(content: _Content) -> _Options:
    if isinstance(content, NumberTable):
        return _of_table(content)
    if isinstance(content, TimeRecording):
        return _of_record(content)
    return _of_responses(content)


class _Motion(NamedTuple):
    """A column or channel of a motion, as an option names it."""

    name: str
    quantity: str
    meaning: UnitMeaning | None
    is_stated: bool  # quantity and unit are stated by the file
    unit_word: str = "UNIT"

    @property
    def base_word(self) -> str:
        """The value of `--base`, always with the quantity."""
        known = self.quantity if self.quantity in DERIVATIVE else "QUANTITY"
        return f"{self.name}:{known}" + ("" if self.is_stated else f":{self.unit_word}")

    @property
    def word(self) -> str:
        """NAME, or NAME:QUANTITY:UNIT where the file does not state them."""
        return self.name if self.is_stated else self.base_word


def _motion_of(name: str, unit: str, role: str) -> _Motion:
    reference = level_reference(unit)
    meaning = meaning_or_none(unit if reference is None else reference)
    if meaning is None:
        return _Motion(name, role, None, False)
    if reference == "":
        return _Motion(name, role, None, False, "dB re UNIT")
    is_motion = meaning.quantity in DERIVATIVE and not meaning.per_volt
    return _Motion(name, meaning.quantity if is_motion else role, meaning, is_motion)


def _of_table(table: NumberTable) -> _Options:
    """Options for a table, from names, units and order of its columns."""
    options, roles = _Options(), {name: table.role(name) for name in table.columns}

    def of(*wanted: str) -> list[str]:
        return [name for name, role in roles.items() if role in wanted]

    if len(of("frequency")) != 1:
        options["frequency"] = next(iter(of("frequency")), "COLUMN")
    numbers = [name for name in table.columns if roles[name] not in _OTHERS]
    named = [_motion_of(name, table.units.get(name, ""), roles[name]) for name in numbers]
    loads = of("force") or of("drive")
    base_motion = [] if loads else [one for one in named if is_of_base(one.name)][:1]
    others = [one for one in named if one not in base_motion]
    responses = (
        [one for one in others if one.is_stated]
        or [one for one in others if roles[one.name] in DERIVATIVE]
        or [one for one in others if roles[one.name] in ("amplitude", "real")][:1]
        or others[:1]
    )
    if base_motion:
        options["base"] = base_motion[0].base_word
    elif loads:
        options["force"] = loads[0]
        if not table.units.get(loads[0]):
            options["force_unit"] = "V" if roles[loads[0]] == "drive" else "UNIT"
    else:
        options.add("force_amplitude", "NEWTONS")
    if any(one.meaning is not None and one.meaning.per_force for one in responses):
        options["over_force"] = True
    for one in responses or [_Motion("COLUMN", "", None, False)]:
        options.add("response", one.word)
    phases = of("phase")
    if not any(np.iscomplexobj(table.columns[one.name]) for one in responses):
        pairs = _phases(list(table.columns), [one.name for one in responses], phases)
        if len(responses) > 1 and pairs:
            options["phase"] = pairs
    kinds = {
        amplitude_kind(f"{table.units.get(name, '')} {name}")
        for name in (*loads[:1], *(one.name for one in (*base_motion, *responses)))
    }
    if len(kinds) == 1 and kinds.isdisjoint(("", "peak")):
        options["amplitude"] = kinds.pop()
    if unit := _phase_unit(table, phases):
        options["phase_unit"] = unit
    return options


def _phases(columns: list[str], responses: list[str], phases: list[str]) -> list[str]:
    """The phase column of each response: the next one after it; empty if not unique."""
    matched = []
    for name in responses:
        after = [one for one in phases if columns.index(one) > columns.index(name)]
        matched += after[:1]
    return matched if len(set(matched)) == len(responses) else []


def _phase_unit(table: NumberTable, phases: Sequence[str]) -> str:
    """The phase unit where only the values show it; empty where the option is not needed.

    Phases within ±π that vary by more than 1 are in radians: in degrees a resonance would span far
    more than 6.
    """
    for name in phases[:1]:
        values = np.asarray(table.columns[name], dtype=float)
        is_known = name in table.units or not np.isfinite(values).any()
        if is_known or np.nanmax(np.abs(values)) > 2 * np.pi:
            return ""
        phase_range = float(np.nanmax(values) - np.nanmin(values))
        return (
            "rad"
            if np.nanmax(np.abs(values)) <= _RADIANS and phase_range > _LEAST_PHASE_RANGE
            else "UNIT"
        )
    return ""


def _of_record(record: TimeRecording) -> _Options:
    """Options for a time record, from quantities or names of its channels."""
    options = _Options()
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
    base_motion = [] if loads else [one for one in named if is_of_base(one.name)][:1]
    responses = [one for one in named if one not in base_motion and one.is_stated] or [
        one for one in named if one not in base_motion
    ][:1]
    if loads:
        options["force"] = loads[0].name
        if loads[0].quantity == "unknown" or (loads[0].quantity == "force" and not loads[0].unit):
            options["force_unit"] = "UNIT"
    elif base_motion:
        options["base"] = base_motion[0].base_word
    else:
        options["record"] = "decay"
    for one in responses or [_Motion("CHANNEL", "", None, False)]:
        options.add("response", one.word)
    return options


def _role(channel: Channel) -> str:
    return role_of(channel.name, channel.unit)


def _of_responses(sets: FrequencyResponses) -> _Options:
    """Options for frequency responses as steady states of known forces."""
    options = _Options()
    load = next((one for one in sets.responses if one.quantity in ("force", "voltage")), None)
    reference = sets.references[0]
    if load is not None:
        options["force"] = load.name
    elif reference.quantity in DERIVATIVE:
        options["base"] = f"AMPLITUDE:{reference.quantity}:{reference.unit or reference.si_unit}"
    else:
        options.add("force_amplitude", "NEWTONS")
        if len(sets.references) > 1:
            options["force"] = reference.name
    named = [
        _Motion(one.name, one.quantity, None, one.quantity in DERIVATIVE)
        for one in sets.responses
        if one is not load
    ]
    for one in [one for one in named if one.is_stated] or named[:1]:
        options.add("response", one.word)
    return options


def _modes(named: str, sets: object) -> list[str]:
    """The command for linear modes of frequency responses, if it can be run."""
    if not isinstance(sets, FrequencyResponses):
        return []
    if any(one.quantity not in DERIVATIVE for one in sets.responses):
        return [
            "`snrmjax modes` needs the quantity of the responses, and the file states no unit: "
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
