"""Verdicts of a diagnosis, and how answers are named."""

from collections.abc import Iterable
from enum import StrEnum

Kinds = tuple[str, ...]
"""An answer: its effects in alphabetical order, or one of those without any."""

NONE: Kinds = ("none",)
UNKNOWN: Kinds = ("unknown",)
NOISE_REJECTED: Kinds = ("noise_rejected",)


class Verdict(StrEnum):
    """The overall result of a diagnosis."""

    NOTHING_MISSING = "none"
    NAMED = "named"
    AMBIGUOUS = "ambiguous"
    DRAWN = "drawn"
    UNKNOWN = "unknown"
    NOISE_REJECTED = "noise_rejected"

    @property
    def is_answer(self) -> bool:
        """Whether effects are given as an answer."""
        return self in (Verdict.NAMED, Verdict.AMBIGUOUS, Verdict.DRAWN)


def answer_of(effects: Iterable[str]) -> Kinds:
    """The answer with these effects, in any order; `NONE` without any."""
    return tuple(sorted(effects)) or NONE
