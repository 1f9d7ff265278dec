"""What a laboratory's file holds, whatever its format."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Num

from snrmjax.io.laboratory.names import column_unit, role_of
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.numerics.facts import Fact

Kind = Literal["uff", "matlab", "octave", "hdf5", "netcdf", "tdms", "lvm", "csv"]


class NumberTable(NamedTuple):
    """Columns of numbers by name, all of one length.

    One row may be a steady state (frequency, force, amplitude, phase), a step of a record or a
    line of a spectrum. Numbers are as they stand in the file, real or complex; NaN where a field is
    empty. `units` has the file's own word for each column that states one, `words` the columns of
    text (a sensor's name, a condition), "" where a field is empty.
    """

    name: str
    columns: Mapping[str, Num[np.ndarray, " row"]]
    units: Mapping[str, str] = {}
    words: Mapping[str, tuple[str, ...]] = {}

    def role(self, name: str) -> str:
        """What a column is, by its name and its unit; see `role_of`. Truth values are marks."""
        is_mark = self.columns[name].dtype == bool
        return "mark" if is_mark else role_of(name, self.units.get(name, ""))

    def with_named_units(self) -> "NumberTable":
        """With the units that names of columns have in them, where the file states none."""
        said = {name: column_unit(name, self.units.get(name, "")) for name in self.columns}
        return self._replace(units={name: unit for name, unit in said.items() if unit})

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values())))


class TextFormat(NamedTuple):
    """How a text is written; what is None is found out.

    `separator` is "comma", "semicolon", "tab" or "space", `decimal` "point" or "comma",
    `header_row` the row of the columns' names, from 1.
    """

    separator: str | None = None
    decimal: str | None = None
    header_row: int | None = None


class LaboratoryFile(NamedTuple):
    """All that a file of a laboratory holds; see `read_laboratory_file`.

    `levels` has one number for each of `responses` (UFF: the value on the z axis), NaN where the
    file states none. `notes` say what was not read, and what was taken for what.
    """

    name: str
    kind: Kind
    recordings: tuple[TimeRecording, ...] = ()
    responses: tuple[FrequencyResponses, ...] = ()
    tables: tuple[NumberTable, ...] = ()
    notes: tuple[Fact, ...] = ()
    levels: tuple[float, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether nothing was found."""
        return not (self.recordings or self.responses or self.tables)
