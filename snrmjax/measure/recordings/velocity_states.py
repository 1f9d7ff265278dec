"""From phasors of recorded channels to steady states: which channels, velocities, levels."""

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

Levels = Literal["auto", "force", "drive", "runs"]

_GAP = 0.05  # of log amplitude between levels, at least
_SPREAD = 0.4  # of log amplitude within a level, at most, where groups are to be believed


class PhasorTable(NamedTuple):
    """Phasors of all states, relative to the force, before they are velocities."""

    time: Float[np.ndarray, " state"]  # s, middle of what was used
    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N or V
    force_std: Float[np.ndarray, " state"]
    phasors: Complex[np.ndarray, "state channel order"]  # of the responses, orders 1, 2, …; SI
    mean: Float[np.ndarray, "state channel"]
    amplitude_std: Float[np.ndarray, "state channel"]  # SI
    phase_std: Float[np.ndarray, "state channel"]  # rad
    harmonic_std: Float[np.ndarray, "state channel order"]  # SI, rms of a complex error
    drive: Float[np.ndarray, " state"] | None = None  # V, of another channel, to group levels


class ChosenChannels(NamedTuple):
    """Channels of a record in the order in which they are read: force, responses, drive."""

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
    """The channels of a verb, checked; `is_base`: what stands for the force is a base's motion.

    Raises `ValueError` for names that no channel has, doubled ones, a force that is no force or
    voltage, responses that are no motion, and sensors of another number.
    """
    wanted = (responses,) if isinstance(responses, str) else tuple(responses)
    if not wanted:
        raise ValueError("`responses` must name one channel at least, but is empty.")
    source = recording.channels[_number(recording, force, "force")]
    if is_base and source.quantity not in DERIVATIVE:
        raise ValueError(
            f"channel {force} must be the motion of a base, but its quantity is {source.quantity}."
        )
    if not is_base and source.quantity not in ("force", "voltage"):
        raise ValueError(
            f"channel {force} must be a force or the voltage that drives one, but its quantity is "
            f"{source.quantity}."
        )
    motions = tuple(recording.channels[_number(recording, name, "response")] for name in wanted)
    for channel in motions:
        if channel.quantity not in DERIVATIVE:
            raise ValueError(
                f"channel {channel.name} must be a displacement, velocity or acceleration, but its "
                f"quantity is {channel.quantity}."
            )
    names = (force, *wanted)
    if len(set(names)) != len(names):
        raise ValueError(f"each channel can be named once, but got {', '.join(names)}.")
    if drive is not None:
        _number(recording, drive, "drive")
    labels = wanted if sensors is None else tuple(sensors)
    if len(labels) != len(wanted) or len(set(labels)) != len(labels):
        raise ValueError(
            f"`sensors` must name each of the {len(wanted)} responses once, but is "
            f"{', '.join(labels) or 'empty'}."
        )
    extra = () if drive is None or drive in names else (drive,)
    return ChosenChannels((*names, *extra), source, motions, labels, drive)


def velocity_factors(
    channels: Sequence[Channel], orders: Sequence[int], frequency: Float[np.ndarray, "*batch"]
) -> Complex[np.ndarray, "*batch channel order"]:
    """What turns phasors of each channel into velocities: (ikΩ) for displacements, 1/(ikΩ) for
    accelerations. The mean of an acceleration says nothing of the velocity: NaN.
    """
    power = 1 - np.array([DERIVATIVE[channel.quantity] for channel in channels])[:, None]
    turn = 1j * np.asarray(orders) * np.asarray(frequency, dtype=float)[..., None, None]
    safe = np.where(turn == 0, 1.0, turn)
    at_rest = np.where(power == 0, 1.0, np.where(power > 0, 0.0, np.nan))
    return np.where(turn == 0, at_rest, safe**power)


def states_of_phasors(
    recording: TimeRecording,
    chosen: ChosenChannels,
    table: PhasorTable,
    orders: tuple[int, ...],
    level: Levels | int,
    notes: Sequence[Fact] = (),
) -> SteadyStates:
    """Steady states of phasors of any motion, in the order of the table.

    Of a base whatever was recorded becomes its acceleration, from which phases then count.
    """
    higher = tuple(k for k in orders if k != 1)
    phasors = np.concatenate([table.mean[:, :, None], table.phasors], axis=2)
    base = chosen.force.quantity in DERIVATIVE
    if base:
        lead = (1j * table.frequency) ** (2 - DERIVATIVE[chosen.force.quantity])
        turns = np.exp(-1j * np.angle(lead)[:, None] * np.arange(phasors.shape[2]))
        phasors = phasors * turns[:, None, :]
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
    """The level of each state, from 1 on, and the word by which they were numbered, if any.

    A number is the level of all; *force* and *drive* group the states by that amplitude, from the
    smallest on; *runs* begins a new level where the frequency turns back to where a run began;
    *auto* takes the drive where there is one, else the force where its groups stand apart, else
    runs.
    """
    if not isinstance(level, str):
        if isinstance(level, bool) or int(level) != level:
            raise ValueError(f"`level` must be a whole number or a word, but is {level!r}.")
        return np.full(len(frequency), int(level)), ""
    if level not in get_args(Levels):
        raise ValueError(f"`level` must be one of {get_args(Levels)} or a number, not {level!r}.")
    if level == "drive" and drive is None:
        raise ValueError("`level='drive'` needs the channel of the drive: state `drive`.")
    if level == "drive" or (level == "auto" and drive is not None):
        return _groups(drive)[0], "drive"
    groups, spread = _groups(force)
    if level == "force" or (level == "auto" and spread < _SPREAD):
        return groups, "force"
    return _runs(frequency), "runs"


def _number(recording: TimeRecording, name: str, what: str) -> int:
    try:
        return channel_number(recording.channels, name)
    except ValueError as error:
        raise ValueError(f"the {what} channel is missing: {error}") from error


def _groups(amplitude: Float[np.ndarray, " state"] | None) -> tuple[np.ndarray, float]:
    """Levels by gaps between sorted log amplitudes, and the widest level's spread."""
    level = np.log(np.asarray(amplitude, dtype=float))
    order = np.argsort(level, kind="stable")
    steps = np.diff(level[order])
    # A gap is larger than steps within a level are.
    within = np.median(steps) if len(steps) else 0.0
    cut = steps > max(_GAP, 5 * within)
    number = np.empty(len(level), dtype=int)
    number[order] = 1 + np.concatenate([[0], np.cumsum(cut)])
    spread = max(float(np.ptp(level[number == k])) for k in np.unique(number))
    return number, spread


def _runs(frequency: np.ndarray) -> np.ndarray:
    """A new level where the frequency jumps back against its direction by several steps."""
    steps = np.diff(frequency)
    typical = np.median(np.abs(steps)) if len(steps) else 0.0
    number, direction, numbers = 1, 0.0, [1]
    for step in steps:
        turns = direction != 0 and np.sign(step) != direction and step != 0
        leaps = abs(step) > 3 * typical
        if turns or leaps:
            number, direction = number + 1, 0.0
        elif step != 0:
            direction = float(np.sign(step))
        numbers.append(number)
    return np.array(numbers)
