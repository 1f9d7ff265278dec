"""Contents of a laboratory file of any format."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Num

from snrmjax.io.laboratory.names import column_unit, role_of
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.numerics.facts import Fact


class NumberTable(NamedTuple):
    """Columns of numbers by name, all of one length.

    One row may be a steady state (frequency, force, amplitude, phase), a step of a record or a
    line of a spectrum. Numbers are unchanged from the file, real or complex; NaN where a field is
    empty. `units` are as written in the file, where stated; `words` has the columns of text (a
    sensor's name, a condition), "" where a field is empty.
    """

    name: str
    columns: Mapping[str, Num[np.ndarray, " row"]]
    units: Mapping[str, str] = {}
    words: Mapping[str, tuple[str, ...]] = {}

    def role(self, name: str) -> str:
        """Role of a column, by name and unit; see `role_of`. Boolean columns are marks."""
        is_mark = self.columns[name].dtype == bool
        return "mark" if is_mark else role_of(name, self.units.get(name, ""))

    def with_named_units(self) -> "NumberTable":
        """With units taken from column names where the file states none."""
        units = {name: column_unit(name, self.units.get(name, "")) for name in self.columns}
        return self._replace(units={name: unit for name, unit in units.items() if unit})

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values())))


class TextFormat(NamedTuple):
    """Format of a text file; None is detected.

    `separator` is "comma", "semicolon", "tab" or "space", `decimal` "point" or "comma",
    `header_row` the row of the columns' names, from 1.
    """

    separator: str | None = None
    decimal: str | None = None
    header_row: int | None = None


class LaboratoryFile(NamedTuple):
    """Contents of a laboratory file; see `read_laboratory_file`.

    `levels` has one number for each of `responses` (UFF: the value on the z axis), NaN where the
    file states none. `notes` report what was not read, and assumptions. `kind` is the format.
    """

    name: str
    recordings: tuple[TimeRecording, ...] = ()
    responses: tuple[FrequencyResponses, ...] = ()
    tables: tuple[NumberTable, ...] = ()
    notes: tuple[Fact, ...] = ()
    levels: tuple[float, ...] = ()
    kind: str = ""  # by `read_laboratory_file`: readers of one format leave it open

    @property
    def is_empty(self) -> bool:
        """Whether the file has no data."""
        return not (self.recordings or self.responses or self.tables)
