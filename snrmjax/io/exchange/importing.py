"""An import: files and a map to steady states, or to records of decays."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from snrmjax.io.columns import is_ours
from snrmjax.io.exchange.import_levels import MeasuredPart, numbered_levels
from snrmjax.io.exchange.import_map import Assumptions, ImportMap
from snrmjax.io.exchange.import_units import Force
from snrmjax.io.exchange.own_tables import (
    restated,
    restated_how,
    states_of_own_table,
)
from snrmjax.io.exchange.record_import import import_record, told_record
from snrmjax.io.exchange.response_import import import_responses
from snrmjax.io.exchange.table_import import import_table
from snrmjax.io.laboratory.contents import LaboratoryFile, NumberTable
from snrmjax.io.laboratory.reading import read_laboratory_file
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.step_counts import StepCounts, joined_counts
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import (
    SteadyStates,
    join_steady_states,
    steady_states,
    with_levels_apart,
)
from snrmjax.numerics.facts import Fact


class Imported(NamedTuple):
    """What an import gave: steady states, or records that stay records.

    `used` is the map with all that was found, `assumed` the reason of each key that nobody stated.
    """

    states: SteadyStates | None
    records: tuple[TimeRecording, ...]
    used: ImportMap
    assumed: Assumptions
    notes: tuple[Fact | str, ...]
    steps: StepCounts | None = None  # of all records that are stepped sines


class _Dataset(NamedTuple):
    """One thing of a file that can be imported."""

    name: str
    file: str
    content: TimeRecording | NumberTable | tuple[FrequencyResponses, ...]
    z: tuple[float, ...] = ()


def import_files(paths: Sequence[Path], told: ImportMap) -> Imported:
    """Import the files of one test.

    Arguments: `told` says which channel or column is what; the same for all files.
    Returns `Imported`. Raises `ValueError`: as `read_laboratory_file` does, and with a question
    that names the option where something cannot be told.
    """
    assumed, notes = Assumptions(), list[Fact | str]()
    chosen: list[_Dataset] = []
    for path in paths:
        held = read_laboratory_file(path, told.text_format)
        chosen += _datasets(held, told)
        notes += [Fact("note_of_file", file=held.name, note=note) for note in held.notes]
    kinds = {type(one.content) for one in chosen}
    if len(kinds) > 1:
        listed = ", ".join(f"{one.file}: {one.name}" for one in chosen)
        raise ValueError(f"files of one test must hold things of one kind, but have {listed}.")
    if told.dataset == "" and len(chosen) == 1:
        told = told._replace(dataset=chosen[0].name)
    if isinstance(chosen[0].content, TimeRecording):
        return _records(chosen, told, assumed, notes)
    own = [
        one
        for one in chosen
        if isinstance(one.content, NumberTable) and is_ours(one.content.columns)
    ]
    if own and not told.responses:
        parts = [
            restated(states_of_own_table(one.content, one.file), told)
            for one in own
            if isinstance(one.content, NumberTable)
        ]
        notes.append(restated_how(told))
        return Imported(_joined(parts), (), told, assumed, tuple(notes))
    return _phasors(chosen, told, assumed, notes)


def _datasets(held: LaboratoryFile, told: ImportMap) -> list[_Dataset]:
    """What of a file is imported. Raises `ValueError` with a question where that is not one."""
    every = [_Dataset(one.name or "record", held.name, one) for one in held.recordings]
    every += [_Dataset(one.name, held.name, one) for one in held.tables]
    if held.responses:
        every.append(_Dataset("responses", held.name, held.responses, held.levels))
    names = [one.name for one in every]
    if told.dataset:
        alike = [one for one in every if one.name == told.dataset]
        if alike:
            return alike
        if len(every) > 1:
            raise ValueError(
                f"--dataset names {told.dataset!r}, but {held.name} has {', '.join(names)}."
            )
    if len(every) > 1 and all(isinstance(one.content, TimeRecording) for one in every):
        return every
    if len(every) > 1:
        raise ValueError(
            f"which part of {held.name} is meant? --dataset names it, of {', '.join(names)}."
        )
    return every


def _records(
    chosen: Sequence[_Dataset], told: ImportMap, assumed: Assumptions, notes: list[Fact | str]
) -> Imported:
    if told.phase_sign == "lag":
        raise ValueError(
            f"--phase-sign must be left out of the time records of {chosen[0].file}: phases follow "
            "from force and motion there. A sensor of the other sign is turned in the model's "
            "`shape`."
        )
    parts: list[SteadyStates] = []
    kept: list[TimeRecording] = []
    steps: list[StepCounts] = []
    used = told
    for one in chosen:
        if isinstance(one.content, TimeRecording):
            record, used = told_record(one.content, told, one.file, assumed)
            states, used, more, counts = import_record(record, used, one.file, assumed)
            notes += [Fact("note_of_file", file=one.file, note=note) for note in more]
            steps += [] if counts is None else [counts]
            if states is None:
                kept.append(record)
            else:
                parts.append(states)
    counted = joined_counts(steps) if steps else None
    if counted is not None:
        reasons = tuple(counted.left_out.items())
        notes.append(Fact("steps_used", used=counted.used, left_out=reasons))
    if not parts:
        return Imported(None, tuple(kept), used, assumed, tuple(notes))
    if told.level == "file" or (len(parts) > 1 and not told.level):
        if not told.level:
            assumed.add("level", Fact("level_a_record"))
        used = used._replace(level="file")
        parts = [
            dataclasses.replace(one, level=jnp.full(one.n_states, k + 1))
            for k, one in enumerate(parts)
        ]
    elif len(parts) > 1:
        parts = list(with_levels_apart(parts))
    return Imported(_joined(parts), (), used, assumed, tuple(notes), counted)


def _phasors(
    chosen: Sequence[_Dataset], told: ImportMap, assumed: Assumptions, notes: list[Fact | str]
) -> Imported:
    """Tables and frequency responses."""
    parts: list[MeasuredPart] = []
    used, force = told, Force(1.0, False, "N")
    for one in chosen:
        if isinstance(one.content, NumberTable):
            part, used, force, more = import_table(one.content, told, one.file, assumed)
        elif isinstance(one.content, TimeRecording):
            continue
        else:
            part, used, force, more = import_responses(one.content, one.z, told, one.file, assumed)
        parts.append(part)
        notes += more
    level, rule = numbered_levels(parts, told.level or _rule(used, parts), assumed)
    every = np.concatenate([one.force for one in parts])
    velocity = np.concatenate([one.velocity for one in parts])
    missing = np.full(len(every), np.nan)
    states = steady_states(
        level,
        np.concatenate([one.frequency for one in parts]),
        missing if force.is_voltage else every,
        np.where(np.isfinite(velocity), velocity, 0.0),
        measured=np.isfinite(velocity),
        sensors=[one.sensor for one in used.responses],
        drive=every if force.is_voltage else missing,
        velocity_std=_stated([(one.velocity_std, one.velocity) for one in parts]),
        phase_std=_stated([(one.phase_std, one.velocity) for one in parts]),
    )
    if not np.any(np.abs(velocity) > 0):
        raise ValueError(f"{chosen[0].file} has nothing but zero responses.")
    used = _filled(used._replace(level=rule), assumed)
    return Imported(states, (), used, assumed, tuple(notes))


def _stated(errors: Sequence[tuple[np.ndarray | None, np.ndarray]]) -> np.ndarray:
    """Standard deviations of all parts; NaN where a part states none."""
    return np.concatenate(
        [np.full(like.shape, np.nan) if std is None else std for std, like in errors]
    )


def _filled(used: ImportMap, assumed: Assumptions) -> ImportMap:
    """The map with choices that were assumed, so that the next test is read alike."""
    keys = ("amplitude", "phase_sign", "phase_unit")
    words: dict[str, Any] = {key: assumed[key].value for key in keys if key in assumed}
    return used._replace(**words)


def _rule(used: ImportMap, parts: Sequence[MeasuredPart]) -> str:
    """The rule that a file's own column or order gives, if all parts have one."""
    return used.level if all(one.key is not None for one in parts) else ""


def _joined(parts: Sequence[SteadyStates]) -> SteadyStates:
    return parts[0] if len(parts) == 1 else join_steady_states(list(parts))
