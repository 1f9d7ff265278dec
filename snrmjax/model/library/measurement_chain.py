"""Errors of the force's spectrum and of the instruments, and what sensors see beside a mode."""

from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.model.effect_base import AbstractForceSpectrum, AbstractMeasurementEffect, Scalar
from snrmjax.numerics.rules import ABOVE_MINUS_ONE, OF_A_MODE, Rule

Amplitude = Float[Array, " state"]
Velocity = Complex[Array, "state harmonic sensor"]


class ForceHarmonics(AbstractForceSpectrum):
    """The force F cos Ωt is F (cos Ωt + `second` cos 2Ωt + `third` cos 3Ωt)."""

    kind: ClassVar[str] = "force_harmonics"
    second: Scalar
    third: Scalar

    def load_orders(self) -> Float[Array, " order"]:
        """See `AbstractForceSpectrum.load_orders`."""
        return jnp.stack([jnp.zeros(()), jnp.ones(()), self.second, self.third])


class ForceGainError(AbstractMeasurementEffect):
    """The true force is the recorded one times 1 + g; `gain` is g."""

    kind: ClassVar[str] = "force_gain_error"
    rules: ClassVar[Mapping[str, tuple[Rule, ...]]] = {"gain": (ABOVE_MINUS_ONE,)}
    gain: Scalar

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        """See `AbstractMeasurementEffect.recorded`."""
        return force / (1 + self.gain), velocity


class ForceOffsetError(AbstractMeasurementEffect):
    """The true force's amplitude is the recorded one plus f₀; `offset` is f₀ in N."""

    kind: ClassVar[str] = "force_offset_error"
    offset: Scalar

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        """See `AbstractMeasurementEffect.recorded`."""
        return force - self.offset, velocity


class SensorGainError(AbstractMeasurementEffect):
    """The recorded velocity, every harmonic of it, is the true one times 1 + s; `gain` is s."""

    kind: ClassVar[str] = "sensor_gain_error"
    rules: ClassVar[Mapping[str, tuple[Rule, ...]]] = {"gain": (ABOVE_MINUS_ONE,)}
    gain: Scalar

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        """See `AbstractMeasurementEffect.recorded`."""
        return force, velocity * (1 + self.gain)


class SensorPhaseError(AbstractMeasurementEffect):
    """The recorded velocity leads the true one by φ; `phase_deg` is φ in degrees.

    As a shift in time would have it: harmonic h leads by hφ, and the mean is untouched.
    """

    kind: ClassVar[str] = "sensor_phase_error"
    phase_deg: Scalar

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        """See `AbstractMeasurementEffect.recorded`."""
        order = jnp.arange(velocity.shape[-2])[:, None]
        return force, velocity * jnp.exp(1j * order * jnp.deg2rad(self.phase_deg))


class ResidualMode(AbstractMeasurementEffect):
    """X_recorded = X + R F: far modes move every sensor with the force; `receptance` is R in m/N.

    The velocity's fundamental gains iΩRF.
    """

    kind: ClassVar[str] = "residual_mode"
    stage: ClassVar[int] = 1
    receptance: Scalar

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        """See `AbstractMeasurementEffect.recorded`."""
        return force, _moved_by(velocity, 1j * frequency * self.receptance * force)


class CloseMode(AbstractMeasurementEffect):
    """X_recorded = X + A F/(ω² − Ω² + 2iζωΩ): a linear mode close by, which all sensors see alike.

    `modal_constant` is A in 1/kg, the product of the mode's shapes at sensor and force;
    `frequency_hz` and `damping_ratio` are the mode's own. The velocity's fundamental gains the
    mode's; it is orthogonal to the mode of interest and does not act on it.
    Reference: for the modal constant, D. J. Ewins, Modal Testing, 2nd ed. (2000).
    """

    kind: ClassVar[str] = "close_mode"
    stage: ClassVar[int] = 1
    rules: ClassVar[Mapping[str, tuple[Rule, ...]]] = OF_A_MODE
    modal_constant: Scalar
    frequency_hz: Scalar
    damping_ratio: Scalar

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        """See `AbstractMeasurementEffect.recorded`."""
        own = 2 * jnp.pi * self.frequency_hz
        stiffness = own**2 - frequency**2 + 2j * self.damping_ratio * own * frequency
        return force, _moved_by(velocity, 1j * frequency * self.modal_constant * force / stiffness)


class ModeShapeChange(AbstractMeasurementEffect):
    """Φ → Φ(1 + s Q²) at every sensor; `coefficient` is s in 1/(kg m²), Q the amplitude."""

    kind: ClassVar[str] = "mode_shape_change"
    stage: ClassVar[int] = 0
    coefficient: Scalar

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        """See `AbstractMeasurementEffect.recorded`."""
        return force, velocity * (1 + self.coefficient * displacement**2)[..., None, None]


def _moved_by(velocity: Velocity, added: Complex[Array, " state"]) -> Velocity:
    """Velocities whose fundamental has gained something, at every sensor."""
    fundamental = np.eye(velocity.shape[-2])[1][:, None]
    return velocity + added[..., None, None] * fundamental
