"""The wording of every fact: one file per subject, each with a table `SENTENCES` keyed by kind.

An entry is a format string with the fact's values by name, or a function of them. In addition to
Python's own formats there are `{n:#state}` (1 state, 2 states), `{fraction:%.3g}` (0.05 is 5 %) and
lists ("1, 2 and 5").
"""

import importlib
import pkgutil
import string
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

Wording = str | Callable[..., str]


class _Words(string.Formatter):
    """Python's formats, counts with a noun, fractions in per cent, and lists."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """See `string.Formatter`."""
        if isinstance(value, list | tuple | set | frozenset):
            return enumerated([self.format_field(one, format_spec) for one in value])
        if format_spec.startswith("#"):
            return number_of(value, format_spec[1:])
        if format_spec.startswith("%"):
            return f"{100 * value:{format_spec[1:]}} %"
        return super().format_field(value, format_spec)


_WORDS = _Words()


def sentence(fact: Fact) -> str:
    """A fact as a sentence.

    Raises `LookupError` for a kind that no file of this folder words, and for a value of the
    wording that the fact does not have.

    >>> sentence(Fact("record_left_out", why="it is clipped"))
    'a record was left out: it is clipped'
    """
    wording = wordings().get(fact.kind)
    if wording is None:
        raise LookupError(
            f"the fact {fact.kind!r} has no wording: add an entry to `SENTENCES` of its room's "
            "file in snrmjax/report/sentences."
        )
    if callable(wording):
        return wording(**fact)
    try:
        return _WORDS.format(wording, **fact)
    except KeyError as error:
        raise LookupError(
            f"the fact {fact.kind!r} is worded with {error}, but has {sorted(fact)}: see its entry "
            "in snrmjax/report/sentences."
        ) from error


def sentences(facts: Sequence[Fact]) -> list[str]:
    """The sentences of several facts, each once."""
    return list(dict.fromkeys(map(str, facts)))


@cache
def wordings() -> dict[str, Wording]:
    """The wording of every kind of fact; each kind belongs to one subject."""
    every: dict[str, Wording] = {}
    for subject in pkgutil.iter_modules(__path__):
        table = importlib.import_module(f"{__name__}.{subject.name}").SENTENCES
        twice = every.keys() & table.keys()
        if twice:
            raise InputError(f"worded twice: {enumerated(sorted(twice))}.")
        every |= table
    return every


def enumerated(words: Sequence[Any]) -> str:
    """Words as a list.

    >>> enumerated([1, 2, 5])
    '1, 2 and 5'
    """
    words = [str(word) for word in words]
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


def of_levels(levels: Sequence[int]) -> str:
    """Levels by their numbers.

    >>> of_levels([3]), of_levels([1, 2])
    ('level 3', 'levels 1 and 2')
    """
    return f"level{'' if len(levels) == 1 else 's'} {enumerated(levels)}"


def number_of(number: int, noun: str) -> str:
    """A number with its noun.

    >>> number_of(1, "state"), number_of(3, "state")
    ('1 state', '3 states')
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"
