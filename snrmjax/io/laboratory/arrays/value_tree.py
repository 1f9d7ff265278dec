"""Named arrays of a file as a tree of structs, lists, text and numbers that are read on demand."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Union

import numpy as np
from jaxtyping import Num

from snrmjax.measure.recordings.time_recording import AbstractSamples
from snrmjax.numerics.rules import InputError

Selection = tuple[slice, ...]
_MOST_IN_MEMORY = 2**24  # largest array (numbers) that is read at once: 128 MiB of float64


class Numbers(NamedTuple):
    """An array of a file: its shape is known, its numbers are read on demand.

    `read` takes one slice an axis. `attributes` are metadata in the file: "unit",
    "quantity", "point", "direction".
    """

    shape: tuple[int, ...]
    read: Callable[[Selection], Num[np.ndarray, "..."]]
    is_complex: bool = False
    attributes: Mapping[str, str] = {}

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(np.prod(self.shape, dtype=object)) if self.shape else 1

    @property
    def dimensions(self) -> list[int]:
        """The lengths of its axes, except those of 1."""
        return [n for n in self.shape if n != 1]

    @property
    def length(self) -> int | None:
        """Length of a vector (a row, a column, or of one axis), else None."""
        return None if len(self.dimensions) > 1 else (self.dimensions or [1])[0]

    @property
    def unit(self) -> str:
        """The unit as written in the file."""
        return self.attributes.get("unit", "")

    def all(self, name: str) -> Num[np.ndarray, "..."]:
        """The whole array, types unchanged. Raises `ValueError` above the size limit."""
        if self.size > _MOST_IN_MEMORY:
            raise InputError(
                f"{name} has {self.size} numbers, more than a table may hold ({_MOST_IN_MEMORY}): "
                "keep long records as time records with an even time vector or a sampling rate."
            )
        return self.read(tuple(slice(0, n) for n in self.shape))

    def vector(self, name: str) -> Num[np.ndarray, " row"]:
        """The array as a vector, row or column."""
        return self.all(name).reshape(-1)

    def part(self, start: int, stop: int) -> Num[np.ndarray, " row"]:
        """A part of a vector, row or column."""
        at = tuple(slice(start, stop) if n != 1 else slice(0, 1) for n in self.shape)
        return self.read(at).reshape(-1)


Node = Union[Numbers, str, list["Node"], dict[str, "Node"]]  # noqa: UP007


def in_memory(
    values: Num[np.ndarray, "..."], attributes: Mapping[str, str] | None = None
) -> Numbers:
    """Numbers from an array in memory."""
    array = np.asarray(values)
    return Numbers(
        array.shape, lambda at: array[at], bool(np.iscomplexobj(array)), dict(attributes or {})
    )


class ChannelPosition(NamedTuple):
    """Position of a channel's samples: array, sample axis, and index on the other axis."""

    numbers: Numbers
    axis: int
    other: int


class ArraySamples(AbstractSamples):
    """Samples of channels in vectors or matrices of a file."""

    def __init__(self, positions: Sequence[ChannelPosition], n_samples: int) -> None:
        self._positions, self._samples = tuple(positions), n_samples

    @property
    def shape(self) -> tuple[int, int]:
        """Channels and samples."""
        return len(self._positions), self._samples

    def read(
        self, channels: Sequence[int], start: int, stop: int
    ) -> Num[np.ndarray, "channel sample"]:
        """Samples of some channels; those of one matrix are read together."""
        chosen = [self._positions[k] for k in channels]
        rows: dict[int, np.ndarray] = {}
        for k, position in enumerate(chosen):
            if k in rows:
                continue
            alike = {
                m: sibling.other
                for m, sibling in enumerate(chosen)
                if sibling.numbers is position.numbers
            }
            at = [slice(0, n) for n in position.numbers.shape]
            at[position.axis] = slice(start, stop)
            first = min(alike.values())
            if len(at) > 1:
                at[1 - position.axis] = slice(first, max(alike.values()) + 1)
            block = position.numbers.read(tuple(at))
            for m, other in alike.items():
                is_matrix = len(at) > 1
                rows[m] = np.take(block, other - first, 1 - position.axis) if is_matrix else block
        return np.stack([rows[k] for k in range(len(chosen))])
