"""Facts: what a result has to tell, as a kind and its numbers; sentences are made from them."""

from collections.abc import Iterator, Mapping
from typing import Any

from snrmjax.numerics import rendering


class Fact(Mapping[str, Any]):
    """One thing that a reader should know: a note, an assumption, a piece of evidence, advice.

    Its `kind` says what, its values, by name, how much and where (`level=3`, `gain=1.02`,
    `frequency_hz=79.1`: a name ends in the unit where that is none of the SI). Code branches on
    these alone. `str(fact)` is the sentence, from the one place that words the kind
    (`snrmjax.report.sentences`). Facts compare and hash by kind and values.

    >>> fact = Fact("harmonics_without_error", n_states=3)
    >>> fact.kind, fact["n_states"]
    ('harmonics_without_error', 3)
    """

    kind: str

    def __init__(self, kind: str, /, **values: Any) -> None:
        self.kind = kind
        self._values = values

    def __getitem__(self, name: str) -> Any:
        """A value by its name."""
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Fact):
            return NotImplemented
        return (self.kind, self._values) == (other.kind, other._values)

    def __hash__(self) -> int:
        return hash((self.kind, *self._values.items()))

    def __str__(self) -> str:
        """The sentence that tells it."""
        return rendering.worded(self)

    def __repr__(self) -> str:
        """As it is written in code."""
        return ", ".join([f"Fact({self.kind!r}", *(f"{k}={v!r}" for k, v in self.items())]) + ")"
