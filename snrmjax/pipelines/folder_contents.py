"""Files of a test's folder by content: model, steady states, responses, records."""

import dataclasses
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from snrmjax.io.exchange.import_map import Assumptions, ImportMap, read_import_map, steps_of_map
from snrmjax.io.exchange.import_options import STAYS_RECORD
from snrmjax.io.exchange.importing import Imported, import_files, joined_files
from snrmjax.io.exchange.own_tables import is_own_file
from snrmjax.io.exchange.proposals import proposed_commands
from snrmjax.io.exchange.record_import import ask_for_rate, at_stated_rate, mapped_record
from snrmjax.io.files import read_text
from snrmjax.io.laboratory.contents import LaboratoryFile
from snrmjax.io.laboratory.reading import SUFFIXES, read_laboratory_file
from snrmjax.io.models import read_model
from snrmjax.io.tables import check_driven_alike, read_steady_states
from snrmjax.measure.base_excitation import states_relative_to_base
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.step_counts import StepCounts
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import UNNAMED_SENSOR, SteadyStates
from snrmjax.model.structures import Structure
from snrmjax.numerics.rules import InputError

MAP = "map.toml"
_WRITTEN = (".txt", ".md", ".log")  # notes; a .txt may also hold measurements
_AXES = ("frequency", "time")
_SHOWN = 60  # lines of a text
_MOST_NAMED = 6  # unused files listed in a message
_LOADS = ("force", "voltage")
_REPORTED = ("channels_shifted", "samples_missing", "runs_side_by_side", "whole_rate_of_digits")


class NamedStates(NamedTuple):
    """Steady states of one file; `table` is our own file, for reading with a model's sensors."""

    file: str
    states: SteadyStates
    table: Path | None = None

    @property
    def names_no_sensor(self) -> bool:
        """Whether the file names no sensor."""
        return self.states.sensors == UNNAMED_SENSOR

    def of_model(self, model: Structure) -> SteadyStates:
        """The states with the sensors of the model.

        Raises `ValueError` as `read_steady_states` does, and for sensors the model does not have.
        """
        if self.table is not None:
            return read_steady_states(self.table, model)
        states, modes = self.states, model.modes
        if self.names_no_sensor and len(modes.sensors) == 1:
            states = dataclasses.replace(states, sensors=modes.sensors)
        if states.sensors != modes.sensors:
            raise InputError(
                f"{self.file} has the sensors {', '.join(self.states.sensors)}, but the model "
                f"{', '.join(modes.sensors)}."
            )
        check_driven_alike(states, modes, self.file)
        return states if modes.base is None else states_relative_to_base(states, modes.base)


class NamedResponses(NamedTuple):
    """Frequency responses of one file."""

    file: str
    responses: FrequencyResponses


class NamedRecord(NamedTuple):
    """A time record of one file."""

    file: str
    record: TimeRecording


class TestFiles(NamedTuple):
    """All files of a test's folder; see `read_test_files`."""

    model: Structure | None
    model_file: str
    states: tuple[NamedStates, ...]
    responses: tuple[NamedResponses, ...]
    records: tuple[NamedRecord, ...]
    passed: tuple[tuple[str, str], ...]  # file without measurements, and its kind
    notes: tuple[str, ...]  # assumptions on files
    texts: tuple[tuple[str, tuple[str, ...]], ...] = ()  # lines of notes and of the map
    steps_at_import: StepCounts | None = None

    def rows(self) -> Iterator[tuple[str, str]]:
        """Each file and its content."""
        if self.model is not None:
            count = self.model.modes.n_modes
            yield self.model_file, f"model with {count} mode{'s' if count > 1 else ''}"
        for file, states, _ in self.states:
            levels = len(set(states.level.tolist()))
            many = f"{levels} level{'s' if levels > 1 else ''}"
            yield file, f"{states.n_states} steady states on {many}"
        for file, one in self.responses:
            sides = f"{len(one.responses)} × {len(one.references)}"
            yield file, f"{sides} frequency responses of {len(one.frequency)} lines"
        for file, record in self.records:
            seconds = record.n_samples / record.sampling_rate
            names = ", ".join(record.channel_names)
            yield file, f"record of {seconds:.4g} s at {record.sampling_rate:g} Hz: {names}"
        yield from self.passed


def read_test_files(
    folder: Path, model: Path | None = None, rate: float = 0.0, map_file: Path | None = None
) -> TestFiles:
    """Read every file of a folder, by its content, but no subfolders.

    Arguments: `model` is a file with the linear model that replaces the folder's; `rate` in Hz is
    that of all records, where files state it with few digits; `map_file` assigns columns and
    channels and replaces the folder's map.toml.
    Raises `ValueError` for a missing folder or one without measurements, for a file of
    measurements that cannot be read, for several models, and as `import_files` does for a table
    whose columns are neither recognised nor assigned in a `map.toml`.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} must be a folder with the files of a test.")
    files = sorted(one for one in folder.iterdir() if one.is_file() and one.name[0] != ".")
    models = [] if model is None else [model]
    own = [file for file in files if file.name == MAP]
    maps = own if map_file is None else [map_file]
    mapping = read_import_map(maps[0]) if maps else ImportMap()
    mapping = mapping._replace(rate=rate or mapping.rate)
    states: list[NamedStates] = []
    responses: list[NamedResponses] = []
    records: list[NamedRecord] = []
    passed: list[tuple[str, str]] = []
    texts: list[tuple[str, tuple[str, ...]]] = []
    raw: list[LaboratoryFile] = []
    for path in files:
        suffix = path.suffix.lower()
        if path in own:
            passed.append((path.name, "how files are imported"))
            texts.append((path.name, _lines(path)))
        elif suffix == ".toml":
            if not _is_model(path):
                passed.append((path.name, "not used: it has no [[mode]] and no [structure]"))
            elif model is None:
                models.append(path)
            elif path.resolve() != model.resolve():
                passed.append((path.name, f"not used: the model is {model.name}"))
        elif suffix == ".txt" and (written := _measured_text(path, mapping)) is not None:
            raw.append(written)
        elif suffix in _WRITTEN and _readable(path):
            passed.append((path.name, "not used: a text of the laboratory, shown below"))
            texts.append((path.name, _lines(path)))
        elif suffix not in SUFFIXES:
            passed.append((path.name, "not used: not a measurement file, by its suffix"))
        elif suffix == ".csv" and is_own_file(path):
            states.append(NamedStates(path.name, read_steady_states(path), path))
        else:
            raw.append(read_laboratory_file(path, mapping.text_format, mapping.even_axis))
    assumed_of: dict[str, list[str]] = {}  # files by assumption
    for content in raw:
        ask_for_rate(content.notes, mapping.rate, content.name)
    for content, names in _joined(raw):
        paths, file, assumed = [folder / name for name in names], content.name, Assumptions()
        stepped = content.recordings and mapping.base and mapping.record not in STAYS_RECORD
        if (
            content.tables
            or stepped
            or (content.responses and (mapping.force_amplitude or mapping.base))
        ):
            imported = _imported(paths, mapping, folder, maps[0].name if mapping.responses else "")
            assumed.update(imported.assumed)
            if imported.states is not None:
                states.append(NamedStates(file, imported.states))
        else:
            responses += [NamedResponses(file, one) for one in _linear(content, paths[0])]
        for recording in () if stepped else content.recordings:
            record = at_stated_rate(recording, mapping.rate, file)
            record = (
                record if mapping.is_empty else mapped_record(record, mapping, file, assumed)[0]
            )
            several = f"{file}: {recording.name}"
            records.append(NamedRecord(several if len(content.recordings) > 1 else file, record))
        lines = [f"{key}: {why}" for key, why in assumed.items()]
        lines += [str(note) for note in content.notes if note.kind in _REPORTED]
        for line in lines:
            assumed_of.setdefault(line, []).append(file)
    notes = [f"{', '.join(named)}: {line}" for line, named in assumed_of.items()]
    if len(models) > 1:
        listed = " and ".join(model.name for model in models)
        raise InputError(
            f"which is the model of this test, {listed}? Choose it by `--model {models[0].name}`."
        )
    if not states and not responses and not records:
        over = "; ".join(f"{name}: {why}" for name, why in passed[:_MOST_NAMED])
        raise InputError(
            f"{folder.name} has no measurements: steady states (CSV), frequency responses or "
            f"time records{f' ({over})' if over else ''}."
        )
    return TestFiles(
        read_model(models[0]) if models else None,
        models[0].name if models else "",
        tuple(states),
        tuple(responses),
        tuple(records),
        tuple(passed),
        tuple(notes),
        tuple((name, lines) for name, lines in texts if lines),
        steps_of_map(maps[0]) if maps else None,
    )


def _measured_text(path: Path, mapping: ImportMap) -> LaboratoryFile | None:
    """A text file of measurements, with a frequency or time column; None for any other."""
    try:
        content = read_laboratory_file(path, mapping.text_format, mapping.even_axis)
    except InputError:
        return None  # notes are shown unchanged
    axes = {table.role(name) for table in content.tables for name in table.columns}
    named = mapping.frequency in {name for table in content.tables for name in table.columns}
    return content if content.recordings or content.responses or named or axes & {*_AXES} else None


def _joined(raw: Sequence[LaboratoryFile]) -> list[tuple[LaboratoryFile, list[str]]]:
    """Files with their sources' names; single channels on one time axis are joined."""
    alone = [one for one in raw if len(one.recordings) == 1 and not (one.tables or one.responses)]
    groups: dict[tuple[float, float, int], list[LaboratoryFile]] = {}
    for one in alone:
        (record,) = one.recordings
        if len(record.channels) == 1:
            clock = record.sampling_rate, record.start_time, record.n_samples
            groups.setdefault(clock, []).append(one)
    files: list[tuple[LaboratoryFile, list[str]]] = []
    taken: set[str] = set()
    for group in groups.values():
        joined = joined_files(group)
        loads = [one for one in group if one.recordings[0].channels[0].quantity in _LOADS]
        if len(joined) == 1 < len(group) and len(loads) == 1:
            names = [one.name for one in group]
            files.append((joined[0], names))
            taken.update(names)
    return [*files, *((one, [one.name]) for one in raw if one.name not in taken)]


def _readable(path: Path) -> bool:
    """Whether a file is text."""
    return b"\0" not in path.read_bytes()[:4096]


def _lines(path: Path) -> tuple[str, ...]:
    """The first lines of a text, and how many follow."""
    lines = [line.rstrip() for line in path.read_text("utf-8", errors="replace").splitlines()]
    lines = [line for line in lines if line]
    further = len(lines) - _SHOWN
    return (*lines[:_SHOWN], *([f"… {further} further lines"] if further > 0 else []))


def _is_model(path: Path) -> bool:
    """Whether a TOML file has modes or matrices; True for a malformed one, for `read_model`."""
    try:
        content = tomllib.loads(read_text(path))
        return "mode" in content or "structure" in content
    except tomllib.TOMLDecodeError:
        return True


def _imported(
    paths: Sequence[Path], mapping: ImportMap, folder: Path, map_file: str = ""
) -> Imported:
    try:
        return import_files(paths, mapping)
    except InputError as error:
        if map_file:
            names = ", ".join(path.name for path in paths)
            raise InputError(
                f"{names}, read with {map_file}: {error} (Its keys have the options' names.)"
            ) from error
        raise InputError(f"{_question(paths, folder)} (Without a map: {error})") from error


def _question(paths: Sequence[Path], folder: Path) -> str:
    """The question about the columns, with the commands that answer it."""
    content = [read_laboratory_file(path) for path in paths]
    command = next(
        line for line in proposed_commands(paths, content) if line.startswith("  snrmjax")
    )
    names = ", ".join(path.name for path in paths)
    base = (
        " --base absolute` (or relative: what the sensors record)" if " --base " in command else "`"
    )
    return (
        f"what are the columns of {names}? `{command.strip()}` assigns them, if its names are "
        f"right; then `snrmjax test {folder} --map imported/{MAP}{base} reads all files with it."
    )


def _linear(content: LaboratoryFile, path: Path) -> tuple[FrequencyResponses, ...]:
    """Responses of a linear test, that is of one level."""
    levels = {level for level in content.levels if np.isfinite(level)}
    if len(levels) > 1:
        raise InputError(
            f"are the responses of {content.name}, of {len(levels)} levels, steady states of a "
            f"stepped sine? If so, run `snrmjax import {path} --force-amplitude z --out DIR`, "
            f"and put its {MAP} next to the file; for linear modes keep only the lowest level."
        )
    return content.responses
