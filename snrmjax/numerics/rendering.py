"""The one door to `report`: sentences, printed results and figures are made there when wanted.

Rooms below `report` never import it; what they hold is typed values. `import snrmjax` says which
modules show them.
"""

import importlib
from typing import Any

_modules: dict[str, str] = {}


def shown_by(*, sentences: str, printed: str, figures: str) -> None:
    """Names the modules that word facts, print results and draw them; each is imported late."""
    _modules.update(sentences=sentences, printed=printed, figures=figures)


def worded(fact: Any) -> str:
    """The sentence that tells a `Fact`."""
    return _module("sentences").sentence(fact)


def on_one_screen(result: Any) -> str:
    """A result on one screen."""
    return _module("printed").screen_of(result)


def in_a_notebook(result: Any) -> str:
    """A result as the HTML that notebooks show."""
    return _module("printed").html_of(result)


def drawn(result: Any, **settings: Any) -> Any:
    """The figure that shows a result."""
    return _module("figures").plot_result(result, **settings)


def _module(what: str) -> Any:
    if what not in _modules:
        raise ValueError(f"no {what} are registered: `import snrmjax` registers them.")
    return importlib.import_module(_modules[what])
