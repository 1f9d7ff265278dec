"""Steady states from time records of a force and of the velocities it drives."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Shaped

from snrmjax.measure.harmonic_fit import (
    HarmonicFit,
    HarmonicFitStatus,
    checked_frequency,
    fit_harmonics,
    orders_with_mean,
    phasor_relative_to_force,
)
from snrmjax.measure.signals import require_orders
from snrmjax.measure.states import SteadyStates, steady_states


class RecordFit(eqx.Module):
    """Harmonics of the force record and of the velocity records of one steady state.

    The phases of both fits count from the mean time of the records, where a wrong clock turns
    them least; the properties below count from the force fundamental.
    """

    force: HarmonicFit  # N
    velocity: HarmonicFit  # m/s, one row a sensor

    @property
    def force_harmonics(self) -> Complex[Array, " harmonic"]:
        """All harmonics of the force in N, relative to its fundamental (order 0 first)."""
        fit = self.force
        return phasor_relative_to_force(fit.amplitude, fit.harmonic(1), fit.harmonic_order)

    @property
    def velocity_harmonics(self) -> Complex[Array, "sensor harmonic"]:
        """All harmonics of the velocities in m/s, relative to the force (order 0 first)."""
        fit = self.velocity
        return phasor_relative_to_force(fit.amplitude, self.force.harmonic(1), fit.harmonic_order)

    @property
    def force_distortion(self) -> Float[Array, ""]:
        """Root sum square of the force's higher harmonics over its fundamental."""
        higher = np.flatnonzero(np.asarray(self.force.harmonic_order) > 1)
        return jnp.linalg.norm(self.force.amplitude[higher]) / jnp.abs(self.force.harmonic(1))


def fit_records(
    time: Shaped[np.ndarray | Array, " sample"],
    force_record: Shaped[np.ndarray | Array, " sample"],
    velocity_records: Shaped[np.ndarray | Array, "sensor sample"],
    frequency: float | Float[Array, ""],
    harmonic_order: tuple[int, ...],
    *,
    refine_frequency: bool = False,
) -> RecordFit:
    """Fit the harmonics of a force and of several velocities recorded together.

    With `refine_frequency` every record is asked for the frequency and the answers are averaged
    with the inverse of their variances; all records are then fitted with that frequency.

    Arguments: `time` in s; `force_record` in N; `velocity_records` in m/s, one row a sensor (a
    vector is one sensor); `frequency` in rad/s; `harmonic_order` must contain 1; the others as in
    `fit_harmonics`. Returns `RecordFit`, differentiable as `fit_harmonics` is,
    with a status for each record as in `fit_harmonics`.
    Raises `ValueError` for wrong shapes, orders or a frequency that is not positive.
    Reference: Kwarta & Allen, section 3.1 (the multi-sine fit named above their Eq. (20)).
    """
    times, force = jnp.asarray(time, dtype=float), jnp.asarray(force_record, dtype=float)
    velocity = jnp.atleast_2d(jnp.asarray(velocity_records, dtype=float))
    for name, record in (("force_record", force), ("velocity_records", velocity[0])):
        if record.shape != times.shape:
            raise ValueError(
                f"`{name}` must have samples of shape {times.shape}, as `time` has, "
                f"but has {record.shape}."
            )
    harmonic_order = require_orders("harmonic_order", harmonic_order)
    if 1 not in harmonic_order:
        raise ValueError(
            f"`harmonic_order` must contain the fundamental, 1, but is {harmonic_order}."
        )
    records = jnp.concatenate([force[None], velocity])
    omega = checked_frequency(frequency, ())
    orders = orders_with_mean(harmonic_order)
    return _fit_together(times, records, omega, orders, refine_frequency)


@eqx.filter_jit
def _fit_together(
    time: Float[Array, " sample"],
    records: Float[Array, "record sample"],
    frequency: Float[Array, ""],
    orders: tuple[int, ...],
    refine: bool,
) -> RecordFit:
    reference = jnp.mean(time)
    std, found = jnp.array(jnp.nan), jnp.array(True)
    if refine:
        alone = fit_harmonics(time, records, frequency, orders, refine_frequency=True)
        good = alone.status == int(HarmonicFitStatus.SUCCESSFUL)
        found = jnp.any(good)
        # Rounding is the floor: without it a record free of noise would weigh infinitely.
        variance = alone.frequency_std**2 + (1e-14 * alone.frequency) ** 2
        weight = jnp.where(good, 1.0 / variance, 0.0)
        mean = jnp.sum(jnp.where(good, weight * alone.frequency, 0.0)) / jnp.sum(weight)
        frequency = jnp.where(found, mean, frequency)
        std = 1.0 / jnp.sqrt(jnp.sum(weight))
    fit = fit_harmonics(time, records, frequency, orders, reference_time=reference)
    if refine:
        lost = dataclasses.replace(alone, degrees_of_freedom=fit.degrees_of_freedom)
        fit = jax.tree.map(lambda new, old: jnp.where(found, new, old), fit, lost)
        fit = dataclasses.replace(fit, frequency_std=jnp.where(found, std, alone.frequency_std))
    return RecordFit(
        jax.tree.map(lambda leaf: leaf[0], fit), jax.tree.map(lambda leaf: leaf[1:], fit)
    )


def steady_state_from_records(
    time: Shaped[np.ndarray | Array, " sample"],
    force_record: Shaped[np.ndarray | Array, " sample"],
    velocity_records: Shaped[np.ndarray | Array, "sensor sample"],
    frequency: float,
    *,
    level: int = 1,
    harmonic_order: tuple[int, ...] = (1, 2, 3),
    sensors: tuple[str, ...] | None = None,
    refine_frequency: bool = False,
) -> SteadyStates:
    """One measured steady state, with its harmonics and standard deviations, from time records.

    Arguments: as in `fit_records`, with the `level` the state belongs to and names of the
    sensors; harmonic 0 is kept when `harmonic_order` lists it.
    Returns `SteadyStates` with one state, to be joined with others by `join_steady_states` and
    written by `sj.io.write_steady_states`; without derivatives (`fit_records` has them).
    `phase_std` contains the phase error of the force;
    `harmonic_std` is the rms over the harmonics. A sensor whose fit failed has `measured` False.
    Raises `ValueError` when the force or every velocity cannot be fitted, with the reason.
    Reference: Kwarta & Allen, section 3.1 (the multi-sine fit named above their Eq. (20)).

    >>> time = np.linspace(0.0, 1.0, 200)
    >>> force, velocity = np.cos(60 * time + 0.3), 0.2 * np.cos(60 * time + 0.4)
    >>> data = steady_state_from_records(time, force, velocity, 60.0)
    >>> data.force.round(9), jnp.angle(data.velocity).round(9)
    (Array([1.], dtype=float64), Array([[0.1]], dtype=float64))
    """
    fit = fit_records(
        time,
        force_record,
        velocity_records,
        frequency,
        harmonic_order,
        refine_frequency=refine_frequency,
    )
    measured = np.asarray(fit.velocity.status) == HarmonicFitStatus.SUCCESSFUL
    for name, good, status in (
        ("force_record", fit.force.status == HarmonicFitStatus.SUCCESSFUL, fit.force.status),
        ("velocity_records", measured.any(), fit.velocity.status[0]),
    ):
        if not good:
            raise ValueError(
                f"`{name}` cannot be fitted: {HarmonicFitStatus(int(status)).message}."
            )
    higher = tuple(int(order) for order in harmonic_order if order != 1)
    state = {name: np.asarray(value)[None] for name, value in _state_of(fit, higher).items()}
    return steady_states(
        np.array([level]),
        sensors=sensors or tuple(f"sensor {k + 1}" for k in range(measured.size)),
        measured=measured[None],
        harmonic_order=higher,
        **state,
    )


@eqx.filter_jit
def _state_of(fit: RecordFit, higher: tuple[int, ...]) -> dict[str, Array]:
    """What a steady state needs, by the names of the arguments of `steady_states`."""
    orders = fit.velocity.harmonic_order
    first = orders.index(1)
    stored = np.asarray([orders.index(order) for order in higher], dtype=int)
    amplitudes = fit.velocity_harmonics
    good = fit.velocity.status == int(HarmonicFitStatus.SUCCESSFUL)
    noisy = [k for k in stored if orders[k] > 1] or list(stored)  # the mean has half an error
    floor = jnp.mean(fit.velocity.complex_std[:, np.asarray(noisy, dtype=int)] ** 2, axis=-1)
    return {
        "frequency": fit.force.frequency,
        "force": jnp.abs(fit.force.harmonic(1)),
        "force_std": fit.force.amplitude_std[first],
        "velocity": jnp.where(good, amplitudes[:, first], 0.0),
        "velocity_std": fit.velocity.amplitude_std[:, first],
        "phase_std": jnp.hypot(fit.velocity.phase_std[:, first], fit.force.phase_std[first]),
        "harmonics": amplitudes[:, stored],
        "harmonic_std": jnp.sqrt(floor),
    }
