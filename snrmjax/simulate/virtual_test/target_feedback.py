"""Control-based continuation: feedback towards a target motion, noninvasive once it is reached.

The voltage is k (w(t) − v(t)), w the target velocity. The target's fundamental is prescribed; its
higher harmonics are set to those measured until the feedback has none of its own (Picard
iteration), so that the structure is driven by a force of one frequency: motions that are unstable
in open loop, on the middle branch between two folds, are stabilised like any other. At fixed
frequency the force over the amplitude is an S-curve; the backbone, with force and velocity in
phase, is located by the secant method in frequency.

With a `filter_rate` only the fundamental is fed back, k (w − v₁) with v₁ from an adaptive filter:
the voltage then has no higher harmonics from the start, and higher modes, which feedback of the
whole velocity might destabilise, are not affected.

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
    ControlledMotion,
    FourierState,
    empty_filter,
    followed,
    noise_of_sample,
    scatter_of_ratio,
    through_hann_window,
)

_ORDERS = np.arange(1, 8)  # harmonics of the target
_PHASE = np.radians(0.5)  # largest phase between force and velocity on the backbone
_STEADY = 0.01  # largest relative change of the velocity fundamental between halves of a record
_LARGEST = 100.0  # velocity over the target beyond which the loop is unstable
_MOST_STEPS = 8  # in frequency at one amplitude
_LARGEST_STEP = 0.02  # of the frequency, relative
_NEXT_SEED = 7919  # a prime, so that runs of different tests do not share their noise


class FeedbackSettings(NamedTuple):
    """Settings of the feedback and of each measurement."""

    gain: float  # V s/m
    settle_cycles: int = 60
    record_cycles: int = 20
    picard_steps: int = 6
    invasive: float = 0.02  # largest ratio of higher harmonics of the feedback to its fundamental
    filter_rate: float = (
        0.0  # 1/s, of the filter of the fundamental; 0 feeds back the whole velocity
    )


class SCurve(NamedTuple):
    """Force over amplitude at one frequency, folds included; NaN where control failed."""

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
        """The angle of the target."""
        return jnp.zeros(())

    def step(
        self, state: Float[Array, ""], sample: Sample, period: Float[Array, ""]
    ) -> tuple[Array, Array, Array]:
        """The voltage that drives the velocity towards the target."""
        wanted = jnp.sum(jnp.real(self.target * jnp.exp(1j * _ORDERS * state)))
        voltage = self.gain * (wanted - sample.velocity)
        return jnp.mod(state + self.frequency * period, 2 * jnp.pi), voltage, state


class FundamentalFeedback(AbstractController):
    """The controller with feedback of the fundamental from an adaptive filter."""

    gain: Float[Array, ""]
    frequency: Float[Array, ""]  # rad/s
    target: Float[Array, ""]  # m/s
    filter_rate: Float[Array, ""]  # 1/s

    def initial(self) -> tuple[Float[Array, ""], FourierState]:
        """The angle of the target, and the filter."""
        return jnp.zeros(()), empty_filter(1, _ORDERS)

    def step(
        self, state: tuple[Float[Array, ""], FourierState], sample: Sample, period: Float[Array, ""]
    ) -> tuple[tuple[Array, FourierState], Array, Array]:
        """The voltage that drives the velocity's fundamental towards the target."""
        angle, filters = state
        fraction = self.filter_rate * period
        filters = followed(filters, sample.velocity[None], angle, _ORDERS, fraction)
        missing = self.target - filters.harmonics[0, 0]
        voltage = self.gain * jnp.real(missing * jnp.exp(1j * angle))
        return (jnp.mod(angle + self.frequency * period, 2 * jnp.pi), filters), voltage, angle


class FeedbackBench:
    """The laboratory under target feedback, with its state kept between measurements.

    Raises `ValueError` for settings that are not positive.
    """

    def __init__(self, laboratory: Laboratory, settings: FeedbackSettings, seed: int):
        if not all(np.isfinite(value) and value > 0 for value in settings[:-1]) or not (
            0 <= settings.filter_rate < np.inf
        ):
            raise InputError(f"the settings of the feedback must be positive, but are {settings}.")
        self.laboratory, self.settings, self.seed = laboratory, settings, seed
        self.runs = 0
        self.state: LabState | None = None
        self.settle = laboratory.samples(settings.settle_cycles)
        self.keep = laboratory.samples(settings.record_cycles)
        self.higher = np.zeros(len(_ORDERS) - 1, dtype=complex)

    @property
    def seconds(self) -> float:
        """Duration of all measurements in s."""
        return self.runs * (self.settle + self.keep) / self.laboratory.sampling_rate

    def _feedback(self, frequency: float, amplitude: float) -> AbstractController:
        """The controller of the next measurement."""
        gain, omega = jnp.asarray(float(self.settings.gain)), jnp.asarray(float(frequency))
        if self.settings.filter_rate:
            rate = jnp.asarray(float(self.settings.filter_rate))
            return FundamentalFeedback(gain, omega, jnp.asarray(float(amplitude)), rate)
        target = np.concatenate([[amplitude], self.higher])
        return TargetFeedback(gain, omega, jnp.asarray(target))

    def motion(self, frequency: float, amplitude: float) -> ControlledMotion:
        """The motion under a target of this amplitude (m/s), with its own higher harmonics."""
        for _ in range(self.settings.picard_steps):
            self.runs += 1
            record, self.state = run_test(
                self.laboratory,
                self._feedback(frequency, amplitude),
                self.settle + self.keep,
                start=self.state,
                seed=self.seed + _NEXT_SEED * self.runs,
            )
            angle, force, velocity, voltage = (
                np.asarray(column)[-self.keep :]
                for column in (record.report, record.force, record.velocity, record.voltage)
            )
            # A diverging loop may give numbers whose squares overflow, or NaN.
            if not np.abs(velocity).max() < _LARGEST * amplitude:
                self.state, self.higher = None, np.zeros_like(self.higher)
                return ControlledMotion(False, frequency)
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
        # From noise alone: 1σ of an amplitude through a Hann window over that of a sample.
        fraction = np.sqrt(2 * HANN / self.keep)
        noise = [
            fraction * noise_of_sample(signal, angle) / abs(amplitude_of)
            for signal, amplitude_of in ((force, pushed[0]), (velocity, moved[0]))
        ]
        scatter = np.sqrt(HANN) * scatter_of_ratio(force, velocity, angle)
        return ControlledMotion(
            on_target=invasive < self.settings.invasive and unsteady < _STEADY,
            frequency=frequency,
            force=complex(pushed[0]),
            velocity=complex(moved[0]),
            ratio_std=max(float(np.hypot(*noise)), float(scatter)),
            velocity_std=float(noise[1]),
            invasive=invasive,
        )

    def resonance(self, omega: float, amplitude: float) -> ControlledMotion:
        """The motion in phase with its force at one amplitude, by the secant method.

        Starts at the frequency `omega` (rad/s); not `on_target` if the phase stays beyond 0.5°.
        """
        before: tuple[float, float] | None = None
        for _ in range(_MOST_STEPS):
            motion = self.motion(omega, amplitude)
            phase = float(np.angle(motion.velocity / motion.force))
            if not abs(phase) >= _PHASE:  # on the backbone, or control lost (NaN)
                return motion
            # A mode's tan φ = (ω̃² − Ω²)/(2ζ̃ω̃Ω): linear in frequency, with slope −1/(ζ̃ω̃).
            error = np.tan(np.clip(phase, -1.4, 1.4))
            step = self.laboratory.decay * error
            if before is not None and before[1] != error:
                secant = -error * (omega - before[0]) / (error - before[1])
                step = secant if abs(secant) < 10 * abs(step) else step
            before = omega, float(error)
            omega += float(np.clip(step, -_LARGEST_STEP * omega, _LARGEST_STEP * omega))
        return motion._replace(on_target=False)


def _harmonics(signal: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Complex amplitudes of the target's harmonics, through a Hann window."""
    return np.mean(through_hann_window(signal, _ORDERS[:, None] * angle), axis=1)


@on_numbers("Differentiate the steady states of a model by `sj.simulate.periodic_motion`.")
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
    since proportional feedback leaves an offset. Returns an `SCurve`: where the force falls while
    the velocity rises, the motion is unstable in open loop. Motions with invasive feedback, or that
    were not steady within 1 %, are NaN.
    Raises `ValueError` for numbers that are not positive.
    Not differentiable: differentiate the steady states of a model by
    `snrmjax.simulate.periodic_motion`.
    """
    (omega,) = positive("frequency", frequency)
    bench = FeedbackBench(laboratory, settings, seed)
    motions = [
        bench.motion(float(omega), float(value)) for value in positive("amplitudes", amplitudes)
    ]
    on_target = np.array([motion.on_target for motion in motions])
    return SCurve(
        np.where(on_target, np.abs([motion.velocity for motion in motions]), np.nan),
        np.where(on_target, np.abs([motion.force for motion in motions]), np.nan),
        np.array([motion.invasive for motion in motions]),
        bench.seconds,
    )
