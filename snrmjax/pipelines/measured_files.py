"""Measured data of a command: steady states or time records, distinguished by content."""

import dataclasses
from pathlib import Path

from snrmjax.io.files import FilePath, file_name, read_text
from snrmjax.io.laboratory.reading import NOT_SEPARATED_TEXT, read_laboratory_file
from snrmjax.io.laboratory.record_tables import is_record_table, read_record_table
from snrmjax.io.tables import read_steady_states
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure
from snrmjax.numerics.rules import InputError

_STATES = {"level", "frequency_hz"}  # columns of which a table of steady states has one


def read_measured_test(path: FilePath, structure: Structure) -> list[SteadyStates | TimeRecording]:
    """Steady states or time records of one file.

    A CSV with a column `time_s` is a time record, one with `level` or `frequency_hz` a table of
    steady states; any other file is a laboratory's, whose time records are read.
    Raises `ValueError` as the readers do, and for a file with neither.
    """
    path = Path(path)
    if path.suffix.lower() not in NOT_SEPARATED_TEXT and _is_text(path):
        if is_record_table(path):
            return [read_record_table(path)]
        if _STATES & _header(path) or not _header(path):
            return [read_steady_states(path, structure)]
    content = read_laboratory_file(path)
    if not content.recordings:
        raise InputError(
            f"{file_name(path)} holds no time record (a CSV needs the column time_s) and no table "
            "of steady states (level, frequency_hz, …)."
        )
    name = file_name(path)
    return [
        dataclasses.replace(one, name=f"{one.name} of {name}" if one.name else name)
        for one in content.recordings
    ]


def _header(path: Path) -> set[str]:
    first = read_text(path).lstrip().split("\n", 1)[0]
    return {field.strip().strip('"') for field in first.split(",") if field.strip()}


def _is_text(path: Path) -> bool:
    """Whether a file is text; True for a missing one, so that its reader reports it."""
    if not path.is_file():
        return True
    with path.open("rb") as file:
        return b"\0" not in file.read(4096)
