"""Import of files by a map: steady states, or time records."""

import dataclasses
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from snrmjax.io.columns import is_ours
from snrmjax.io.exchange.import_levels import MeasuredPart, numbered_levels
from snrmjax.io.exchange.import_map import Assumptions, ImportMap
from snrmjax.io.exchange.import_options import (
    Content,
    refuse_unused,
    refuse_unused_axis,
    refuse_unused_phase_unit,
)
from snrmjax.io.exchange.import_units import Force
from snrmjax.io.exchange.own_tables import restated, restated_how, states_of_own_table
from snrmjax.io.exchange.record_import import at_stated_rate, import_record, mapped_record
from snrmjax.io.exchange.response_import import import_responses
from snrmjax.io.exchange.table_import import import_table
from snrmjax.io.laboratory.contents import LaboratoryFile, NumberTable
from snrmjax.io.laboratory.reading import read_laboratory_file
from snrmjax.io.laboratory.shared_clock import joined_by_clock
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.step_counts import StepCounts, joined_counts
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import (
    SteadyStates,
    join_steady_states,
    steady_states,
    with_levels_apart,
)
from snrmjax.model.moving_base import BaseMotion
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError


class Imported(NamedTuple):
    """Result of an import: steady states, or records kept as such.

    `used` is the completed map, `assumed` the reason of each key that was not stated.
    """

    states: SteadyStates | None
    records: tuple[TimeRecording, ...]
    used: ImportMap
    assumed: Assumptions
    notes: tuple[Fact, ...]
    steps: StepCounts | None = None  # of all stepped-sine records


class _Dataset(NamedTuple):
    """One dataset of a file that can be imported."""

    name: str
    file: str
    content: TimeRecording | NumberTable | tuple[FrequencyResponses, ...]
    z: tuple[float, ...] = ()


def import_files(
    paths: Sequence[Path], mapping: ImportMap, stated: Collection[str] = ()
) -> Imported:
    """Import the files of one test.

    Arguments: `mapping` gives the meaning of channels and columns, the same for all files; `stated`
    are its keys that must have an effect.
    Returns `Imported`. Raises `ValueError`: as `read_laboratory_file` does, and with a question
    that names the option where something is undetermined.
    """
    assumed, notes = Assumptions(), list[Fact]()
    datasets: list[_Dataset] = []
    text_and_axis = mapping.text_format, mapping.even_axis
    files = [read_laboratory_file(path, *text_and_axis) for path in paths]
    refuse_unused_axis(stated, files)
    files = joined_files(files)
    for source in files:
        datasets += _datasets(source, mapping, strict="dataset" in stated)
        notes += [
            Fact("note_of_file", file=source.name, note=note)
            for note in source.notes
            if not (mapping.rate and note.kind == "rate_left_open")
        ]
    if len({type(dataset.content) for dataset in datasets}) > 1:
        listed = ", ".join(f"{dataset.file}: {dataset.name}" for dataset in datasets)
        raise InputError(f"files of one test must hold datasets of one kind, but have {listed}.")
    if mapping.dataset == "" and len(datasets) == 1:
        mapping = mapping._replace(dataset=datasets[0].name)
    file = datasets[0].file
    contents = [(dataset.content, dataset.file) for dataset in datasets]
    records = [(content, name) for content, name in contents if isinstance(content, TimeRecording)]
    tables = [(content, name) for content, name in contents if isinstance(content, NumberTable)]
    own_tables = [(table, name) for table, name in tables if is_ours(table.columns)]
    is_own = bool(own_tables) and not mapping.responses
    kind: Content = (
        "records" if records else "own table" if is_own else "table" if tables else "responses"
    )
    refuse_unused(stated, kind, mapping, file, [source.kind for source in files])
    if records:
        return _records(records, mapping, assumed, notes)
    if is_own:
        parts = [restated(states_of_own_table(table, name), mapping) for table, name in own_tables]
        notes.append(restated_how(mapping))
        return Imported(join_steady_states(parts), (), mapping, assumed, tuple(notes))
    each = mapping.force_amplitude
    if len(each) == len(tables) > 1:  # one a file
        mappings = [mapping._replace(force_amplitude=(word,)) for word in each]
    else:
        mappings = [mapping] * len(tables)
    imported = [
        import_table(table, file_map, name, assumed)
        for (table, name), file_map in zip(tables, mappings, strict=True)
    ] or [
        import_responses(content, z, mapping, name, assumed)
        for _, name, content, z in datasets
        if not isinstance(content, TimeRecording | NumberTable)
    ]
    used, force = imported[-1][1:3]
    refuse_unused_phase_unit(stated, used)
    used = used._replace(force_amplitude=mapping.force_amplitude)
    measured = [part for part, *_ in imported]
    notes += [note for *_, further in imported for note in further]
    return _phasors(measured, used, force, file, mapping.level, assumed, notes)


def joined_files(files: Sequence[LaboratoryFile]) -> list[LaboratoryFile]:
    """Join files of one channel each on a common clock into one record; others are unchanged."""
    recordings = {file.name: file.recordings for file in files if file.recordings}
    joined = joined_by_clock(recordings) if len(recordings) == len(files) else None
    if joined is None or any(file.tables or file.responses for file in files):
        return list(files)
    record, name = joined
    joined_note = [Fact("channels_of_files", files=tuple(recordings))]
    notes = tuple(dict.fromkeys([*joined_note, *(note for file in files for note in file.notes)]))
    return [files[0]._replace(name=name, recordings=(record,), notes=notes)]


def _datasets(
    source: LaboratoryFile, mapping: ImportMap, *, strict: bool = False
) -> list[_Dataset]:
    """The datasets to import. Raises `ValueError` with a question where they are ambiguous."""
    parts = [_Dataset(record.name or "record", source.name, record) for record in source.recordings]
    parts += [_Dataset(table.name, source.name, table) for table in source.tables]
    if source.responses:
        parts.append(_Dataset("responses", source.name, source.responses, source.levels))
    names = ", ".join(dataset.name for dataset in parts)
    named = [dataset for dataset in parts if dataset.name == mapping.dataset != ""]
    if named or (len(parts) == 1 and not strict):
        return named or parts
    if mapping.dataset:
        raise InputError(f"--dataset names {mapping.dataset!r}, but {source.name} has {names}.")
    if len(parts) > len(source.recordings):
        raise InputError(f"which part of {source.name} is meant? --dataset names it, of {names}.")
    return parts


def _records(
    records: Sequence[tuple[TimeRecording, str]],
    mapping: ImportMap,
    assumed: Assumptions,
    notes: list[Fact],
) -> Imported:
    if mapping.phase_sign == "lag":
        raise InputError(
            f"--phase-sign must be left out of the time records of {records[0][1]}: phases follow "
            "from force and motion there. Change the sign of an inverted sensor in the model's "
            "`shape`."
        )
    parts: list[SteadyStates] = []
    kept: list[TimeRecording] = []
    steps: list[StepCounts] = []
    used = mapping
    for recorded, file in records:
        record = at_stated_rate(recorded, mapping.rate, file)
        record, used = mapped_record(record, mapping, file, assumed)
        states, used, further, counts = import_record(record, used, file, assumed)
        notes += [Fact("note_of_file", file=file, note=note) for note in further]
        steps += [] if counts is None else [counts]
        if states is None:
            kept.append(record)
        else:
            parts.append(states)
    counted = joined_counts(steps) if steps else None
    if counted is not None:
        notes.append(counted.fact)
    if not parts:
        return Imported(None, tuple(kept), used, assumed, tuple(notes))
    if mapping.level == "file" or (len(parts) > 1 and not mapping.level):
        if not mapping.level:
            assumed.add("level", Fact("level_a_record"))
        used = used._replace(level="file")
        parts = [
            dataclasses.replace(states, level=jnp.full(states.n_states, k))
            for k, states in enumerate(parts, 1)
        ]
    elif len(parts) > 1:
        parts = list(with_levels_apart(parts))
    return Imported(join_steady_states(parts), (), used, assumed, tuple(notes), counted)


def _phasors(
    parts: Sequence[MeasuredPart],
    used: ImportMap,
    force: Force,
    file: str,
    level: str,
    assumed: Assumptions,
    notes: Sequence[Fact],
) -> Imported:
    """Steady states of tables and frequency responses."""
    velocity = np.concatenate([part.velocity for part in parts])
    if not np.any(np.abs(velocity) > 0):
        raise InputError(f"{file} has only zero responses.")
    keyed = all(part.key is not None for part in parts)
    number, rule = numbered_levels(parts, level or (used.level if keyed else ""), assumed)
    amplitude = np.concatenate([part.force for part in parts])
    missing = np.full(len(amplitude), np.nan)
    states = steady_states(
        number,
        np.concatenate([part.frequency for part in parts]),
        missing if force.is_voltage else amplitude,
        np.where(np.isfinite(velocity), velocity, 0.0),
        measured=np.isfinite(velocity),
        sensors=[response.sensor for response in used.responses],
        drive=amplitude if force.is_voltage else missing,
        velocity_std=np.concatenate([part.velocity_std for part in parts]),
        phase_std=np.concatenate([part.phase_std for part in parts]),
        base=None if force.motion is None else BaseMotion("relative"),
    )
    # Assumed choices go into the map, so that the next test is read the same way.
    keys = {"amplitude", "phase_sign", "phase_unit"}.intersection(assumed)
    words: dict[str, Any] = {key: assumed[key].value for key in keys}
    used = used._replace(level=rule, **words)
    return Imported(states, (), used, assumed, tuple(notes))
