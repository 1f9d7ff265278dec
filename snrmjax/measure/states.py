"""Measured steady states: the input of every identification."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, TypedDict, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.model.moving_base import BaseMotion
from snrmjax.numerics.compiled import as_numpy, value_of
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import DEGREE, HERTZ

PHASE_UNKNOWN = np.pi / 3
"""1σ of a phase, rad, above which it counts as unknown.

Errors are propagated to first order, which is meaningless at a radian: a velocity at resonance
would be compatible with any in-phase part above cos 60° of its amplitude.
"""

_UNKNOWN_FROM = PHASE_UNKNOWN * (1 - 1e-12)  # rounding of 60°

NO_PHASE = np.pi
"""1σ, rad, of a phase that was not measured."""


class SteadyStates(AbstractResult):
    """Steady states, each measured by one or several sensors.

    Phasors e^{+iΩt} relative to the force (velocity phase 0 = phase resonance), peak amplitudes.
    A sensor that did not measure a state has `measured` False and velocity 0. A standard
    deviation that is not stated is NaN. A phase with a 1σ of `PHASE_UNKNOWN` or more is unknown:
    only the amplitudes of such a velocity and of its harmonics are used. A force known only as a
    drive voltage is in `drive` and `force` is NaN. With base excitation `force` is the amplitude
    of the base acceleration in m/s² and velocities are relative to the base; `base` has the motion
    that the sensors recorded. `notes` list unused or missing data of files. To differentiate by a
    column, change it with `dataclasses.replace`.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("state", "sensor", "harmonic", "level")

    measured: Bool[Array, "state sensor"]
    harmonic_order: tuple[int, ...] = eqx.field(static=True)
    sensors: tuple[str, ...] = eqx.field(static=True)
    level: Int[Array, " state"] = quantity("state", "1", "level of the test")
    frequency: Float[Array, " state"] = quantity("state", "Hz", "forcing frequency")
    force: Float[Array, " state"] = quantity("state", "N", "force amplitude")
    # Fundamental, relative to the force.
    velocity: Complex[Array, "state sensor"] = quantity("state sensor", "m/s", "velocity")
    # NaN in the following: not stated, not measured; for the drive, that the force is known.
    velocity_std: Float[Array, "state sensor"] = quantity(
        "state sensor", "m/s", "1σ of the amplitude"
    )
    phase_std: Float[Array, "state sensor"] = quantity("state sensor", "deg", "1σ of the phase")
    force_std: Float[Array, " state"] = quantity("state", "N", "1σ of the force")
    drive: Float[Array, " state"] = quantity(
        "state", "V", "drive voltage where the force is unknown"
    )
    order: Float[Array, " state"] = quantity("state", "1", "position in the test, from 0 to 1")
    harmonics: Complex[Array, "state sensor harmonic"] = quantity(
        "state sensor harmonic", "m/s", "harmonic of the velocity", name="harmonic"
    )
    harmonic_std: Float[Array, "state sensor"] = quantity(
        "state sensor", "m/s", "rms error of a harmonic"
    )
    notes: tuple[Fact | str, ...] = setting(default=())
    base: BaseMotion | None = eqx.field(static=True, default=None)

    def summary(self) -> tuple[str, ...]:
        """Ranges, stated errors and missing data."""

        def spans(values: Any, unit: str) -> str:
            finite = np.asarray(values)[np.isfinite(np.asarray(values))]
            return f"{finite.min():.4g} to {finite.max():.4g} {unit}" if finite.size else "unknown"

        n_levels = len(np.unique(np.asarray(self.level)))
        volts = np.isfinite(np.asarray(self.drive)).any() and not np.isfinite(self.force).any()
        load = (
            spans(self.drive, "V (force unknown)") if volts else spans(self.force, self.force_unit)
        )
        stated = [
            name
            for name in ("velocity", "phase", "force")
            if np.isfinite(np.asarray(getattr(self, f"{name}_std"))).any()
        ]
        amplitude = np.where(np.asarray(self.measured), np.abs(np.asarray(self.velocity)), np.nan)
        missing = int(np.sum(~np.asarray(self.measured)))
        lines = [
            f"SteadyStates: {self.n_states} states of {n_levels} "
            f"level{'s' if n_levels != 1 else ''} at {', '.join(self.sensors)}",
            f"frequency {spans(np.asarray(self.frequency) / HERTZ, 'Hz')}, "
            f"{'force' if self.base is None else 'acceleration of the base'} {load}",
            f"velocity {spans(amplitude, 'm/s')}",
            f"errors stated of {', '.join(stated) or 'nothing'}",
        ]
        if missing:
            lines.append(f"{missing} velocities not measured")
        if self.harmonic_order:
            lines.append(f"harmonics {', '.join(map(str, self.harmonic_order))}")
        return (*lines, *(f"note: {note}" for note in self.notes))

    def variables(self) -> dict[str, Variable]:
        """The columns of a table of steady states."""
        velocity: Any = np.where(self.measured, self.velocity, np.nan)
        masked = dataclasses.replace(self, velocity=velocity)
        orders = np.asarray(self.harmonic_order, dtype=int)
        columns = dict(super(SteadyStates, masked).variables())
        if self.base is not None:
            for name in ("force_n", "force_std_n"):
                one = columns.pop(name)
                meaning = one.meaning.replace("force", "acceleration of the base")
                new = name.replace("force", "base_acceleration").replace("_n", "_m_s2")
                columns[new] = one._replace(unit="m/s²", meaning=meaning)
        return {
            **columns,
            "sensor": Variable(("sensor",), np.asarray(self.sensors), "", "sensor"),
            "harmonic": Variable(("harmonic",), orders, "1", "harmonic of the forcing frequency"),
        }

    @property
    def n_states(self) -> int:
        """Number of steady states."""
        return self.frequency.shape[0]

    @property
    def force_unit(self) -> str:
        """Unit of `force`: newtons, or m/s² of a base."""
        return "N" if self.base is None else "m/s²"

    @property
    def phase_unknown(self) -> Bool[Array, "state sensor"]:
        """Measured velocities of which only the amplitude is known."""
        return self.measured & (self.phase_std >= _UNKNOWN_FROM)

    def select(self, rows: Bool[np.ndarray, " state"] | Int[np.ndarray, " row"]) -> "SteadyStates":
        """Some of the states, by a mask or by row numbers in the given order."""
        index = np.asarray(rows)
        # On the host, where possible: on the device every number of rows would compile.
        return jax.tree.map(lambda column: jnp.asarray(as_numpy(column)[index]), self)

    def renumbered(self, offset: int) -> "SteadyStates":
        """The same states with `offset` added to their levels, for joining tests."""
        return eqx.tree_at(lambda data: data.level, self, self.level + offset)


class OptionalColumns(TypedDict, total=False):
    """Optional columns of a table of steady states, as keywords of `steady_states`.

    None means absent. One number per state, or per state and sensor (a vector for one sensor).
    """

    measured: Bool[np.ndarray, "state sensor"] | None  # False where a sensor missed a state
    velocity_std: Float[np.ndarray, "state sensor"] | None  # m/s, 1σ of the amplitude
    phase_std: Float[np.ndarray, "state sensor"] | None  # rad, 1σ
    force_std: Float[np.ndarray, " state"] | None  # N, 1σ
    drive: Float[np.ndarray, " state"] | None  # V, in place of an unknown force (NaN)
    order: Float[np.ndarray, " state"] | None  # position in the test, from 0 to 1
    harmonics: Complex[np.ndarray, "state sensor harmonic"] | None  # m/s, relative to the force
    harmonic_std: Float[np.ndarray, "state sensor"] | None  # m/s, rms of a complex error
    harmonic_order: tuple[int, ...]  # orders of the columns of `harmonics`
    base: BaseMotion | None  # base excitation: `force` is its acceleration (m/s²)


UNNAMED_SENSOR = ("sensor 1",)
"""Sensors of a test with a single unnamed sensor, which matches a model with any single one."""


def steady_states(
    level: Int[np.ndarray, " state"],
    frequency: Float[np.ndarray, " state"],
    force: Float[np.ndarray, " state"],
    velocity: Complex[np.ndarray, "state sensor"],
    *,
    sensors: Sequence[str] = UNNAMED_SENSOR,
    **columns: Unpack[OptionalColumns],
) -> SteadyStates:
    """Build `SteadyStates` from arrays or lists; `velocity` may be a vector for one sensor.

    Arguments: `frequency` in rad/s, `force` in N, `velocity` phasors in m/s relative to the
    force; further columns by name, those of `OptionalColumns`: `measured`, `velocity_std` (m/s),
    `phase_std` (rad), `force_std` (N), `drive` (V), `order`, `harmonics` (m/s), `harmonic_std`
    (m/s), `harmonic_order` and `base` (see `base_excited_states`). Arrays are copied to the host:
    not differentiable.
    Raises `ValueError` naming the argument with a wrong shape, `TypeError` for an unknown column.

    >>> data = steady_states([1, 1], [500.0, 510.0], [1.0, 1.0], [0.6 + 0.0j, 0.5 - 0.2j])
    >>> data.n_states, data.velocity.shape
    (2, (2, 1))
    """
    unknown = sorted(set(columns) - set(OptionalColumns.__annotations__))
    if unknown:
        raise TypeError(
            f"`steady_states` has no column {unknown[0]!r}, but "
            f"{', '.join(OptionalColumns.__annotations__)}."
        )
    measured, harmonics = columns.get("measured"), columns.get("harmonics")
    harmonic_order = tuple(int(order) for order in columns.get("harmonic_order", ()))
    omega = np.asarray(frequency, dtype=np.float64)
    if omega.ndim != 1:
        raise InputError(f"`frequency` must be a vector, but has shape {omega.shape}.")
    n_states, n_sensors = omega.size, len(sensors)

    def per_state(name: str, value: object, dtype: type = np.float64) -> Any:
        array = np.full(n_states, np.nan) if value is None else np.asarray(value, dtype=dtype)
        if array.shape != (n_states,):
            raise InputError(f"`{name}` must have shape ({n_states},), but has {array.shape}.")
        return array

    def per_sensor(name: str, value: object, dtype: type = np.float64) -> Any:
        shape = (n_states, n_sensors)
        array = np.full(shape, np.nan) if value is None else np.asarray(value, dtype=dtype)
        if array.ndim == 1 and n_sensors == 1:
            array = array[:, None]
        if array.shape != shape:
            raise InputError(f"`{name}` must have shape {shape}, but has {array.shape}.")
        return array

    if harmonics is None:
        harmonics = np.zeros((n_states, n_sensors, 0), dtype=np.complex128)
        if harmonic_order:
            raise InputError("`harmonic_order` is given without `harmonics`.")
    recorded: Any = np.asarray(harmonics, dtype=np.complex128)
    if recorded.shape != (n_states, n_sensors, len(harmonic_order)):
        raise InputError(
            f"`harmonics` must have shape {(n_states, n_sensors, len(harmonic_order))}, "
            f"but has {recorded.shape}."
        )
    states = SteadyStates(
        level=per_state("level", level, np.int64),
        frequency=per_state("frequency", omega),
        force=per_state("force", force),
        velocity=per_sensor("velocity", velocity, np.complex128),
        measured=per_sensor(
            "measured", np.ones((n_states, n_sensors)) if measured is None else measured, np.bool_
        ),
        velocity_std=per_sensor("velocity_std", columns.get("velocity_std")),
        phase_std=per_sensor("phase_std", columns.get("phase_std")),
        force_std=per_state("force_std", columns.get("force_std")),
        drive=per_state("drive", columns.get("drive")),
        order=per_state("order", columns.get("order")),
        harmonics=recorded,
        harmonic_std=per_sensor("harmonic_std", columns.get("harmonic_std")),
        harmonic_order=harmonic_order,
        sensors=tuple(sensors),
        base=columns.get("base"),
    )
    # In one transfer: one by one, a copy is compiled for every shape.
    return jax.device_put(states, may_alias=False)


def check_phases(data: SteadyStates, purpose: str) -> None:
    """Raise `ValueError` for unknown phases; `purpose` is what needs them."""
    std, measured = value_of(data.phase_std), value_of(data.measured)
    if std is None or measured is None:
        return
    unknown = np.any(measured & (std >= _UNKNOWN_FROM), axis=1)
    if unknown.any():
        raise InputError(
            f"{purpose} needs the phases of all velocities relative to the force, but those of "
            f"{int(unknown.sum())} of {data.n_states} steady states are unknown (`velocity_m_s` "
            f"in place of real and imaginary part, or `phase_std_deg` of "
            f"{PHASE_UNKNOWN / DEGREE:.0f} or more): leave these out, or ask `snrmjax diagnose` "
            "(`diagnose_model`) what the model lacks, which works with amplitudes alone."
        )


def check_force(data: SteadyStates, purpose: str) -> None:
    """Raise `ValueError` if no state has a force; `purpose` is what needs it."""
    force = value_of(data.force)
    if force is None or np.any(np.isfinite(force)):
        return
    if not np.any(np.isfinite(np.asarray(data.drive))):
        raise InputError(f"{purpose} needs the force, but no steady state has one.")
    raise InputError(
        f"{purpose} needs the force in newtons, but only a drive voltage (`drive_v`) is given. Let "
        "a joint fit find the force per volt together with the curves: `--fit auto --free "
        'force_gain`, in Python `fit_jointly(data, modes, free=["force_gain"])`.'
    )


def join_steady_states(*parts: SteadyStates | Iterable[SteadyStates]) -> SteadyStates:
    """All steady states of several tests of the same structure, in order.

    Arguments: the tests, as separate arguments or as one list. Levels are unchanged: states of one
    level have common errors of gain and phase, so give different tests different levels beforehand
    (`SteadyStates.renumbered`). Harmonics that a test did not record are NaN in its states.
    Returns `SteadyStates`. Raises `ValueError` for an empty list, for anything but `SteadyStates`,
    and for different sensors.

    >>> one = steady_states([1], [500.0], [1.0], [0.6 + 0.0j])
    >>> join_steady_states([one, one.renumbered(1)]).level
    Array([1, 2], dtype=int64)
    """
    tests: list[SteadyStates] = []
    for part in parts:
        tests += [part] if isinstance(part, SteadyStates) else _listed(part)
    if not tests:
        raise InputError("there is nothing to join: give one `SteadyStates` at least.")
    for test in tests:
        if not isinstance(test, SteadyStates):
            raise InputError(
                f"`join_steady_states` joins `SteadyStates`, but got a `{type(test).__name__}`."
            )
        if test.sensors != tests[0].sensors:
            raise InputError(
                "tests can be joined when they have the same sensors, but one has "
                f"{list(test.sensors)}, the first {list(tests[0].sensors)}."
            )
        if test.base != tests[0].base:
            raise InputError(
                "tests can be joined when they have the same excitation, but one has a force and "
                "another a base acceleration, or their sensors record different motions."
            )
    notes = tuple(dict.fromkeys(note for test in tests for note in test.notes))
    orders = tuple(sorted({order for test in tests for order in test.harmonic_order}))
    alike = [dataclasses.replace(_with_harmonics(test, orders), notes=notes) for test in tests]
    return jax.tree.map(_joined, *alike)


def _joined(*columns: Array) -> Array:
    """One after the other, on the host where possible: on the device other lengths compile."""
    hosted = list(map(as_numpy, columns))
    if any(isinstance(column, jax.core.Tracer) for column in hosted):
        return jnp.concatenate(hosted)
    return jnp.asarray(np.concatenate(hosted))


def with_levels_apart(tests: Iterable[SteadyStates]) -> tuple[SteadyStates, ...]:
    """Tests with consecutive level numbers, so that joined tests have no common level."""
    renumbered, offset = [], 0
    for test in tests:
        moved = test.renumbered(offset)
        offset = int(moved.level.max())
        renumbered.append(moved)
    return tuple(renumbered)


def _with_harmonics(data: SteadyStates, orders: tuple[int, ...]) -> SteadyStates:
    """The states with columns for these harmonics, NaN where they were not recorded."""
    if data.harmonic_order == orders:
        return data
    columns = jnp.full((*data.velocity.shape, len(orders)), jnp.nan, dtype=data.velocity.dtype)
    index = np.array([orders.index(order) for order in data.harmonic_order], dtype=int)
    filled = columns.at[:, :, index].set(data.harmonics)
    return dataclasses.replace(data, harmonics=filled, harmonic_order=orders)


def _listed(part: Any) -> list[Any]:
    """The members of a list; anything else is its only member, to be rejected by its type."""
    alone = isinstance(part, str | Mapping) or not np.iterable(part)
    return [part] if alone else list(part)


def relative_errors(data: SteadyStates) -> Float[Array, "state sensor input"]:
    """Stated 1σ of log force, log velocity and phase; 0 for those not stated if others are.

    NaN throughout for a state without any stated error. NumPy arrays stay NumPy arrays.
    """
    xp: Any = data.velocity.__array_namespace__()

    def over(std: Any, amplitude: Any) -> Any:
        # NaN is kept out of the division, since it would pass `where` in a gradient.
        known = xp.isfinite(std) & (amplitude > 0)
        return xp.where(known, xp.where(known, std, 0.0) / xp.where(known, amplitude, 1.0), xp.nan)

    amplitude = xp.abs(data.velocity)
    force = xp.broadcast_to(over(data.force_std, data.force)[:, None], amplitude.shape)
    velocity = over(data.velocity_std, amplitude)
    # A velocity error without a phase error is assumed circular in the complex plane.
    phase = xp.where(xp.isfinite(data.phase_std), data.phase_std, velocity)
    stated = xp.stack([force, velocity, phase], axis=2)
    something = xp.any(xp.isfinite(stated), axis=2, keepdims=True)
    return xp.where(xp.isfinite(stated), stated, xp.where(something, 0.0, xp.nan))
