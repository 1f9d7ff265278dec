"""How many steps of a test were used: of its records, and as its import counted them."""

from collections.abc import Sequence

import numpy as np

from snrmjax.identify.pointwise.points_result import BackbonePoints
from snrmjax.measure.recordings.step_counts import StepCounts, counts_in, joined_counts
from snrmjax.report.html import Rows
from snrmjax.report.whole_test.folder_contents import TestFiles

_ROW = "steady states used"


def used_steps(files: TestFiles, steps: Sequence[StepCounts]) -> StepCounts | None:
    """The counts of the records, or those that a map states of the tables imported with it.

    None where neither is known, or where not all states are steps.
    """
    n_states = sum(one.states.n_states for one in files.states)
    if steps and not n_states:
        return joined_counts(steps)
    lines = [line for _, lines in files.texts for line in lines]
    stated = [one for one in map(counts_in, lines) if one is not None and one.used == n_states]
    return stated[0] if stated and not steps else None


def with_steps(rows: Rows, counts: StepCounts | None, points: BackbonePoints) -> Rows:
    """Rows of a summary whose number of states is that of the steps, those left out included."""
    if counts is None or not counts.reasons:
        return rows
    used = int(np.sum(np.asarray(points.usable)))
    words = f"{used} of {counts.steps} steps at sensor {points.sensor}; left out: {counts.reasons}"
    return [(name, words if name == _ROW else text) for name, text in rows]
