"""Facts: typed statements about a result, from which sentences are made, and what shows them.

A fact is a kind with values. `snrmjax.report` registers itself as what shows facts and results:
packages below it never import it.
"""

from collections.abc import Iterator, Mapping
from typing import Any, Protocol

from snrmjax.numerics.rules import InputError


class Renderer(Protocol):
    """Shows facts and results."""

    def sentence(self, fact: Any) -> str:
        """A `Fact` as a sentence."""

    def screen(self, result: Any) -> str:
        """A result as text for one screen."""

    def html(self, result: Any) -> str:
        """A result as HTML for notebooks."""

    def figure(self, result: Any, **settings: Any) -> Any:
        """The figure of a result."""


_registered: list[Renderer] = []


def show_by(renderer: Renderer) -> None:
    """Show facts and results by this renderer from here on."""
    _registered[:] = [renderer]


def renderer() -> Renderer:
    """The registered renderer."""
    if not _registered:
        raise InputError("nothing shows facts and results: `import snrmjax` registers what does.")
    return _registered[0]


class Fact(Mapping[str, Any]):
    """A statement for the reader: a note, an assumption, a piece of evidence, advice.

    It has a `kind` and named values (`level=3`, `gain=1.02`, `frequency_hz=79.1`: a name ends in
    the unit where that is not the SI unit). Code branches on these alone. `str(fact)` is the
    sentence, worded in one module (`snrmjax.report.sentences`). Facts compare and hash by kind and
    values.

    >>> fact = Fact("harmonics_without_error", n_states=3)
    >>> fact.kind, fact["n_states"]
    ('harmonics_without_error', 3)
    """

    kind: str

    def __init__(self, kind: str, /, **values: Any) -> None:
        self.kind = kind
        self._values = values

    def __getitem__(self, name: str) -> Any:
        """The value of this name."""
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
        """The fact as a sentence."""
        return renderer().sentence(self)

    def __repr__(self) -> str:
        """The fact as it is constructed in code."""
        return ", ".join([f"Fact({self.kind!r}", *(f"{k}={v!r}" for k, v in self.items())]) + ")"
