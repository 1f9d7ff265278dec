"""Phase-locked loop: a controller that keeps phase resonance while the drive is raised.

Adaptive filters track the Fourier coefficients of force and velocity; the phase between their
fundamentals, zero at resonance, is the error of a proportional-integral controller of the drive
frequency. Near resonance the phase obeys φ̇ = (ω̃ − Ω) − ζ̃ω̃ φ, so that Ω = Ω₀ + k_p φ + k_i ∫φ makes
φ̈ + (ζ̃ω̃ + k_p) φ̇ + k_i φ = 0: both gains follow from one rate λ, k_p = 2λ − ζω and k_i = λ².
The loop stabilises branches that jump in open loop, since frequency is no longer prescribed.

References: S. Peter & R. I. Leine, Mech. Syst. Signal Process. 96 (2017) 139,
doi:10.1016/j.ymssp.2017.04.011; M. Scheel, S. Peter, R. I. Leine & M. Krack, J. Sound Vib. 435
(2018) 56, doi:10.1016/j.jsv.2018.07.010; for adaptive filters in the loop, arXiv:2403.06639.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.rules import InputError
from snrmjax.simulate.balance.given_numbers import positive
from snrmjax.simulate.virtual_test.laboratory import (
    AbstractController,
    Laboratory,
    LabState,
    Sample,
    run_test,
)
from snrmjax.simulate.virtual_test.record_phasors import (
    HANN,
    PARTS,
    ControlledMotion,
    FourierState,
    empty_filter,
    followed,
    noise_of_sample,
    through_hann_window,
)

_ORDERS = np.arange(1, 6)  # harmonics that the filters track, in addition to the mean
_FASTEST, _RATES = 20.0, 20000  # range of the loop's spectrum over its fastest rate; grid size
_LOCKED_PHASE = np.radians(1.0)  # largest mean phase error of a locked loop
_LOCKED_SCATTER = 0.5  # largest 1σ of the frequency over the record, in half-power half widths ζω
_NEXT_SEED = 7919  # a prime, so that runs of different tests do not share their noise


class LoopGains(NamedTuple):
    """Rates of the loop, in multiples of 1/s.

    `filter_rate` is the decay rate of the filters and `loop_rate` is λ; a loop is well tuned if λ
    is several times the decay ζω of the structure and at most a fifth of the filter rate.
    """

    filter_rate: float
    loop_rate: float


class LoopState(NamedTuple):
    """Angle and integral of the loop, and the state of its filters."""

    angle: Float[Array, ""]
    integral: Float[Array, ""]  # rad/s
    filters: FourierState  # force, velocity
    frequency: Float[Array, ""]  # rad/s


class LoopReport(NamedTuple):
    """Record of the loop at a sample."""

    frequency: Float[Array, ""]  # rad/s
    angle: Float[Array, ""]  # rad, of the drive at the sample


class PhaseLockedLoop(AbstractController):
    """The controller: a voltage of constant amplitude whose frequency controls the phase."""

    voltage: Float[Array, ""]
    start_frequency: Float[Array, ""]  # rad/s
    decay: Float[Array, ""]  # ζω of the linear mode, 1/s
    filter_rate: Float[Array, ""]  # 1/s
    loop_rate: Float[Array, ""]  # 1/s
    target: Float[Array, ""]  # rad, phase of the velocity ahead of the force

    def initial(self) -> LoopState:
        """At the start frequency, with empty filters."""
        zero = jnp.zeros(())
        return LoopState(zero, zero, empty_filter(2, _ORDERS), self.start_frequency)

    def step(
        self, state: LoopState, sample: Sample, period: Float[Array, ""]
    ) -> tuple[LoopState, Array, LoopReport]:
        """Frequency from the phase error, and the voltage."""
        seen = jnp.stack([sample.force, sample.velocity])
        filters = followed(state.filters, seen, state.angle, _ORDERS, self.filter_rate * period)
        ratio = filters.harmonics[1, 0] * jnp.conj(filters.harmonics[0, 0])
        error = ratio * jnp.exp(-1j * self.target)
        phase = jnp.where(jnp.abs(ratio) > 0, jnp.angle(error), 0.0)
        proportional = 2 * self.loop_rate - self.decay
        integral = state.integral + self.loop_rate**2 * phase * period
        frequency = self.start_frequency + proportional * phase + integral
        # A frequency beyond these limits means that the loop has lost lock.
        frequency = jnp.clip(frequency, 0.5 * self.start_frequency, 2.0 * self.start_frequency)
        angle = jnp.mod(state.angle + frequency * period, 2 * jnp.pi)
        report = LoopReport(frequency, state.angle)
        after = LoopState(angle, integral, filters, frequency)
        return after, self.voltage * jnp.cos(angle), report


class PhaseSweep(NamedTuple):
    """States of one drive voltage at controlled phases; NaN where the loop did not lock."""

    phase: Float[np.ndarray, " state"]  # rad, requested: velocity ahead of force
    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N
    velocity: Complex[np.ndarray, " state"]  # m/s, relative to the force
    on_target: Bool[np.ndarray, " state"]
    test_seconds: float


@on_numbers("Differentiate the steady states of a model by `sj.simulate.periodic_motion`.")
def phase_sweep(
    laboratory: Laboratory,
    voltage: float,
    phases: Float[np.ndarray, " state"],
    *,
    gains: LoopGains | None = None,
    settle_cycles: int = 300,
    record_cycles: int = 50,
    seed: int = 0,
) -> PhaseSweep:
    """A whole response at one drive voltage, phase by phase, its unstable part included.

    On the response of one mode the phase decreases monotonically along the curve, around its folds
    too, so that a loop stepped from phase to phase meets no jump.

    Arguments: `voltage` in V; `phases` in rad in the order of the test, positive below resonance;
    the others as in `locked_motions`. Returns a `PhaseSweep`.
    Raises `ValueError` for a voltage that is not positive and phases beyond ±90°.
    Not differentiable: differentiate the steady states of a model by
    `snrmjax.simulate.periodic_motion`.
    Reference: V. Denis, M. Jossic, C. Giraud-Audine, B. Chomette, A. Renault & O. Thomas, Mech.
    Syst. Signal Process. 106 (2018) 430, doi:10.1016/j.ymssp.2018.01.014.
    """
    wanted = np.atleast_1d(np.asarray(phases, dtype=float))
    if not np.all(np.abs(wanted) < np.pi / 2):
        raise InputError(f"`phases` must lie within ±90°, but are {phases} rad.")
    steps = [(voltage, phase) for phase in wanted.tolist()]
    motions, _, seconds = locked_motions(
        laboratory,
        steps,
        gains=gains,
        settle_cycles=settle_cycles,
        record_cycles=record_cycles,
        seed=seed,
    )
    on_target = np.array([motion.on_target for motion in motions])
    force = np.where(on_target, [motion.force for motion in motions], np.nan)
    velocity = np.where(on_target, [motion.velocity for motion in motions], np.nan)
    frequency = np.where(on_target, [motion.frequency for motion in motions], np.nan)
    relative = velocity * np.conj(force) / np.abs(force)
    return PhaseSweep(wanted, frequency, np.abs(force), relative, on_target, seconds)


def locked_motions(
    laboratory: Laboratory,
    steps: Sequence[tuple[float, float]],
    *,
    gains: LoopGains | None = None,
    settle_cycles: int = 300,
    record_cycles: int = 50,
    seed: int = 0,
) -> tuple[list[ControlledMotion], LabState | None, float]:
    """Step drive voltage and phase in closed loop and record the motions.

    At each step the loop has `settle_cycles` of the linear mode to lock, then `record_cycles` are
    recorded. Fundamentals of force and velocity are computed from the record, by projection on the
    angle of the drive.

    Arguments: `steps` as voltage (V) and phase (rad, of the velocity ahead of the force) in the
    order of the test; `gains` by default a filter of ω/20 of the mode of interest and a loop of a
    sixth of that.
    Returns the motions, the final state of the laboratory, and the duration in s.
    Raises `ValueError` for voltages or cycles that are not positive.
    """
    positive("voltages", [voltage for voltage, _ in steps])
    positive("settle_cycles", settle_cycles)
    positive("record_cycles", record_cycles)
    rates = LoopGains(laboratory.frequency / 20, laboratory.frequency / 120)
    rates = rates if gains is None else gains
    settle, keep = laboratory.samples(settle_cycles), laboratory.samples(record_cycles)
    motions, state = [], None
    for number, (voltage, phase) in enumerate(steps, 1):
        numbers = (voltage, laboratory.frequency, laboratory.decay, *rates, phase)
        loop = PhaseLockedLoop(*(jnp.asarray(value, dtype=float) for value in numbers))
        record, state = run_test(
            laboratory, loop, settle + keep, start=state, seed=seed + _NEXT_SEED * number
        )
        columns = (*record.report, record.force, record.velocity)
        frequency, angle, force, velocity = (np.asarray(column)[-keep:] for column in columns)
        noise = [noise_of_sample(signal, angle) for signal in (force, velocity)]
        locked = _Locked(
            frequency=frequency,
            force=through_hann_window(force, angle),
            velocity=through_hann_window(velocity, angle),
            decay=laboratory.decay,
            phase=phase,
            noise=np.array(noise),
            period=1 / laboratory.sampling_rate,
            gains=rates,
        )
        motions.append(locked.motion())
    seconds = len(steps) * (settle + keep) / laboratory.sampling_rate
    return motions, state, seconds


class _Locked(NamedTuple):
    """The recorded part: frequency, and force and velocity demodulated by the drive's angle."""

    frequency: np.ndarray  # rad/s
    force: np.ndarray  # N, complex
    velocity: np.ndarray  # m/s, complex
    decay: float  # ζω of the linear mode, 1/s
    phase: float  # rad, requested
    noise: Float[np.ndarray, "2"]  # of a sample of force (N) and velocity (m/s)
    period: float  # s, of sampling
    gains: LoopGains

    def motion(self) -> ControlledMotion:
        """Means over the record, with 1σ from its noise and the scatter between its tenths."""
        omega, force, velocity = (float(np.mean(self.frequency)), *map(np.mean, self[1:3]))
        ratio = force / velocity  # N s/m
        off = np.angle(np.exp(-1j * self.phase) / ratio) if np.isfinite(ratio) else np.inf
        steady = float(np.std(self.frequency)) < _LOCKED_SCATTER * self.decay
        if not (abs(off) <= _LOCKED_PHASE and steady):
            return ControlledMotion(False, omega)
        parts = np.array_split(np.arange(len(self.frequency)), PARTS)
        inner = parts[1:-1]
        each = [np.mean(self.force[k]) / np.mean(self.velocity[k]) for k in inner]
        spread = np.std([np.mean(self.frequency[k]) for k in parts])
        from_phase = self.decay * np.std(np.angle(each))
        # Variances of ln F and ln v, or of their phases, over a record, times its duration.
        densities = 2 * self.period * (self.noise / np.abs([force, velocity])) ** 2
        density, seconds = float(np.sum(densities)), len(self.frequency) * self.period
        scatter = float(np.std(np.real(each))) / np.sqrt(len(inner) - 1) / float(np.real(ratio))
        return ControlledMotion(
            True,
            omega,
            max(
                float(np.hypot(spread, from_phase) / np.sqrt(PARTS - 1)),
                np.sqrt(density) * _propagated(self.gains, self.decay, seconds),
            ),
            complex(force),
            complex(velocity),
            max(scatter, float(np.sqrt(HANN * density / seconds))),
            float(np.sqrt(HANN * densities[1] / seconds)),
        )


def _propagated(gains: LoopGains, decay: float, seconds: float) -> float:
    """1σ of the mean frequency of a record for white phase noise of unit density.

    The loop controls the measured phase, noise included: the transfer function from noise to
    frequency is G = C D/(1 + C D P), with the controller C = k_p + k_i/s, the filter D and the
    structure P = 1/(s + ζω). A slow loop correlates neighbouring parts of a record.
    """
    fast = max(*gains, 1 / seconds)
    rate = np.linspace(0.0, _FASTEST * fast, _RATES)[1:]
    s = 1j * rate
    controller = (2 * gains.loop_rate - decay) + gains.loop_rate**2 / s
    seen = controller * gains.filter_rate / (s + gains.filter_rate)
    power = np.abs(seen / (1 + seen / (s + decay))) ** 2
    mean = np.sinc(rate * seconds / (2 * np.pi)) ** 2
    return float(np.sqrt(np.sum(power * mean) * (rate[1] - rate[0]) / np.pi))
