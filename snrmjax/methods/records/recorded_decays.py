"""The model's mode in every free decay of a record, apart from its company, or why it is not."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from snrmjax.measure.decays.isolated_decay import IsolatedDecay, isolate_decay
from snrmjax.methods.records.recorded_test import RecordedTest
from snrmjax.methods.records.recorded_velocity import recorded_velocity
from snrmjax.methods.result import MethodResult
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ


class RecordedDecay(NamedTuple):
    """One stretch of free decay: the mode alone, or why there is none."""

    decay: IsolatedDecay | None
    notes: tuple[Fact, ...]
    why: str = ""


def recorded_decays(test: RecordedTest, modes: LinearModes) -> tuple[RecordedDecay, ...]:
    """The mode of interest in every free decay of a record (`isolate_decay`)."""
    rest = modes.natural_frequency.item(modes.mode_of_interest)
    found = []
    for part in test.free:
        try:
            seen = recorded_velocity(test.recording, test.channels.reference, rest, part)
            decay = isolate_decay(seen.time, seen.velocity, rest)
        except ValueError as error:
            found.append(RecordedDecay(None, (), str(error)))
        else:
            found.append(RecordedDecay(decay, (*decay.notes(), *seen.notes)))
    return tuple(found)


def read_decays(
    method: Callable[[IsolatedDecay], MethodResult], decays: tuple[RecordedDecay, ...]
) -> list[MethodResult]:
    """What a method finds in the decays whose mode could be isolated.

    A decay that could not be is named in a note. Raises `ValueError` where none could, and where a
    method's frequencies lie outside the band of the mode: it follows another motion.
    """
    left_out = [Fact("decay_left_out", why=one.why) for one in decays if one.decay is None]
    found = []
    for one in decays:
        if one.decay is None:
            continue
        result = method(one.decay)
        _require_band(result, one.decay)
        notes = dict.fromkeys((*result.notes, *one.notes, *left_out))
        found.append(dataclasses.replace(result, notes=tuple(notes)))
    if not found:
        raise ValueError(decays[0].why if decays else "the record has no free decay.")
    return found


def _require_band(result: MethodResult, decay: IsolatedDecay) -> None:
    omega = np.asarray(result.natural_frequency)[result.found]
    low, high = decay.band
    if omega.size and (omega.min() < low or omega.max() > high):
        raise ValueError(
            f"what was found, {omega.min() / HERTZ:.4g} to {omega.max() / HERTZ:.4g} Hz, lies "
            f"outside the mode's own band of {low / HERTZ:.4g} to {high / HERTZ:.4g} Hz: it "
            "follows another motion."
        )
