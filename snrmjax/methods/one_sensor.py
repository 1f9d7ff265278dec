"""Steady states of one sensor, by level, force and displacement, as the other methods need them."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from snrmjax.measure.states import PHASE_UNKNOWN, SteadyStates
from snrmjax.model.modes import LinearModes, reference_sensor
from snrmjax.numerics.rules import InputError


class SensorStates(NamedTuple):
    """States of the reference sensor whose force, amplitude and phase were measured."""

    level: Int[np.ndarray, " state"]
    frequency: Float[np.ndarray, " state"]  # rad/s
    force: Float[np.ndarray, " state"]  # N
    velocity: Complex[np.ndarray, " state"]  # m/s, relative to the force
    amplitude_std: Float[np.ndarray, " state"]  # relative, of velocity over force; NaN = unstated
    phase_std: Float[np.ndarray, " state"]  # rad, NaN = not stated

    @property
    def displacement(self) -> Complex[np.ndarray, " state"]:
        """Displacement phasor, m."""
        return self.velocity / (1j * self.frequency)

    @property
    def receptance(self) -> Complex[np.ndarray, " state"]:
        """Displacement over force, m/N."""
        return self.displacement / self.force

    @property
    def phase(self) -> Float[np.ndarray, " state"]:
        """Phase of the velocity relative to the force, rad: positive below resonance."""
        return np.angle(self.velocity)

    def of(self, rows: Bool[np.ndarray, " state"] | Int[np.ndarray, " row"]) -> "SensorStates":
        """A subset of the states."""
        return SensorStates(*(column[rows] for column in self))

    def levels(self) -> Iterator[tuple[int, "SensorStates"]]:
        """The states of each level."""
        for level in np.unique(self.level):
            yield int(level), self.of(self.level == level)


def sensor_states(
    data: SteadyStates, modes: LinearModes, *, any_scale: bool = False
) -> SensorStates:
    """The usable states of the reference sensor, with the velocity's sign that of the mode.

    Arguments: with `any_scale` the drive voltage replaces a force that was not measured, for
    methods that do not need the modal constant.
    A phase without stated error gets the relative amplitude error, in rad.
    Raises `ValueError` where no force or no phase was measured, or where the reference sensor is
    not in the data.
    """
    name = modes.sensors[reference_sensor(modes)]
    if name not in data.sensors:
        raise InputError(
            f"the sensor {name}, where the mode moves most, is needed, but the data have "
            f"{', '.join(data.sensors)}."
        )
    at = data.sensors.index(name)
    force, velocity = np.asarray(data.force), np.asarray(data.velocity)[:, at]
    if any_scale and not np.isfinite(force).any():
        force = np.asarray(data.drive)
    phase_std = np.asarray(data.phase_std)[:, at]
    measured = np.asarray(data.measured)[:, at] & (np.abs(velocity) > 0)
    forced = measured & np.isfinite(force) & (force > 0)
    if not forced.any():
        raise InputError("forces in N are needed, but the data have none (force_n).")
    phased = forced & ~(phase_std >= PHASE_UNKNOWN * (1 - 1e-12))
    if not phased.any():
        raise InputError("phases are needed, but the data have amplitudes alone.")
    kept = np.flatnonzero(phased)
    sign = np.sign(signed_drive_point(modes))
    velocity_std = np.asarray(data.velocity_std)[kept, at] / np.abs(velocity[kept])
    force_std = np.asarray(data.force_std)[kept] / force[kept]
    return SensorStates(
        np.asarray(data.level)[kept],
        np.asarray(data.frequency)[kept],
        force[kept],
        sign * velocity[kept],
        np.hypot(velocity_std, np.where(np.isfinite(force_std), force_std, 0.0)),
        np.where(np.isfinite(phase_std[kept]), phase_std[kept], velocity_std),
    )


def signed_drive_point(modes: LinearModes) -> float:
    """Shape at the reference sensor times participation (1 / modal mass there), 1/kg, signed."""
    k = modes.mode_of_interest
    return modes.mode_shape.item(reference_sensor(modes), k) * modes.participation.item(k)


def drive_point(modes: LinearModes) -> float:
    """Modal constant of the reference sensor, |Φ_r Φᵀb|, 1/kg."""
    return abs(signed_drive_point(modes))
