"""Steady states under base excitation: relative motion over the base acceleration."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Unpack

import jax
import numpy as np
from jaxtyping import Complex, Float, Int, Shaped

from snrmjax.measure.states import (
    UNNAMED_SENSOR,
    OptionalColumns,
    SteadyStates,
    steady_states,
)
from snrmjax.model.moving_base import BaseMotion, base_motion
from snrmjax.numerics.rules import InputError


def base_excited_states(
    level: Int[Shaped[np.ndarray, " state"], " state"],
    frequency: Float[Shaped[np.ndarray, " state"], " state"],
    base_acceleration: Complex[Shaped[np.ndarray, " state"], " state"],
    velocity: Complex[Shaped[np.ndarray, "state sensor"], "state sensor"],
    *,
    sensors: Sequence[str] = UNNAMED_SENSOR,
    along: Sequence[float] | Mapping[str, float] | None = None,
    relative: bool = False,
    **columns: Unpack[OptionalColumns],
) -> SteadyStates:
    """Steady states of a base-excited test, for the force balance of a mode.

    With base acceleration a(t), a mode obeys q̈ + 2ζωq̇ + ω²q + … = −Γa, with q the motion relative
    to the base and Γ = Σ m φ along the base motion (kg^1/2). Returned is the relative velocity
    V − c a/(iΩ), with its phase relative to a, and |a| in place of the force: the model's
    participation must then be −Γ, in kg^1/2 per m/s² (as `snrmjax modes --base` writes it).

    Arguments: `level`; `frequency` in rad/s; phasors e^{+iΩt} of one common reference,
    `base_acceleration` in m/s² and `velocity` in m/s, peak amplitudes of the fundamental; `sensors`
    names the columns of `velocity`; `along` has the direction cosine between each sensor's axis
    and the base motion, 1 where not given; `relative` for velocities already relative to the base;
    further columns as of `steady_states`, with errors and harmonics of the recorded velocities
    and `force_std` that of the acceleration (`base` is set by this function).
    Returns `SteadyStates` whose `force` is the amplitude of the acceleration in m/s².
    Raises `ValueError` for inconsistent shapes and as `steady_states` does.
    Validity: a rigid base that moves along one axis without higher harmonics, its acceleration
    measured at the attachment of the structure.

    >>> a, speed = np.array([2.0 + 0j]), np.array([[0.1 + 0.01j]])
    >>> base_excited_states([1], [500.0], a, speed).velocity.round(4).tolist()
    [[(0.1+0.014j)]]
    """
    omega = np.asarray(frequency, dtype=float)
    load = np.asarray(base_acceleration, dtype=complex)
    recorded = np.asarray(velocity, dtype=complex)
    recorded = recorded[:, None] if recorded.ndim == 1 else recorded
    if load.shape != omega.shape or recorded.shape != (omega.size, len(sensors)):
        raise InputError(
            f"`base_acceleration` must have shape {omega.shape} and `velocity` "
            f"{(omega.size, len(sensors))}, but have {load.shape} and {recorded.shape}."
        )
    if along is not None and not isinstance(along, Mapping):
        if np.shape(along) != (len(sensors),):
            raise InputError(f"`along` must have one number per sensor, {len(sensors)}.")
        along = dict(zip(sensors, along, strict=True))
    angle = np.angle(load)
    rotated: OptionalColumns = {**columns}
    harmonics, orders = columns.get("harmonics"), columns.get("harmonic_order", ())
    if harmonics is not None:
        rotated["harmonics"] = np.asarray(harmonics) * np.exp(
            -1j * angle[:, None, None] * np.asarray(orders)
        )
    states = steady_states(
        np.asarray(level),
        omega,
        np.abs(load),
        recorded * np.exp(-1j * angle)[:, None],
        sensors=tuple(sensors),
        **rotated,
    )
    return states_relative_to_base(
        states, base_motion("relative" if relative else "absolute", along)
    )


def states_relative_to_base(data: SteadyStates, base: BaseMotion) -> SteadyStates:
    """Convert states with recorded velocities and the base acceleration as `force`.

    Returns velocities relative to the base, with propagated errors of amplitude and phase.
    Raises `ValueError` for unknown phases if the sensors record absolute motion, since the base
    motion cannot be subtracted then.
    """
    if base.motion == "relative":
        return dataclasses.replace(data, base=base)
    if np.any(np.asarray(data.phase_unknown)):
        raise InputError(
            "the base motion cannot be subtracted from velocities without phases: measure the "
            "phases, or motion relative to the base."
        )
    recorded, measured = np.asarray(data.velocity), np.asarray(data.measured)
    own = base.own_velocity(data.sensors, np.asarray(data.frequency), np.asarray(data.force))
    velocity = np.where(measured, recorded - own, 0.0)
    return dataclasses.replace(_with_velocities(data, velocity), base=base)


def as_recorded(data: SteadyStates) -> SteadyStates:
    """Base-excited states with the velocities as recorded; others are returned unchanged."""
    if data.base is None or data.base.motion == "relative":
        return data
    relative, measured = np.asarray(data.velocity), np.asarray(data.measured)
    own = data.base.own_velocity(data.sensors, np.asarray(data.frequency), np.asarray(data.force))
    return _with_velocities(data, np.where(measured, relative + own, 0.0))


def _with_velocities(
    data: SteadyStates, velocity: Complex[np.ndarray, "state sensor"]
) -> SteadyStates:
    """The states with other velocities and propagated errors."""
    stds = np.asarray(data.velocity_std), np.asarray(data.phase_std)
    errors = _rotated_errors(np.asarray(data.velocity), velocity, *stds)
    new, amplitude_std, phase_std = jax.device_put((velocity, *errors))
    return dataclasses.replace(data, velocity=new, velocity_std=amplitude_std, phase_std=phase_std)


def _rotated_errors(
    old: Complex[np.ndarray, "state sensor"],
    new: Complex[np.ndarray, "state sensor"],
    amplitude_std: Float[np.ndarray, "state sensor"],
    phase_std: Float[np.ndarray, "state sensor"],
) -> tuple[Float[np.ndarray, "state sensor"], Float[np.ndarray, "state sensor"]]:
    """1σ of amplitude (m/s) and phase (rad) of the same complex error about another phasor.

    The error ellipse has its axes along and across the old phasor; an axis that is not stated
    counts as zero if the other one is.
    """
    stated = np.isfinite(amplitude_std) | np.isfinite(phase_std)
    along, across = np.nan_to_num(amplitude_std), np.nan_to_num(phase_std) * np.abs(old)
    with np.errstate(divide="ignore", invalid="ignore"):
        rotation = np.angle(new * old.conj())
        radial = np.hypot(along * np.cos(rotation), across * np.sin(rotation))
        angular = np.hypot(along * np.sin(rotation), across * np.cos(rotation)) / np.abs(new)
    both = np.abs(rotation) > 1e-12
    radial = np.where(stated & (both | np.isfinite(amplitude_std)), radial, np.nan)
    angular = np.where(stated & (both | np.isfinite(phase_std)), angular, np.nan)
    return radial, angular
