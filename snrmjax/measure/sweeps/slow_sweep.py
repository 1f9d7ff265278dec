"""Steady states from slow sweeps, corrected for the bias of the sweep.

Each state has the force that would sustain it.
"""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float, Int

from snrmjax.measure.recordings.channels import DERIVATIVE
from snrmjax.measure.recordings.step_counts import RecordStatus
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.recordings.tone_track import ToneTrack, check_rate, track_tone, unwrapped_phase
from snrmjax.measure.recordings.velocity_states import (
    ChosenChannels,
    Levels,
    PhasorTable,
    choose_channels,
    states_of_phasors,
)
from snrmjax.measure.signals import require_fundamental
from snrmjax.measure.states import SteadyStates
from snrmjax.measure.sweeps.sweep_bias import SweepBias, sweep_bias_where_slow
from snrmjax.measure.sweeps.sweep_correction import (
    ModalBalance,
    SweptMotion,
    fraction_of_bias,
    modal_balance,
)
from snrmjax.measure.sweeps.sweep_runs import LEAST_RANGE, Sweep, sweep_runs, track_speed
from snrmjax.measure.sweeps.swept_phasors import SweptPhasors, displacement_series, swept_phasors
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting
from snrmjax.numerics.rules import POSITIVE, InputError, require
from snrmjax.numerics.units import HERTZ

_START = 60  # states per sweep before refinement where the response changes
_CHORD = 0.08  # of the largest response between neighbouring states
_ROUNDS = 3
_MUCH = 0.3  # largest correction, of the force
_BLURRED = 0.1  # relative error of a phasor above which the window is too wide


class Moment(NamedTuple):
    """The phasors of a sweep at one moment."""

    sweep: int
    phasors: SweptPhasors
    motion: Complex[np.ndarray, "channel power"]  # displacements of the responses, m
    motion_std: Float[np.ndarray, "channel power"]


def swept_moment(chosen: ChosenChannels, sweep: int, phasors: SweptPhasors) -> Moment:
    """The displacements of all responses at one moment, from any recorded motion."""
    motion, std = [], []
    rows = (chosen.responses, phasors.series[1:], phasors.std[1:])
    for channel, series, error in zip(*rows, strict=True):
        times = DERIVATIVE[channel.quantity]
        motion.append(displacement_series(series[None], phasors.rate, times)[0])
        std.append(error / phasors.rate[0] ** times)
    return Moment(sweep, phasors, np.array(motion), np.array(std))


def reference_response(moments: list[Moment]) -> int:
    """The response with the largest signal-to-noise ratio."""
    amplitude = np.abs([moment.motion[:, 0] for moment in moments])
    ratio = amplitude / np.fmax([moment.motion_std[:, 0] for moment in moments], 1e-300)
    return int(np.argmax(np.median(ratio, axis=0)))


def swept_motion(moments: list[Moment], reference: int) -> SweptMotion:
    """Force, and displacement of one response with its derivatives."""
    series = np.array([moment.motion[reference] for moment in moments])
    return SweptMotion(
        np.array([moment.phasors.rate[0] for moment in moments]),
        np.array([moment.phasors.rate[1] for moment in moments]),
        np.array([moment.phasors.series[0, 0] for moment in moments]),
        series[:, 0],
        series[:, 1],
        2 * series[:, 2],
        np.array([moment.motion_std[reference, 1] for moment in moments]),
    )


def steady_force(
    moments: list[Moment], reference: int, balance: ModalBalance, corrected: bool
) -> tuple[Complex[np.ndarray, " state"], Float[np.ndarray, " state"]]:
    """Force that would sustain each state, and the rms of its complex error.

    Without correction the error includes the estimated bias of the sweep.
    """
    motion = swept_motion(moments, reference)
    std = np.array([moment.phasors.std[0, 0] for moment in moments])
    if not corrected:
        return motion.force, np.hypot(std, np.abs(motion.force) * fraction_of_bias(motion))
    transient = balance.force_to_move(motion)
    of_slope = 2 * motion.frequency * motion.first_std / abs(balance.constant)
    of_constant = np.abs(transient) * balance.constant_std / abs(balance.constant)
    return motion.force - transient, np.sqrt(std**2 + of_slope**2 + of_constant**2)


def table_of(
    moments: list[Moment],
    chosen: ChosenChannels,
    force: Complex[np.ndarray, " state"],
    force_error: Float[np.ndarray, " state"],
) -> PhasorTable:
    """Phasors relative to the sustaining force of each state, with their errors."""
    omega = np.array([moment.phasors.rate[0] for moment in moments])
    phasors = np.array([moment.phasors.harmonics[1:] for moment in moments])
    times = np.array([DERIVATIVE[moment.quantity] for moment in chosen.responses])
    # A steady motion of the same displacement.
    steady = np.array([moment.motion[:, 0] for moment in moments])
    phasors[:, :, 0] = steady * (1j * omega[:, None]) ** times
    unit = force / np.abs(force)
    order = 1 + np.arange(phasors.shape[2])
    std = np.array([moment.phasors.std[1:, 0] for moment in moments]) / np.sqrt(2)
    force_std = force_error / np.sqrt(2)
    return PhasorTable(
        np.array([moment.phasors.time for moment in moments]),
        omega,
        np.abs(force),
        force_std,
        phasors * unit.conj()[:, None, None] ** order,
        np.array([moment.phasors.mean[1:] for moment in moments]),
        std,
        np.hypot(std / np.abs(phasors[:, :, 0]), (force_std / np.abs(force))[:, None]),
        np.array([moment.phasors.harmonic_std[1:] for moment in moments]),
    )


class SweptStates(AbstractResult):
    """Steady states of slow sweeps; see `sweep_states`."""

    coordinates: ClassVar[tuple[str, ...]] = ("state",)

    states: SteadyStates
    sweeps: tuple[Sweep, ...] = eqx.field(static=True)
    bias: tuple[SweepBias | None, ...] = eqx.field(static=True)  # at resonance, uncorrected
    balance: ModalBalance
    sweep: Int[np.ndarray, " state"] = quantity("state", "1", "number of its sweep")
    time: Float[np.ndarray, " state"] = quantity("state", "s", "time in the record", name="time_s")
    # The part of the force that changed the phasor instead of sustaining it.
    sweep_inertia_fraction: Complex[np.ndarray, " state"] = quantity(
        "state", "1", "fraction of the force subtracted"
    )
    corrected: bool = setting()
    notes: tuple[Fact | str, ...] = setting()  # the bias of the sweeps, and omitted moments

    def variables(self) -> dict[str, Variable]:
        """Columns by state, with its frequency."""
        hertz = np.asarray(self.states.frequency) / HERTZ
        return {
            **super().variables(),
            "frequency_hz": Variable(("state",), hertz, "Hz", "frequency"),
        }


def sweep_states(
    recording: TimeRecording,
    force: str,
    responses: Sequence[str],
    *,
    harmonic_order: Sequence[int] = (1, 2, 3),
    level: Levels | int = "auto",
    sensors: Sequence[str] | None = None,
    frequencies: Float[np.ndarray, " frequency"] | Sequence[float] | None = None,
    drive: str | None = None,
    cycles: float = 16.0,
    correct: bool = True,
    is_base: bool = False,
) -> SweptStates:
    """Steady states from the time record of slow linear or logarithmic sweeps.

    Around each frequency the harmonics and their rates are fitted over a window of the chirp. A
    state of a sweep is the steady state of another force: the part of the force that changes the
    phasor is subtracted, so that amplitude and frequency remain those measured.

    Arguments: `force`, `responses`, `harmonic_order`, `level`, `sensors`, `drive` and `is_base`
    as in `stepped_sine_states`; `frequencies` in rad/s of the states (by default a grid that is
    finer where the response changes); `cycles` is the width of the window; `correct` removes the
    bias of the sweep (without it, and if it is unknown, 1σ includes the bias).
    Returns `SweptStates` with the bias of each sweep at resonance without correction.
    Raises `ValueError` for unsuitable channels, a record without a sweep, windows of fewer than
    six cycles, fewer than four samples per cycle, frequencies outside every sweep and a record
    that gives no state.
    Validity: one mode near its resonance; the error of the correction is propagated from the modal
    constant and the phasor's derivatives, and grows if the window is longer than the time in which
    the phasor changes (jumps are excluded).
    Reference: G. Gloth & M. Sinapius, Mech. Syst. Signal Process. 18 (2004) 1421.

    >>> from snrmjax.measure import Channel, time_recording
    >>> t = np.arange(60000) / 1000
    >>> turn = 2 * np.pi * (20 * t + t**2 / 20)
    >>> record = time_recording(
    ...     np.stack([2 * np.cos(turn), 0.1 * np.cos(turn + 0.2)]),
    ...     [Channel("load cell", "force"), Channel("tip", "velocity")], 1000)
    >>> found = sweep_states(
    ...     record, "load cell", ["tip"], frequencies=2 * np.pi * np.array([22, 24.0]),
    ...     correct=False)
    >>> found.states.force.round(4).tolist(), np.angle(found.states.velocity).round(4).tolist()
    ([2.0, 2.0], [[0.2], [0.2]])
    """
    orders = require_fundamental("harmonic_order", harmonic_order)
    chosen = choose_channels(
        recording, force, responses, sensors=sensors, drive=drive, is_base=is_base
    )
    if not cycles >= 6:
        raise InputError(f"`cycles` must be 6 at least, but is {cycles:g}.")
    guide = drive or force
    track = track_tone(recording, guide)
    phase = unwrapped_phase(track)
    runs = sweep_runs(track, phase)
    if not runs:
        raise InputError(
            f"the record has no sweep: the frequency of channel {guide} does not change by "
            f"{100 * LEAST_RANGE:g} % in one direction (steps? `stepped_sine_states` reads them)."
        )
    fastest = max(float(np.max(track_speed(track, phase)[rows])) for rows in runs)
    check_rate(recording, fastest * recording.sampling_rate * max(orders) / 2, guide)
    reader = _Reader(recording, chosen, track, phase, cycles, max(*orders, 3))
    wanted = None if frequencies is None else _wanted(frequencies, reader, runs)
    grids = [reader.along(rows, None) for rows in runs] if correct or wanted is None else []
    passed = grids if wanted is None else [reader.along(rows, wanted) for rows in runs]
    return _result(reader, runs, passed, grids, orders, level, correct)


class _Reader(NamedTuple):
    """Data and settings for reading phasors at a moment."""

    recording: TimeRecording
    chosen: ChosenChannels
    track: ToneTrack
    phase: Float[np.ndarray, " frame"]
    cycles: float
    highest: int

    def at(self, rows: slice, omega: float) -> SweptPhasors | None:
        """Phasors at the frequency `omega` (rad/s) of a sweep."""
        part = self.track.part(rows)
        speed = track_speed(self.track, self.phase)[rows] * self.recording.sampling_rate
        rising = speed[-1] > speed[0]
        ordered = np.maximum.accumulate(speed if rising else -speed)
        goal = omega if rising else -omega
        if not ordered[0] <= goal <= ordered[-1]:
            return None
        sample = float(np.interp(goal, ordered, part.middle))
        names = (self.chosen.force.name, *(channel.name for channel in self.chosen.responses))
        return swept_phasors(
            self.recording,
            names,
            part,
            self.phase[rows],
            omega,
            sample,
            self.cycles,
            self.highest,
        )

    def along(
        self, rows: slice, wanted: np.ndarray | None
    ) -> list[tuple[float, SweptPhasors | None]]:
        """Phasors at the wanted frequencies, or on an adaptively refined grid."""
        speed = track_speed(self.track, self.phase)[rows] * self.recording.sampling_rate
        if wanted is not None:
            inside = (wanted >= speed.min()) & (wanted <= speed.max())
            return [(float(omega), self.at(rows, float(omega))) for omega in wanted[inside]]
        middle = self.track.middle[rows] / self.recording.sampling_rate
        edge = HERTZ * self.cycles / speed.min()
        rate = np.ptp(speed) / np.ptp(middle)
        grid = np.linspace(speed[0], speed[-1], _START + 2)[1:-1]
        passed = {float(omega): self.at(rows, float(omega)) for omega in grid}
        for _ in range(_ROUNDS):
            known = sorted((omega, at) for omega, at in passed.items() if at is not None)
            if len(known) < 2:
                break
            response = np.array([at.series[1:, 0] / at.series[0, 0] for _, at in known])
            change = np.abs(np.diff(response, axis=0)) / np.abs(response).max(axis=0)
            omegas = np.array([omega for omega, _ in known])
            coarse = (change.max(axis=1) > _CHORD) & (np.diff(omegas) > rate * edge / 2)
            for omega in (omegas[1:] + omegas[:-1])[coarse] / 2:
                passed[float(omega)] = self.at(rows, float(omega))
        return sorted(passed.items(), reverse=bool(speed[-1] < speed[0]))


def _wanted(
    frequencies: Float[np.ndarray, " frequency"] | Sequence[float],
    reader: _Reader,
    runs: list[slice],
) -> Float[np.ndarray, " frequency"]:
    wanted = np.asarray(frequencies, dtype=float)
    if wanted.ndim != 1 or not wanted.size:
        raise InputError("`frequencies` must be a vector of at least one frequency.")
    require("`frequencies` (rad/s)", wanted, POSITIVE)
    speed = track_speed(reader.track, reader.phase) * reader.recording.sampling_rate
    low = min(float(speed[rows].min()) for rows in runs)
    high = max(float(speed[rows].max()) for rows in runs)
    outside = wanted[(wanted < low) | (wanted > high)]
    if outside.size:
        raise InputError(
            f"`frequencies` must lie within the sweeps, {low / HERTZ:.6g} to "
            f"{high / HERTZ:.6g} Hz, but one is {outside[0] / HERTZ:.6g} Hz."
        )
    return wanted


def _result(
    reader: _Reader,
    runs: list[slice],
    passed: list[list[tuple[float, SweptPhasors | None]]],
    grids: list[list[tuple[float, SweptPhasors | None]]],
    orders: tuple[int, ...],
    level: Levels | int,
    correct: bool,
) -> SweptStates:
    moments, status = _moments(reader.chosen, passed)
    left_out = [status.count(kind) for kind in RecordStatus]
    if moments:
        along = _moments(reader.chosen, grids)[0] or moments
        reference = reference_response(along)
        balance = modal_balance(swept_motion(along, reference))
        corrected = correct and bool(np.isfinite(balance.constant))
        force, force_std = steady_force(moments, reference, balance, corrected)
        fraction = 1 - force / np.array([moment.phasors.series[0, 0] for moment in moments])
        slow = np.abs(fraction) <= _MUCH
        left_out[int(RecordStatus.TOO_FAST)] += int(np.sum(~slow))
    if not moments or not slow.any():
        reasons = "; ".join(
            f"{count} because {kind.message}"
            for kind, count in zip(RecordStatus, left_out, strict=True)
            if count and kind is not RecordStatus.SETTLED
        )
        default = "none passes the wanted frequencies, or samples are missing there"
        raise InputError(f"the sweeps give no steady state: {reasons or default}.")
    kept = [moment for moment, good in zip(moments, slow, strict=True) if good]
    table = table_of(kept, reader.chosen, force[slow], force_std[slow])
    number = np.array([moment.sweep for moment in kept])
    fraction = fraction[slow]
    notes = [Fact("sweep_bias_unknown")] if correct and not corrected else []
    states = states_of_phasors(reader.recording, reader.chosen, table, orders, level, notes)
    rate, begin = reader.recording.sampling_rate, reader.recording.start_time
    speed = track_speed(reader.track, reader.phase) * rate
    sweeps = tuple(
        Sweep(
            *(begin + float(reader.track.middle[k]) / rate for k in (rows.start, rows.stop - 1)),
            *(float(speed[k]) for k in (rows.start, rows.stop - 1)),
        )
        for rows in runs
    )
    bias = tuple(_bias(balance, along, k) for k in range(len(runs)))
    facts = (*_facts_of_sweeps(bias, corrected, left_out), *states.notes)
    return SweptStates(
        states, sweeps, bias, balance, number, table.time, fraction, corrected, facts
    )


def _facts_of_sweeps(
    bias: Sequence[SweepBias | None], corrected: bool, left_out: Sequence[int]
) -> list[Fact]:
    known = [sweep for sweep in bias if sweep is not None]
    facts = []
    if known:
        shift = max(abs(sweep.frequency_shift) for sweep in known) / HERTZ
        facts.append(
            Fact(
                "sweep_bias",
                sweeps=len(bias),
                shift_hz=shift,
                lowest=min(sweep.peak_ratio for sweep in known),
                removed=corrected,
            )
        )
    return facts + [
        Fact("moments_left_out", count=count, status=kind)
        for kind, count in zip(RecordStatus, left_out, strict=True)
        if count and kind is not RecordStatus.SETTLED
    ]


def _moments(
    chosen: ChosenChannels, passed: list[list[tuple[float, SweptPhasors | None]]]
) -> tuple[list[Moment], list[RecordStatus]]:
    """States that can be read, and the status of every moment."""
    moments, status = [], []
    for k, run in enumerate(passed):
        for _, phasors in run:
            if phasors is None:
                status.append(RecordStatus.OUTSIDE)
            elif phasors.clipped:
                status.append(RecordStatus.CLIPPED)
            else:
                moment = swept_moment(chosen, k, phasors)
                error = np.min(phasors.std[1:, 0] / np.abs(phasors.series[1:, 0]))
                blurred = not error < _BLURRED
                status.append(RecordStatus.TOO_FAST if blurred else RecordStatus.SETTLED)
                moments += [] if blurred else [moment]
    return moments, status


def _bias(balance: ModalBalance, moments: list[Moment], sweep: int) -> SweepBias | None:
    """Bias of the sweep at resonance, for the mode identified by the balance."""
    mine = [moment for moment in moments if moment.sweep == sweep]
    if not mine or not np.isfinite(balance.constant):
        return None
    stiffness, damping = balance.stiffness[-1], balance.damping[-1]
    if stiffness <= 0 or damping <= 0:
        return None
    omega = float(np.sqrt(stiffness))
    near = min(mine, key=lambda moment: abs(moment.phasors.rate[0] - omega))
    return sweep_bias_where_slow(omega, float(damping / (2 * omega)), float(near.phasors.rate[1]))
