"""Table of the phase resonances of a test's levels, measured and predicted."""

from collections.abc import Iterable, Sequence

import numpy as np

from snrmjax.diagnose.response_prediction import LevelResponse, PhaseResonance
from snrmjax.report.style import Unit, unit_for, with_unit


def resonance_rows(rows: Sequence[LevelResponse], force_unit: str = "N") -> list[tuple[str, ...]]:
    """The rows of the table of resonances, all velocities in one unit."""
    each = [(row.measured, row.before, row.completed, row.after) for row in rows]
    unit = velocity_unit(one for four in each for one in four)
    some_withheld = any(row.withheld for row in rows)
    table = []
    for row, (*fitted, withheld) in zip(rows, each, strict=True):
        texts = [resonance_in_words(one, unit) for one in fitted]
        if some_withheld:
            texts.append(resonance_in_words(withheld, unit) if row.withheld else "–")
        table.append((str(row.level), _unbroken(with_unit(row.force, force_unit)), *texts))
    return table


def velocity_unit(resonances: Iterable[PhaseResonance]) -> Unit:
    """One unit for the velocities of resonances."""
    velocities = [resonance.velocity for resonance in resonances if np.isfinite(resonance.velocity)]
    return unit_for(velocities, "m/s")


def resonance_in_words(one: PhaseResonance, unit: Unit) -> str:
    """Frequency, velocity and fold of a phase resonance, or why there is none."""
    if one.jump is not None:
        low, high = (f"{end:.5g}" for end in one.jump)
        return f"none: the states jump over it, {_unbroken(f'{low} → {high} Hz')}"
    if not np.isfinite(one.frequency):
        return "no resonance"
    fold = f", fold at {_unbroken(f'{one.fold:.5g} Hz')}" if np.isfinite(one.fold) else ""
    speed = _unbroken(f"{one.velocity / unit.size:.3g} {unit.name}")
    return f"{_unbroken(f'{one.frequency:.5g} Hz')}, {speed}{fold}"


def _unbroken(text: str) -> str:
    """A value and its unit, joined by a no-break space."""
    return text.replace(" ", "\u00a0")
