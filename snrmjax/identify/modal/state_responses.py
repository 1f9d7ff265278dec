"""Low-level steady states as a frequency response, and whether they are low enough."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.identify.modal.modal_fit import LinearModalFit
from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.frequency_responses import FrequencyResponses, frequency_responses
from snrmjax.measure.states import SteadyStates, relative_errors
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

_CERTAIN = 2.0  # standard errors of a difference between levels


class StateResponses(NamedTuple):
    """Velocity over force of one level."""

    responses: FrequencyResponses
    std: Float[np.ndarray, "response frequency"] | None  # of real and of imaginary part
    level: int
    velocity: float  # m/s, the largest


def levels_by_velocity(data: SteadyStates) -> list[int]:
    """The levels of a test, that of the smallest largest velocity first."""
    size = np.where(np.asarray(data.measured), np.abs(np.asarray(data.velocity)), 0.0).max(axis=1)
    level = np.asarray(data.level)
    return sorted(np.unique(level).tolist(), key=lambda number: size[level == number].max())


def responses_of_states(data: SteadyStates, level: int) -> StateResponses:
    """The mobilities of one level; states of one frequency are averaged.

    Raises `ValueError` for a level that is not there, for phases that were not measured and for
    states with neither a force nor a drive voltage.
    """
    rows = np.asarray(data.level) == level
    if not rows.any():
        listed = ", ".join(map(str, np.unique(np.asarray(data.level)).tolist()))
        raise ValueError(f"there is no level {level}; there are {listed}.")
    if np.any(np.asarray(data.phase_unknown)[rows]):
        raise ValueError("modes need phases, but velocities of amplitude alone were measured.")
    force = np.asarray(data.force)[rows]
    volts = not np.isfinite(force).any()
    if volts:
        force = np.asarray(data.drive)[rows]
    reference = Channel("drive", "voltage", "V") if volts else Channel("force", "force", "N")
    seen = np.asarray(data.measured)[rows]
    velocity = np.where(seen, np.asarray(data.velocity)[rows], np.nan)
    mobility = velocity / force[:, None]
    errors = np.asarray(relative_errors(data))[rows]
    stated = np.isfinite(errors).all(axis=2)
    parts = np.sqrt(np.nansum(errors**2, axis=2) / 2) * np.abs(mobility)
    known = bool(np.all(stated[seen]) and np.all(parts[seen] > 0))
    omega, place = np.unique(np.asarray(data.frequency)[rows], return_inverse=True)
    shape = (velocity.shape[1], len(omega))
    total, count, variance = np.zeros(shape, dtype=complex), np.zeros(shape), np.zeros(shape)
    for k, row in enumerate(place):
        total[:, row] += np.where(seen[k], mobility[k], 0.0)
        count[:, row] += seen[k]
        variance[:, row] += np.where(seen[k], parts[k] ** 2, 0.0)
    values = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    std = np.sqrt(variance) / np.maximum(count, 1)
    responses = frequency_responses(
        omega,
        values[:, None],
        [Channel(name, "velocity", "m/s") for name in data.sensors],
        [reference],
        name=f"level {level}",
    )
    largest = float(np.nanmax(np.abs(velocity)))
    return StateResponses(responses, std if known else None, level, largest)


def amplitude_dependence(
    lowest: LinearModalFit,
    next_level: LinearModalFit,
    velocities: tuple[float, float],
) -> tuple[LinearModalFit, tuple[Fact, ...]]:
    """Whether modes differ between the two lowest levels by more than their errors.

    Where one does, its value at no amplitude may differ from that of the lower level by the change
    times v₁/(v₂ − v₁), as if it grew with the amplitude: that is the error to add.

    Arguments: the largest velocity of each level, m/s, the lower first.
    Returns the fit at the lower level with these errors, and notes.
    """
    low, high = velocities
    rest = low / (high - low) if high > 1.01 * low else 1.0
    added, notes = np.zeros((2, lowest.n_modes)), []
    pairs = (
        (lowest.natural_frequency, next_level.natural_frequency),
        (lowest.damping_ratio, next_level.damping_ratio),
    )
    stds = (
        (lowest.natural_frequency_std, next_level.natural_frequency_std),
        (lowest.damping_ratio_std, next_level.damping_ratio_std),
    )
    for k, omega in enumerate(lowest.natural_frequency.tolist()):
        other = int(np.argmin(np.abs(next_level.natural_frequency - omega)))
        for row, (values, errors) in enumerate(zip(pairs, stds, strict=True)):
            change = float(values[1][other] - values[0][k])
            allowed = _CERTAIN * float(np.hypot(errors[1][other], errors[0][k]))
            if abs(change) > allowed:
                added[row, k] = abs(change) * rest
                at = {"mode": k + 1, "frequency_hz": omega / HERTZ, "of_damping": row == 1}
                sizes = {"change": change, "allowed": allowed, "left": float(added[row, k])}
                notes.append(Fact("amplitude_dependence", **at, **sizes, velocities=velocities))
    if not notes:
        notes.append(Fact("levels_agree"))
    covariance = lowest.mode_covariance.copy()
    covariance[:, (0, 1), (0, 1)] += added.T**2
    return dataclasses.replace(lowest, mode_covariance=covariance), tuple(notes)
