"""Results that are tables of rows: sequences that also become a labelled data set."""

from collections.abc import Iterator, Sequence
from typing import Any, Generic, TypeVar, overload

import numpy as np

from snrmjax.numerics.result import AbstractResult, Variable

Row = TypeVar("Row")


class AbstractTable(AbstractResult, Generic[Row]):
    """A result that is a sequence of rows, each a `NamedTuple`."""

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

    def column(self, values: Sequence[Any] | np.ndarray, unit: str, meaning: str) -> Variable:
        """A quantity of every row."""
        return Variable(("row",), np.asarray(values), unit, meaning)
