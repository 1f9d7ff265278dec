"""CSV tables of numbers with numbered columns."""

import re
from typing import NamedTuple

import numpy as np

from snrmjax.io.files import FilePath, shown, suggestion
from snrmjax.io.rows import Cells, read_cells

_NUMBERED = re.compile(r"([a-z]+)_([1-9][0-9]{0,5})")


class NumberedColumns(NamedTuple):
    """The rows of a CSV by column; `groups` are the numbered columns, by their stem."""

    cells: Cells
    groups: dict[str, int]  # number of columns stem_1 … stem_n

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

    Raises `ValueError` that names file, row or column for an unknown or missing column of a group,
    and as `read_cells` does.
    """
    cells = read_cells(path)
    groups: dict[str, int] = {}
    for name in cells.names:
        numbered = _NUMBERED.fullmatch(name)
        if numbered and numbered[1] in stems:
            groups[numbered[1]] = max(groups.get(numbered[1], 0), int(numbered[2]))
        elif name not in single:
            known = (*single, *(f"{stem}_1" for stem in stems))
            near = suggestion(name, known)
            raise ValueError(f"{cells.file} has the unknown column {shown(name)}{near}.")
    for stem, count in groups.items():
        for k in range(count):
            if not cells.has(f"{stem}_{k + 1}"):
                raise ValueError(f"{cells.file} lacks the column `{stem}_{k + 1}`.")
    return NumberedColumns(cells, groups)
