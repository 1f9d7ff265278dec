"""Classify a time record as free decay, stepped sine, slow sweep or broadband, by stated rules.

1. A record without an acting force or drive is a free decay if, from its largest value on, its
   motion decreases from each eighth of the record to the next.
2. Where the drive (else the force) stops for 12 cycles or more, and these stretches are a third
   of the record, they are free decays.
3. A drive that is a single tone, with little change of amplitude from one frame of 3 to 6 cycles
   to the next, is a stepped sine if 30 % of it are steps of 10 cycles or more whose frequency
   varies by less than half of the change from step to step; and a slow sweep if its frequency
   changes by 2 % in one direction.
4. Any other force is broadband; but if the motion decreases as in rule 1 the force is noise of
   its channel, and the record is a free decay.
"""

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.measure.decays.isolated_decay import IsolatedDecay
from snrmjax.measure.recordings.ring_down import find_ring_downs
from snrmjax.measure.recordings.steps import moves_within_steps, recognise_steps
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.recordings.tone_track import ToneTrack, track_tone, unwrapped_phase
from snrmjax.measure.sweeps.sweep_runs import sweep_runs
from snrmjax.model.modes import LinearModes, reference_sensor
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_MOTIONS = ("velocity", "acceleration", "displacement")
_PARTS = 8
_RISE = 0.05  # of the first part's rms: allowed increase from part to part (noise, beats)
_DECAYED = 0.95  # of the first part's rms: upper limit of the last
_FREE = 1 / 3  # least fraction of a record without drive
_TONE_COVERS = 0.5  # of the record
_TONE_AMPLITUDE = 0.05  # median change of log amplitude from frame to frame
_TONE_FREQUENCY = 0.02  # median relative change of frequency
_STEP_CYCLES = 10
_STEPS_COVER = 0.3
_MOVES = 0.5
_FAR = 2.0  # ratio to the mode's frequency beyond which it is another mode, or time not in s
_LEAST_POWER = 0.01  # of a decay's power near the mode's frequency
_BAND = (0.01, 0.99)  # of the force's power: what a broadband test excites
_MOST_SAMPLES = 2**20  # samples whose spectrum is taken


class RecordKind(StrEnum):
    """Kind of test that a time record holds."""

    FREE_DECAY = "free decay"
    STEPPED_SINE = "stepped sine"
    SLOW_SWEEP = "slow sweep"
    BROADBAND = "broadband"


class RecordChannels(NamedTuple):
    """Channels of a record by their role in the test; motions in the order of `sensors`."""

    force: str | None
    drive: str | None
    motions: tuple[str, ...]
    sensors: tuple[str, ...]  # of the model
    reference: str  # motion at the sensor with the largest mode shape component


class RecordedDecay(NamedTuple):
    """The isolated mode of one free decay, or why there is none."""

    decay: IsolatedDecay | None
    notes: tuple[Fact, ...]
    why: str = ""


class RecordedTest(NamedTuple):
    """A time record, its kind, and the rule that decided."""

    recording: TimeRecording
    channels: RecordChannels
    kind: RecordKind
    why: Fact  # the rule
    free: tuple[tuple[int, int], ...] = ()  # samples of free decays, start and stop
    frequency: float = np.nan  # rad/s, strongest line of the motion
    decays: tuple[RecordedDecay, ...] = ()  # of free decays, once isolated


def recorded_test(recording: TimeRecording, modes: LinearModes) -> RecordedTest:
    """Classify a time record by the rules of this module.

    Arguments: `recording` has at most one force, at most one drive voltage, and motions whose
    channels are named after sensors of `modes` (by `point`, by name or by both); a single motion
    without such a name belongs to the sensor with the largest mode shape component.
    Returns a `RecordedTest`. Raises `ValueError`, with the record's name, for unsuitable channels,
    samples that are not finite, a motion or drive far from the mode's frequency (time not in
    seconds, another structure), a single tone, and a record of no known kind.
    """
    channels = _channels(recording, modes)
    rest = modes.natural_frequency.item(modes.mode_of_interest)
    motion = recording.values([channels.reference], 0, _MOST_SAMPLES)[0]
    if not np.isfinite(motion).all():
        raise InputError(
            f"{recording.name}: channel {channels.reference} has samples that are not finite."
        )
    if not np.ptp(motion) > 0:
        raise InputError(f"{recording.name}: channel {channels.reference} does not move.")
    frequency = _strongest(motion, recording.sampling_rate)
    guide = channels.drive or channels.force
    acting = guide is not None and bool(np.ptp(recording.values([guide], 0, _MOST_SAMPLES)[0]) > 0)
    fall = _decay_of(motion)
    if guide is None or not acting:
        if fall.decays:
            frequency = _decay_frequency(motion, fall, recording.sampling_rate, rest)
        return _undriven(recording, channels, frequency, rest, fall, len(motion))
    free = _free_stretches(recording, guide, channels.reference)
    if sum(stop - start for start, stop in free) >= _FREE * recording.n_samples:
        _require_near_mode(recording, frequency, frequency, rest)
        why = Fact("drive_stops", channel=guide, n=len(free))
        return RecordedTest(recording, channels, RecordKind.FREE_DECAY, why, free, frequency)
    track = _tone(recording, guide)
    if track is not None:
        omega = track.frequency * recording.sampling_rate
        _require_near_mode(recording, float(omega.min()), float(omega.max()), rest)
        kind, why = _tone_kind(recording, guide, track)
        return RecordedTest(recording, channels, kind, why, (), frequency)
    if fall.decays:
        why = Fact("motion_decays_under_noise", channel=guide)
        parts = ((fall.start, len(motion)),)
        frequency = _decay_frequency(motion, fall, recording.sampling_rate, rest)
        return RecordedTest(recording, channels, RecordKind.FREE_DECAY, why, parts, frequency)
    low, high = _band(recording.values([guide], 0, _MOST_SAMPLES)[0], recording.sampling_rate)
    _require_near_mode(recording, low, high, rest)
    why = Fact("drive_is_no_tone", channel=guide, low_hz=low / HERTZ, high_hz=high / HERTZ)
    return RecordedTest(recording, channels, RecordKind.BROADBAND, why, (), frequency)


def _channels(recording: TimeRecording, modes: LinearModes) -> RecordChannels:
    """Channels by quantity, and their sensors."""
    kept = {
        kind: [channel for channel in recording.channels if channel.quantity == kind]
        for kind in ("force", "voltage")
    }
    for kind, channels in kept.items():
        if len(channels) > 1:
            raise InputError(
                f"{recording.name} has several channels of {kind} "
                f"({', '.join(each.name for each in channels)}): keep the one that drives the mode."
            )
    motions = [channel for channel in recording.channels if channel.quantity in _MOTIONS]
    if not motions:
        listed = ", ".join(map(str, recording.channels))
        raise InputError(
            f"{recording.name} has no channel of motion, but {listed}: state units, or name it "
            "velocity_m_s, acceleration_m_s2 or displacement_m."
        )
    at: dict[str, str] = {}
    for channel in motions:
        for sensor in modes.sensors:
            point_name = f"{channel.point}{channel.direction}"
            names = (channel.point, channel.name, point_name, f"{channel.name}:{point_name}")
            if sensor in names:  # the last is the name in UFF files
                at.setdefault(sensor, channel.name)
    reference = modes.sensors[reference_sensor(modes)]
    if not at and len(motions) == 1 and not motions[0].point:
        at = {reference: motions[0].name}
    if reference not in at:
        raise InputError(
            f"{recording.name} has no motion of the sensor {reference}, where the mode moves most, "
            f"but {', '.join(channel.name for channel in motions)}."
        )
    force, drive = (channels[0].name if channels else None for channels in kept.values())
    return RecordChannels(force, drive, tuple(at.values()), tuple(at), at[reference])


class _Decay(NamedTuple):
    start: int  # of the largest value
    decays: bool
    last: float  # rms of the last part over that of the first


def _decay_of(motion: Float[np.ndarray, " sample"]) -> _Decay:
    """Whether, from its largest value on, a motion decreases from each eighth to the next."""
    centred = motion - motion.mean()
    start = int(np.argmax(np.abs(centred)))
    length = (len(motion) - start) // _PARTS
    if start > len(motion) // 2 or not length:
        return _Decay(start, False, 1.0)
    parts = centred[start : start + _PARTS * length].reshape(_PARTS, length)
    rms = np.sqrt(np.mean(parts**2, axis=1))
    falls = bool(np.all(np.diff(rms) < _RISE * rms[0])) and bool(rms[-1] < _DECAYED * rms[0])
    return _Decay(start, falls, float(rms[-1] / rms[0]))


def _undriven(
    recording: TimeRecording,
    channels: RecordChannels,
    frequency: float,
    rest: float,
    fall: _Decay,
    count: int,
) -> RecordedTest:
    if not fall.decays:
        raise InputError(
            f"{recording.name} has no force or drive that acts, and its motion does not decay "
            f"(its last eighth has {100 * fall.last:.3g} % of the first): it is neither a free "
            "decay nor a forced test."
        )
    _require_near_mode(recording, frequency, frequency, rest)
    why = Fact("motion_falls_undriven")
    free = ((fall.start, recording.n_samples if count < _MOST_SAMPLES else count),)
    return RecordedTest(recording, channels, RecordKind.FREE_DECAY, why, free, frequency)


def _free_stretches(
    recording: TimeRecording, guide: str, motion: str
) -> tuple[tuple[int, int], ...]:
    """Stretches without drive, from one cycle after its stop on; none where it never stops."""
    try:
        ring_downs = find_ring_downs(recording, guide, motion)
    except InputError:  # the drive never stops; other causes were excluded before
        return ()
    return tuple(
        (free.start + int(np.ceil(HERTZ * recording.sampling_rate / free.frequency)), free.stop)
        for free in ring_downs
    )


def _tone(recording: TimeRecording, guide: str) -> ToneTrack | None:
    """The track of a drive that is one slowly varying tone, or None."""
    try:
        track = track_tone(recording, guide)
    except InputError:  # no frame holds a tone
        return None
    if len(track.middle) < 3 or np.sum(track.length) / 2 < _TONE_COVERS * recording.n_samples:
        return None
    amplitude = np.median(np.abs(np.diff(np.log(track.amplitude))))
    frequency = np.median(np.abs(np.diff(np.log(track.frequency))))
    return track if amplitude < _TONE_AMPLITUDE and frequency < _TONE_FREQUENCY else None


def _tone_kind(recording: TimeRecording, guide: str, track: ToneTrack) -> tuple[RecordKind, Fact]:
    rate = recording.sampling_rate
    steps = [
        step
        for step in recognise_steps(track, rate, least_amplitude_step=0.05, least_step=0.0)
        if (step.stop - step.start) * step.frequency / HERTZ / rate >= _STEP_CYCLES
    ]
    covered = sum(step.stop - step.start for step in steps) / max(float(np.ptp(track.middle)), 1.0)
    stays = moves_within_steps(steps, track, rate) < _MOVES
    if len(steps) > 1 and covered >= _STEPS_COVER and stays:
        return RecordKind.STEPPED_SINE, Fact("tone_in_steps", channel=guide, n=len(steps))
    runs = sweep_runs(track, unwrapped_phase(track))
    if runs:
        return RecordKind.SLOW_SWEEP, Fact("tone_that_moves", channel=guide, n=len(runs))
    raise InputError(
        f"{recording.name}: {guide} is a single tone of "
        f"{np.median(track.frequency) * rate / HERTZ:.5g} Hz, which gives no backbone."
    )


def _spectrum(values: Float[np.ndarray, " sample"], rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies in rad/s and power."""
    power = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(len(values)))) ** 2
    return HERTZ * np.fft.rfftfreq(len(values), 1 / rate), power


def _strongest(motion: Float[np.ndarray, " sample"], rate: float) -> float:
    omega, power = _spectrum(motion, rate)
    return float(omega[1 + int(np.argmax(power[1:]))])


def _decay_frequency(
    motion: Float[np.ndarray, " sample"], fall: _Decay, rate: float, rest: float
) -> float:
    """Strongest frequency of a decay, in rad/s; its start, where it is largest, weighs most.

    Searched near the mode's frequency if 1 % of the power is there: another mode may be larger.
    """
    decaying = motion[fall.start :] - motion.mean()
    window = np.hanning(2 * len(decaying))[len(decaying) :]
    power = np.abs(np.fft.rfft(decaying * window)) ** 2
    omega = HERTZ * np.fft.rfftfreq(len(decaying), 1 / rate)
    near = (omega > rest / _FAR) & (omega < rest * _FAR)
    if power[near].sum() > _LEAST_POWER * power[1:].sum():
        power = np.where(near, power, 0.0)
    return float(omega[1 + int(np.argmax(power[1:]))])


def _band(force: Float[np.ndarray, " sample"], rate: float) -> tuple[float, float]:
    omega, power = _spectrum(force, rate)
    fraction = np.cumsum(power) / np.sum(power)
    low, high = (float(omega[np.searchsorted(fraction, edge)]) for edge in _BAND)
    return low, high


def _require_near_mode(recording: TimeRecording, low: float, high: float, rest: float) -> None:
    if low / _FAR <= rest <= high * _FAR:
        return
    where = f"{low / HERTZ:.4g}" if high == low else f"{low / HERTZ:.4g} to {high / HERTZ:.4g}"
    raise InputError(
        f"{recording.name} is at {where} Hz, but the mode of interest is at "
        f"{rest / HERTZ:.4g} Hz: is its time in seconds, and is it a test of this mode?"
    )
