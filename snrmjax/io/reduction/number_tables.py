"""CSV tables of numbers with numbered columns."""

import re
from typing import NamedTuple

import numpy as np

from snrmjax.io.columns import Header
from snrmjax.io.files import FilePath, file_name, read_text, shown, suggestion
from snrmjax.io.rows import Cells, split_rows

_NUMBERED = re.compile(r"([a-z]+)_([1-9][0-9]{0,5})")


class NumberedColumns(NamedTuple):
    """The rows of a CSV by column; `groups` are the numbered columns, by their stem."""

    cells: Cells
    groups: dict[str, int]  # number of columns stem_1 … stem_n

    @property
    def file(self) -> str:
        """As messages name it."""
        return self.cells.file

    def has(self, column: str) -> bool:
        """Whether there is such a column."""
        return column in self.cells.header.position

    def group(self, stem: str, *, empty_allowed: bool = False) -> np.ndarray:
        """The numbered columns of one stem, (row, column)."""
        columns = [f"{stem}_{k + 1}" for k in range(self.groups[stem])]
        return np.stack(
            [self.cells.numbers(name, empty_allowed=empty_allowed) for name in columns], axis=1
        )


def read_number_table(
    path: FilePath, stems: tuple[str, ...], single: tuple[str, ...] = ()
) -> NumberedColumns:
    """Read a CSV whose columns are `stem_1 … stem_n` for some stems, and some single ones.

    Raises `ValueError` that names file, row or column for an unknown, doubled or missing column of
    a group, and for rows that do not fit the header.
    """
    file = file_name(path)
    rows = split_rows(read_text(path), file)
    names = rows[0].fields
    if len(names) == 1 and re.search(r"[;\t]", names[0]):
        mark = "semicolons" if ";" in names[0] else "tabs"
        raise ValueError(
            f"the fields of {file} must be separated by commas, but its header row has {mark}."
        )
    position: dict[str, int] = {}
    groups: dict[str, int] = {}
    for k, name in enumerate(names):
        if name in position:
            raise ValueError(f"{file} has the column {shown(name)} twice.")
        numbered = _NUMBERED.fullmatch(name)
        if numbered and numbered[1] in stems:
            groups[numbered[1]] = max(groups.get(numbered[1], 0), int(numbered[2]))
        elif name not in single:
            known = (*single, *(f"{stem}_1" for stem in stems))
            raise ValueError(
                f"{file} has the unknown column {shown(name)}{suggestion(name, known)}."
            )
        position[name] = k
    for stem, count in groups.items():
        for k in range(count):
            if f"{stem}_{k + 1}" not in position:
                raise ValueError(f"{file} lacks the column `{stem}_{k + 1}`.")
    if len(rows) == 1:
        raise ValueError(f"{file} has a header row, but no rows of numbers.")
    for row in rows[1:]:
        if len(row.fields) != len(names):
            raise ValueError(
                f"row {row.number} of {file} has {len(row.fields)} fields, but the header "
                f"{len(names)}."
            )
    return NumberedColumns(Cells(rows[1:], Header(position, len(names), (), ()), file), groups)
