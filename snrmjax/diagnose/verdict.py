"""What a diagnosis says as a whole, and how answers are named."""

from collections.abc import Iterable
from enum import StrEnum

Kinds = tuple[str, ...]
"""An answer: its effects in alphabetic order, or one of those without any."""

NONE: Kinds = ("none",)
UNKNOWN: Kinds = ("unknown",)
NOISE_REJECTED: Kinds = ("noise_rejected",)


class Verdict(StrEnum):
    """What a diagnosis says as a whole."""

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
    """The answer of effects in any order, and of none."""
    return tuple(sorted(effects)) or NONE
