"""Near misses among names, as messages suggest them."""

import difflib
from collections.abc import Iterable


def near_miss(name: str, known: Iterable[str], cutoff: float = 0.6) -> str | None:
    """The known name that is most like a given one, upper or lower case, or nothing.

    Arguments: `cutoff` is difflib's similarity, from 0 to 1, that the name must reach.

    >>> near_miss("Freq_hz", ["level", "frequency_hz"])
    'frequency_hz'
    """
    folded = {other.casefold(): other for other in known}
    near = difflib.get_close_matches(name.casefold(), folded, n=1, cutoff=cutoff)
    return folded[near[0]] if near else None


def suggestion(name: str, known: Iterable[str], cutoff: float = 0.6) -> str:
    """A near miss among the known names, ready to end a message, or nothing.

    >>> suggestion("dampin_ratio", ["damping_ratio", "shape"])
    ' (did you mean `damping_ratio`?)'
    """
    near = near_miss(name, known, cutoff)
    return "" if near is None else f" (did you mean `{near}`?)"
