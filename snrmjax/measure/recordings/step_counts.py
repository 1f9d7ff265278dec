"""How many steps of a stepped sine became steady states, and why the others did not."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple


class StepCounts(NamedTuple):
    """Steps that were used, and those left out by their reason."""

    used: int
    left_out: Mapping[str, int]

    @property
    def steps(self) -> int:
        """All steps."""
        return self.used + sum(self.left_out.values())

    @property
    def words(self) -> str:
        """The counts as part of a sentence.

        >>> StepCounts(44, {"unsettled": 58, "too short": 2}).words
        '44 of 104 steps used; left out: 58 unsettled, 2 too short'
        """
        reasons = self.reasons
        return f"{self.used} of {self.steps} steps used" + (
            f"; left out: {reasons}" if reasons else ""
        )

    @property
    def reasons(self) -> str:
        """How many were left out for each reason; empty where none was."""
        return ", ".join(f"{count} {reason}" for reason, count in self.left_out.items() if count)


def joined_counts(counts: Iterable[StepCounts]) -> StepCounts:
    """The counts of several records together."""
    every = list(counts)
    left: Counter[str] = Counter()
    for one in every:
        left.update(one.left_out)
    return StepCounts(sum(one.used for one in every), dict(left))
