"""Steady states from the time record of a stepped sine."""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from snrmjax.measure.recordings.block_phasors import BlockPhasors, block_phasors
from snrmjax.measure.recordings.settling import (
    Means,
    mean_phasors,
    moves,
    settled_part,
    steady_frequency,
)
from snrmjax.measure.recordings.step_counts import FEWEST_CYCLES, RecordStatus, StepCounts
from snrmjax.measure.recordings.steps import Step, moves_within_steps, recognise_steps
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.recordings.tone_track import check_rate, track_tone
from snrmjax.measure.recordings.velocity_states import (
    ChosenChannels,
    Levels,
    PhasorTable,
    choose_channels,
    states_of_phasors,
)
from snrmjax.measure.signals import require_fundamental
from snrmjax.measure.states import SteadyStates
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, quantity, setting
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_HIGHEST = 3  # least number of fitted harmonics, so that they do not count as noise
_NEAR_TABLE = 0.5  # permitted error of a table's frequency, cycles over a step
_BEYOND = 3.0  # times the median residual: the block extends beyond the step
_MOVES = 0.5  # drift within a step over the distance to the next: a sweep in pieces
_COVERED = 0.3  # least fraction of the time with a tone that steps cover
_TRIES = 5  # candidate starts of the settled part
_QUIET = 1e-3  # of the largest force: a pause


class SteppedSineStates(AbstractResult):
    """Steps of a record and the steady states of those that settled; see `stepped_sine_states`."""

    coordinates: ClassVar[tuple[str, ...]] = ("step",)

    states: SteadyStates
    start: Float[np.ndarray, " step"] = quantity("step", "s", "its start", name="start_s")
    stop: Float[np.ndarray, " step"] = quantity("step", "s", "its end", name="stop_s")
    # NaN if it did not settle.
    settled_from: Float[np.ndarray, " step"] = quantity(
        "step", "s", "start of the part used", name="settled_from_s"
    )
    frequency: Float[np.ndarray, " step"] = quantity("step", "Hz", "frequency of the force")
    force: Float[np.ndarray, " step"] = quantity("step", "N or V", "amplitude of the force")
    # NaN if no transient was detected.
    decay_time: Float[np.ndarray, " step"] = quantity(
        "step", "s", "decay time of the transient", name="decay_time_s"
    )
    moved: Float[np.ndarray, " step"] = quantity("step", "1", "relative drift of a phasor")
    noise_to_white_ratio: Float[np.ndarray, " step"] = quantity(
        "step", "1", "scatter of blocks over white noise's"
    )
    state: Int[np.ndarray, " step"] = quantity("step", "1", "row of the steady states, -1: none")
    status: Int[np.ndarray, " step"] = quantity("step", "", "whether it settled", of=RecordStatus)
    notes: tuple[Fact | str, ...] = setting(default=())

    @property
    def counts(self) -> StepCounts:
        """Numbers of used steps, and of omitted ones by reason."""
        left = {
            kind.name.lower().replace("_", " "): int(np.sum(self.status == int(kind)))
            for kind in RecordStatus
            if kind is not RecordStatus.SETTLED and np.any(self.status == int(kind))
        }
        return StepCounts(self.states.n_states, left)


class _Measured(NamedTuple):
    """The evaluation of one step."""

    step: Step
    status: RecordStatus
    settled_from: float = np.nan
    decay_time: float = np.nan
    moved: float = np.nan
    transient: Float[np.ndarray, " channel"] | None = None
    means: Means | None = None
    middle: float = np.nan  # s, of the part used
    drive: float = np.nan  # amplitude of the drive's channel


def stepped_sine_states(
    recording: TimeRecording,
    force: str,
    responses: Sequence[str],
    *,
    harmonic_order: Sequence[int] = (1, 2, 3),
    level: Levels | int = "auto",
    sensors: Sequence[str] | None = None,
    frequencies: Sequence[tuple[float, float, float]] | None = None,
    settle: float | None = None,
    drive: str | None = None,
    tolerance: float = 2e-3,
    least_amplitude_step: float = 0.05,
    least_frequency_step: float = 0.0,
    is_base: bool = False,
) -> SteppedSineStates:
    """Steady states from the time record of a stepped sine.

    Steps of frequency or amplitude are detected from phase and amplitude of the drive; in each the
    transient is discarded, and harmonics are fitted by least squares to the rest.

    Arguments: `force` names the channel of the force (N), or of a voltage in its place (the
    states then have `drive` in place of `force`); `responses` the channels of motion, converted to
    velocities by iΩ; `level` as in `number_levels`; `sensors` names the responses in the states;
    `frequencies` is a table of steps, (start in s, end in s, frequency in rad/s), in place of
    detection; `settle` in s is discarded at the start of every step instead of the detected
    transient; `drive` names the channel for the detection of steps and levels, best the voltage of
    the generator; `tolerance` is the largest relative drift of a phasor over the part used;
    `least_amplitude_step` (relative) and `least_frequency_step` in rad/s are the smallest steps of
    the test; with `is_base`, `force` names the motion of a base, whose acceleration (m/s²) then
    takes the place of the force.
    Returns `SteppedSineStates`: `states` in the order of time, with standard deviations (the
    larger of those from white noise and from the scatter of blocks), harmonics and `order`; and
    the table of steps, with the reasons of omitted ones.
    Raises `ValueError` for unsuitable channels, a record without steps or with a single one
    (state `frequencies` for a single tone), a table beyond the record, fewer than four samples per
    cycle, harmonics above half the sampling rate, and a record without any settled step.
    Validity: 1σ is valid for white or coloured noise with a correlation time well below a sixteenth
    of the settled part; dwells of at least ten cycles, twenty for the detection of steps.

    >>> from snrmjax.measure import Channel, time_recording
    >>> t = np.arange(4000) / 1000
    >>> turn = 2 * np.pi * np.where(t < 2, 20 * t, 21 * t - 2)
    >>> record = time_recording(
    ...     np.stack([2 * np.cos(turn), 0.1 * np.cos(turn + 0.2)]),
    ...     [Channel("load cell", "force"), Channel("tip", "velocity")], 1000)
    >>> found = stepped_sine_states(record, "load cell", ["tip"])
    >>> found.states.force.round(3).tolist(), np.angle(found.states.velocity).round(3).tolist()
    ([2.0, 2.0], [[0.2], [0.2]])
    """
    orders = require_fundamental("harmonic_order", harmonic_order)
    chosen = choose_channels(
        recording, force, responses, sensors=sensors, drive=drive, is_base=is_base
    )
    if frequencies is None:
        steps = _recognised(recording, chosen, least_amplitude_step, least_frequency_step)
    else:
        steps = _of_table(recording, frequencies)
    for step in steps:
        check_rate(recording, step.frequency, force)
    _check_highest(recording, steps, orders)
    measured = [
        _measure(recording, chosen, step, orders, settle, tolerance, frequencies is not None)
        for step in steps
    ]
    measured = _without_pauses(measured)
    return _result(recording, chosen, measured, orders, level)


def _recognised(
    recording: TimeRecording, chosen: ChosenChannels, amplitude_step: float, frequency_step: float
) -> list[Step]:
    if not 0 < amplitude_step < 1 or not frequency_step >= 0:
        raise InputError(
            "`least_amplitude_step` must be between 0 and 1 and `least_frequency_step` not below "
            f"0, but they are {amplitude_step:g} and {frequency_step:g}."
        )
    name = chosen.drive or chosen.force.name
    track = track_tone(recording, name)
    steps = recognise_steps(
        track,
        recording.sampling_rate,
        least_amplitude_step=amplitude_step,
        least_step=frequency_step,
    )
    long = [step for step in steps if _cycles(recording, step) >= FEWEST_CYCLES]
    if sum(step.stop - step.start for step in long) < _COVERED * np.ptp(track.middle):
        raise InputError(
            f"the record has no steps: the tone of channel {name} does not dwell at one frequency "
            f"for {FEWEST_CYCLES} cycles anywhere (a sweep? `sweep_states` reads it)."
        )
    if len(long) == 1:
        raise InputError(
            f"the record has one step only, of {long[0].frequency / HERTZ:.6g} Hz from "
            f"{long[0].start / recording.sampling_rate:.4g} s on: state `frequencies` where a "
            "single tone is meant."
        )
    moves = moves_within_steps(long, track, recording.sampling_rate)
    if moves > _MOVES:
        raise InputError(
            f"the record has no steps: the frequency of channel {name} drifts within them, by "
            f"{100 * moves:.0f} % of the way to the next (a sweep? `sweep_states` reads it)."
        )
    return steps


def _of_table(
    recording: TimeRecording, frequencies: Sequence[tuple[float, float, float]]
) -> list[Step]:
    table = np.asarray(frequencies, dtype=float)
    if table.ndim != 2 or table.shape[1:] != (3,) or not len(table):
        raise InputError(
            "`frequencies` must have rows of start (s), end (s) and frequency (rad/s), but has "
            f"shape {table.shape}."
        )
    begin, end = recording.start_time, recording.start_time + recording.duration
    slack = 1.5 / recording.sampling_rate
    steps = []
    for k, (start, stop, omega) in enumerate(table):
        if not (np.isfinite([start, stop, omega]).all() and start < stop and omega > 0):
            raise InputError(
                f"row {k} of `frequencies` must have start < end and a frequency above 0, "
                f"but is {start:g} s, {stop:g} s, {omega:g} rad/s."
            )
        if start < begin - slack or stop > end + slack:
            raise InputError(
                f"row {k} of `frequencies` lies beyond the record: {start:g} to {stop:g} s, but "
                f"the record goes from {begin:g} to {end:g} s."
            )
        first = max(0, int(np.ceil((start - begin) * recording.sampling_rate - 1e-6)))
        last = min(recording.n_samples, int((stop - begin) * recording.sampling_rate + 1e-6))
        steps.append(Step(first, last, float(omega), np.nan))
    return steps


def _check_highest(
    recording: TimeRecording, steps: Sequence[Step], orders: tuple[int, ...]
) -> None:
    highest = max(step.frequency for step in steps) * max(orders)
    if highest >= np.pi * recording.sampling_rate:
        raise InputError(
            f"harmonic {max(orders)} of {highest / max(orders) / HERTZ:.6g} Hz lies above half "
            f"the sampling rate, {recording.sampling_rate / 2:.6g} Hz: ask for fewer harmonics."
        )


def _cycles(recording: TimeRecording, step: Step) -> float:
    return (step.stop - step.start) * step.frequency / HERTZ / recording.sampling_rate


def _measure(
    recording: TimeRecording,
    chosen: ChosenChannels,
    step: Step,
    orders: tuple[int, ...],
    settle: float | None,
    tolerance: float,
    of_table: bool,
) -> _Measured:
    """Evaluate one step."""
    if settle is not None and not 0 <= settle < np.inf:
        raise InputError(f"`settle` must be a time of 0 s or more, but is {settle:g}.")
    if _cycles(recording, step) < FEWEST_CYCLES:
        return _Measured(step, RecordStatus.TOO_SHORT)
    below = np.pi * recording.sampling_rate / step.frequency
    highest = max(*orders, min(_HIGHEST, int(np.ceil(below) - 1)))
    blocks = block_phasors(recording, chosen.names, step.start, step.stop, step.frequency, highest)
    if not np.isfinite(blocks.phasors).all():
        return _Measured(step, RecordStatus.NOT_FINITE)
    if blocks.clipped:
        return _Measured(step, RecordStatus.CLIPPED)
    guide = chosen.names.index(chosen.drive) if chosen.drive is not None else 0
    if not of_table:
        blocks = _within_step(blocks, guide)
    shift = steady_frequency(blocks, guide)
    dwell = (step.stop - step.start) / recording.sampling_rate
    if of_table and abs(shift) * dwell > HERTZ * _NEAR_TABLE:
        return _Measured(step, RecordStatus.NOT_FOUND)
    blocks = blocks.shifted(shift)
    step = step._replace(frequency=blocks.frequency)
    motion = _without_drive(blocks, chosen)
    part = settled_part(motion, settle)
    # If a single decaying mode does not explain the drift, a later start is tried.
    for first in np.unique(np.linspace(part.first, part.latest, _TRIES).astype(int)):
        kept = _rows(motion, slice(first, None))
        moved = moves(kept, tolerance) if len(kept.time) else 0.0
        if moved == 0:
            break
    each = (blocks.time[-1] - blocks.time[0]) / max(len(blocks.time) - 1, 1)
    if len(kept.time) * each * step.frequency < HERTZ * FEWEST_CYCLES / 2 or len(kept.time) < 3:
        return _Measured(step, RecordStatus.TOO_SHORT)
    means = mean_phasors(kept)
    transient = part.remaining[:, first]
    fraction = float(np.max(transient / np.abs(means.phasors[:, 0])))
    begins = float(kept.time[0] - each / 2)
    unsettled = moved > 0 or fraction > tolerance
    return _Measured(
        step._replace(amplitude=float(np.abs(means.phasors[0, 0]))),
        RecordStatus.UNSETTLED if unsettled else RecordStatus.SETTLED,
        np.nan if unsettled else begins,
        part.decay_time,
        max(moved, fraction),
        transient,
        means,
        float(kept.time.mean()),
        float(np.abs(blocks.phasors[guide, 0, first:]).mean()) if chosen.drive else np.nan,
    )


def _without_drive(blocks: BlockPhasors, chosen: ChosenChannels) -> BlockPhasors:
    n = 1 + len(chosen.responses)
    return blocks._replace(phasors=blocks.phasors[:n], noise=blocks.noise[:n], mean=blocks.mean[:n])


def _within_step(blocks: BlockPhasors, guide: int) -> BlockPhasors:
    """Without blocks at the ends that extend beyond the step, where the drive is not steady."""
    rest = blocks.noise[guide]
    good = np.flatnonzero(rest <= _BEYOND * np.median(rest))
    return _rows(blocks, slice(int(good[0]), int(good[-1]) + 1))


def _rows(blocks: BlockPhasors, rows: slice) -> BlockPhasors:
    return blocks._replace(
        time=blocks.time[rows],
        phasors=blocks.phasors[:, :, rows],
        noise=blocks.noise[:, rows],
        mean=blocks.mean[:, rows],
    )


def _without_pauses(measured: list[_Measured]) -> list[_Measured]:
    amplitudes = [fitted.step.amplitude for fitted in measured]
    largest = max((a for a in amplitudes if np.isfinite(a)), default=0.0)
    return [
        fitted._replace(status=RecordStatus.NO_FORCE, settled_from=np.nan)
        if fitted.means is not None and fitted.step.amplitude <= _QUIET * largest
        else fitted
        for fitted in measured
    ]


def _result(
    recording: TimeRecording,
    chosen: ChosenChannels,
    measured: list[_Measured],
    orders: tuple[int, ...],
    level: Levels | int,
) -> SteppedSineStates:
    status = np.array([int(fitted.status) for fitted in measured])
    good = [fitted for fitted in measured if fitted.status is RecordStatus.SETTLED]
    if not good:
        reasons = "; ".join(
            f"{np.sum(status == int(kind))} because {kind.message}"
            for kind in RecordStatus
            if np.any(status == int(kind))
        )
        moving = np.isin(status, (int(RecordStatus.UNSETTLED), int(RecordStatus.TOO_SHORT))).all()
        hint = " (a sweep? `sweep_states` reads it)" if moving else ""
        raise InputError(
            f"none of the {len(measured)} steps of the record settled: {reasons}{hint}."
        )
    states = states_of_phasors(recording, chosen, _table(good), orders, level)
    number = np.full(len(measured), -1)
    number[status == int(RecordStatus.SETTLED)] = np.arange(len(good))
    rate, begin = recording.sampling_rate, recording.start_time
    return SteppedSineStates(
        states,
        begin + np.array([fitted.step.start for fitted in measured]) / rate,
        begin + np.array([fitted.step.stop for fitted in measured]) / rate,
        np.array([fitted.settled_from for fitted in measured]),
        np.array([fitted.step.frequency for fitted in measured]),
        np.array([fitted.step.amplitude for fitted in measured]),
        np.array([fitted.decay_time for fitted in measured]),
        np.array([fitted.moved for fitted in measured]),
        np.array(
            [np.nan if fitted.means is None else fitted.means.colour.max() for fitted in measured]
        ),
        number,
        status,
        states.notes,
    )


def _table(good: list[_Measured]) -> PhasorTable:
    """Phasors of the settled steps; the remaining transient is added to the errors."""
    means = [fitted.means for fitted in good if fitted.means is not None]
    transient = np.array([fitted.transient for fitted in good])
    first = np.array([np.abs(fitted.phasors[:, 0]) for fitted in means])
    amplitude_std = np.hypot([fitted.amplitude_std for fitted in means], transient)
    phase_std = np.hypot([fitted.phase_std for fitted in means], (transient / first)[:, :])
    drive = np.array([fitted.drive for fitted in good])
    return PhasorTable(
        np.array([fitted.middle for fitted in good]),
        np.array([fitted.step.frequency for fitted in good]),
        first[:, 0],
        amplitude_std[:, 0],
        np.array([fitted.phasors[1:] for fitted in means]),
        np.array([fitted.mean[1:] for fitted in means]),
        amplitude_std[:, 1:],
        phase_std[:, 1:],
        np.array([fitted.harmonic_std[1:] for fitted in means]),
        drive if np.isfinite(drive).all() else None,
    )
