"""Test programmes in time domain: stepped sines, multisines, decays, tables of voltages."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from snrmjax.measure.recordings.channels import Channel
from snrmjax.measure.recordings.stepped_sine import stepped_sine_states
from snrmjax.measure.recordings.time_recording import time_recording
from snrmjax.measure.states import SteadyStates
from snrmjax.model.modes import reference_sensor
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.rules import InputError
from snrmjax.simulate.balance.given_numbers import positive
from snrmjax.simulate.virtual_test.laboratory import (
    AbstractController,
    Laboratory,
    Sample,
    TestRecord,
    run_test,
)
from snrmjax.simulate.virtual_test.phase_loop import LoopGains, locked_motions
from snrmjax.simulate.virtual_test.record_phasors import ControlledMotion


class TestSteps(NamedTuple):
    """Positions of the steady states in a record."""

    frequency: Float[np.ndarray, " step"]  # rad/s
    first: Int[np.ndarray, " step"]  # first sample of the settled part
    samples: int  # of the settled part


class LaboratoryTest(NamedTuple):
    """A test in the virtual laboratory: its channels and its duration."""

    record: TestRecord
    seconds: float
    steps: TestSteps | None = None  # of a stepped sine


class DecayTest(NamedTuple):
    """A free decay from a controlled resonance, and that resonance."""

    record: TestRecord  # from the moment the shaker is disconnected
    seconds: float  # duration of resonance and decay
    resonance: ControlledMotion  # `on_target` if the loop had locked


class Playback(AbstractController):
    """A table of voltages, one per sample; zero after its end."""

    voltages: Float[Array, " sample"]

    def initial(self) -> Int[Array, ""]:
        """The number of the sample."""
        return jnp.asarray(0)

    def step(
        self, state: Int[Array, ""], sample: Sample, period: Float[Array, ""]
    ) -> tuple[Array, Array, Array]:
        """The voltage of the next row."""
        voltage = self.voltages.at[state].get(mode="fill", fill_value=0.0)
        return state + 1, voltage, state


class StepState(NamedTuple):
    """State of a stepped sine."""

    samples: Int[Array, ""]  # so far
    angle: Float[Array, ""]


class SteppedSineDrive(AbstractController):
    """A sine of constant voltage and continuous phase whose frequency is stepped."""

    frequencies: Float[Array, " step"]  # rad/s
    voltage: Float[Array, ""]
    dwell: Int[Array, ""]  # samples per step

    def initial(self) -> StepState:
        """Before the first step."""
        return StepState(jnp.asarray(0), jnp.zeros(()))

    def step(
        self, state: StepState, sample: Sample, period: Float[Array, ""]
    ) -> tuple[StepState, Array, Array]:
        """A sine of the step's frequency."""
        number = jnp.clip(state.samples // self.dwell, 0, self.frequencies.size - 1)
        angle = jnp.mod(state.angle + self.frequencies[number] * period, 2 * jnp.pi)
        return StepState(state.samples + 1, angle), self.voltage * jnp.cos(angle), angle


@on_numbers("Differentiate the steady states of a model by `sj.simulate.periodic_motion`.")
def stepped_sine_test(
    laboratory: Laboratory,
    voltage: float,
    frequencies: Float[np.ndarray, " step"],
    *,
    settle_cycles: int = 200,
    record_cycles: int = 30,
    seed: int = 0,
) -> LaboratoryTest:
    """Step the frequency of a sine in open loop, with continuous phase.

    Force and response are not controlled, and jump where a branch ends.

    Arguments: `voltage` in V; `frequencies` in rad/s in the order of the test; cycles of the linear
    mode of interest at each of them, to settle and then to record.
    Returns a `LaboratoryTest` with its steps, for `steady_states_of`. Raises `ValueError` for
    numbers that are not positive.
    Not differentiable: differentiate the steady states of a model by
    `snrmjax.simulate.periodic_motion`.
    """
    steps = np.atleast_1d(np.asarray(frequencies, dtype=float))
    for name, values in (
        *(("voltage", voltage), ("frequencies", steps)),
        *(("settle_cycles", settle_cycles), ("record_cycles", record_cycles)),
    ):
        positive(name, values)
    settle, keep = laboratory.samples(settle_cycles), laboratory.samples(record_cycles)
    programme = SteppedSineDrive(
        jnp.asarray(steps), jnp.asarray(float(voltage)), jnp.asarray(settle + keep)
    )
    count = len(steps) * (settle + keep)
    record, _ = run_test(laboratory, programme, count, seed=seed)
    first = settle + np.arange(len(steps)) * (settle + keep)
    return LaboratoryTest(record, count / laboratory.sampling_rate, TestSteps(steps, first, keep))


@on_numbers("Differentiate the steady states of a model by `sj.simulate.periodic_motion`.")
def multisine_test(
    laboratory: Laboratory,
    rms_voltage: float,
    lines: Int[np.ndarray, " line"],
    period_samples: int,
    periods: int,
    *,
    seed: int = 0,
) -> LaboratoryTest:
    """A periodic multisine with lines of equal amplitude.

    Arguments: `rms_voltage` in V of the signal; `lines` are multiples of the sampling rate over
    `period_samples`; phases are drawn from `seed`.
    Returns a `LaboratoryTest` of `periods` periods, the first of them with the transient.
    Raises `ValueError` for lines outside 1 to half of `period_samples`, and for numbers that are
    not positive.
    Not differentiable: differentiate the steady states of a model by
    `snrmjax.simulate.periodic_motion`.
    """
    distinct = np.unique(np.asarray(lines, dtype=int))
    for name, value in (
        *(("rms_voltage", rms_voltage), ("periods", periods)),
        ("period_samples", period_samples),
    ):
        positive(name, value)
    if not distinct.size or distinct[0] < 1 or distinct[-1] >= period_samples / 2:
        raise InputError(
            f"`lines` must lie between 1 and half of `period_samples`, {period_samples / 2:g}, but "
            f"are {lines}."
        )
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(distinct))
    spectrum = np.zeros(period_samples // 2 + 1, dtype=complex)
    spectrum[distinct] = np.exp(1j * phases)
    once = np.fft.irfft(spectrum, period_samples)
    voltages = np.tile(once * rms_voltage / np.sqrt(np.mean(once**2)), periods)
    record, _ = run_test(laboratory, Playback(jnp.asarray(voltages)), len(voltages), seed=seed)
    return LaboratoryTest(record, len(voltages) / laboratory.sampling_rate)


@on_numbers("Differentiate the steady states of a model by `sj.simulate.periodic_motion`.")
def decay_test(
    laboratory: Laboratory,
    voltage: float,
    decay_seconds: float,
    *,
    gains: LoopGains | None = None,
    settle_cycles: int = 300,
    record_cycles: int = 50,
    seed: int = 0,
) -> DecayTest:
    """Lock onto phase resonance, disconnect the shaker and record the decay.

    Arguments: `voltage` in V of the resonance; `decay_seconds` after it; the others as in
    `locked_motions`. Returns a `DecayTest`, whose velocity goes into `resonant_decay`.
    Raises `ValueError` for numbers that are not positive.
    Not differentiable: differentiate the steady states of a model by
    `snrmjax.simulate.periodic_motion`.
    """
    positive("decay_seconds", decay_seconds)
    (resonance,), state, seconds = locked_motions(
        laboratory,
        [(voltage, 0.0)],
        gains=gains,
        settle_cycles=settle_cycles,
        record_cycles=record_cycles,
        seed=seed,
    )
    free = Playback(jnp.zeros(1))
    locked = state or laboratory.at_rest(free)
    start = locked._replace(controller=free.initial(), voltage=jnp.zeros(3))
    count = round(decay_seconds * laboratory.sampling_rate)
    away = dataclasses.replace(laboratory, attached=False)
    record, _ = run_test(away, free, count, start=start, seed=seed + 1)
    return DecayTest(record, seconds + decay_seconds, resonance)


@on_numbers("Differentiate the steady states of a model by `sj.simulate.periodic_motion`.")
def steady_states_of(
    laboratory: Laboratory,
    test: LaboratoryTest,
    *,
    level: int = 1,
    harmonic_order: tuple[int, ...] = (1, 2, 3),
) -> SteadyStates:
    """The steady states of a stepped sine, from the settled part of every step.

    Arguments: `level` that they all belong to; `harmonic_order` as in `stepped_sine_states`.
    Returns `SteadyStates` of the reference sensor, one per step, with standard deviations: large
    ones for a step that has not settled or in which the motion jumps.
    Raises `ValueError` for a test without steps, and for a step that cannot be fitted.
    Not differentiable: differentiate the steady states of a model by
    `snrmjax.simulate.periodic_motion`.
    """
    if test.steps is None:
        raise InputError("`test` must be a stepped sine: other records have no steady states.")
    modes = laboratory.structure.modes
    sensor, j = reference_sensor(modes), modes.mode_of_interest
    # In records force and velocity agree in sign at resonance; states have the model's.
    sign = float(np.sign(modes.mode_shape[sensor, j] * modes.participation[j]))
    record, rate = test.record, laboratory.sampling_rate
    recording = time_recording(
        np.stack([record.force, sign * record.velocity, record.voltage]),
        [Channel("force", "force"), Channel("velocity", "velocity"), Channel("drive", "voltage")],
        rate,
    )
    first, dwell = test.steps.first / rate, test.steps.samples / rate
    fitted = stepped_sine_states(
        recording,
        "force",
        ["velocity"],
        harmonic_order=harmonic_order,
        level=level,
        sensors=(modes.sensors[sensor],),
        frequencies=list(zip(first, first + dwell, test.steps.frequency, strict=True)),
        drive="drive",
        settle=0.0,
        tolerance=np.inf,
    )
    if fitted.states.n_states < len(first):
        reasons = ", ".join(f"{count} {reason}" for reason, count in fitted.counts.reasons)
        raise InputError(f"not every step of `test` can be fitted: {reasons}.")
    return fitted.states
