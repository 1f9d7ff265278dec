"""Results that are tables of rows: sequences that also become a labelled data set."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, Generic, TypeVar, overload

import numpy as np

from snrmjax.numerics.result import AbstractResult, Variable

Row = TypeVar("Row")


class AbstractTable(AbstractResult, Generic[Row]):
    """A result that is a sequence of rows, each a `NamedTuple`."""

    # Of a row, unit and meaning.
    columns: ClassVar[Mapping[str, tuple[Callable[[Any], Any], str, str]]]
    rows: tuple[Row, ...]

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.rows)

    @overload
    def __getitem__(self, place: int) -> Row: ...
    @overload
    def __getitem__(self, place: slice) -> tuple[Row, ...]: ...
    def __getitem__(self, place: int | slice) -> Row | tuple[Row, ...]:
        """The row at a place, or those of a slice."""
        return self.rows[place]

    def __iter__(self) -> Iterator[Row]:
        """The rows in their order."""
        return iter(self.rows)

    def variables(self) -> dict[str, Variable]:
        """One of every entry of `columns`."""
        return {
            name: Variable(("row",), np.array([of(row) for row in self.rows]), unit, meaning)
            for name, (of, unit, meaning) in self.columns.items()
        }
