"""Errors of the excitation and the instruments, and modes missing in the model."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.model.effect_base import AbstractForceSpectrum, AbstractMeasurementEffect, Scalar
from snrmjax.model.effect_metadata import (
    ADDED_MODE_DAMPING,
    POSITIVE_FACTOR,
    VISIBLE_CHANGE,
    Part,
    Prior,
    Shape,
    parameter,
)
from snrmjax.numerics.rules import ABOVE_MINUS_ONE, OF_A_DAMPING_RATIO, OF_A_FREQUENCY
from snrmjax.numerics.units import DEGREE, HERTZ

_SCALE = "scale of the response"
_WIDE = 0.15  # relative distance in frequency, beyond which a mode counts as a residual one
_RELATIVE: dict[str, Any] = {  # bounds and starting value of a relative error
    "rules": (ABOVE_MINUS_ONE,),
    "prior": POSITIVE_FACTOR,
    "start": lambda _: VISIBLE_CHANGE,
}
Amplitude = Float[Array, " state"]
Velocity = Complex[Array, "state harmonic sensor"]


class ForceHarmonics(AbstractForceSpectrum):
    """The force F cos Ωt is F (cos Ωt + `second` cos 2Ωt + `third` cos 3Ωt)."""

    kind: ClassVar[str] = "force_harmonics"
    description: ClassVar[str] = (
        "The force of the shaker is not a pure sine: it contains harmonics 2 and 3."
    )
    shape: ClassVar[Shape] = Shape(Part.HARMONICS)
    second: Scalar = parameter(
        "1", "harmonic 2 of the force over its fundamental", start=lambda _: 0.02
    )
    third: Scalar = parameter(
        "1", "harmonic 3 of the force over its fundamental", typical=0.0, start=lambda _: 0.02
    )

    def load_orders(self) -> Float[Array, " order"]:
        return jnp.stack([jnp.zeros(()), jnp.ones(()), self.second, self.third])


class ForceGainError(AbstractMeasurementEffect):
    """The true force is the recorded one times 1 + g; `gain` is g."""

    kind: ClassVar[str] = "force_gain_error"
    description: ClassVar[str] = (
        "The force is recorded in a wrong scale: the calibration factor of the force sensor, or a "
        "mass between it and the structure."
    )
    gain: Scalar = parameter("1", "relative error of the force", **_RELATIVE)

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        return force / (1 + self.gain), velocity


class ForceOffsetError(AbstractMeasurementEffect):
    """The true force's amplitude is the recorded one plus f₀; `offset` is f₀ in N."""

    kind: ClassVar[str] = "force_offset_error"
    description: ClassVar[str] = (
        "The recorded amplitude of the force is too small or too large by a constant, such as a "
        "noise floor or a threshold."
    )
    offset: Scalar = parameter(
        "N",
        "true minus recorded amplitude of the force",
        start=lambda scales: VISIBLE_CHANGE * scales.smallest_force,
    )

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        return force - self.offset, velocity


class SensorGainError(AbstractMeasurementEffect):
    """Every harmonic of the recorded velocity is the true one times 1 + s; `gain` is s."""

    kind: ClassVar[str] = "sensor_gain_error"
    description: ClassVar[str] = (
        "The velocity is recorded in a wrong scale: the calibration factor of the sensor, or peak "
        "values taken for amplitudes."
    )
    gain: Scalar = parameter("1", "relative error of the velocity", **_RELATIVE)

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        return force, velocity * (1 + self.gain)


class SensorPhaseError(AbstractMeasurementEffect):
    """The recorded velocity leads the true one by φ; `phase_deg` is φ in degrees.

    As with a time shift, harmonic h leads by hφ, and the mean is unchanged.
    """

    kind: ClassVar[str] = "sensor_phase_error"
    description: ClassVar[str] = (
        "The recorded velocity leads or lags by a constant phase, such as that of a filter or a "
        "delay between the channels."
    )
    phase_deg: Scalar = parameter(
        "°",
        "phase by which the recorded velocity leads",
        start=lambda _: VISIBLE_CHANGE / DEGREE,
    )

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        order = jnp.arange(velocity.shape[-2])[:, None]
        return force, velocity * jnp.exp(1j * order * jnp.deg2rad(self.phase_deg))


class ResidualMode(AbstractMeasurementEffect):
    """X_recorded = X + R F: residual of distant modes at every sensor; `receptance` is R in m/N.

    The velocity's fundamental gains iΩRF.
    """

    kind: ClassVar[str] = "residual_mode"
    description: ClassVar[str] = (
        "Modes far from the measured frequencies, missing in the model, add a displacement "
        "proportional to the force."
    )
    stage: ClassVar[int] = 1
    receptance: Scalar = parameter(
        "m/N",
        "displacement of the distant modes over the force",
        start=lambda scales: VISIBLE_CHANGE * scales.receptance,
    )

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        return force, _with_fundamental(velocity, 1j * frequency * self.receptance * force)


class CloseMode(AbstractMeasurementEffect):
    """X_recorded = X + A F/(ω² − Ω² + 2iζωΩ): a close linear mode, equal at all sensors.

    `modal_constant` is A in 1/kg, the product of the mode's shapes at sensor and force;
    `frequency_hz` and `damping_ratio` are the mode's own. The velocity's fundamental gains the
    mode's; it is orthogonal to the mode of interest and does not act on it.
    Reference: for the modal constant, D. J. Ewins, Modal Testing, 2nd ed. (2000).
    """

    kind: ClassVar[str] = "close_mode"
    description: ClassVar[str] = (
        "A further linear mode near the measured frequencies, missing in the model, adds its "
        "response."
    )
    stage: ClassVar[int] = 1
    modal_constant: Scalar = parameter("1/kg", "product of its shapes at sensor and force")
    frequency_hz: Scalar = parameter(
        "Hz",
        "its natural frequency",
        rules=OF_A_FREQUENCY,
        prior=Prior(1 - 2 * _WIDE, 1 + 2 * _WIDE, lambda scales: scales.frequency / HERTZ),
    )
    damping_ratio: Scalar = parameter(
        "1", "its damping ratio", rules=OF_A_DAMPING_RATIO, prior=ADDED_MODE_DAMPING
    )

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        natural = HERTZ * self.frequency_hz
        stiffness = natural**2 - frequency**2 + 2j * self.damping_ratio * natural * frequency
        return force, _with_fundamental(
            velocity, 1j * frequency * self.modal_constant * force / stiffness
        )


class ModeShapeChange(AbstractMeasurementEffect):
    """Φ → Φ(1 + s Q²) at every sensor; `coefficient` is s in 1/(kg m²), Q the amplitude."""

    kind: ClassVar[str] = "mode_shape_change"
    description: ClassVar[str] = (
        "The mode shape changes with the amplitude: the ratio of sensor motion to modal "
        "coordinate is not constant."
    )
    stage: ClassVar[int] = 0
    coefficient: Scalar = parameter(
        "1/(kg m²)",
        "relative change per squared amplitude",
        start=lambda scales: VISIBLE_CHANGE / scales.amplitude**2,
    )

    def recorded(
        self, frequency: Amplitude, force: Amplitude, velocity: Velocity, displacement: Amplitude
    ) -> tuple[Amplitude, Velocity]:
        return force, velocity * (1 + self.coefficient * displacement**2)[..., None, None]


def _with_fundamental(velocity: Velocity, added: Complex[Array, " state"]) -> Velocity:
    """The velocities with `added` on the fundamental, at every sensor."""
    fundamental = np.eye(velocity.shape[-2])[1][:, None]
    return velocity + added[..., None, None] * fundamental
