"""The measurement chain of a virtual test: instruments, their effects and random errors."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from snrmjax.measure.states import SteadyStates, steady_states
from snrmjax.model.modes import LinearModes
from snrmjax.model.moving_base import newtons
from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.rules import InputError
from snrmjax.simulate.balance.harmonics import displacement_phasors, velocity_phasors
from snrmjax.simulate.continuation.response_curve import ResponseCurve

_BLOCK = 4096
_POINTS = 256  # of a curve, in one call


class MeasurementErrors(NamedTuple):
    """Random errors of a test, 1σ; those of a level are drawn once per level."""

    amplitude: float = 0.0  # relative (0.01 is 1 %), of the velocity
    phase: float = 0.0  # rad
    force: float = 0.0  # relative
    level_gain: float = 0.0  # relative, common to a level
    level_phase: float = 0.0  # rad, common to a level
    harmonic: float = 0.0  # m/s, rms of the complex error of every higher harmonic


NO_ERRORS = MeasurementErrors()


class Recording(NamedTuple):
    """Settings of the recorded states: random errors, and harmonics to record."""

    errors: MeasurementErrors = NO_ERRORS
    seed: int = 0  # of the random errors
    keep_harmonics: tuple[int, ...] = ()  # orders recorded in addition to the fundamental


EXACT = Recording()


class VisitedStates(NamedTuple):
    """The exact states that a test visits, in the order of the test."""

    level: Int[np.ndarray, " state"]
    order: Float[np.ndarray, " state"]  # time in the test, from 0 to 1
    force: Float[np.ndarray, " state"]  # N
    frequency: Float[np.ndarray, " state"]  # rad/s
    coefficients: Float[np.ndarray, "state coefficient mode"]  # kg^1/2 m, all simulated modes

    def only(self, rows: np.ndarray) -> "VisitedStates":
        """The states `rows` (indices or a mask)."""
        return VisitedStates(*(part[rows] for part in self))


def check_recording(recording: Recording, harmonic_order: int) -> None:
    """Raise `ValueError` for harmonics that are not simulated and for invalid errors."""
    errors, _, keep_harmonics = recording
    if not all(2 <= h <= harmonic_order for h in keep_harmonics):
        raise InputError(
            f"`keep_harmonics` must lie between 2 and `harmonic_order` = {harmonic_order}, "
            f"but is {keep_harmonics}."
        )
    for name, value in errors._asdict().items():
        if not 0 <= value < np.inf:
            raise InputError(f"the error `{name}` must be zero or positive, but is {value}.")


def recorded_states(
    model: Structure,
    states: VisitedStates,
    recording: Recording,
) -> SteadyStates:
    """The states as recorded, with their time in the test as `order`.

    The motion at the sensors (flexible and rigid-body modes) passes the model's measurement
    effects in their order; random errors are added last.
    """
    modes = simulated_structure(model).modes
    frequency = jnp.asarray(states.frequency)
    force = newtons(modes.unbalance, frequency, jnp.asarray(states.force))
    coefficients = jnp.asarray(states.coefficients)
    velocity = velocity_phasors(coefficients, frequency, modes.mode_shape)
    velocity = velocity + _rigid_body_velocity(model, frequency, force, velocity.shape[1])
    seen = _behind_instruments(
        model,
        frequency,
        force,
        velocity,
        jnp.abs(displacement_phasors(coefficients)[:, 1, modes.mode_of_interest]),
    )
    written = np.asarray(seen[0]), np.asarray(seen[1])
    return _with_errors(states, *written, model.modes, recording)


def recorded_curves(model: Structure, curves: Sequence[ResponseCurve]) -> list[ResponseCurve]:
    """Simulated responses as the model's instruments record them, in force and velocities.

    Events remain at the points of the exact motion.
    """
    if not model.measurement_effects:
        return list(curves)
    return [_recorded(model, curve) if len(curve.frequency) else curve for curve in curves]


def _recorded(model: Structure, curve: ResponseCurve) -> ResponseCurve:
    n = len(curve.frequency)
    fill = np.minimum(np.arange(-(-n // _POINTS) * _POINTS), n - 1)  # one length compiles once
    coefficients = jnp.asarray(np.asarray(curve.coefficients)[fill])
    j = model.modes.mode_of_interest
    displacement = jnp.abs(displacement_phasors(coefficients)[:, 1, j])
    frequency, velocity = (
        jnp.asarray(np.asarray(part)[fill]) for part in (curve.frequency, curve.velocity)
    )
    force = jnp.full(len(fill), curve.force)
    force, velocity = _behind_instruments(model, frequency, force, velocity, displacement)
    return dataclasses.replace(curve, force=float(force[0]), velocity=np.asarray(velocity)[:n])


def acting_force(model: Structure, recorded: float) -> float:
    """The force (N) that the model's instruments record as `recorded` (N).

    Validity: the recorded force is a linear function of the acting one, the same for every motion,
    as with a gain and an offset.
    """
    acting = jnp.array([1.0, 2.0]) * recorded
    still = jnp.zeros((2, 2, len(model.modes.sensors)), dtype=complex)
    force, _ = _behind_instruments(model, jnp.ones(2), acting, still, jnp.zeros(2))
    at_one, at_two = (float(value) for value in force)
    return recorded * (1 + (recorded - at_one) / (at_two - at_one))


def _behind_instruments(
    model: Structure, frequency: Array, force: Array, velocity: Array, displacement: Array
) -> tuple[Array, Array]:
    """Force and velocities after the model's measurement effects, applied in sequence."""
    for effect in model.measurement_effects:
        force, velocity = effect.recorded(frequency, force, velocity, displacement)
    return force, velocity


def _rigid_body_velocity(
    model: Structure, frequency: Array, force: Array, n_harmonics: int
) -> Complex[Array, "state harmonic sensor"]:
    """−iΦ ΦᵀF_h/(hΩ) for every harmonic of the force."""
    modes = model.modes
    per_force = modes.rigid_body_shape @ modes.rigid_body_participation
    spectrum = model.load_orders()[:n_harmonics]
    orders = np.arange(1, len(spectrum))
    fraction = jnp.zeros(n_harmonics).at[orders].set(spectrum[1:] / orders)
    return -1j * (force / frequency)[:, None, None] * fraction[:, None] * per_force


def _with_errors(
    states: VisitedStates,
    force: np.ndarray,
    velocity: np.ndarray,
    modes: LinearModes,
    recording: Recording,
) -> SteadyStates:
    """Measured values: the exact ones with random errors."""
    errors, seed, keep_harmonics = recording
    sensors, base = modes.sensors, modes.base
    keep_harmonics = tuple(int(h) for h in keep_harmonics)
    n, n_sensors = len(force), velocity.shape[2]
    keys = jax.random.split(jax.random.key(seed), 6)

    def normal(key: jax.Array, *shape: int) -> np.ndarray:
        # Drawn in blocks of one length, which compiles once.
        size = int(np.prod(shape))
        blocks = jax.random.normal(key, (-(-size // _BLOCK) * _BLOCK,))
        return np.asarray(blocks)[:size].reshape(shape)

    groups, group = np.unique(states.level, return_inverse=True)
    gain = errors.level_gain * normal(keys[3], len(groups))[group]
    phase = errors.level_phase * normal(keys[4], len(groups))[group]
    shared = (1 + gain) * np.exp(1j * phase)
    alone = (1 + errors.amplitude * normal(keys[0], n, n_sensors)) * np.exp(
        1j * errors.phase * normal(keys[1], n, n_sensors)
    )
    factor = shared[:, None] * alone
    magnitude = np.abs(factor)  # a phase error is one of time: h times as large for harmonic h
    harmonics = (
        np.stack(
            [velocity[:, h] * magnitude * (factor / magnitude) ** h for h in keep_harmonics], axis=2
        )
        if keep_harmonics
        else None
    )
    if harmonics is not None:
        parts = normal(keys[5], 2, *harmonics.shape) / np.sqrt(2)
        harmonics = harmonics + errors.harmonic * (parts[0] + 1j * parts[1])
    measured = velocity[:, 1] * factor

    def stated(value: float, scale: np.ndarray) -> np.ndarray | None:
        return value * scale if value > 0 else None

    return steady_states(
        states.level,
        states.frequency,
        force * (1 + errors.force * normal(keys[2], n)),
        measured,
        sensors=sensors,
        velocity_std=stated(errors.amplitude, np.abs(measured)),
        phase_std=stated(errors.phase, np.ones((n, n_sensors))),
        force_std=stated(errors.force, force),
        order=states.order,
        harmonics=harmonics,
        harmonic_order=keep_harmonics,
        harmonic_std=stated(errors.harmonic, np.ones((n, n_sensors))),
        base=base,
    )
