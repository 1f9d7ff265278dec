"""Patterns of the sensors' response to a force at an attachment point, whatever its law.

A force f along the influence vector b moves the sensors by −H(hΩ) b f at every harmonic h: one
unknown for all of them. The measured response less that of the linear structure must be along this
pattern: a linear equation for each state and harmonic, without a law.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from snrmjax.diagnose.location.element_motion import JUMP_ORDERS
from snrmjax.identify.calibrate.calibration_states import ComparedColumns
from snrmjax.model.modes import LinearModes, phasor_of_load

_MODEL = 1e-3  # 1σ of the linear prediction, relative to a sensor's record


class SensorRecords(NamedTuple):
    """The sensors' records at every order, the fundamental first, with their errors."""

    orders: tuple[int, ...]
    frequency: Float[np.ndarray, " state"]  # rad/s
    seen: Complex[np.ndarray, "state order sensor"]  # m/s
    there: Bool[np.ndarray, "state order sensor"]
    gain: Float[np.ndarray, "state sensor"]  # 1σ of log velocity
    phase: Float[np.ndarray, "state sensor"]  # rad, of the fundamental
    floor: Float[np.ndarray, "state order sensor"]  # 1σ of real and of imaginary part, m/s

    def std(self) -> Float[np.ndarray, "state order sensor"]:
        """1σ of real and of imaginary part, from all errors."""
        order = np.array(self.orders)[:, None]
        own = 0.5 * (self.gain[:, None] ** 2 + (order * self.phase[:, None]) ** 2)
        return np.sqrt((own + _MODEL**2) * np.abs(self.seen) ** 2 + self.floor**2)

    def perturbed(
        self, by: Float[np.ndarray, "state input"]
    ) -> Complex[np.ndarray, "state order sensor"]:
        """The records with errors of gain, phase and additive noise, in units of 1σ."""
        n = self.gain.shape[1]
        gain, phase = by[:, None, :n] * self.gain[:, None], by[:, None, n : 2 * n]
        factor = np.exp(gain + 1j * np.array(self.orders)[:, None] * phase * self.phase[:, None])
        real, imaginary = by[:, 2 * n :].reshape(len(by), 2, *self.seen.shape[1:]).swapaxes(0, 1)
        model = np.hypot(self.floor, _MODEL * np.abs(self.seen))
        return self.seen * factor + model * (real + 1j * imaginary)

    @property
    def n_inputs(self) -> int:
        """Number of errors a state."""
        return 2 * self.gain.shape[1] + 2 * self.seen[0].size


def sensor_records(chosen: ComparedColumns) -> SensorRecords:
    """The records of the compared states."""
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
    """Responses of sensors and attachment to the measured force and to a force there."""

    driven: Complex[np.ndarray, "state order sensor"]  # m/s, to the measured force
    pattern: Complex[np.ndarray, "state order sensor"]  # m/s per unit force along the vector
    own_driven: Complex[np.ndarray, " state"]  # displacement along the vector, to the force
    own: Complex[np.ndarray, "state own"]  # likewise per unit force along it, orders from 0


def source_pattern(
    records: SensorRecords,
    chosen: ComparedColumns,
    modes: LinearModes,
    vector: Float[np.ndarray, " mode"],
) -> SourcePattern:
    """Responses of the linear structure to a force along b, with `vector` bᵀΦ (kg^-1/2)."""
    load = np.asarray(phasor_of_load(modes))
    force = np.asarray(chosen.states.force)
    shape = np.asarray(modes.mode_shape)[list(chosen.sensors)]
    both = np.stack([load.astype(complex), vector.astype(complex)], axis=1)
    orders, count = np.array(records.orders), max(JUMP_ORDERS, *records.orders) + 1
    modal = np.array(
        [[_receptance(modes, h * omega, both) for h in range(count)] for omega in records.frequency]
    )
    modal[:, 1, :, 0] *= force[:, None]
    seen = modal[:, orders]
    seen[:, 1:, :, 0] = 0.0  # the exciter force has no other harmonics
    rate = 1j * records.frequency[:, None] * orders
    velocity = rate[..., None, None] * (shape @ seen)
    along = vector @ modal
    return SourcePattern(velocity[..., 0], velocity[..., 1], along[:, 1, 0], along[..., 1])


class SourceFit(NamedTuple):
    """How well a force along one influence vector explains the sensors."""

    chi_square: float  # of the unexplained rest
    freedom: int  # degrees of freedom
    weights: Complex[np.ndarray, "state order sensor"]  # of the residuals, to estimate the force


def source_fit(records: SensorRecords, response: SourcePattern) -> SourceFit:
    """Least-squares force along an influence vector in each state, and the remaining χ²."""
    scale = np.where(records.there, 1 / records.std(), 0.0)
    pattern, left = scale * response.pattern, scale * (records.seen - response.driven)
    norm = np.sum(np.abs(pattern) ** 2, axis=2, keepdims=True)
    weights = pattern.conj() / np.where(norm > 0, norm, 1.0)
    force = np.sum(weights * left, axis=2, keepdims=True)
    square = float(np.sum(np.abs(left - pattern * force) ** 2))
    count = records.there.sum(axis=2)
    return SourceFit(square, int(2 * np.sum(np.maximum(count - 1, 0))), weights * scale)


def _receptance(
    modes: LinearModes, omega: float, loads: Complex[np.ndarray, "mode load"]
) -> Complex[np.ndarray, "mode load"]:
    """Modal displacements from modal loads at a frequency."""
    natural, ratio = np.asarray(modes.natural_frequency), np.asarray(modes.damping_ratio)
    stiffness = natural**2 - omega**2 + 2j * ratio * natural * omega
    if modes.damping_coupling is None:
        return loads / stiffness[:, None]
    return np.linalg.solve(
        np.diag(stiffness) + 1j * omega * np.asarray(modes.damping_coupling), loads
    )
