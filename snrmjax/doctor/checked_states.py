"""Tables of steady states as the check looks at them: one mode at the sensor that moves most."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from snrmjax.doctor.priors import MODAL_MASS
from snrmjax.identify.test_model.states import TestStates, state_errors
from snrmjax.measure.states import SteadyStates, relative_errors
from snrmjax.model.modes import residual_velocity
from snrmjax.model.structures import Structure


class CheckedStates(NamedTuple):
    """States of one sensor, and what an error of import or of the test may depend on."""

    test: TestStates  # as recorded, without what moves beside the mode
    row: Int[np.ndarray, " state"]  # in the table
    beside: Complex[np.ndarray, " state"]  # m/s, of the other modes
    order: Float[np.ndarray, " state"]  # of the test, 0 to 1
    noise: float  # stated 1σ of velocities, relative; NaN where none is
    files: tuple[tuple[int, ...], ...]  # levels of each table, where there are several

    @property
    def recorded(self) -> Complex[np.ndarray, " state"]:
        """Phasors as they stand in the table, with the sign of the mode."""
        return self.test.velocity + self.beside

    @property
    def mobility(self) -> Float[np.ndarray, " state"]:
        """|V|/F."""
        return np.abs(self.test.velocity) / self.test.force

    def read(self, velocity: Complex[np.ndarray, " state"]) -> TestStates:
        """The states with other phasors in the place of the recorded ones."""
        return self.test._replace(velocity=velocity - self.beside)


def checked_states(
    data: SteadyStates,
    model: Structure | None,
    sensor: int,
    rows: Bool[np.ndarray, " state"],
    files: tuple[tuple[int, ...], ...] = (),
) -> CheckedStates:
    """Some rows of a table at one sensor, with what the model says of its mode.

    Without a model the modal constant is one and the other modes are taken to be still. Errors
    count by their proportions: their common size is always found from the states.
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
        stds = (gain, phase, 2 * frequency / own, damping / max(ratio, 1e-6))
    sign = -1.0 if constant < 0 else 1.0
    errors, stated = state_errors(np.asarray(relative_errors(some))[:, sensor])
    noise = float(np.median(errors[:, 1:])) if stated else np.nan
    if stated:
        errors = errors / noise
    order = np.asarray(some.order)
    if not np.all(np.isfinite(order)):
        order = np.linspace(0.0, 1.0, len(at))
    level = np.unique(np.asarray(some.level), return_inverse=True)[1]
    test = TestStates(
        *(level, omega, force, sign * (velocity - beside), errors, False),
        *(abs(constant) or 1.0, stds, MODAL_MASS),
    )
    return CheckedStates(test, at, sign * beside, order, noise, files)


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
