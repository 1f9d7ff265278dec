"""Control-based continuation: a feedback that holds a target motion, and vanishes on it.

The voltage is k (w(t) − v(t)), w the target velocity. The target's fundamental is prescribed; its
higher harmonics are set to those measured until the feedback has none of its own (Picard
iteration), so that what drives the structure is a force of one frequency: motions that an open
loop cannot hold, on the middle branch of a fold, are then held as any other. At fixed frequency
the force over the amplitude is an S-curve; where force and velocity are in phase lies the
backbone, found by the secant method in frequency.

With a `filter_rate` only the fundamental is fed back, k (w − v₁) with v₁ from an adaptive filter:
the voltage is then free of higher harmonics from the beginning, and modes above, which a feedback
of the whole velocity might drive unstable, are left alone.

References: J. Sieber & B. Krauskopf, Nonlinear Dyn. 51 (2008) 365,
doi:10.1007/s11071-007-9217-2; L. Renson, A. Gonzalez-Buelga, D. A. W. Barton & S. A. Neild,
J. Sound Vib. 367 (2016) 145, doi:10.1016/j.jsv.2015.12.035; for adaptive filters in the loop,
G. Abeloos, L. Renson, C. Collette & G. Kerschen, Nonlinear Dyn. 104 (2021) 3793,
doi:10.1007/s11071-021-06506-z.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.methods.bench.equipment import positive
from snrmjax.methods.bench.fourier_filter import FourierState, followed, nothing_followed
from snrmjax.methods.bench.held_phasors import (
    HANN,
    noise_of_sample,
    scatter_of_ratio,
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

_ORDERS = np.arange(1, 8)  # harmonics of the target
_PHASE = np.radians(0.5)  # between force and velocity, below which a motion is on the backbone
_STEADY = 0.01  # change of the velocity's fundamental between the halves of a record, relative
_LARGEST = 100.0  # times the target, beyond which the loop is unstable
_MOST_STEPS = 8  # of frequency at one amplitude
_FIRST_STEP = 0.002  # of the frequency, relative, where a slope is not yet known


class FeedbackSettings(NamedTuple):
    """The feedback and how long each measurement takes."""

    gain: float  # V s/m
    settle_cycles: int = 60
    record_cycles: int = 20
    picard_steps: int = 6
    invasive: float = 0.02  # higher harmonics of the feedback over its fundamental, at most
    filter_rate: float = 0.0  # 1/s, of the filter of the fundamental; 0 feeds the whole velocity


class HeldMotion(NamedTuple):
    """A motion that the feedback holds: fundamentals and how far it disturbs."""

    frequency: float  # rad/s
    force: complex  # N
    velocity: complex  # m/s
    invasive: float  # higher harmonics of the voltage over its fundamental
    unsteady: float  # change of the velocity between the halves of the record, relative
    ratio_std: float  # of force over velocity, relative: of either part
    velocity_std: float  # relative


class SCurve(NamedTuple):
    """Force over amplitude at one frequency, folds included; NaN where no motion was held."""

    velocity: Float[np.ndarray, " point"]  # m/s
    force: Float[np.ndarray, " point"]  # N
    invasive: Float[np.ndarray, " point"]
    test_seconds: float


class TargetFeedback(AbstractController):
    """The controller: velocity feedback towards a periodic target."""

    gain: Float[Array, ""]
    frequency: Float[Array, ""]  # rad/s
    target: Complex[Array, " order"]  # m/s

    def initial(self) -> Float[Array, ""]:
        """See `AbstractController.initial`: the angle of the target."""
        return jnp.zeros(())

    def step(
        self, state: Float[Array, ""], sample: Sample, period: Float[Array, ""]
    ) -> tuple[Array, Array, Array]:
        """See `AbstractController.step`."""
        wanted = jnp.sum(jnp.real(self.target * jnp.exp(1j * _ORDERS * state)))
        voltage = self.gain * (wanted - sample.velocity)
        return jnp.mod(state + self.frequency * period, 2 * jnp.pi), voltage, state


class FundamentalFeedback(AbstractController):
    """The controller that feeds back what an adaptive filter follows of the fundamental."""

    gain: Float[Array, ""]
    frequency: Float[Array, ""]  # rad/s
    target: Float[Array, ""]  # m/s
    filter_rate: Float[Array, ""]  # 1/s

    def initial(self) -> tuple[Float[Array, ""], FourierState]:
        """See `AbstractController.initial`: the angle of the target, and the filter."""
        return jnp.zeros(()), nothing_followed(1, _ORDERS)

    def step(
        self, state: tuple[Float[Array, ""], FourierState], sample: Sample, period: Float[Array, ""]
    ) -> tuple[tuple[Array, FourierState], Array, Array]:
        """See `AbstractController.step`."""
        angle, filters = state
        share = self.filter_rate * period
        filters = followed(filters, sample.velocity[None], angle, _ORDERS, share)
        missing = self.target - filters.fundamental(0)
        voltage = self.gain * jnp.real(missing * jnp.exp(1j * angle))
        return (jnp.mod(angle + self.frequency * period, 2 * jnp.pi), filters), voltage, angle


class _Bench:
    """The laboratory as it goes on from one measurement to the next."""

    def __init__(self, laboratory: Laboratory, settings: FeedbackSettings, seed: int):
        self.laboratory, self.settings, self.seed = laboratory, settings, seed
        self.samples, self.runs = 0, 0
        self.state: LabState | None = None
        self.settle = laboratory.samples(settings.settle_cycles)
        self.keep = laboratory.samples(settings.record_cycles)
        self.higher = np.zeros(len(_ORDERS) - 1, dtype=complex)

    @property
    def seconds(self) -> float:
        return self.samples / self.laboratory.sampling_rate

    def feedback(self, frequency: float, amplitude: float) -> AbstractController:
        """The controller of the next measurement."""
        gain, omega = jnp.asarray(float(self.settings.gain)), jnp.asarray(float(frequency))
        if self.settings.filter_rate:
            rate = jnp.asarray(float(self.settings.filter_rate))
            return FundamentalFeedback(gain, omega, jnp.asarray(float(amplitude)), rate)
        target = np.concatenate([[amplitude], self.higher])
        return TargetFeedback(gain, omega, jnp.asarray(target))

    def held(self, frequency: float, amplitude: float) -> HeldMotion:
        """The motion under a target of this amplitude, higher harmonics left alone."""
        for _ in range(self.settings.picard_steps):
            feedback = self.feedback(frequency, amplitude)
            self.runs += 1
            count = self.settle + self.keep
            record, self.state = run_test(
                self.laboratory,
                feedback,
                count,
                start=self.state,
                seed=self.seed + 7919 * self.runs,
            )
            self.samples += count
            angle, force, velocity, voltage = (
                np.asarray(column)[-self.keep :]
                for column in (record.report, record.force, record.velocity, record.voltage)
            )
            # A diverging loop may leave numbers whose squares overflow, or none at all.
            if not np.abs(velocity).max() < _LARGEST * amplitude:
                self.state, self.higher = None, np.zeros_like(self.higher)
                return HeldMotion(frequency, *6 * (np.nan,))
            moved, drive, pushed = (_harmonics(x, angle) for x in (velocity, voltage, force))
            invasive = float(np.linalg.norm(drive[1:]) / np.abs(drive[0]))
            self.higher = moved[1:]
            if invasive < self.settings.invasive or self.settings.filter_rate:
                break
        halves = [
            _harmonics(velocity[part], angle[part])[0]
            for part in (slice(self.keep // 2), slice(self.keep // 2, None))
        ]
        unsteady = float(abs(halves[1] - halves[0]) / abs(moved[0]))
        # Of noise alone: a Hann window keeps so much of the variance of a mean.
        share = np.sqrt(2 * HANN / self.keep)
        noise = [
            share * noise_of_sample(signal, angle) / abs(size)
            for signal, size in ((force, pushed[0]), (velocity, moved[0]))
        ]
        scatter = np.sqrt(HANN) * scatter_of_ratio(force, velocity, angle)
        return HeldMotion(
            *(frequency, complex(pushed[0]), complex(moved[0]), invasive, unsteady),
            *(max(float(np.hypot(*noise)), float(scatter)), float(noise[1])),
        )

    def holds(self, found: HeldMotion) -> bool:
        """Whether a motion was held, steadily and without invasion."""
        return found.invasive < self.settings.invasive and found.unsteady < _STEADY


def _harmonics(signal: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Complex amplitudes of the target's harmonics, through a Hann window."""
    window = 2 * np.hanning(len(angle)) / np.hanning(len(angle)).mean()
    return (np.exp(-1j * _ORDERS[:, None] * angle) * window / len(angle)) @ signal


def s_curve(
    laboratory: Laboratory,
    frequency: float,
    amplitudes: Float[np.ndarray, " point"],
    settings: FeedbackSettings,
    *,
    seed: int = 0,
) -> SCurve:
    """Force over velocity at one frequency, by raising the target's amplitude.

    Arguments: `frequency` in rad/s; `amplitudes` of the target in m/s, above those that result,
    since the feedback leaves a distance. Returns an `SCurve`: where the force falls while the
    velocity rises, an open loop under that force would jump. Motions whose feedback kept harmonics
    of its own, or that were not steady within 1 %, are NaN.
    Raises `ValueError` for numbers that are not positive.
    """
    targets = positive("amplitudes", amplitudes)
    (omega,) = positive("frequency", frequency)
    bench = _Bench(laboratory, _checked(settings), seed)
    found = [bench.held(float(omega), float(size)) for size in targets]
    held = np.array([bench.holds(one) for one in found])
    return SCurve(
        np.where(held, [abs(one.velocity) for one in found], np.nan),
        np.where(held, [abs(one.force) for one in found], np.nan),
        np.array([one.invasive for one in found]),
        bench.seconds,
    )


def control_based_continuation(
    laboratory: Laboratory,
    amplitudes: Float[np.ndarray, " level"],
    settings: FeedbackSettings,
    *,
    seed: int = 0,
) -> MethodResult:
    """The backbone: at each target amplitude the frequency at which force and velocity agree.

    The phase that is left between them is taken away by the balance of the mode,
    ω̃² − Ω² + 2iζ̃ω̃Ω = iΩ|Φ_r Φᵀb| F/v.

    Arguments: `amplitudes` of the target in m/s, rising. Returns a `MethodResult` with a point an
    amplitude; damping by the balance of power. Amplitudes whose phase was not brought within 0.5°,
    whose feedback kept harmonics of its own beyond `settings.invasive`, or that were not steady
    within 1 %, are `NOT_LOCKED`. 1σ are those of the noise and of the scatter within a record; a
    second mode close by or harmonics of the force are not in them. `test_seconds` counts
    everything.
    Raises `ValueError` for numbers that are not positive.
    """
    targets = positive("amplitudes", amplitudes)
    bench = _Bench(laboratory, _checked(settings), seed)
    modes, omega, decay = laboratory.structure.modes, laboratory.frequency, laboratory.decay
    points, velocity_std = [], []
    for level, size in enumerate(targets, 1):
        found = _resonance(bench, omega, float(size), decay)
        if found is None:
            points.append(MethodPoint(MethodStatus.NOT_LOCKED, level))
            velocity_std.append(np.nan)
            continue
        omega = found.frequency
        points.append(_point(level, found, drive_point(modes)))
        velocity_std.append(found.velocity_std)
    points = with_velocity_errors(points, np.array(velocity_std))
    return method_result("cbc", points, len(targets), test_seconds=bench.seconds)


def _point(level: int, found: HeldMotion, per_force: float) -> MethodPoint:
    """Both numbers by the balance of the mode in a motion near its resonance."""
    balance = per_force * found.force / found.velocity  # 2ζ̃ω̃ + (ω̃² − Ω²)/(iΩ)
    omega = np.sqrt(found.frequency**2 - found.frequency * balance.imag)
    error = abs(balance) * found.ratio_std
    return MethodPoint(
        MethodStatus.FOUND,
        level,
        velocity=abs(found.velocity),
        natural_frequency=float(omega),
        natural_frequency_std=error / 2,
        damping_ratio=balance.real / (2 * float(omega)),
        damping_ratio_std=error / (2 * float(omega)),
    )


def _resonance(bench: _Bench, omega: float, size: float, decay: float) -> HeldMotion | None:
    """The motion in phase with its force at one amplitude, by the secant method."""
    before: tuple[float, float] | None = None
    for _ in range(_MOST_STEPS):
        found = bench.held(omega, size)
        phase = float(np.angle(found.velocity / found.force))
        if not np.isfinite(phase):
            return None
        if abs(phase) < _PHASE:
            return found if bench.holds(found) else None
        # A mode's tan φ = (ω̃² − Ω²)/(2ζ̃ω̃Ω): straight in frequency, with slope −1/(ζ̃ω̃).
        error = np.tan(np.clip(phase, -1.4, 1.4))
        step = decay * error
        if before is not None and before[1] != error:
            secant = -error * (omega - before[0]) / (error - before[1])
            step = secant if abs(secant) < 10 * abs(step) else step
        before = omega, float(error)
        largest = 10 * _FIRST_STEP * omega
        omega += float(np.clip(step, -largest, largest))
    return None


def _checked(settings: FeedbackSettings) -> FeedbackSettings:
    if not all(np.isfinite(value) and value > 0 for value in settings[:-1]) or not (
        0 <= settings.filter_rate < np.inf
    ):
        raise ValueError(f"the settings of the feedback must be positive, but are {settings}.")
    return settings
