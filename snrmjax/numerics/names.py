"""Names: suggestions for misspelt ones in error messages, and aliases of former public ones."""

import difflib
import importlib
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any


def near_miss(name: str, known: Iterable[str], cutoff: float = 0.6) -> str | None:
    """The known name most similar to a given one, ignoring case, or None.

    Arguments: `cutoff` is the least similarity of difflib, from 0 to 1.

    >>> near_miss("Freq_hz", ["level", "frequency_hz"])
    'frequency_hz'
    """
    folded = {other.casefold(): other for other in known}
    near = difflib.get_close_matches(name.casefold(), folded, n=1, cutoff=cutoff)
    return folded[near[0]] if near else None


def suggestion(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """The most similar known name as the end of an error message, or an empty string.

    >>> suggestion("dampin_ratio", ["damping_ratio", "shape"])
    ' (did you mean `damping_ratio`?)'
    """
    near = near_miss(name, known, cutoff)
    return "" if near is None else f" (did you mean `{near}`?)"


def with_retired_names(
    package: str, current: Callable[[str], Any], names: Mapping[str, str]
) -> Callable[[str], Any]:
    """The `__getattr__` of a package, with `names` from former to present ones.

    A former name gives the present object with a `DeprecationWarning`. A present name with dots is
    in another package.
    """

    def attribute(name: str) -> Any:
        if name not in names:
            return current(name)
        elsewhere, _, present = names[name].rpartition(".")
        warnings.warn(
            f"{package}.{name} is now {elsewhere or package}.{present}: the former name goes in "
            "the next release.",
            DeprecationWarning,
            stacklevel=2,
        )
        if elsewhere:
            return getattr(importlib.import_module(elsewhere), present)
        return current(present)

    return attribute
