"""Numbers of used and omitted steps of a stepped sine, with reasons."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from snrmjax.numerics.facts import Fact


class StepCounts(NamedTuple):
    """Number of used steps, and of omitted ones by reason."""

    used: int
    left_out: Mapping[str, int]

    @property
    def fact(self) -> Fact:
        """The counts as a fact: 44 of 104 steps used; left out: 58 unsettled, 2 too short."""
        return Fact("steps_used", used=self.used, left_out=self.reasons)

    @property
    def reasons(self) -> tuple[tuple[str, int], ...]:
        """Reasons for omitting steps, with their numbers."""
        return tuple((reason, count) for reason, count in self.left_out.items() if count)


def joined_counts(counts: Iterable[StepCounts]) -> StepCounts:
    """The sum of the counts of several records."""
    records = list(counts)
    left: Counter[str] = Counter()
    for record in records:
        left.update(record.left_out)
    return StepCounts(sum(record.used for record in records), dict(left))
