"""What lies in the folder of a test, by content: model, steady states, responses, records."""

import dataclasses
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from snrmjax.io.exchange.import_map import (
    Assumptions,
    ImportMap,
    read_import_map,
    steps_of_map,
)
from snrmjax.io.exchange.import_options import STAYS_RECORD
from snrmjax.io.exchange.importing import Imported, import_files, joined_files
from snrmjax.io.exchange.own_tables import is_own_file
from snrmjax.io.exchange.proposals import proposed_commands
from snrmjax.io.exchange.record_import import (
    ask_for_rate,
    at_stated_rate,
    mapped_record,
)
from snrmjax.io.files import read_text
from snrmjax.io.laboratory.contents import LaboratoryFile
from snrmjax.io.laboratory.reading import read_laboratory_file
from snrmjax.io.models import read_model
from snrmjax.io.tables import check_driven_alike, read_steady_states
from snrmjax.measure.base_excitation import seen_from_base
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.step_counts import StepCounts
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import UNNAMED_SENSOR, SteadyStates
from snrmjax.model.structures import Structure

_MEASURED = (
    *(".csv", ".uff", ".unv", ".unv58", ".mat", ".h5", ".hdf5", ".nc", ".nc4", ".cdf"),
    *(".tdms", ".lvm", ".tsv", ".dat", ".asc"),
)
MAP = "map.toml"
_WRITTEN = (".txt", ".md", ".log")  # of which the first may hold measurements, too
_AXES = ("frequency", "time")
_SHOWN = 60  # lines of a text
_MOST_NAMED = 6  # files that were passed over, in a message
_LOADS = ("force", "voltage")
_TOLD = ("channels_shifted", "samples_missing", "runs_side_by_side", "whole_rate_of_digits")


class NamedStates(NamedTuple):
    """Steady states of one file; `table` is where they are read again with a model's sensors."""

    file: str
    states: SteadyStates
    table: Path | None = None

    @property
    def names_no_sensor(self) -> bool:
        """Whether the file does not say which sensor it is of."""
        return self.states.sensors == UNNAMED_SENSOR

    def of_model(self, model: Structure) -> SteadyStates:
        """The same with the sensors of the model.

        Raises `ValueError` as `read_steady_states` does, and for sensors that the model lacks.
        """
        if self.table is not None:
            return read_steady_states(self.table, model)
        states, modes = self.states, model.modes
        if self.names_no_sensor and len(modes.sensors) == 1:
            states = dataclasses.replace(states, sensors=modes.sensors)
        if states.sensors != modes.sensors:
            raise ValueError(
                f"{self.file} has the sensors {', '.join(self.states.sensors)}, but the model "
                f"{', '.join(modes.sensors)}."
            )
        check_driven_alike(states, modes, self.file)
        return states if modes.base is None else seen_from_base(states, modes.base)


class NamedResponses(NamedTuple):
    """Frequency responses of one file."""

    file: str
    responses: FrequencyResponses


class NamedRecord(NamedTuple):
    """A time record of one file."""

    file: str
    record: TimeRecording


class TestFiles(NamedTuple):
    """All that a folder holds of a test; see `read_test_files`."""

    model: Structure | None
    model_file: str
    states: tuple[NamedStates, ...]
    responses: tuple[NamedResponses, ...]
    records: tuple[NamedRecord, ...]
    passed: tuple[tuple[str, str], ...]  # file and why nothing was measured in it
    notes: tuple[str, ...]  # what was assumed of a file
    texts: tuple[tuple[str, tuple[str, ...]], ...] = ()  # lines that people wrote, and the map's
    steps_at_import: StepCounts | None = None

    def rows(self) -> Iterator[tuple[str, str]]:
        """Each file, and what was found in it."""
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
    """Read every file of a folder, by its content; folders inside it are left alone.

    Arguments: `model` is a file with the linear model, in place of the one in the folder; `rate` in
    Hz that of all records, where files state it with few digits; `map_file` says what columns and
    channels are, in place of the folder's map.toml.
    Raises `ValueError` for a folder that is missing or holds nothing measured, for a file of
    measurements that cannot be read, for several models, and as `import_files` does for a table
    whose columns neither are understood nor stand in a `map.toml`.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder} must be a folder with the files of a test.")
    files = sorted(one for one in folder.iterdir() if one.is_file() and one.name[0] != ".")
    models = [] if model is None else [model]
    own = [file for file in files if file.name == MAP]
    maps = own if map_file is None else [map_file]
    told = read_import_map(maps[0]) if maps else ImportMap()
    told = told._replace(rate=rate or told.rate)
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
        elif suffix == ".txt" and (written := _measured_text(path, told)) is not None:
            raw.append(written)
        elif suffix in _WRITTEN and _readable(path):
            passed.append((path.name, "not used: a text of the laboratory, shown below"))
            texts.append((path.name, _lines(path)))
        elif suffix not in _MEASURED:
            passed.append((path.name, "not used: no file of measurements, by its ending"))
        elif suffix == ".csv" and is_own_file(path):
            states.append(NamedStates(path.name, read_steady_states(path), path))
        else:
            raw.append(read_laboratory_file(path, told.text_format, told.even_axis))
    assumed_of: dict[str, list[str]] = {}  # files by what was assumed of them
    for held in raw:
        ask_for_rate(held.notes, told.rate, held.name)
    for held, names in _joined(raw):
        paths, file, assumed = [folder / name for name in names], held.name, Assumptions()
        stepped = held.recordings and told.base and told.record not in STAYS_RECORD
        if held.tables or stepped or (held.responses and (told.force_amplitude or told.base)):
            found = _imported(paths, told, folder, maps[0].name if told.responses else "")
            assumed.update(found.assumed)
            if found.states is not None:
                states.append(NamedStates(file, found.states))
        else:
            responses += [NamedResponses(file, one) for one in _linear(held, paths[0])]
        for recording in () if stepped else held.recordings:
            record = at_stated_rate(recording, told.rate, file)
            record = record if told.is_empty else mapped_record(record, told, file, assumed)[0]
            several = f"{file}: {recording.name}"
            records.append(NamedRecord(several if len(held.recordings) > 1 else file, record))
        said = [f"{key}: {why}" for key, why in assumed.items()]
        said += [str(note) for note in held.notes if note.kind in _TOLD]
        for line in said:
            assumed_of.setdefault(line, []).append(file)
    notes = [f"{', '.join(named)}: {line}" for line, named in assumed_of.items()]
    if len(models) > 1:
        listed = " and ".join(model.name for model in models)
        raise ValueError(
            f"which is the model of this test, {listed}? Say so by `--model {models[0].name}`."
        )
    if not states and not responses and not records:
        over = "; ".join(f"{name}: {why}" for name, why in passed[:_MOST_NAMED])
        raise ValueError(
            f"{folder.name} holds nothing measured: steady states (CSV), frequency responses or "
            f"time records{f' ({over})' if over else ''}."
        )
    return TestFiles(
        read_model(models[0]) if models else None,
        models[0].name if models else "",
        *(tuple(states), tuple(responses), tuple(records), tuple(passed), tuple(notes)),
        tuple((name, lines) for name, lines in texts if lines),
        steps_of_map(maps[0]) if maps else None,
    )


def _measured_text(path: Path, told: ImportMap) -> LaboratoryFile | None:
    """A text that holds measurements: numbers with a frequency or a time; None of any other."""
    try:
        held = read_laboratory_file(path, told.text_format, told.even_axis)
    except ValueError:
        return None  # what people wrote is shown as it is
    axes = {table.role(name) for table in held.tables for name in table.columns}
    named = told.frequency in {name for table in held.tables for name in table.columns}
    return held if held.recordings or held.responses or named or axes & {*_AXES} else None


def _joined(raw: Sequence[LaboratoryFile]) -> list[tuple[LaboratoryFile, list[str]]]:
    """Files with the names of what they were read from: channels of one clock are one of them."""
    alone = [one for one in raw if len(one.recordings) == 1 and not (one.tables or one.responses)]
    groups: dict[tuple[float, float, int], list[LaboratoryFile]] = {}
    for one in alone:
        (record,) = one.recordings
        if len(record.channels) == 1:
            clock = record.sampling_rate, record.start_time, record.n_samples
            groups.setdefault(clock, []).append(one)
    found: list[tuple[LaboratoryFile, list[str]]] = []
    taken: set[str] = set()
    for group in groups.values():
        joined = joined_files(group)
        loads = [one for one in group if one.recordings[0].channels[0].quantity in _LOADS]
        if len(joined) == 1 < len(group) and len(loads) == 1:
            names = [one.name for one in group]
            found.append((joined[0], names))
            taken.update(names)
    return [*found, *((one, [one.name]) for one in raw if one.name not in taken)]


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
    """Whether a TOML file has modes or matrices; one that cannot be read is left to its reader."""
    try:
        held = tomllib.loads(read_text(path))
        return "mode" in held or "structure" in held
    except tomllib.TOMLDecodeError:
        return True


def _imported(paths: Sequence[Path], told: ImportMap, folder: Path, map_file: str = "") -> Imported:
    try:
        return import_files(paths, told)
    except ValueError as error:
        if map_file:
            names = ", ".join(path.name for path in paths)
            raise ValueError(
                f"{names}, read as {map_file} says: {error} (Its keys have the options' names.)"
            ) from error
        raise ValueError(f"{_asked(paths, folder)} (Without a map: {error})") from error


def _asked(paths: Sequence[Path], folder: Path) -> str:
    """The question what columns are, with the commands that answer it."""
    held = [read_laboratory_file(path) for path in paths]
    command = next(line for line in proposed_commands(paths, held) if line.startswith("  snrmjax"))
    names = ", ".join(path.name for path in paths)
    base = (
        " --base absolute` (or relative: what the sensors record)" if " --base " in command else "`"
    )
    return (
        f"what are the columns of {names}? `{command.strip()}` says so, if its names are right; "
        f"then `snrmjax test {folder} --map imported/{MAP}{base} reads all files of the folder so."
    )


def _linear(held: LaboratoryFile, path: Path) -> tuple[FrequencyResponses, ...]:
    """Responses of a linear test; several levels are no such test."""
    levels = {level for level in held.levels if np.isfinite(level)}
    if len(levels) > 1:
        raise ValueError(
            f"are the responses of {held.name}, of {len(levels)} levels, steady states of a "
            f"stepped sine? Say so by `snrmjax import {path} --force-amplitude z --out DIR`, "
            f"and put its {MAP} beside the file; for linear modes keep the lowest level alone."
        )
    return held.responses
