"""A table of measured steady states: the input of every identification."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

PHASE_UNKNOWN = np.pi / 3
"""1σ of a phase, rad, from which on it counts as unknown.

Errors are carried to first order, which at a radian says nothing any more: a velocity at
resonance would pass for anything from cos 60° of its size on.
"""

NO_PHASE = np.pi
"""1σ, rad, that stands for a phase that was not measured."""


class SteadyStates(eqx.Module):
    """Steady states, each measured by one or several sensors.

    Phasors e^{+iΩt} relative to the force (velocity phase 0 = phase resonance), peak amplitudes.
    A sensor that did not measure a state has `measured` False and velocity 0. A standard
    deviation that nobody stated is NaN. A phase with a 1σ of `PHASE_UNKNOWN` or more is unknown:
    of such a velocity and of its harmonics the amplitudes alone count. A force known only as a
    drive voltage is in `drive` and `force` is NaN. `notes` say what a reader of files did not use
    or did not find stated.
    """

    level: Int[Array, " state"]
    frequency: Float[Array, " state"]  # rad/s
    force: Float[Array, " state"]  # N
    velocity: Complex[Array, "state sensor"]  # m/s, fundamental
    measured: Bool[Array, "state sensor"]
    velocity_std: Float[Array, "state sensor"]  # m/s, 1σ of the amplitude, NaN = not stated
    phase_std: Float[Array, "state sensor"]  # rad, 1σ, NaN = not stated
    force_std: Float[Array, " state"]  # N, 1σ, NaN = not stated
    drive: Float[Array, " state"]  # V, NaN where the force is known
    order: Float[Array, " state"]  # test order 0…1, NaN = not stated
    harmonics: Complex[Array, "state sensor harmonic"]  # m/s, NaN = not measured
    harmonic_std: Float[Array, "state sensor"]  # m/s, rms of the complex error, NaN = not stated
    harmonic_order: tuple[int, ...] = eqx.field(static=True)
    sensors: tuple[str, ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def n_states(self) -> int:
        """Number of steady states."""
        return self.frequency.shape[0]

    @property
    def phase_unknown(self) -> Bool[Array, "state sensor"]:
        """Where a velocity was measured whose amplitude alone is known."""
        return self.measured & (self.phase_std >= PHASE_UNKNOWN * (1 - 1e-12))

    def renumbered(self, offset: int) -> "SteadyStates":
        """The same states with `offset` added to their levels, before joining tests."""
        return eqx.tree_at(lambda data: data.level, self, self.level + offset)


def steady_states(
    level: Int[np.ndarray, " state"],
    frequency: Float[np.ndarray, " state"],
    force: Float[np.ndarray, " state"],
    velocity: Complex[np.ndarray, "state sensor"],
    *,
    sensors: tuple[str, ...] = ("sensor 1",),
    measured: Bool[np.ndarray, "state sensor"] | None = None,
    velocity_std: Float[np.ndarray, "state sensor"] | None = None,
    phase_std: Float[np.ndarray, "state sensor"] | None = None,
    force_std: Float[np.ndarray, " state"] | None = None,
    drive: Float[np.ndarray, " state"] | None = None,
    order: Float[np.ndarray, " state"] | None = None,
    harmonics: Complex[np.ndarray, "state sensor harmonic"] | None = None,
    harmonic_std: Float[np.ndarray, "state sensor"] | None = None,
    harmonic_order: tuple[int, ...] = (),
) -> SteadyStates:
    """Build `SteadyStates` from arrays; `velocity` may be a vector when there is one sensor.

    Arguments: `frequency` in rad/s, `force` in N, `velocity` phasors in m/s relative to the
    force; standard deviations in the same units, `phase_std` in rad.
    Raises `ValueError` naming the argument whose shape does not fit.

    >>> data = steady_states([1, 1], [500.0, 510.0], [1.0, 1.0], [0.6 + 0.0j, 0.5 - 0.2j])
    >>> data.n_states, data.velocity.shape
    (2, (2, 1))
    """
    omega = np.asarray(frequency, dtype=np.float64)
    if omega.ndim != 1:
        raise ValueError(f"`frequency` must be a vector, but has shape {omega.shape}.")
    n_states, n_sensors = omega.size, len(sensors)

    def per_state(name: str, value: object, dtype: type = np.float64) -> Any:
        array = np.full(n_states, np.nan) if value is None else np.asarray(value, dtype=dtype)
        if array.shape != (n_states,):
            raise ValueError(f"`{name}` must have shape ({n_states},), but has {array.shape}.")
        return array

    def per_sensor(name: str, value: object, dtype: type = np.float64) -> Any:
        shape = (n_states, n_sensors)
        array = np.full(shape, np.nan) if value is None else np.asarray(value, dtype=dtype)
        if array.ndim == 1 and n_sensors == 1:
            array = array[:, None]
        if array.shape != shape:
            raise ValueError(f"`{name}` must have shape {shape}, but has {array.shape}.")
        return array

    if harmonics is None:
        harmonics = np.zeros((n_states, n_sensors, 0), dtype=np.complex128)
        if harmonic_order:
            raise ValueError("`harmonic_order` is given without `harmonics`.")
    told: Any = np.asarray(harmonics, dtype=np.complex128)
    if told.shape != (n_states, n_sensors, len(harmonic_order)):
        raise ValueError(
            f"`harmonics` must have shape {(n_states, n_sensors, len(harmonic_order))}, "
            f"but has {told.shape}."
        )
    states = SteadyStates(
        level=per_state("level", level, np.int64),
        frequency=per_state("frequency", omega),
        force=per_state("force", force),
        velocity=per_sensor("velocity", velocity, np.complex128),
        measured=per_sensor(
            "measured", np.ones((n_states, n_sensors)) if measured is None else measured, np.bool_
        ),
        velocity_std=per_sensor("velocity_std", velocity_std),
        phase_std=per_sensor("phase_std", phase_std),
        force_std=per_state("force_std", force_std),
        drive=per_state("drive", drive),
        order=per_state("order", order),
        harmonics=told,
        harmonic_std=per_sensor("harmonic_std", harmonic_std),
        harmonic_order=tuple(harmonic_order),
        sensors=tuple(sensors),
    )
    # All at once: one by one they compile, a copy of every shape.
    return jax.device_put(states, may_alias=False)


def check_phases(data: SteadyStates, purpose: str) -> None:
    """Raise `ValueError` where phases are unknown; `purpose` is what needs them."""
    phases: Any = data.phase_unknown
    if isinstance(phases, jax.core.Tracer):  # within `jax.jit` nothing has a value yet
        return
    unknown = np.any(np.asarray(phases), axis=1)
    if unknown.any():
        raise ValueError(
            f"{purpose} needs the phases of all velocities relative to the force, but those of "
            f"{int(unknown.sum())} of {data.n_states} steady states are unknown (`velocity_m_s` "
            f"in place of real and imaginary part, or `phase_std_deg` of "
            f"{np.degrees(PHASE_UNKNOWN):.0f} or more): leave these out, or ask `snrmjax diagnose` "
            "(`diagnose_model`) what the model lacks, which works with amplitudes alone."
        )


def check_force(data: SteadyStates, purpose: str) -> None:
    """Raise `ValueError` where no state has a force; `purpose` is what needs it."""
    known: Any = jnp.isfinite(data.force)
    # Within `jax.jit` nothing has a value yet; within a derivative this still has one.
    if isinstance(known, jax.core.Tracer) or np.any(known):
        return
    if not np.any(np.isfinite(np.asarray(data.drive))):
        raise ValueError(f"{purpose} needs the force, but no steady state has one.")
    raise ValueError(
        f"{purpose} needs the force in newtons, but only a drive voltage (`drive_v`) is given. Let "
        "a joint fit find the force per volt together with the curves: `--fit auto --free "
        'force_gain`, in Python `fit_jointly(data, modes, free=["force_gain"])`. Or calibrate the '
        "force with low-level responses first: `sj.measure.equivalent_force`, `calibrate_force` "
        "and `apply_calibration`."
    )


def join_steady_states(*parts: SteadyStates | Iterable[SteadyStates]) -> SteadyStates:
    """All steady states of several tests of the same structure, in order.

    Arguments: the tests, as separate arguments or as one list. Levels are kept as they are: states
    of one level are taken to share their errors of gain and phase, so give different tests
    different levels beforehand (`SteadyStates.renumbered`).
    Returns `SteadyStates`. Raises `ValueError` when there is nothing to join, when something is
    not `SteadyStates`, or when sensors or recorded harmonics differ.

    >>> one = steady_states([1], [500.0], [1.0], [0.6 + 0.0j])
    >>> join_steady_states([one, one.renumbered(1)]).level
    Array([1, 2], dtype=int64)
    """
    tests: list[SteadyStates] = []
    for part in parts:
        tests += [part] if isinstance(part, SteadyStates) else _listed(part)
    if not tests:
        raise ValueError("there is nothing to join: give one `SteadyStates` at least.")
    for test in tests:
        if not isinstance(test, SteadyStates):
            raise ValueError(
                f"`join_steady_states` joins `SteadyStates`, but got a `{type(test).__name__}`."
            )
        if test.sensors != tests[0].sensors or test.harmonic_order != tests[0].harmonic_order:
            raise ValueError(
                "tests can be joined when they have the same sensors and harmonics, but one has "
                f"{list(test.sensors)} and {list(test.harmonic_order)}, the first "
                f"{list(tests[0].sensors)} and {list(tests[0].harmonic_order)}."
            )
    notes = tuple(dict.fromkeys(note for test in tests for note in test.notes))
    alike = [dataclasses.replace(test, notes=notes) for test in tests]
    return jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *alike)


def _listed(part: Any) -> list[Any]:
    """The members of a list; what is no list is its only member, to be refused by its type."""
    alone = isinstance(part, str | Mapping) or not np.iterable(part)
    return [part] if alone else list(part)


def relative_errors(data: SteadyStates) -> Float[Array, "state sensor input"]:
    """Stated 1σ of log force, log velocity and phase; what is not stated is 0 if others are.

    A state for which nothing is stated has NaN throughout. NumPy's arrays stay so.
    """
    xp: Any = data.velocity.__array_namespace__()

    def over(std: Any, size: Any) -> Any:
        # What is not stated is kept out of the division: its NaN would pass `where` in a gradient.
        known = xp.isfinite(std) & (size > 0)
        return xp.where(known, xp.where(known, std, 0.0) / xp.where(known, size, 1.0), xp.nan)

    amplitude = xp.abs(data.velocity)
    force = xp.broadcast_to(over(data.force_std, data.force)[:, None], amplitude.shape)
    velocity = over(data.velocity_std, amplitude)
    # A velocity error without a phase error is taken as a circle in the complex plane.
    phase = xp.where(xp.isfinite(data.phase_std), data.phase_std, velocity)
    stated = xp.stack([force, velocity, phase], axis=2)
    something = xp.any(xp.isfinite(stated), axis=2, keepdims=True)
    return xp.where(xp.isfinite(stated), stated, xp.where(something, 0.0, xp.nan))
