"""Which parts of a record gave a steady state, and the numbers of used and omitted ones."""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from snrmjax.numerics.facts import Fact
from snrmjax.numerics.status import Status

FEWEST_CYCLES = 10
"""Cycles of a step that are evaluated, at least."""


class RecordStatus(Status):
    """Whether a step or a moment of a record gave a steady state, or why it did not."""

    SETTLED = 0, "settled"
    UNSETTLED = 1, "amplitude or phase still change at its end; dwell longer"
    TOO_SHORT = 2, f"fewer than {FEWEST_CYCLES} cycles are left"
    NOT_FINITE = 3, "samples are missing or not finite"
    CLIPPED = 4, "a channel stays at its largest value: it is clipped"
    NOT_FOUND = 5, "the frequency of the force differs from the table"
    NO_FORCE = 6, "the force is a thousandth of the largest or less: a pause"
    OUTSIDE = 7, "the window leaves the sweep, or samples are missing"
    TOO_FAST = 8, "the phasor changes too fast for a steady state (a jump, or too fast a sweep)"


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
