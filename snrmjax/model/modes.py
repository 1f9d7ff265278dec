"""Linear modes of a structure and their frequency response."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int, Shaped

from snrmjax.model.moving_base import BaseMotion, drive_unit
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.names import suggestion, with_former_arguments
from snrmjax.numerics.result import AbstractShown
from snrmjax.numerics.rules import BELOW_ONE, NOT_NEGATIVE, POSITIVE, InputError, require
from snrmjax.numerics.units import HERTZ

_SHOWN = 12  # modes listed in a text
STILL = 1e-9  # of the largest shape at a point, below which a mode counts as having a node there

UNSTATED_MODAL_MASS_STD = 0.05
"""1σ, relative, of a modal mass whose uncertainty is not stated.

An assumption: careful modal tests of one structure agree to a few per cent in modal mass.
"""


class LinearModes(AbstractShown):
    """Mass-normalised linear modes, measured at some sensors and driven by one force pattern.

    `mode_of_interest` counts from zero; files count from one.
    """

    natural_frequency: Float[Array, " mode"]  # rad/s; 0 without linear stiffness, these last
    damping_ratio: Float[Array, " mode"]  # fraction of critical
    mode_shape: Float[Array, "sensor mode"]  # kg^-1/2
    participation: Float[Array, " mode"]  # Φᵀb per newton of the recorded force, kg^-1/2
    rigid_body_shape: Float[Array, "sensor rigid"]  # kg^-1/2
    rigid_body_participation: Float[Array, " rigid"]  # kg^-1/2
    natural_frequency_std: Float[Array, " mode"]  # rad/s, 0 = known exactly
    damping_ratio_std: Float[Array, " mode"]
    sensors: tuple[str, ...] = eqx.field(static=True)
    mode_of_interest: int = eqx.field(static=True, default=0)
    # 1σ, relative, of the modal masses 1/(Φ_r Φᵀb); None if not stated.
    modal_mass_std: Float[Array, " mode"] | None = None
    # Points without a sensor, at which forces may act.
    points: tuple[str, ...] = eqx.field(static=True, default=())
    point_shape: Float[Array, "point mode"] | None = None  # kg^-1/2
    # ΦᵀCΦ minus the 2ζω of its diagonal, 1/s; None for modal damping.
    damping_coupling: Float[Array, "mode mode"] | None = None
    # Part of Φᵀb that lags by 90°, of a force that acts at several points with different phases.
    participation_lag: Float[Array, " mode"] | None = None  # kg^-1/2
    # Base excitation: participations are then −Γ, kg^1/2 per m/s².
    base: BaseMotion | None = eqx.field(static=True, default=None)
    # A rotating unbalance U = m r, kg m, exerts U Ω²: a "force" is then a multiple of U.
    unbalance: Float[Array, ""] | None = None

    def has_screen(self) -> bool:
        """Whether these are concrete modes of a single structure."""
        return have_values(self) and self.natural_frequency.ndim == 1

    def summary(self) -> tuple[str, ...]:
        """A line for every mode."""
        rigid = self.rigid_body_participation.shape[0]
        rigid_text = f" and {rigid} rigid-body mode{'s' if rigid > 1 else ''}" if rigid else ""
        count = f"{self.n_modes} mode{'s' if self.n_modes > 1 else ''}"
        lines = [f"LinearModes: {count}{rigid_text} at {', '.join(self.sensors)}"]
        for k in range(min(self.n_modes, _SHOWN)):
            if not self.natural_frequency[k]:
                lines.append(f"mode {k + 1}: no linear stiffness, only nonlinear elements")
                continue
            hertz, ratio = self.natural_frequency.item(k) / HERTZ, self.damping_ratio[k]
            chosen = ", of interest" if k == self.mode_of_interest else ""
            std = float(self.damping_ratio_std[k])
            known = f" ± {100 * std:.1g}" if std > 0 else ""
            lines.append(
                f"mode {k + 1}: {hertz:.6g} Hz, damping {100 * ratio:.3g}{known} %{chosen}"
            )
        if self.n_modes > _SHOWN:
            lines.append(f"… and {self.n_modes - _SHOWN} more")
        if self.base is not None:
            lines.append(f"driven by the acceleration of its base, {self.base.motion} motion")
        if self.unbalance is not None:
            lines.append(f"driven by an unbalance of {float(self.unbalance):.6g} kg m")
        return tuple(lines)

    @property
    def n_modes(self) -> int:
        """Number of flexible modes."""
        return self.natural_frequency.shape[-1]

    def shape_at(self, point: str) -> Float[Array, " mode"]:
        """The mode shapes at a sensor or another point, kg^-1/2.

        Raises `ValueError` for an unknown one.
        """
        if point in self.sensors:
            return self.mode_shape[..., self.sensors.index(point), :]
        if point in self.points and self.point_shape is not None:
            return self.point_shape[..., self.points.index(point), :]
        known = (*self.sensors, *self.points)
        near = suggestion(point, known) or f"; known are {', '.join(known[:_SHOWN])}"
        raise InputError(f"a force acts at {point!r}, where the modes have no shape{near}.")

    def forced_at(self, point: str) -> "LinearModes":
        """The same modes driven by a force at this point instead.

        Raises `ValueError` for a point without a shape, for one without a sensor if there are
        rigid-body modes, and for a node of the mode of interest.
        """
        participation = self.shape_at(point)
        if self.base is not None:
            raise InputError(
                "the structure is driven by its base: its modes have no scale in newtons."
            )
        if not np.abs(participation[self.mode_of_interest]) > STILL * np.max(np.abs(participation)):
            raise InputError(f"a force at {point!r} does not excite the mode of interest.")
        rigid = self.rigid_body_participation
        if rigid.size and point not in self.sensors:
            raise InputError(
                f"a force at {point!r} excites rigid-body modes, but has no sensor there."
            )
        if rigid.size:
            rigid = self.rigid_body_shape[self.sensors.index(point)]
        return dataclasses.replace(
            self,
            participation=participation,
            rigid_body_participation=rigid,
            participation_lag=None,
        )

    def with_first_sensor(self, sensor: str) -> "LinearModes":
        """The same modes with this sensor first: responses are reported at the first sensor.

        Raises `ValueError` for an unknown one.
        """
        if sensor not in self.sensors:
            near = suggestion(sensor, self.sensors) or f"; known are {', '.join(self.sensors)}"
            raise InputError(f"the model does not have the sensor {sensor!r}{near}.")
        names = (sensor, *(name for name in self.sensors if name != sensor))
        order = np.array([self.sensors.index(name) for name in names])
        return dataclasses.replace(
            self,
            mode_shape=self.mode_shape[..., order, :],
            rigid_body_shape=self.rigid_body_shape[..., order, :],
            sensors=names,
        )

    @property
    def force_unit(self) -> str:
        """Unit of the excitation: a force, a base acceleration, or an unbalance."""
        return drive_unit(self.base, self.unbalance)

    def driven(self) -> Bool[np.ndarray, " mode"]:
        """Which flexible modes the force excites beyond rounding errors."""
        drive = np.abs(np.asarray(phasor_of_load(self)))
        return drive > STILL * np.max(drive, initial=0.0)

    @property
    def own_modal_mass_std(self) -> Float[Array, ""] | None:
        """1σ, relative, of the modal mass of the mode of interest; None if not stated."""
        stated = self.modal_mass_std
        return None if stated is None else stated[..., self.mode_of_interest]

    @property
    def residual_modes(self) -> tuple[int, ...]:
        """Indices of the flexible modes other than the mode of interest; they respond linearly."""
        return tuple(k for k in range(self.n_modes) if k != self.mode_of_interest)


def have_values(tree: object) -> bool:
    """Whether all leaves are concrete arrays, as outside `jax.jit`."""
    leaves = jax.tree.leaves(tree)
    kinds = (np.ndarray, jax.Array)
    return all(isinstance(a, kinds) and not isinstance(a, jax.core.Tracer) for a in leaves)


class OptionalModalData(NamedTuple):
    """Optional data of linear modes: points without a sensor, damping coupling, excitation."""

    # Shapes at points without a sensor, kg^-1/2.
    points: dict[str, Shaped[np.ndarray | Array, " mode"] | list[float]] | None = None
    # Damping in addition to the damping ratios: ΦᵀCΦ minus the 2ζω of its diagonal, 1/s.
    damping_coupling: Shaped[np.ndarray | Array, "mode mode"] | None = None
    participation_lag: Shaped[np.ndarray | Array, " mode"] | list[float] | None = None  # kg^-1/2
    base: BaseMotion | None = None  # whose acceleration replaces the force
    unbalance: float | Float[Array, ""] | None = None  # kg m, replaces the force


class RigidBodyModes(NamedTuple):
    """Mass-normalised rigid-body modes of a free structure."""

    shape: Shaped[np.ndarray | Array, "sensor rigid"] | list[list[float]]  # kg^-1/2
    # Φᵀb per newton of the recorded force, kg^-1/2
    participation: Shaped[np.ndarray | Array, " rigid"] | list[float]


class LinearModesStd(NamedTuple):
    """1σ of the results of a linear modal test; None if known exactly."""

    natural_frequency: Shaped[np.ndarray | Array, " mode"] | list[float] | None = None  # rad/s
    damping_ratio: Shaped[np.ndarray | Array, " mode"] | list[float] | None = None
    # Relative; None if not stated (`UNSTATED_MODAL_MASS_STD`).
    modal_mass: Shaped[np.ndarray | Array, " mode"] | list[float] | None = None


@with_former_arguments({"beside": "optional"})
def linear_modes(
    natural_frequency: Shaped[np.ndarray | Array, " mode"] | list[float],
    damping_ratio: Shaped[np.ndarray | Array, " mode"] | list[float],
    mode_shape: Shaped[np.ndarray | Array, "sensor mode"] | list[list[float]],
    participation: Shaped[np.ndarray | Array, " mode"] | list[float],
    *,
    sensors: tuple[str, ...] | None = None,
    mode_of_interest: int = 0,
    rigid_body: RigidBodyModes | None = None,
    std: LinearModesStd | None = None,
    optional: OptionalModalData | None = None,
) -> LinearModes:
    """Build `LinearModes` from arrays or lists, checking shapes and ranges.

    Arguments: natural frequencies in rad/s, damping as a fraction of critical, shapes at the
    sensors and participations Φᵀb in kg^-1/2; `rigid_body` modes likewise; `std` has the 1σ of
    frequencies and damping ratios (exact without) and of modal masses (relative,
    `UNSTATED_MODAL_MASS_STD` without); `optional` has optional data: shapes at points without a
    sensor, damping that couples the modes, the lagging part of a force, and a base or an
    unbalance in place of the force.
    Raises `ValueError` that names the argument whose shape or value is wrong. Traced numbers
    (within `jax.jit` and derivatives) are not checked.

    >>> modes = linear_modes([500.0], [0.01], [[2.0]], [3.0])
    >>> modes.n_modes, modes.sensors
    (1, ('sensor 1',))
    """
    frequency = _vector("natural_frequency", natural_frequency)
    n_modes = frequency.size
    if n_modes == 0:
        raise InputError("`natural_frequency` must have at least one mode, but is empty.")
    damping = _vector("damping_ratio", damping_ratio, n_modes)
    shape = _numbers(mode_shape)
    if shape.ndim != 2 or shape.shape[1] != n_modes or shape.shape[0] == 0:
        raise InputError(
            f"`mode_shape` must have shape (sensors, {n_modes} modes), but has {shape.shape}."
        )
    require("`mode_shape`", shape)
    n_sensors = shape.shape[0]
    names = sensors or tuple(f"sensor {k + 1}" for k in range(n_sensors))
    if len(names) != n_sensors:
        raise InputError(f"`sensors` names {len(names)} sensors, but `mode_shape` has {n_sensors}.")
    if not 0 <= mode_of_interest < n_modes:
        raise InputError(
            f"`mode_of_interest` must lie between 0 and {n_modes - 1}, but is {mode_of_interest}."
        )
    require("`natural_frequency`", frequency, NOT_NEGATIVE)
    require("`natural_frequency` of the mode of interest", frequency[mode_of_interest], POSITIVE)
    require("`damping_ratio`", damping, BELOW_ONE)
    shapes, participations = rigid_body or RigidBodyModes(np.zeros((n_sensors, 0)), [])
    rigid_shape = _numbers(shapes)
    if rigid_shape.ndim != 2 or rigid_shape.shape[0] != n_sensors:
        raise InputError(
            f"`rigid_body.shape` must have shape ({n_sensors} sensors, rigid-body modes), "
            f"but has {rigid_shape.shape}."
        )
    require("`rigid_body.shape`", rigid_shape)
    numbers: dict[str, Any] = {
        "natural_frequency": frequency,
        "damping_ratio": damping,
        "mode_shape": shape,
        "participation": _vector("participation", participation, n_modes),
        "rigid_body_shape": rigid_shape,
        "rigid_body_participation": _vector(
            "rigid_body.participation", participations, rigid_shape.shape[1]
        ),
    }
    for name, values in zip(LinearModesStd._fields, std or LinearModesStd(), strict=True):
        if values is not None:
            numbers[f"{name}_std"] = _vector(f"std.{name}", values, n_modes)
        elif name != "modal_mass":
            numbers[f"{name}_std"] = np.zeros(n_modes)
    optional = optional or OptionalModalData()
    points = optional.points or {}
    for name in points:
        if name in names:
            raise InputError(f"`optional.points` has {name!r}, which is a sensor.")
    if points:
        shapes_there = [_vector(f"optional.points[{k!r}]", s, n_modes) for k, s in points.items()]
        numbers["point_shape"] = _numbers(shapes_there)
    if optional.damping_coupling is not None:
        numbers["damping_coupling"] = _coupling(optional.damping_coupling, n_modes)
    if optional.participation_lag is not None:
        lag = _vector("optional.participation_lag", optional.participation_lag, n_modes)
        numbers["participation_lag"] = lag
    if optional.base is not None:
        _check_base(optional.base, (*names, *points), participations)
    if optional.unbalance is not None:
        require("`optional.unbalance`", optional.unbalance, POSITIVE)
        numbers["unbalance"] = _numbers(optional.unbalance)
    if optional.base is not None and optional.unbalance is not None:
        raise InputError("a base and an unbalance cannot both drive a structure.")
    modes = LinearModes(
        **numbers,
        sensors=tuple(names),
        mode_of_interest=mode_of_interest,
        points=tuple(points),
        base=optional.base,
    )
    # In one transfer: one by one, a copy is compiled for every shape.
    return jax.device_put(modes, may_alias=False)


def _check_base(base: BaseMotion, points: tuple[str, ...], rigid: Any) -> None:
    for point, _ in base.along:
        if point not in points:
            near = suggestion(point, points) or f"; known are {', '.join(points[:_SHOWN])}"
            raise InputError(f"the base's `along` names {point!r}, which is not a point{near}.")
    if np.size(rigid):
        raise InputError("with base excitation there are no rigid-body modes, but some are given.")


def _numbers(value: Any) -> Any:
    """A NumPy array, or a traced array."""
    traced = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value))
    return jnp.asarray(value, jnp.float64) if traced else np.asarray(value, dtype=np.float64)


def _coupling(damping: Any, n_modes: int) -> Any:
    """The checked damping coupling matrix."""
    matrix = _numbers(damping)
    require("`optional.damping_coupling`", matrix)
    if matrix.shape != (n_modes, n_modes):
        raise InputError(
            f"`optional.damping_coupling` must have shape ({n_modes}, {n_modes}), but has "
            f"{matrix.shape}."
        )
    return matrix


def _vector(name: str, value: object, size: int | None = None) -> Any:
    vector = _numbers(value)
    require(f"`{name}`", vector)
    if vector.ndim != 1 or (size is not None and vector.size != size):
        wanted = "a vector" if size is None else f"a vector of {size}"
        raise InputError(f"`{name}` must be {wanted}, but has shape {vector.shape}.")
    return vector


@compiled
def residual_velocity(
    modes: LinearModes,
    frequency: Float[Array, "*batch"],
    force: Float[Array, "*batch"],
) -> Complex[Array, "*batch sensor"]:
    """Velocity of rigid-body modes and of all linear modes but the mode of interest.

    V_lin + V_RB of Eq. (10b), as phasors e^{+iΩt} relative to the force: a flexible mode gives
    iΩ Φ ΦᵀF / (ω² − Ω² + 2iζωΩ), a rigid-body mode −iΦ ΦᵀF / Ω. For a force with phases ΦᵀF is
    complex; modes coupled by damping are solved together with the mode of interest fixed
    (the contribution of its motion is in `identify.pointwise.snrm.sensed_mode`).

    Arguments: `frequency` Ω in rad/s, `force` in N. Returns m/s at every sensor.
    Reference: Kwarta & Allen, Eqs. (10b), (23), rotated by +90° (the paper uses a sine force).
    """
    keep = np.asarray(modes.residual_modes, dtype=int)
    flexible = _flexible_velocity(modes, keep, frequency, force)
    return flexible + _rigid_body_velocity(modes, frequency, force)


@compiled
def linear_response(
    modes: LinearModes,
    frequency: Float[Array, "*batch"],
    force: Float[Array, "*batch"],
) -> Complex[Array, "*batch sensor"]:
    """Velocity of the whole linear structure at every sensor.

    Arguments: `frequency` Ω in rad/s, `force` in N. Returns phasors e^{+iΩt} relative to the
    force, in m/s; exact for a linear structure with modal damping. Differentiable.
    Reference: Kwarta & Allen, Eq. (23), with phases rotated by +90° (the paper uses a sine force).

    >>> modes = linear_modes([500.0], [0.01], [[2.0]], [3.0])
    >>> linear_response(modes, jnp.array(500.0), jnp.array(1.0)).real.round(6)
    Array([0.6], dtype=float64)
    """
    keep = np.arange(modes.n_modes)
    flexible = _flexible_velocity(modes, keep, frequency, force)
    return flexible + _rigid_body_velocity(modes, frequency, force)


def phasor_of_load(modes: LinearModes) -> Complex[Array, " mode"]:
    """Φᵀb per newton of the recorded force as a phasor, kg^-1/2."""
    lag = modes.participation_lag
    return modes.participation - (0j if lag is None else 1j * lag)


def reference_sensor(modes: LinearModes) -> int:
    """The sensor with the largest shape of the mode of interest, where amplitudes are given.

    Within `jax.jit` mode shapes of several sensors must be compile-time constants.
    """
    if modes.mode_shape.shape[0] == 1:
        return 0
    shape = modes.mode_shape
    if isinstance(shape, jax.core.Tracer):  # within a derivative the value is still known
        shape = jax.lax.stop_gradient(shape)
    return int(np.argmax(np.abs(np.asarray(shape)[:, modes.mode_of_interest])))


def _flexible_velocity(
    modes: LinearModes,
    keep: Int[np.ndarray, " kept"],
    frequency: Float[Array, "*batch"],
    force: Float[Array, "*batch"],
) -> Complex[Array, "*batch sensor"]:
    """Velocity of some flexible modes, with the others fixed."""
    omega = jnp.asarray(frequency)[..., None]
    load = modes.participation[keep]
    if modes.participation_lag is not None:
        load = phasor_of_load(modes)[keep]
    if modes.damping_coupling is None:
        natural, ratio = modes.natural_frequency[keep], modes.damping_ratio[keep]
        modal = load / (natural**2 - omega**2 + 2j * ratio * natural * omega)
    else:
        matrix = dynamic_stiffness(modes, keep, 1j * omega[..., 0])
        modal = jnp.linalg.solve(matrix, jnp.broadcast_to(load, matrix.shape[:-1])[..., None])
        modal = modal[..., 0]
    modal = 1j * omega * modal * jnp.asarray(force)[..., None]
    return jnp.einsum("...m,sm->...s", modal, modes.mode_shape[:, keep])


def dynamic_stiffness(
    modes: LinearModes, keep: Int[np.ndarray, " kept"], s: Complex[Array, "*batch"]
) -> Complex[Array, "*batch kept kept"]:
    """Φᵀ(s²M + sC + K)Φ of some flexible modes at a complex frequency s (rad/s), 1/s²."""
    natural, ratio = modes.natural_frequency[keep], modes.damping_ratio[keep]
    s = jnp.asarray(s)[..., None]
    own = (natural**2 + s**2 + 2 * ratio * natural * s)[..., None] * jnp.eye(len(keep))
    coupling = modes.damping_coupling
    return own if coupling is None else own + s[..., None] * coupling[np.ix_(keep, keep)]


def _rigid_body_velocity(
    modes: LinearModes, frequency: Float[Array, "*batch"], force: Float[Array, "*batch"]
) -> Complex[Array, "*batch sensor"]:
    per_force = modes.rigid_body_shape @ modes.rigid_body_participation
    return -1j * (jnp.asarray(force) / jnp.asarray(frequency))[..., None] * per_force
