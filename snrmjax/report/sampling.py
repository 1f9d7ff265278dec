"""Data of results for figures: sampled curves, phasors and phases, in the units of figures."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike

from snrmjax.identify.pointwise.prediction import PredictedResponse
from snrmjax.measure.states import SteadyStates
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import DEGREE, HERTZ
from snrmjax.simulate.continuation.response_curve import (
    MotionCurve,
    ResponseCurve,
    velocity_at_sensors,
)

if TYPE_CHECKING:  # figures of a simulation do not wait for the imports of an identification
    from snrmjax.identify.joint.joint_fit import JointFit
    from snrmjax.identify.pointwise.backbone import Backbone, BackboneValues
    from snrmjax.identify.pointwise.backbone_points import BackbonePoints

BAND = 1.96
"""Half the width of a 95 % band in standard deviations."""

_CURVE_POINTS = 200  # as many as files have: one compiled function serves both


class ShownAmplitude(NamedTuple):
    """The amplitude of a motion that figures and tables show."""

    name: str  # "displacement"
    unit: str  # its base unit
    column: str  # how its columns in files end
    power: int  # of the angular frequency, by which a velocity is multiplied

    def of(self, velocity: ArrayLike, angular_frequency: ArrayLike) -> np.ndarray:
        """The amplitude of velocities (m/s) at these frequencies (rad/s)."""
        if not self.power:  # to the bit
            return np.asarray(velocity)
        return np.asarray(velocity) * np.asarray(angular_frequency) ** float(self.power)


class BackboneSamples(NamedTuple):
    """A backbone at some amplitudes, in the units of the figures; errors are 95 %."""

    velocity: np.ndarray  # m/s
    frequency: np.ndarray  # Hz
    frequency_error: np.ndarray  # Hz
    damping: np.ndarray  # % of critical
    damping_error: np.ndarray
    modal_damping: np.ndarray  # 1/s
    modal_damping_error: np.ndarray
    beyond: np.ndarray  # whether the amplitude exceeds the measured ones

    def amplitude(self, shown: ShownAmplitude) -> np.ndarray:
        """The amplitude that a figure shows, in its base unit."""
        return shown.of(self.velocity, self.frequency * HERTZ)

    def curves(self) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
        """Natural frequency and damping ratio, and the errors of both."""
        return (self.frequency, self.damping), (self.frequency_error, self.damping_error)


def sample_backbone(backbone: "Backbone", *, reach: float = 1.0) -> BackboneSamples:
    """A backbone from its smallest amplitude to `reach` times its largest."""
    values = backbone.sampled(_CURVE_POINTS, reach=reach)
    ends = float(backbone.smallest), reach * float(backbone.largest)
    return _in_units(values, np.linspace(*ends, _CURVE_POINTS) > float(backbone.largest))


def sample_fit(fit: "JointFit", *, include_level_variance: bool = False) -> BackboneSamples:
    """The curves of a joint fit from zero to the largest measured velocity."""
    velocity = np.linspace(0.0, fit.largest[1], _CURVE_POINTS)
    from snrmjax.identify.inference.fitted_curves import fitted_values

    values = fitted_values(fit, velocity, include_level_variance=include_level_variance)
    return _in_units(values, np.zeros(_CURVE_POINTS, dtype=bool))


def _in_units(values: "BackboneValues", beyond: np.ndarray) -> BackboneSamples:
    omega, omega_std, damping, damping_std, modal, modal_std = (
        np.asarray(of)
        for of in (
            *(values.natural_frequency, values.natural_frequency_std),
            *(values.damping_ratio, values.damping_ratio_std),
            *(values.modal_damping, values.modal_damping_std),
        )
    )
    return BackboneSamples(
        velocity=np.asarray(values.velocity),
        frequency=omega / HERTZ,
        frequency_error=BAND * omega_std / HERTZ,
        damping=100 * damping,
        damping_error=100 * BAND * damping_std,
        modal_damping=modal,
        modal_damping_error=BAND * modal_std,
        beyond=beyond,
    )


class FitResiduals(NamedTuple):
    """Whitened residuals of a joint fit: of unit variance if model and noise are right."""

    level: np.ndarray  # counted from one
    velocity: np.ndarray  # m/s
    frequency: np.ndarray  # rad/s
    phase: np.ndarray  # degrees, 0 at resonance
    parts: np.ndarray  # (state, 2)
    rms: float


def fit_residuals(fit: "JointFit") -> FitResiduals:
    """The residuals of a joint fit, with amplitude, frequency and phase of their states."""
    velocity = np.asarray(fit.motion().velocity)
    sign = np.sign(float(fit.problem.modal_constant))
    return FitResiduals(
        level=np.asarray(fit.data.level) + 1,
        velocity=np.abs(velocity),
        frequency=np.asarray(fit.data.frequency),
        phase=np.angle(sign * velocity) / DEGREE,
        parts=fit.residuals,
        rms=float(np.sqrt(np.mean(fit.residuals**2))),
    )


def velocity_of(curve: PredictedResponse | MotionCurve, sensor: str) -> np.ndarray:
    """Phasors (m/s) of the velocity fundamental along a curve, at one sensor.

    A `PredictedResponse` has only its backbone's sensor. Raises `ValueError` for an unknown one.
    """
    if isinstance(curve, PredictedResponse):
        return curve.velocity
    force = getattr(curve, "force", 0.0)  # a normal mode has none
    return velocity_at_sensors(curve, force)[:, 1, sensor_index(curve.sensors, sensor)]


VELOCITY = ShownAmplitude("velocity", "m/s", "velocity_m_s", 0)
SHOWN_AMPLITUDES = {
    "velocity": VELOCITY,
    "displacement": ShownAmplitude("displacement", "m", "displacement_m", -1),
    "acceleration": ShownAmplitude("acceleration", "m/s²", "acceleration_m_s2", 1),
}
"""The amplitudes that figures can show, by name."""


def usable_damping(
    points: "BackbonePoints", shown: ShownAmplitude = VELOCITY
) -> tuple[np.ndarray, np.ndarray]:
    """Amplitude on the backbone and modal damping (1/s) of the points that curves use."""
    use = np.asarray(points.usable)
    amplitude = shown.of(points.backbone_velocity, points.natural_frequency)
    return amplitude[use], np.asarray(points.modal_damping)[use]


def phase_of(velocity: Any, backbone: "Backbone") -> np.ndarray:
    """Velocity phase in degrees, 0 at resonance whatever the sign of the modal constant."""
    return np.angle(np.asarray(velocity) * np.sign(float(backbone.modal_constant))) / DEGREE


def sensor_index(sensors: tuple[str, ...], name: str) -> int:
    """Index of a sensor, or a `ValueError` that lists the sensors."""
    if name not in sensors:
        raise InputError(f"`sensor` must be one of {', '.join(sensors)}, but is {name!r}.")
    return sensors.index(name)


def span_of(curve: PredictedResponse | ResponseCurve, sensor: str) -> tuple[float, float]:
    """Frequencies (rad/s) between which a response exceeds a quarter of its peak, with a margin."""
    amplitude = np.abs(velocity_of(curve, sensor))
    inside = curve.frequency[amplitude >= 0.25 * amplitude.max()]
    margin = 0.1 * np.ptp(inside)
    return inside.min() - margin, inside.max() + margin


def measured_near(
    measured: SteadyStates | None, sensor: str, force: float, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (Hz) and phasors (m/s) of the steady states under about this force."""
    if measured is None:
        return np.zeros(0), np.zeros(0, dtype=np.complex128)
    r = sensor_index(measured.sensors, sensor)
    near = np.abs(np.asarray(measured.force) / force - 1) <= tolerance
    near &= np.asarray(measured.measured[:, r])
    return np.asarray(measured.frequency)[near] / HERTZ, np.asarray(measured.velocity)[near, r]
