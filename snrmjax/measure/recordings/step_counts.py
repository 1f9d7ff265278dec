"""How many steps of a stepped sine became steady states, and why the others did not."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from snrmjax.numerics.facts import Fact


class StepCounts(NamedTuple):
    """Steps that were used, and those left out by their reason."""

    used: int
    left_out: Mapping[str, int]

    @property
    def words(self) -> str:
        """The counts as part of a sentence: 44 of 104 steps used; left out: 58 unsettled."""
        return str(Fact("steps_used", used=self.used, left_out=self.reasons))

    @property
    def reasons(self) -> dict[str, int]:
        """How many were left out for each reason for which any was."""
        return {reason: count for reason, count in self.left_out.items() if count}


def joined_counts(counts: Iterable[StepCounts]) -> StepCounts:
    """The counts of several records together."""
    every = list(counts)
    left: Counter[str] = Counter()
    for one in every:
        left.update(one.left_out)
    return StepCounts(sum(one.used for one in every), dict(left))
