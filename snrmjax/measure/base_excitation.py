"""Steady states of a structure on a moving base: relative motion over the base's acceleration."""

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
    """Steady states of a base-excited test, as the force balance of a mode wants them.

    On a base with acceleration a(t) a mode obeys q̈ + 2ζωq̇ + ω²q + … = −Γa, q the motion relative to
    the base and Γ the participation of the base's motion, Σ m φ along it (kg^1/2). The relative
    velocity V − c a/(iΩ), relative to a, is returned, with |a| in the place of the force: the
    model's participation must then be −Γ, in kg^1/2 per m/s² (`snrmjax modes --base` writes it so).

    Arguments: `level`; `frequency` in rad/s; phasors e^{+iΩt} of one common reference,
    `base_acceleration` in m/s² and `velocity` in m/s, peak amplitudes of the fundamental; `sensors`
    names the columns of `velocity`; `along` has the cosine between each sensor's axis and the
    base's motion, 1 where not given; `relative` says that velocities are relative to the base
    already; further columns as `steady_states` takes them, errors and harmonics those of the
    velocities as recorded, `force_std` that of the acceleration
    (`base` is what this function finds).
    Returns `SteadyStates` whose `force` is the amplitude of the acceleration in m/s².
    Raises `ValueError` for shapes that disagree and as `steady_states` does.
    Validity: a rigid base that moves along one axis, its acceleration measured at the structure's
    foot, the same for all harmonics but the first, of which the base has none.

    >>> a, speed = np.array([2.0 + 0j]), np.array([[0.1 + 0.01j]])
    >>> base_excited_states([1], [500.0], a, speed).velocity.round(4).tolist()
    [[(0.1+0.014j)]]
    """
    omega = np.asarray(frequency, dtype=float)
    load = np.asarray(base_acceleration, dtype=complex)
    seen = np.asarray(velocity, dtype=complex)
    seen = seen[:, None] if seen.ndim == 1 else seen
    if load.shape != omega.shape or seen.shape != (omega.size, len(sensors)):
        raise ValueError(
            f"`base_acceleration` must have shape {omega.shape} and `velocity` "
            f"{(omega.size, len(sensors))}, but have {load.shape} and {seen.shape}."
        )
    if along is not None and not isinstance(along, Mapping):
        if np.shape(along) != (len(sensors),):
            raise ValueError(f"`along` must have one number a sensor, {len(sensors)}.")
        along = dict(zip(sensors, along, strict=True))
    angle = np.angle(load)
    turned: OptionalColumns = {**columns}
    harmonics, orders = columns.get("harmonics"), columns.get("harmonic_order", ())
    if harmonics is not None:
        turned["harmonics"] = np.asarray(harmonics) * np.exp(
            -1j * angle[:, None, None] * np.asarray(orders)
        )
    states = steady_states(
        *(np.asarray(level), omega, np.abs(load), seen * np.exp(-1j * angle)[:, None]),
        sensors=tuple(sensors),
        **turned,
    )
    return seen_from_base(states, base_motion("relative" if relative else "absolute", along))


def seen_from_base(data: SteadyStates, base: BaseMotion) -> SteadyStates:
    """States whose `force` is the base's acceleration and whose velocities are as recorded.

    Returns them relative to the base. The errors of amplitude and phase are turned with them; a
    phase that is unknown stays so, and then the motion of the base cannot be taken away.
    Raises `ValueError` for such a phase where the sensors record absolute motion.
    """
    if base.motion == "relative":
        return dataclasses.replace(data, base=base)
    if np.any(np.asarray(data.phase_unknown)):
        raise ValueError(
            "the motion of the base cannot be taken away from velocities without phases: measure "
            "them, or motion relative to the base."
        )
    recorded, measured = np.asarray(data.velocity), np.asarray(data.measured)
    own = base.own_velocity(data.sensors, np.asarray(data.frequency), np.asarray(data.force))
    velocity = np.where(measured, recorded - own, 0.0)
    return dataclasses.replace(_with_velocities(data, velocity), base=base)


def as_recorded(data: SteadyStates) -> SteadyStates:
    """States of a moving base with the velocities that the sensors recorded; others as they are."""
    if data.base is None or data.base.motion == "relative":
        return data
    seen, measured = np.asarray(data.velocity), np.asarray(data.measured)
    own = data.base.own_velocity(data.sensors, np.asarray(data.frequency), np.asarray(data.force))
    return _with_velocities(data, np.where(measured, seen + own, 0.0))


def _with_velocities(
    data: SteadyStates, velocity: Complex[np.ndarray, "state sensor"]
) -> SteadyStates:
    """The states with other velocities, their errors turned along."""
    stds = np.asarray(data.velocity_std), np.asarray(data.phase_std)
    turned = _turned_errors(np.asarray(data.velocity), velocity, *stds)
    new, amplitude_std, phase_std = jax.device_put((velocity, *turned))
    return dataclasses.replace(data, velocity=new, velocity_std=amplitude_std, phase_std=phase_std)


def _turned_errors(
    old: Complex[np.ndarray, "state sensor"],
    new: Complex[np.ndarray, "state sensor"],
    amplitude_std: Float[np.ndarray, "state sensor"],
    phase_std: Float[np.ndarray, "state sensor"],
) -> tuple[Float[np.ndarray, "state sensor"], Float[np.ndarray, "state sensor"]]:
    """1σ of amplitude (m/s) and phase (rad) of the same complex error about another phasor.

    The error's ellipse has its axes along and across the old phasor; what is not stated of one of
    them counts as none, where the other is.
    """
    stated = np.isfinite(amplitude_std) | np.isfinite(phase_std)
    along, across = np.nan_to_num(amplitude_std), np.nan_to_num(phase_std) * np.abs(old)
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.angle(new * old.conj())
        radial = np.hypot(along * np.cos(turn), across * np.sin(turn))
        angular = np.hypot(along * np.sin(turn), across * np.cos(turn)) / np.abs(new)
    both = np.abs(turn) > 1e-12
    radial = np.where(stated & (both | np.isfinite(amplitude_std)), radial, np.nan)
    angular = np.where(stated & (both | np.isfinite(phase_std)), angular, np.nan)
    return radial, angular
