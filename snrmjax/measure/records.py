"""Steady states from time records of a force and of the velocities it drives."""

from typing import Any

import numpy as np
from jaxtyping import Array, Shaped

from snrmjax.measure.harmonic_fit import (
    HarmonicFitStatus,
    fit_harmonics,
    phasor_relative_to_force,
)
from snrmjax.measure.signals import require_fundamental
from snrmjax.measure.states import SteadyStates, steady_states


def steady_state_from_records(
    time: Shaped[np.ndarray | Array, " sample"],
    force_record: Shaped[np.ndarray | Array, " sample"],
    velocity_records: Shaped[np.ndarray | Array, "sensor sample"],
    frequency: float,
    *,
    level: int = 1,
    harmonic_order: tuple[int, ...] = (1, 2, 3),
    sensors: tuple[str, ...] | None = None,
) -> SteadyStates:
    """One measured steady state, with its harmonics and standard deviations, from time records.

    Arguments: `time` in s; `force_record` in N; `velocity_records` in m/s, one row a sensor (a
    vector is one sensor); `frequency` in rad/s; `level` that the state belongs to;
    `harmonic_order`, of which harmonic 0 is kept when it is listed; `sensors` by name.
    Returns `SteadyStates` with one state, to be joined with others by `join_steady_states` and
    written by `sj.io.write_steady_states`; without derivatives (`fit_harmonics` has them).
    `phase_std` contains the phase error of the force; `harmonic_std` is the rms over the
    harmonics. A sensor whose fit failed has `measured` False.
    Raises `ValueError` for wrong shapes and orders, and when the force or every velocity cannot be
    fitted, with the reason.
    Reference: Kwarta & Allen, section 3.1 (the multi-sine fit named above their Eq. (20)).

    >>> time = np.linspace(0.0, 1.0, 200)
    >>> force, velocity = np.cos(60 * time + 0.3), 0.2 * np.cos(60 * time + 0.4)
    >>> data = steady_state_from_records(time, force, velocity, 60.0)
    >>> data.force.round(9), np.angle(data.velocity).round(9)
    (Array([1.], dtype=float64), array([[0.1]]))
    """
    times, force = np.asarray(time, dtype=float), np.asarray(force_record, dtype=float)
    velocity = np.atleast_2d(np.asarray(velocity_records, dtype=float))
    for name, record in (("force_record", force), ("velocity_records", velocity[0])):
        if record.shape != times.shape:
            raise ValueError(
                f"`{name}` must have samples of shape {times.shape}, as `time` has, "
                f"but has {record.shape}."
            )
    orders = require_fundamental("harmonic_order", harmonic_order)
    # From the middle of the records, where a wrong clock turns the phases least.
    records = np.concatenate([force[None], velocity])
    fit = fit_harmonics(times, records, frequency, orders, reference_time=times.mean())
    good = np.asarray(fit.status) == HarmonicFitStatus.SUCCESSFUL
    for name, fitted, row in (
        ("force_record", good[0], 0),
        ("velocity_records", good[1:].any(), 1),
    ):
        if not fitted:
            why = HarmonicFitStatus(int(fit.status[row])).message
            raise ValueError(f"`{name}` cannot be fitted: {why}.")
    first, higher = fit.harmonic_order.index(1), tuple(k for k in orders if k != 1)
    stored = [fit.harmonic_order.index(k) for k in higher]
    noisy = [k for k in stored if fit.harmonic_order[k] > 1] or stored  # the mean has half an error
    amplitude: Any = np.asarray(fit.amplitude)
    phase_std = np.asarray(fit.phase_std)[:, first]
    relative = np.asarray(
        phasor_relative_to_force(amplitude[1:], amplitude[0, first], fit.harmonic_order)
    )
    harmonic_std = np.full(len(velocity), np.nan)
    if noisy:
        squares = np.asarray(fit.complex_std)[1:, noisy] ** 2
        harmonic_std = np.sqrt(squares.mean(axis=1))
    return steady_states(
        np.array([level]),
        np.array([frequency]),
        np.abs(amplitude[:1, first]),
        np.where(good[1:], relative[:, first], 0.0)[None],
        sensors=sensors or tuple(f"sensor {k + 1}" for k in range(len(velocity))),
        measured=good[None, 1:],
        force_std=np.asarray(fit.amplitude_std)[:1, first],
        velocity_std=np.asarray(fit.amplitude_std)[None, 1:, first],
        phase_std=np.hypot(phase_std[1:], phase_std[0])[None],
        harmonics=relative[None][..., stored],
        harmonic_std=harmonic_std[None],
        harmonic_order=higher,
    )
