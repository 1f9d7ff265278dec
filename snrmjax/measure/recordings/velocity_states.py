"""From phasors of recorded channels to steady states: channels, velocities, levels."""

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Complex, Float, Int

from snrmjax.measure.recordings.channels import DERIVATIVE, Channel, channel_number
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.states import SteadyStates, steady_states
from snrmjax.model.moving_base import BaseMotion
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

Levels = Literal["auto", "force", "drive", "runs"]

_GAP = 0.05  # least gap of log amplitude between levels
_SPREAD = 0.4  # largest spread of log amplitude within a level, for plausible groups


class PhasorTable(NamedTuple):
    """Phasors of all states relative to the force, before conversion to velocities."""

    time: Float[np.ndarray, " state"]  # s, middle of the part used
    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N or V
    force_std: Float[np.ndarray, " state"]
    phasors: Complex[np.ndarray, "state channel order"]  # of the responses, orders 1, 2, …; SI
    mean: Float[np.ndarray, "state channel"]
    amplitude_std: Float[np.ndarray, "state channel"]  # SI
    phase_std: Float[np.ndarray, "state channel"]  # rad
    harmonic_std: Float[np.ndarray, "state channel order"]  # SI, rms of a complex error
    drive: Float[np.ndarray, " state"] | None = (
        None  # V, of another channel, for grouping into levels
    )


class ChosenChannels(NamedTuple):
    """Channels of a record in reading order: force, responses, drive."""

    names: tuple[str, ...]
    force: Channel
    responses: tuple[Channel, ...]
    sensors: tuple[str, ...]
    drive: str | None


def choose_channels(
    recording: TimeRecording,
    force: str,
    responses: Sequence[str],
    *,
    sensors: Sequence[str] | None = None,
    drive: str | None = None,
    is_base: bool = False,
) -> ChosenChannels:
    """The checked channels; with `is_base` the motion of a base takes the place of the force.

    Raises `ValueError` for unknown and repeated names, a force that is not a force or voltage,
    responses that are not a motion, and a wrong number of sensors.
    """
    wanted = (responses,) if isinstance(responses, str) else tuple(responses)
    if not wanted:
        raise InputError("`responses` must name at least one channel, but is empty.")
    source = recording.channels[_number(recording, force, "force")]
    if is_base and source.quantity not in DERIVATIVE:
        raise InputError(
            f"channel {force} must be the motion of a base, but its quantity is {source.quantity}."
        )
    if not is_base and source.quantity not in ("force", "voltage"):
        raise InputError(
            f"channel {force} must be a force or the voltage that drives one, but its quantity is "
            f"{source.quantity}."
        )
    motions = tuple(recording.channels[_number(recording, name, "response")] for name in wanted)
    for channel in motions:
        if channel.quantity not in DERIVATIVE:
            raise InputError(
                f"channel {channel.name} must be a displacement, velocity or acceleration, but its "
                f"quantity is {channel.quantity}."
            )
    names = (force, *wanted)
    if len(set(names)) != len(names):
        raise InputError(f"each channel can be named once, but got {', '.join(names)}.")
    if drive is not None:
        _number(recording, drive, "drive")
    labels = wanted if sensors is None else tuple(sensors)
    if len(labels) != len(wanted) or len(set(labels)) != len(labels):
        raise InputError(
            f"`sensors` must name each of the {len(wanted)} responses once, but is "
            f"{', '.join(labels) or 'empty'}."
        )
    extra = () if drive is None or drive in names else (drive,)
    return ChosenChannels((*names, *extra), source, motions, labels, drive)


def velocity_factors(
    channels: Sequence[Channel], orders: Sequence[int], frequency: Float[np.ndarray, "*batch"]
) -> Complex[np.ndarray, "*batch channel order"]:
    """Factors from phasors of each channel to velocities: (ikΩ) for displacements, 1/(ikΩ) for
    accelerations. NaN for the mean of an acceleration, which does not determine the velocity.
    """
    power = 1 - np.array([DERIVATIVE[channel.quantity] for channel in channels])[:, None]
    derivative = 1j * np.asarray(orders) * np.asarray(frequency, dtype=float)[..., None, None]
    safe = np.where(derivative == 0, 1.0, derivative)
    at_rest = np.where(power == 0, 1.0, np.where(power > 0, 0.0, np.nan))
    return np.where(derivative == 0, at_rest, safe**power)


def states_of_phasors(
    recording: TimeRecording,
    chosen: ChosenChannels,
    table: PhasorTable,
    orders: tuple[int, ...],
    level: Levels | int,
    notes: Sequence[Fact] = (),
) -> SteadyStates:
    """Steady states from phasors of any motion, in the order of the table.

    For base excitation any recorded motion is converted to acceleration, the phase reference.
    """
    higher = tuple(k for k in orders if k != 1)
    phasors = np.concatenate([table.mean[:, :, None], table.phasors], axis=2)
    base = chosen.force.quantity in DERIVATIVE
    if base:
        lead = (1j * table.frequency) ** (2 - DERIVATIVE[chosen.force.quantity])
        rotation = np.exp(-1j * np.angle(lead)[:, None] * np.arange(phasors.shape[2]))
        phasors = phasors * rotation[:, None, :]
        table = table._replace(
            force=table.force * np.abs(lead), force_std=table.force_std * np.abs(lead)
        )
    spread = np.concatenate([np.full_like(table.mean, np.nan)[:, :, None], table.harmonic_std], 2)
    factors = velocity_factors(chosen.responses, range(phasors.shape[2]), table.frequency)
    velocity = phasors * factors
    noisy = [k for k in higher if k > 0]
    floor = None
    if noisy:
        floor = np.sqrt(np.mean((spread * np.abs(factors))[:, :, noisy] ** 2, axis=2))
    volts = chosen.force.quantity == "voltage"
    number, rule = number_levels(level, table.force, table.drive, table.frequency)
    numbered = (Fact("levels_numbered", by=rule),) if rule else ()
    unknown = np.full(len(table.force), np.nan)
    states = steady_states(
        number,
        table.frequency,
        unknown if volts else table.force,
        velocity[:, :, 1],
        sensors=chosen.sensors,
        velocity_std=table.amplitude_std * np.abs(factors[:, :, 1]),
        phase_std=table.phase_std,
        force_std=unknown if volts else table.force_std,
        drive=table.force if volts else unknown,
        order=np.clip((table.time - recording.start_time) / recording.duration, 0, 1),
        harmonics=velocity[:, :, list(higher)],
        harmonic_std=floor,
        harmonic_order=higher,
        base=BaseMotion("relative") if base else None,
    )
    return dataclasses.replace(states, notes=(*notes, *numbered))


def number_levels(
    level: Levels | int,
    force: Float[np.ndarray, " state"],
    drive: Float[np.ndarray, " state"] | None,
    frequency: Float[np.ndarray, " state"],
) -> tuple[Int[np.ndarray, " state"], str]:
    """The level of each state, from 1 on, and the rule by which they were numbered, if any.

    A number is the level of all; *force* and *drive* group the states by that amplitude, in
    ascending order; *runs* begins a new level where the frequency reverses or jumps back; *auto*
    uses the drive if there is one, otherwise the force if its groups are distinct, otherwise runs.
    """
    if not isinstance(level, str):
        if isinstance(level, bool) or int(level) != level:
            raise InputError(f"`level` must be a whole number or a word, but is {level!r}.")
        return np.full(len(frequency), int(level)), ""
    if level not in get_args(Levels):
        raise InputError(f"`level` must be one of {get_args(Levels)} or a number, not {level!r}.")
    if level == "drive" and drive is None:
        raise InputError("`level='drive'` needs the channel of the drive: state `drive`.")
    if level == "drive" or (level == "auto" and drive is not None):
        return _groups(drive)[0], "drive"
    groups, spread = _groups(force)
    if level == "force" or (level == "auto" and spread < _SPREAD):
        return groups, "force"
    return _runs(frequency), "runs"


def _number(recording: TimeRecording, name: str, what: str) -> int:
    try:
        return channel_number(recording.channels, name)
    except InputError as error:
        raise InputError(f"the {what} channel is missing: {error}") from error


def _groups(amplitude: Float[np.ndarray, " state"] | None) -> tuple[np.ndarray, float]:
    """Levels by gaps between sorted log amplitudes, and the largest spread of a level."""
    level = np.log(np.asarray(amplitude, dtype=float))
    order = np.argsort(level, kind="stable")
    steps = np.diff(level[order])
    # A gap is larger than the steps within a level.
    within = np.median(steps) if len(steps) else 0.0
    cut = steps > max(_GAP, 5 * within)
    number = np.empty(len(level), dtype=int)
    number[order] = 1 + np.concatenate([[0], np.cumsum(cut)])
    spread = max(float(np.ptp(level[number == k])) for k in np.unique(number))
    return number, spread


def _runs(frequency: np.ndarray) -> np.ndarray:
    """A new level where the frequency reverses or jumps by several steps."""
    steps = np.diff(frequency)
    typical = np.median(np.abs(steps)) if len(steps) else 0.0
    number, direction, numbers = 1, 0.0, [1]
    for step in steps:
        reverses = direction != 0 and np.sign(step) != direction and step != 0
        leaps = abs(step) > 3 * typical
        if reverses or leaps:
            number, direction = number + 1, 0.0
        elif step != 0:
            direction = float(np.sign(step))
        numbers.append(number)
    return np.array(numbers)
