"""Where a force must act for the sensors to move as they did, whatever its law.

A force f at a row b of a structure moves the sensors by −H(hΩ) b f at every harmonic h: all of
them by one unknown number. What they move otherwise than the linear structure must be along that
pattern. No law is needed, and nothing is solved but a linear equation for each state and harmonic.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from snrmjax.diagnose.location.element_motion import JUMP_ORDERS
from snrmjax.identify.calibrate.calibration_states import ComparedColumns
from snrmjax.model.modes import LinearModes, phasor_of_load

_MODEL = 1e-3  # 1σ of what the linear structure says, relative to what a sensor sees


class SensorRecords(NamedTuple):
    """What the sensors saw at every order, the fundamental first, and how it may err."""

    orders: tuple[int, ...]
    frequency: Float[np.ndarray, " state"]  # rad/s
    seen: Complex[np.ndarray, "state order sensor"]  # m/s
    there: Bool[np.ndarray, "state order sensor"]
    gain: Float[np.ndarray, "state sensor"]  # 1σ of log velocity
    phase: Float[np.ndarray, "state sensor"]  # rad, of the fundamental
    floor: Float[np.ndarray, "state order sensor"]  # 1σ of real and of imaginary part, m/s

    def std(self) -> Float[np.ndarray, "state order sensor"]:
        """1σ of real and of imaginary part, all errors together."""
        order = np.array(self.orders)[:, None]
        own = 0.5 * (self.gain[:, None] ** 2 + (order * self.phase[:, None]) ** 2)
        return np.sqrt((own + _MODEL**2) * np.abs(self.seen) ** 2 + self.floor**2)

    def erring(
        self, by: Float[np.ndarray, "state input"]
    ) -> Complex[np.ndarray, "state order sensor"]:
        """The records with errors of gain, of phase and beside them, in units of 1σ."""
        n = self.gain.shape[1]
        gain, phase = by[:, None, :n] * self.gain[:, None], by[:, None, n : 2 * n]
        turned = np.exp(gain + 1j * np.array(self.orders)[:, None] * phase * self.phase[:, None])
        real, imaginary = by[:, 2 * n :].reshape(len(by), 2, *self.seen.shape[1:]).swapaxes(0, 1)
        model = np.hypot(self.floor, _MODEL * np.abs(self.seen))
        return self.seen * turned + model * (real + 1j * imaginary)

    @property
    def n_inputs(self) -> int:
        """How many errors a state has."""
        return 2 * self.gain.shape[1] + 2 * self.seen[0].size


def sensor_records(chosen: ComparedColumns) -> SensorRecords:
    """The records of states that are compared with a model."""
    states, n = chosen.states, len(chosen.sensors)
    known: np.ndarray = np.all(
        np.asarray(states.known).reshape(len(chosen.rows), -1, 2), axis=2, keepdims=False
    )
    velocity = np.asarray(states.velocity)
    higher = np.moveaxis(np.asarray(states.harmonics), 1, 2)
    own = np.asarray(states.own_std)[:, 2 * n :: 2].reshape(len(velocity), n, -1)
    floor = np.moveaxis(own, 1, 2) * np.abs(velocity[:, :1, None])
    there = np.moveaxis(known[:, n:].reshape(len(known), n, -1), 1, 2)
    error = np.asarray(states.error)
    return SensorRecords(
        orders=(1, *chosen.orders),
        frequency=np.asarray(states.frequency),
        seen=np.concatenate([velocity[:, None], higher], axis=1),
        there=np.concatenate([known[:, None, :n], there], axis=1),
        gain=error[:, 1 : n + 1],
        phase=error[:, n + 1 : 2 * n + 1],
        floor=np.concatenate([np.zeros_like(velocity.real)[:, None], floor], axis=1),
    )


class SourcePattern(NamedTuple):
    """What the measured force and one at a row do to the sensors and to the row itself."""

    driven: Complex[np.ndarray, "state order sensor"]  # m/s, by the measured force
    pattern: Complex[np.ndarray, "state order sensor"]  # m/s per unit of a force along the row
    own_driven: Complex[np.ndarray, " state"]  # displacement along the row, by the force
    own: Complex[np.ndarray, "state own"]  # and per unit of a force along it, orders from 0


def source_pattern(
    records: SensorRecords,
    chosen: ComparedColumns,
    modes: LinearModes,
    row: Float[np.ndarray, " mode"],
) -> SourcePattern:
    """The responses of the linear structure to a force along a row b Φ (kg^-1/2)."""
    load = np.asarray(phasor_of_load(modes))
    force = np.asarray(chosen.states.force)
    shape = np.asarray(modes.mode_shape)[list(chosen.sensors)]
    both = np.stack([load.astype(complex), row.astype(complex)], axis=1)
    orders, count = np.array(records.orders), max(JUMP_ORDERS, *records.orders) + 1
    moved = np.array(
        [[_receptance(modes, h * omega, both) for h in range(count)] for omega in records.frequency]
    )
    moved[:, 1, :, 0] *= force[:, None]
    seen = moved[:, orders]
    seen[:, 1:, :, 0] = 0.0  # the force has one harmonic
    rate = 1j * records.frequency[:, None] * orders
    velocity = rate[..., None, None] * (shape @ seen)
    along = row @ moved
    return SourcePattern(velocity[..., 0], velocity[..., 1], along[:, 1, 0], along[..., 1])


class SourceFit(NamedTuple):
    """How well a force along one row explains the sensors."""

    chi_square: float  # of what no force there explains
    freedom: int  # real numbers in it
    weights: Complex[np.ndarray, "state order sensor"]  # that make the force of the rest seen


def source_fit(records: SensorRecords, place: SourcePattern) -> SourceFit:
    """The forces along a row that explain the states best, each by itself, and what they leave."""
    scale = np.where(records.there, 1 / records.std(), 0.0)
    pattern, left = scale * place.pattern, scale * (records.seen - place.driven)
    size = np.sum(np.abs(pattern) ** 2, axis=2, keepdims=True)
    weights = pattern.conj() / np.where(size > 0, size, 1.0)
    force = np.sum(weights * left, axis=2, keepdims=True)
    square = float(np.sum(np.abs(left - pattern * force) ** 2))
    count = records.there.sum(axis=2)
    return SourceFit(square, int(2 * np.sum(np.maximum(count - 1, 0))), weights * scale)


def _receptance(
    modes: LinearModes, omega: float, loads: Complex[np.ndarray, "mode load"]
) -> Complex[np.ndarray, "mode load"]:
    """Modal displacements by modal loads at a frequency."""
    natural, ratio = np.asarray(modes.natural_frequency), np.asarray(modes.damping_ratio)
    stiffness = natural**2 - omega**2 + 2j * ratio * natural * omega
    if modes.damping_coupling is None:
        return loads / stiffness[:, None]
    return np.linalg.solve(
        np.diag(stiffness) + 1j * omega * np.asarray(modes.damping_coupling), loads
    )
