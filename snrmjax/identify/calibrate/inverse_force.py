"""The force of a measured motion by inverse harmonic balance: single-valued through folds."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from snrmjax.identify.calibrate.calibration_states import CalibrationStates, calibration_states
from snrmjax.measure.states import SteadyStates, check_phases
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import mapped
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.result import AbstractResult, Variable, quantity
from snrmjax.simulate.balance.prescribed_motion import PrescribedMotion, prescribed_motion


class InverseForce(AbstractResult):
    """Motions with a prescribed fundamental and their forces; NaN where the solution failed."""

    coordinates: ClassVar[tuple[str, ...]] = ("state", "harmonic")

    force: Complex[Array, " state"]  # N, as recorded, relative to the phase of the measured force
    velocity: Complex[Array, "state harmonic sensor"]  # m/s, as recorded, h = 0…H
    converged: Bool[Array, " state"] = quantity("state", "1", "whether the motion converged")

    def variables(self) -> dict[str, Variable]:
        """Real and imaginary parts of forces and velocities."""
        force, velocity = np.asarray(self.force), np.asarray(self.velocity)
        state, where = ("state",), ("state", "harmonic", "sensor")
        n, orders = velocity.shape[:2]
        return {
            "state": Variable(state, np.arange(n), "1", "steady state"),
            "harmonic": Variable(("harmonic",), np.arange(orders), "1", "harmonic order"),
            "force_re_n": Variable(state, force.real, "N", "force in phase with the measured"),
            "force_im_n": Variable(state, force.imag, "N", "force 90° ahead of it"),
            "velocity_re_m_s": Variable(where, velocity.real, "m/s", "velocity, real part"),
            "velocity_im_m_s": Variable(where, velocity.imag, "m/s", "velocity, imaginary part"),
            **super().variables(),
        }


def inverse_force(model: Structure, data: SteadyStates, *, harmonic_order: int = 9) -> InverseForce:
    """The complex force that a model needs for the measured frequencies and fundamentals.

    Solves the harmonic balance for all coefficients and the force, with the velocity's fundamental
    at the reference sensor prescribed as measured: single-valued through folds. The motion is
    continued from small amplitudes by Newton's method.

    Arguments: `model`; `data` with forces in N, the phase reference of the result.
    Returns an `InverseForce`, NaN where no solution was found and for states without a measurement
    of the reference sensor. It equals the measured force where model and measurement are right.
    Differentiable once with respect to the model's parameters, in forward and reverse mode, by the
    implicit function theorem; states without a solution have derivatives zero or NaN and do not
    affect the others. There are no derivatives by the data, which are prepared on the host.
    Raises `ValueError` for sensors other than the model's and for an unknown force or phase.

    >>> import snrmjax as sj
    >>> linear = sj.model.structure(sj.model.linear_modes([500.0], [0.01], [[2.0]], [3.0]))
    >>> data = sj.measure.steady_states([1], [500.0], [1.0], [0.9 + 0.0j])
    >>> inverse_force(linear, data).force.round(6)
    Array([1.5+0.j], dtype=complex128)
    """
    check_phases(data, "an inverse force")
    chosen = calibration_states(model, data, harmonic_order)
    solved = _needed(model, chosen.states, chosen.sensors[0], harmonic_order)
    n, rows = data.n_states, chosen.rows
    nothing = jnp.full((n, *solved.velocity.shape[1:]), jnp.nan, dtype=jnp.complex128)
    return InverseForce(
        force=nothing[:, 0, 0].at[rows].set(solved.force),
        velocity=nothing.at[rows].set(solved.velocity),
        converged=jnp.zeros(n, dtype=bool).at[rows].set(solved.converged),
    )


def state_motion(
    model: Structure,
    state: CalibrationStates,
    velocity: Complex[Array, ""],
    sensor: int,
    harmonic_order: int,
) -> PrescribedMotion:
    """The equations of one state with a prescribed velocity (m/s) of the reference sensor."""
    return prescribed_motion(
        eqx.tree_at(lambda m: m.test_order, model, state.order),
        state.frequency,
        state.force,
        velocity,
        sensor=sensor,
        harmonic_order=harmonic_order,
        scale=jnp.abs(state.velocity[0]),
    )


class StateWithErrors(NamedTuple):
    """A steady state whose recorded force, velocities and phases have given errors."""

    state: CalibrationStates
    factor: Complex[Array, ""] | float  # of all velocities
    error: Float[Array, " input"]  # of the logarithms of force and velocities, and of the phases

    def velocity(self) -> Complex[Array, " sensor"]:
        """Fundamentals corrected for the errors, in m/s."""
        n = self.state.velocity.shape[0]
        factors = jnp.exp(self.error[1 : n + 1] + 1j * self.error[n + 1 : 2 * n + 1])
        return self.state.velocity * self.factor * factors

    def harmonics(self, orders: tuple[int, ...]) -> Complex[Array, "sensor harmonic"]:
        """Harmonics corrected for the errors, in m/s; phase errors grow with the order h."""
        n = self.state.velocity.shape[0]
        phase = self.error[n + 1 : 2 * n + 1]
        factor = self.factor * jnp.exp(self.error[1 : n + 1] + 1j * phase)
        gain = jnp.abs(factor)
        phase_factor = (factor / gain)[:, None] ** np.array(orders, dtype=int)
        return self.state.harmonics * gain[:, None] * phase_factor

    def motion(self, model: Structure, sensor: int, harmonic_order: int) -> PrescribedMotion:
        """The equations of its motion."""
        return state_motion(model, self.state, self.velocity()[0], sensor, harmonic_order)


def residual_columns(
    erring: StateWithErrors,
    motion: PrescribedMotion,
    point: Float[Array, " entry"],
    sensors: tuple[int, ...],
    orders: tuple[int, ...],
) -> Float[Array, " column"]:
    """Deviations of a state's motion from the measured force, other sensors and harmonics.

    Arguments: `motion` is that of `erring`, and `point` its solution; `sensors` has the reference
    first; `orders` are the harmonics that are compared.
    Returns real and imaginary parts, of the force over the measured one and of the rest over the
    measured velocity.
    """
    state = erring.state
    velocity, harmonics = erring.velocity(), erring.harmonics(orders)
    force, seen = motion.recorded(point)
    seen = seen[:, np.array(sensors)]
    higher = seen[np.array(orders, dtype=int)].T - harmonics
    misfit = jnp.append((seen[1] - velocity)[1:], higher.reshape(-1)) / jnp.abs(state.velocity[0])
    force_misfit = (force - state.force * jnp.exp(erring.error[0])) / state.force
    each = jnp.append(force_misfit, misfit)
    parts = jnp.stack([each.real, each.imag], axis=1).reshape(-1)
    return jnp.where(state.known, parts, 0.0)


@compiled
def _needed(
    model: Structure, states: CalibrationStates, sensor: int, harmonic_order: int
) -> InverseForce:
    def one(state: CalibrationStates) -> InverseForce:
        motion = state_motion(model, state, state.velocity[0], sensor, harmonic_order)
        point = motion.solved(motion.grown())
        force, velocity = motion.recorded(point)
        return InverseForce(force, velocity, jnp.isfinite(jax.lax.stop_gradient(point[-1])))

    return mapped(one, states)
