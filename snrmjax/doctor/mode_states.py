"""Tables of steady states as the doctor looks at them: one mode at the sensor that moves most."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from snrmjax.doctor.balance_fit import UNSTATED, ModeStates
from snrmjax.measure.states import SteadyStates, relative_errors
from snrmjax.model.modes import residual_velocity
from snrmjax.model.structures import Structure


def mode_states(
    data: SteadyStates, model: Structure | None, sensor: int, rows: Bool[np.ndarray, " state"]
) -> ModeStates:
    """Some rows of a table at one sensor, with what the model says of its mode.

    Without a model the modal constant is one and the other modes are taken to be still.
    """
    at = np.flatnonzero(rows)
    # As NumPy's: nothing compiles for the table's own number of states.
    some: SteadyStates = jax.tree.map(lambda column: np.asarray(column)[at], data)
    drive = np.isnan(np.asarray(some.force))
    force = np.where(drive, np.asarray(some.drive), np.asarray(some.force))
    omega = np.asarray(some.frequency)
    velocity = np.asarray(some.velocity)[:, sensor]
    constant, beside = 1.0, np.zeros(len(at), dtype=complex)
    stds = (0.0, 0.0, 0.0, 0.0)
    if model is not None:
        modes = model.modes
        one = modes.mode_of_interest
        constant = float(modes.mode_shape[sensor, one] * modes.participation[one])
        if not drive.any() and (modes.n_modes > 1 or modes.rigid_body_participation.size):
            beside = np.asarray(residual_velocity(modes, jnp.asarray(omega), jnp.asarray(force)))[
                :, sensor
            ]
        gain, phase, frequency, damping = model.level_stds
        own, ratio = float(modes.natural_frequency[one]), float(modes.damping_ratio[one])
        stds = (gain, phase, frequency / own, damping / max(ratio, 1e-6))
    sign = -1.0 if constant < 0 else 1.0
    errors = np.asarray(relative_errors(some))[:, sensor]
    stated = bool(np.all(np.isfinite(errors)))
    if not stated:
        errors = np.tile([0.0, UNSTATED, UNSTATED], (len(at), 1))
    order = np.asarray(some.order)
    if not np.all(np.isfinite(order)):
        order = np.linspace(0.0, 1.0, len(at))
    level = np.unique(np.asarray(some.level), return_inverse=True)[1]
    return ModeStates(
        *(at, level, omega, force, sign * velocity, sign * beside, order, errors, stated),
        *(abs(constant) or 1.0, stds),
    )


def usable_rows(data: SteadyStates, sensor: int) -> Bool[np.ndarray, " state"]:
    """States that this sensor measured, with a phase and with a force or a drive voltage."""
    force = np.where(np.isnan(np.asarray(data.force)), np.asarray(data.drive), data.force)
    velocity = np.asarray(data.velocity)[:, sensor]
    known = np.asarray(data.measured)[:, sensor] & ~np.asarray(data.phase_unknown)[:, sensor]
    return known & (np.abs(velocity) > 0) & np.isfinite(force) & (force > 0)


def leading_sensor(data: SteadyStates) -> int:
    """The sensor with most usable states; of several, the one that moves most."""
    size = np.where(np.asarray(data.measured), np.abs(np.asarray(data.velocity)), 0.0)
    ranks = [
        (int(usable_rows(data, k).sum()), float(size[:, k].mean())) for k in range(size.shape[1])
    ]
    return ranks.index(max(ranks))


def files_of_levels(
    tables: Sequence[SteadyStates],
) -> tuple[list[SteadyStates], tuple[tuple[int, ...], ...]]:
    """The tables with levels of their own, counted from 0, and the levels of each table."""
    renumbered, groups, first = [], [], 0
    for given in tables:
        one: SteadyStates = jax.tree.map(np.asarray, given)
        numbers = np.unique(np.asarray(one.level))
        levels = np.searchsorted(numbers, np.asarray(one.level)) + first
        renumbered.append(one.renumbered(levels - np.asarray(one.level)))
        groups.append(tuple(range(first, first + len(numbers))))
        first += len(numbers)
    return renumbered, tuple(groups)
