"""Level numbers of imported states."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.io.exchange.import_map import Assumptions
from snrmjax.measure.recordings.velocity_states import number_levels
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError


class MeasuredPart(NamedTuple):
    """Steady states of one file before levels are numbered; phasors relative to the force."""

    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N or V
    velocity: Complex[np.ndarray, "state sensor"]  # m/s
    key: Float[np.ndarray, " state"] | None  # level keys from a column or the order
    velocity_std: Float[np.ndarray, "state sensor"]  # m/s; NaN where not stated
    phase_std: Float[np.ndarray, "state sensor"]  # rad


def numbered_levels(
    parts: Sequence[MeasuredPart], level: str, assumed: Assumptions
) -> tuple[np.ndarray, str]:
    """The level of every state of all parts, and the rule used, for the map.

    Arguments: `level` is the stated rule; without one, a column or the order in the file, then
    one level a file, then groups of equal force.
    Raises `ValueError` for a rule that does not apply to the data.
    """
    lengths = [len(part.frequency) for part in parts]
    files = np.repeat(np.arange(1, len(parts) + 1), lengths)
    force = np.concatenate([part.force for part in parts])
    frequency = np.concatenate([part.frequency for part in parts])
    keyed = all(part.key is not None for part in parts)
    if level not in ("", "file", "force", "runs") or (not level and keyed):
        keys = np.concatenate([np.full(0, 0.0) if p.key is None else p.key for p in parts])
        if not keyed:
            raise InputError(
                f"--level {level} does not exist in this file: give force, runs, file, or a column."
            )
        if len(parts) > 1:  # separate keys for each file
            keys = np.unique(np.stack([files, keys]), axis=1, return_inverse=True)[1] + 1.0
        whole = np.all(keys == np.round(keys)) and np.all(np.abs(keys) < 1e9)
        if whole:
            return keys.astype(int), level
        return np.unique(keys, return_inverse=True)[1] + 1, level
    if level == "file" or (not level and len(parts) > 1):
        if not level:
            assumed.add("level", Fact("level_a_file"))
        return files, "file"
    number, rule = number_levels(level or "auto", force, None, frequency)  # type: ignore[arg-type]
    if not level:
        assumed.add("level", Fact("levels_counted", n=len(np.unique(number)), by=rule))
    return number, rule
