"""Measured steady states in the form in which a calibration compares them with a model."""

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.identify.pointwise.snrm import reference_sensor
from snrmjax.measure.states import SteadyStates, check_force, relative_errors
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import taken
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

OneKind = TypeVar("OneKind", Array, np.ndarray)

ASSUMED_ERROR = 0.01
"""Relative and rad, of velocities where no noise is stated; the fit then estimates the scale."""


class CalibrationStates(NamedTuple):
    """Measured states; the reference sensor comes first.

    A column is the real or the imaginary part of the force, of another sensor's fundamental or of
    a harmonic, the latter two over the reference velocity.
    """

    level: Int[Array, " state"]  # counted from zero
    frequency: Float[Array, " state"]  # rad/s
    force: Float[Array, " state"]  # N
    order: Float[Array, " state"]  # of the test, 0…1
    velocity: Complex[Array, "state sensor"]  # m/s
    harmonics: Complex[Array, "state sensor harmonic"]  # m/s
    error: Float[Array, "state input"]  # 1σ of log force, of log velocities and of phases
    own_std: Float[Array, "state column"]  # 1σ of errors independent between columns: harmonics
    known: Bool[Array, "state column"]  # whether measured


class ComparedColumns(NamedTuple):
    """The steady states compared with a model, and the sensors and harmonics of their columns."""

    states: CalibrationStates
    rows: Int[np.ndarray, " state"]  # in the data
    n_levels: int
    sensors: tuple[int, ...]  # in the order of the states' sensors
    orders: tuple[int, ...]  # harmonics that are compared
    phase_unknown: Bool[np.ndarray, "state sensor"]
    noise_stated: bool
    notes: tuple[Fact, ...]


def calibration_states(
    model: Structure, data: SteadyStates, harmonic_order: int
) -> ComparedColumns:
    """The steady states that the reference sensor measured under a known force.

    Where the velocity of some state has no stated error, all get `ASSUMED_ERROR`. Harmonics are
    compared where their error is stated. A velocity of unknown phase and its harmonics are stored
    as real and positive, with the imaginary columns marked as unknown; if the reference sensor has
    no phase, all phases of the state count as unknown.
    Raises `ValueError` for sensors other than the model's, where no force is known and where no
    state is left.
    """
    if data.sensors != model.modes.sensors:
        raise InputError(
            f"`data` has the sensors {list(data.sensors)}, but `model` has "
            f"{list(model.modes.sensors)}."
        )
    check_force(data, "a comparison with a model")
    notes = []
    # NumPy: JAX operations would compile anew for every number of states.
    host: Any = jax.tree.map(np.asarray, data)
    r = reference_sensor(model.modes)
    sensors = [r, *(s for s in range(len(host.sensors)) if s != r)]
    velocity = host.velocity[:, sensors]
    amplitude = np.abs(velocity)
    measured = host.measured[:, sensors] & np.isfinite(amplitude) & (amplitude > 0)
    force, frequency = host.force, host.frequency
    rows = np.flatnonzero(measured[:, 0] & np.isfinite(force) & (force > 0) & (frequency > 0))
    if not rows.size:
        raise InputError(
            f"no state has a force above zero and a velocity of {data.sensors[r]!r}, the sensor "
            "that sees the mode of interest best."
        )
    velocity, measured = np.where(measured, velocity, 0.0)[rows], measured[rows]
    host = taken(host, rows)
    errors = np.asarray(relative_errors(host))[:, sensors]
    stated = bool(np.all(errors[measured][:, 1:] > 0))  # False for NaN
    if not stated:
        in_part = bool(np.any(errors[measured][:, 1:] > 0))
        errors = np.broadcast_to([0.0, ASSUMED_ERROR, ASSUMED_ERROR], errors.shape)
        notes.append(Fact("equal_errors_assumed", some_stated=in_part))
    errors = np.where(measured[..., None], errors, 0.0)
    positions = [k for k, h in enumerate(host.harmonic_order) if 1 < h <= harmonic_order]
    harmonics = host.harmonics[:, sensors][..., positions]
    std = host.harmonic_std[:, sensors] / np.abs(velocity[:, :1])
    recorded = np.isfinite(np.abs(harmonics)) & (measured & (std > 0))[..., None]
    unknown = np.asarray(host.phase_unknown)[:, sensors]
    unknown = measured & (unknown | unknown[:, :1])
    velocity = np.where(unknown, np.abs(velocity), velocity)
    harmonics = np.where(unknown[..., None], np.abs(harmonics), harmonics)
    errors[..., 2] = np.where(unknown, 0.0, errors[..., 2])
    if positions and not recorded.any():
        notes.append(Fact("harmonics_without_error"))
        harmonics, recorded, positions = harmonics[..., :0], recorded[..., :0], []
    n = len(rows)
    real = np.concatenate([np.ones((n, 1), bool), measured[:, 1:], recorded.reshape(n, -1)], axis=1)
    independent = [unknown, np.repeat(unknown, len(positions), axis=1)]
    known = np.stack([real, real & ~np.concatenate(independent, axis=1)], axis=2).reshape(n, -1)
    # `harmonic_std` is the rms of a complex error: each part has half the variance.
    own_std = np.where(recorded, std[..., None] / np.sqrt(2), 0.0).reshape(n, -1)
    order = host.order
    levels, level = np.unique(host.level, return_inverse=True)
    columns: list[Any] = [
        level,
        host.frequency,
        host.force,
        np.where(np.isfinite(order), order, np.asarray(model.test_order)),
        velocity,
        np.where(recorded, harmonics, 0.0),
        np.concatenate([errors[:, 0, :1], *np.moveaxis(errors, 2, 0)[1:]], 1),
        np.repeat(np.pad(own_std, ((0, 0), (len(sensors), 0))), 2, axis=1),
        known,
    ]
    parts = jax.device_put(CalibrationStates(*columns), may_alias=False)
    orders = tuple(host.harmonic_order[k] for k in positions)
    compared = (tuple(sensors), orders, unknown)
    return ComparedColumns(parts, rows, len(levels), *compared, stated, tuple(notes))


@compiled
def state_whitener(
    states: CalibrationStates,
    by_error: Float[Array, "state column input"],
    harmonic_error: Float[Array, ""],
) -> Float[Array, "state column column"]:
    """Whitening matrices: a state's columns become independent and of unit variance.

    Arguments: derivatives of the columns with respect to the errors in `states.error`;
    `harmonic_error` is an additional relative error of the harmonics. Zero for states
    whose derivatives are not finite: they have no weight.
    """
    good = jnp.all(jnp.isfinite(by_error), axis=(1, 2))[:, None, None]
    scaled = jnp.where(good, by_error, 1.0) * states.error[:, None, :]
    ratio = jnp.abs(states.harmonics).reshape(len(by_error), -1) / jnp.abs(states.velocity[:, :1])
    wide = jnp.pad(ratio, ((0, 0), (states.velocity.shape[1], 0)))
    independent = states.own_std**2 + harmonic_error**2 * jnp.repeat(wide, 2, axis=1) ** 2
    independent = jnp.where(states.known, independent, 1.0)
    covariance = scaled @ scaled.transpose(0, 2, 1) + jax.vmap(jnp.diag)(independent)
    # Keeps the Cholesky factorisation from failing by rounding.
    floor = 1e-14 * jnp.trace(covariance, axis1=1, axis2=2)[:, None, None]
    eye = jnp.eye(covariance.shape[1])
    root = jnp.linalg.cholesky(covariance + floor * eye)
    inverse = jax.vmap(lambda low: jax.scipy.linalg.solve_triangular(low, eye, lower=True))(root)
    return jnp.where(good, inverse, 0.0)


def whitened_columns(
    whitener: Float[OneKind, "state column column"], columns: Float[OneKind, "state column *entry"]
) -> Float[OneKind, "state column *entry"]:
    """Columns of all states, or their derivatives, whitened; zero for states without weight.

    NumPy arrays in, NumPy arrays out.
    """
    xp: Any = columns.__array_namespace__()
    used = xp.any(whitener != 0, axis=(1, 2)).reshape(-1, *(1,) * (columns.ndim - 1))
    return xp.einsum("sij,sj...->si...", whitener, xp.where(used, columns, 0.0))
