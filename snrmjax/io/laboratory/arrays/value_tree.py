"""Named arrays of a file as a tree of structs, lists, text and numbers that are read when asked."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Union

import numpy as np
from jaxtyping import Num

from snrmjax.measure.recordings.time_recording import AbstractSamples

Selection = tuple[slice, ...]
_MOST_HELD = 2**24  # numbers of an array that are read at once: 128 MiB of float64


class Numbers(NamedTuple):
    """An array of a file: its shape is known, its numbers are read when asked.

    `read` takes one slice an axis. `attributes` are words that the file has for it: "unit",
    "quantity", "point", "direction".
    """

    shape: tuple[int, ...]
    read: Callable[[Selection], Num[np.ndarray, "..."]]
    is_complex: bool = False
    attributes: Mapping[str, str] = {}

    @property
    def size(self) -> int:
        """How many numbers."""
        return int(np.prod(self.shape, dtype=object)) if self.shape else 1

    @property
    def sides(self) -> list[int]:
        """The lengths of its axes but for those of 1."""
        return [n for n in self.shape if n != 1]

    @property
    def length(self) -> int | None:
        """Length of a vector (a row, a column, or of one axis), else None."""
        return None if len(self.sides) > 1 else (self.sides or [1])[0]

    @property
    def unit(self) -> str:
        """The file's word for the unit."""
        return self.attributes.get("unit", "")

    def all(self, name: str) -> Num[np.ndarray, "..."]:
        """All of it, integers and booleans as they are; refused by its name where that is much."""
        if self.size > _MOST_HELD:
            raise ValueError(
                f"{name} has {self.size} numbers, more than a table may hold ({_MOST_HELD}): keep "
                "long records as time records with an even time vector or a sampling rate."
            )
        return self.read(tuple(slice(0, n) for n in self.shape))

    def vector(self, name: str) -> Num[np.ndarray, " row"]:
        """A vector, whichever way it lies."""
        return self.all(name).reshape(-1)

    def stretch(self, start: int, stop: int) -> Num[np.ndarray, " row"]:
        """A part of a vector, whichever way it lies."""
        at = tuple(slice(start, stop) if n != 1 else slice(0, 1) for n in self.shape)
        return self.read(at).reshape(-1)


Node = Union[Numbers, str, list["Node"], dict[str, "Node"]]  # noqa: UP007


def held(values: Num[np.ndarray, "..."], attributes: Mapping[str, str] | None = None) -> Numbers:
    """Numbers that are in memory already."""
    array = np.asarray(values)
    return Numbers(
        array.shape, lambda at: array[at], bool(np.iscomplexobj(array)), dict(attributes or {})
    )


class ChannelPlace(NamedTuple):
    """Where a channel's samples lie: an array, its axis of samples, and the place on the other."""

    numbers: Numbers
    axis: int
    other: int


class PlacedSamples(AbstractSamples):
    """Channels in vectors and in columns of matrices of a file."""

    def __init__(self, places: Sequence[ChannelPlace], n_samples: int) -> None:
        self._places, self._samples = tuple(places), n_samples

    @property
    def shape(self) -> tuple[int, int]:
        """Channels and samples."""
        return len(self._places), self._samples

    def read(
        self, channels: Sequence[int], start: int, stop: int
    ) -> Num[np.ndarray, "channel sample"]:
        """A stretch of some channels; those of one matrix are read together."""
        chosen = [self._places[k] for k in channels]
        rows: dict[int, np.ndarray] = {}
        for k, place in enumerate(chosen):
            if k in rows:
                continue
            alike = {
                m: sibling.other
                for m, sibling in enumerate(chosen)
                if sibling.numbers is place.numbers
            }
            at = [slice(0, n) for n in place.numbers.shape]
            at[place.axis] = slice(start, stop)
            first = min(alike.values())
            if len(at) > 1:
                at[1 - place.axis] = slice(first, max(alike.values()) + 1)
            block = place.numbers.read(tuple(at))
            for m, other in alike.items():
                is_matrix = len(at) > 1
                rows[m] = np.take(block, other - first, 1 - place.axis) if is_matrix else block
        return np.stack([rows[k] for k in range(len(chosen))])
