"""What a laboratory's file holds, whatever its format."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Num

from snrmjax.io.laboratory.names import role_of
from snrmjax.io.laboratory.physical_units import unit_meaning
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.numerics.facts import Fact

_QUANTITIES = ("force", "drive", "displacement", "velocity", "acceleration", "frequency", "time")
_ROLES = {one: one for one in _QUANTITIES} | {"angle": "phase", "voltage": "drive"}
Kind = Literal["uff", "matlab", "hdf5", "netcdf", "tdms", "lvm", "csv"]


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
        """What a column is: by its name or, where that says little, by its unit; or nothing.

        A unit says "frequency", "phase", "time", "force", "drive" (volts) or which motion it is,
        and is believed before a name that says another of these quantities.
        """
        by_name = role_of(name)
        try:
            meaning = unit_meaning(self.units.get(name, ""))
        except ValueError:
            return by_name
        by_unit = _ROLES.get(meaning.dimension, "")
        is_drive = by_unit == "drive" and by_name != "drive"  # a sensor's volts are volts, too
        plain = not by_name or (by_name in _QUANTITIES and by_unit in _QUANTITIES)
        return by_unit if by_unit and plain and not is_drive else by_name

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
