"""Access to `report`, where sentences, printed results and figures are made on demand.

Packages below `report` never import it: they hold typed values. `import snrmjax` registers the
modules that render them.
"""

import importlib
from typing import Any

from snrmjax.numerics.rules import InputError

_modules: dict[str, str] = {}


def shown_by(*, sentences: str, printed: str, figures: str) -> None:
    """Register the modules of sentences, printed results and figures; each is imported late."""
    _modules.update(sentences=sentences, printed=printed, figures=figures)


def worded(fact: Any) -> str:
    """A `Fact` as a sentence."""
    return _module("sentences").sentence(fact)


def on_one_screen(result: Any) -> str:
    """A result as text for one screen."""
    return _module("printed").screen_of(result)


def in_a_notebook(result: Any) -> str:
    """A result as HTML for notebooks."""
    return _module("printed").html_of(result)


def drawn(result: Any, **settings: Any) -> Any:
    """The figure of a result."""
    return _module("figures").plot_result(result, **settings)


def _module(what: str) -> Any:
    if what not in _modules:
        raise InputError(f"no {what} are registered: `import snrmjax` registers them.")
    return importlib.import_module(_modules[what])
