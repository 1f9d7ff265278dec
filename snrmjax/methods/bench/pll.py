"""Phase-locked loop: a controller that holds phase resonance while the drive is raised.

Adaptive filters follow the Fourier coefficients of force and velocity; the phase between their
fundamentals, zero at resonance, goes through a proportional-integral law to the frequency of the
drive. Near resonance the phase obeys φ̇ = (ω̃ − Ω) − ζ̃ω̃ φ, so that Ω = Ω₀ + k_p φ + k_i ∫φ makes
φ̈ + (ζ̃ω̃ + k_p) φ̇ + k_i φ = 0: both gains follow from one rate λ, k_p = 2λ − ζω and k_i = λ².
The loop holds branches that an open loop jumps off, since frequency is no longer prescribed.

References: S. Peter & R. I. Leine, Mech. Syst. Signal Process. 96 (2017) 139,
doi:10.1016/j.ymssp.2017.04.011; M. Scheel, S. Peter, R. I. Leine & M. Krack, J. Sound Vib. 435
(2018) 56, doi:10.1016/j.jsv.2018.07.010; for adaptive filters in the loop, arXiv:2403.06639.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.methods.bench.equipment import positive
from snrmjax.methods.bench.fourier_filter import FourierState, followed, nothing_followed
from snrmjax.methods.bench.held_phasors import (
    HANN,
    PARTS,
    noise_of_sample,
    with_velocity_errors,
)
from snrmjax.methods.bench.laboratory import (
    AbstractController,
    Laboratory,
    LabState,
    Sample,
    run_test,
)
from snrmjax.methods.one_sensor import drive_point
from snrmjax.methods.result import MethodPoint, MethodResult, MethodStatus, method_result

_ORDERS = np.arange(1, 6)  # harmonics that the filters follow beside the mean
_FASTEST, _RATES = 20.0, 20000  # of the loop's spectrum, times its fastest rate, and how many
_LOCKED_PHASE = np.radians(1.0)  # mean error that counts as locked
_LOCKED_SCATTER = 0.5  # 1σ of the frequency over the record, in half-power half widths ζω


class LoopGains(NamedTuple):
    """Rates of the loop, in multiples of 1/s.

    `filter_rate` is how fast the filters forget and `loop_rate` is λ; a loop is well tuned where
    λ is several times the decay ζω of the structure and a fifth of the filter's rate or less.
    """

    filter_rate: float
    loop_rate: float


class LoopState(NamedTuple):
    """Angle and integral of the loop, and what its filters know."""

    angle: Float[Array, ""]
    integral: Float[Array, ""]  # rad/s
    filters: FourierState  # force, velocity
    frequency: Float[Array, ""]  # rad/s


class LoopReport(NamedTuple):
    """What the loop writes down at a sample."""

    frequency: Float[Array, ""]  # rad/s
    angle: Float[Array, ""]  # rad, of the drive at the sample


class PhaseLockedLoop(AbstractController):
    """The controller: a voltage of constant amplitude whose frequency holds the phase."""

    voltage: Float[Array, ""]
    start_frequency: Float[Array, ""]  # rad/s
    decay: Float[Array, ""]  # ζω of the linear mode, 1/s
    filter_rate: Float[Array, ""]  # 1/s
    loop_rate: Float[Array, ""]  # 1/s
    target: Float[Array, ""]  # rad, phase of the velocity ahead of the force

    def initial(self) -> LoopState:
        """See `AbstractController.initial`."""
        zero = jnp.zeros(())
        return LoopState(zero, zero, nothing_followed(2, _ORDERS), self.start_frequency)

    def step(
        self, state: LoopState, sample: Sample, period: Float[Array, ""]
    ) -> tuple[LoopState, Array, LoopReport]:
        """See `AbstractController.step`."""
        seen = jnp.stack([sample.force, sample.velocity])
        filters = followed(state.filters, seen, state.angle, _ORDERS, self.filter_rate * period)
        ratio = filters.fundamental(1) * jnp.conj(filters.fundamental(0))
        turned = ratio * jnp.exp(-1j * self.target)
        phase = jnp.where(jnp.abs(ratio) > 0, jnp.angle(turned), 0.0)
        proportional = 2 * self.loop_rate - self.decay
        integral = state.integral + self.loop_rate**2 * phase * period
        frequency = self.start_frequency + proportional * phase + integral
        # A frequency off by more than half of it means that the loop is lost.
        frequency = jnp.clip(frequency, 0.5 * self.start_frequency, 2.0 * self.start_frequency)
        angle = jnp.mod(state.angle + frequency * period, 2 * jnp.pi)
        report = LoopReport(frequency, state.angle)
        after = LoopState(angle, integral, filters, frequency)
        return after, self.voltage * jnp.cos(angle), report


def standard_gains(laboratory: Laboratory) -> LoopGains:
    """Gains from the linear mode of interest: a filter of ω/20 and a loop of a sixth of that."""
    return LoopGains(laboratory.frequency / 20, laboratory.frequency / 120)


def phase_locked_loop(
    laboratory: Laboratory,
    voltages: Float[np.ndarray, " level"],
    *,
    gains: LoopGains | None = None,
    settle_cycles: int = 300,
    record_cycles: int = 50,
    seed: int = 0,
) -> MethodResult:
    """Track the backbone: the loop stays closed while the drive voltage steps up.

    At each voltage the loop has `settle_cycles` of the linear mode to lock, then `record_cycles`
    are recorded. Fundamentals of force and velocity come from the record itself, by projection on
    the drive's angle; damping is from the balance of power, 2ζ̃ω̃ = |Φ_r Φᵀb| F / |v|.

    Arguments: `voltages` in V, in the order of the test; `gains` by default `standard_gains`.
    Returns a `MethodResult` with a point a voltage; 1σ from the noise of the samples, which the
    loop carries into its frequency, or from the scatter between tenths of the record where that
    says more, and from the noise of the velocity at which the point lies, along the slope between
    the levels. Levels whose record is off phase resonance by more than 1°, or whose
    frequency wandered by more than half of ζω (1σ), are `NOT_LOCKED`. `test_seconds` counts
    everything.
    Raises `ValueError` for voltages or cycles that are not positive.
    Validity: where the natural frequency changes much with little amplitude (a stop, a gap) the
    loop must follow faster than the motion grows: gains above the standard ones, or small steps.
    A loop that has not come to rest is off by some times what it still drifts, which 1σ does not
    know: 0.005 % of the frequency after 300 cycles at a large step under v|v|, nothing after 900.
    """
    levels = positive("voltages", voltages)
    if settle_cycles < 1 or record_cycles < 1:
        raise ValueError(
            f"`settle_cycles` and `record_cycles` must be 1 or more, but are {settle_cycles} and "
            f"{record_cycles}."
        )
    points: list[MethodPoint] = []
    velocity_std: list[float] = []
    state: LabState | None = None
    seconds = 0.0
    for level, voltage in enumerate(levels, 1):
        held = lock_in(
            laboratory,
            float(voltage),
            gains=gains,
            settle_cycles=settle_cycles,
            record_cycles=record_cycles,
            start=state,
            level=level,
            seed=seed + 7919 * level,
        )
        points.append(held.point)
        velocity_std.append(held.velocity_std)
        state, seconds = held.state, seconds + held.seconds
    points = with_velocity_errors(points, np.array(velocity_std))
    return method_result("pll", points, len(levels), test_seconds=seconds)


class PhaseSweep(NamedTuple):
    """States of one drive voltage at held phases; NaN where a phase was not held."""

    phase: Float[np.ndarray, " state"]  # rad, asked for: velocity ahead of force
    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N
    velocity: Complex[np.ndarray, " state"]  # m/s, relative to the force
    status: tuple[MethodStatus, ...]
    test_seconds: float


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
    """A whole response at one drive voltage, its unstable part included, phase by phase.

    On the response of one mode the phase falls steadily along the curve, around its folds too, so
    that a loop that holds one phase after another meets no jump.

    Arguments: `voltage` in V; `phases` in rad in the order of the test, positive below resonance;
    the others as in `phase_locked_loop`. Returns a `PhaseSweep`.
    Raises `ValueError` for a voltage that is not positive and phases beyond ±90°.
    Reference: V. Denis, M. Jossic, C. Giraud-Audine, B. Chomette, A. Renault & O. Thomas, Mech.
    Syst. Signal Process. 106 (2018) 430, doi:10.1016/j.ymssp.2018.01.014.
    """
    wanted = np.atleast_1d(np.asarray(phases, dtype=float))
    if not (np.isfinite(voltage) and voltage > 0) or not np.all(np.abs(wanted) < np.pi / 2):
        raise ValueError(
            f"`voltage` must be positive and `phases` within ±90°, but are {voltage} and {phases}."
        )
    held: list[HeldPhase] = []
    for number, phase in enumerate(wanted, 1):
        held.append(
            lock_in(
                laboratory,
                float(voltage),
                phase=float(phase),
                gains=gains,
                settle_cycles=settle_cycles,
                record_cycles=record_cycles,
                start=held[-1].state if held else None,
                seed=seed + 7919 * number,
            )
        )
    return PhaseSweep(
        wanted,
        np.array([one.frequency for one in held]),
        np.array([one.force for one in held]),
        np.array([one.velocity for one in held]),
        tuple(one.point.status for one in held),
        sum(one.seconds for one in held),
    )


class HeldPhase(NamedTuple):
    """The motion that a loop held, and where the test may go on from; NaN where it held none."""

    point: MethodPoint  # a resonance where the phase was zero
    frequency: float  # rad/s
    force: float  # N
    velocity: complex  # m/s, relative to the force
    velocity_std: float  # relative
    state: LabState
    seconds: float


def lock_in(
    laboratory: Laboratory,
    voltage: float,
    *,
    phase: float = 0.0,
    gains: LoopGains | None = None,
    settle_cycles: int = 300,
    record_cycles: int = 50,
    start: LabState | None = None,
    level: int = 1,
    seed: int = 0,
) -> HeldPhase:
    """One level of `phase_locked_loop`, or one phase of `phase_sweep`.

    Arguments: `phase` in rad, of the velocity ahead of the force; `start` is the state of the
    level before, by default rest; the others as there.
    """
    rates = standard_gains(laboratory) if gains is None else gains
    decay = laboratory.decay
    settle, keep = laboratory.samples(settle_cycles), laboratory.samples(record_cycles)
    numbers = (voltage, laboratory.frequency, decay, *rates, phase)
    loop = PhaseLockedLoop(*(jnp.asarray(value, dtype=float) for value in numbers))
    record, state = run_test(laboratory, loop, settle + keep, start=start, seed=seed)
    frequency, angle, force, velocity = (
        np.asarray(column)[-keep:]
        for column in (record.report.frequency, record.report.angle, record.force, record.velocity)
    )
    # A Hann window: the record need not hold whole cycles.
    turned = 2 * np.exp(-1j * angle) * np.hanning(keep) / np.hanning(keep).mean()
    period = 1 / laboratory.sampling_rate
    noise = [noise_of_sample(signal, angle) for signal in (force, velocity)]
    locked = _Locked(
        *(frequency, force * turned, velocity * turned, decay, phase),
        *(np.array(noise), period, rates),
    )
    seconds = (settle + keep) / laboratory.sampling_rate
    if not locked.holds():
        lost = MethodPoint(MethodStatus.NOT_LOCKED, level)
        return HeldPhase(lost, np.nan, np.nan, complex(np.nan), np.nan, state, seconds)
    push, speed = np.mean(locked.force), np.mean(locked.velocity)
    relative = complex(speed * np.conj(push) / np.abs(push))
    point = locked.point(level, drive_point(laboratory.structure.modes))
    return HeldPhase(
        *(point, point.natural_frequency, float(np.abs(push)), relative, locked.velocity_std()),
        *(state, seconds),
    )


class _Locked(NamedTuple):
    """The end of a record: frequency, and force and velocity turned against the drive."""

    frequency: np.ndarray  # rad/s
    force: np.ndarray  # N, complex
    velocity: np.ndarray  # m/s, complex
    decay: float  # ζω of the linear mode, 1/s
    phase: float  # rad, asked for
    noise: Float[np.ndarray, "2"]  # of a sample of force (N) and velocity (m/s)
    period: float  # s, of sampling
    gains: LoopGains

    def holds(self) -> bool:
        ratio = np.mean(self.velocity) / np.mean(self.force) * np.exp(-1j * self.phase)
        if not np.isfinite(ratio) or abs(np.angle(ratio)) > _LOCKED_PHASE:
            return False
        return float(np.std(self.frequency)) < _LOCKED_SCATTER * self.decay

    def densities(self) -> Float[np.ndarray, "2"]:
        """Variances of ln F and ln v, or of their phases, over a stretch, times its length."""
        size = np.abs([np.mean(self.force), np.mean(self.velocity)])
        return 2 * self.period * (self.noise / size) ** 2

    def velocity_std(self) -> float:
        """1σ of the velocity's mean over the record, relative."""
        seconds = len(self.frequency) * self.period
        return float(np.sqrt(HANN * self.densities()[1] / seconds))

    def point(self, level: int, per_force: float) -> MethodPoint:
        """Means over the record, and 1σ from its noise and the scatter between its tenths."""
        parts = np.array_split(np.arange(len(self.frequency)), PARTS)
        inner = parts[1:-1]
        each = [np.mean(self.force[k]) / np.mean(self.velocity[k]) for k in inner]
        omega, damping = float(np.mean(self.frequency)), np.real(each)
        spread = np.std([np.mean(self.frequency[k]) for k in parts])
        turn = self.decay * np.std(np.angle(each))
        ratio = np.mean(self.force) / np.mean(self.velocity)  # N s/m
        # Of phase and of the logarithm of F/v.
        density, seconds = float(np.sum(self.densities())), len(self.frequency) * self.period
        scatter = float(np.std(damping)) / np.sqrt(len(inner) - 1)
        of_noise = float(np.real(ratio)) * np.sqrt(HANN * density / seconds)
        omega_std = max(
            float(np.hypot(spread, turn) / np.sqrt(PARTS - 1)),
            np.sqrt(density) * _carried(self.gains, self.decay, seconds),
        )
        return MethodPoint(
            MethodStatus.FOUND,
            level,
            float(np.abs(np.mean(self.velocity))),
            omega,
            omega_std,
            per_force * float(np.real(ratio)) / (2 * omega),
            per_force * max(scatter, of_noise) / (2 * omega),
        )


def _carried(gains: LoopGains, decay: float, seconds: float) -> float:
    """1σ of the frequency's mean over a record for white noise of the phase of density one.

    The loop brings the measured phase to zero, and noise with it: from noise to frequency
    G = C D/(1 + C D P), with the law C = k_p + k_i/s, the filter D and the structure
    P = 1/(s + ζω). Neighbouring parts of a record share what a loop as slow as they does.
    """
    fast = max(*gains, 1 / seconds)
    rate = np.linspace(0.0, _FASTEST * fast, _RATES)[1:]
    s = 1j * rate
    law = (2 * gains.loop_rate - decay) + gains.loop_rate**2 / s
    seen = law * gains.filter_rate / (s + gains.filter_rate)
    power = np.abs(seen / (1 + seen / (s + decay))) ** 2
    mean = np.sinc(rate * seconds / (2 * np.pi)) ** 2
    return float(np.sqrt(np.sum(power * mean) * (rate[1] - rate[0]) / np.pi))
