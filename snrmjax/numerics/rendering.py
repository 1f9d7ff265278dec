"""How facts and results are shown: by `snrmjax.report`, which registers itself here.

Packages below `report` never import it: they hold typed values.
"""

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
