"""Motions of several modes held as sensors measured them: the forces that they ask for are left.

The fundamental at one sensor fixes a motion as long as one mode is nonlinear. Inside an internal
resonance several motions share it. With as many sensors as modes take part, the motion of each mode
follows from what was measured, at every recorded order; what else moves is solved for, and what is
left of each held mode's balance is a force that should not be there. No branch has to be chosen,
and what is left is linear in the coefficients of a potential.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from snrmjax.identify.calibrate.calibration_states import CalibrationStates, ComparedColumns
from snrmjax.identify.calibrate.inverse_force import StateWithErrors
from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, harmonic_balance
from snrmjax.simulate.balance.harmonics import velocity_phasors
from snrmjax.simulate.balance.prescribed_motion import newton_solved

_FLOOR = 1e-6  # 1σ of every column, over the force: rounding must not count as an error


class HeldModes(NamedTuple):
    """Which modes are held at the fundamental and at each recorded harmonic, as many at each."""

    modes: tuple[tuple[int, ...], ...]  # of each order
    sensors: tuple[int, ...]
    orders: tuple[int, ...]  # the fundamental first


def held_at_orders(
    model: Structure, modes: Sequence[int], frequency: float, orders: Sequence[int], n_sensors: int
) -> tuple[tuple[int, ...], ...]:
    """Of some modes as many as there are sensors, at each order those nearest to its frequency.

    What responds most there the sensors tell best; the others are solved for.
    """
    natural = np.asarray(model.modes.natural_frequency)

    def away(mode: int, order: int) -> float:
        return abs(float(np.log(natural[mode] / (order * frequency))))

    return tuple(
        tuple(sorted(sorted(modes, key=lambda m: away(m, order))[:n_sensors])) for order in orders
    )


class HeldState(eqx.Module):
    """The equations of one state: the balance, and held modes in place of their equations.

    A point holds the balance's scaled displacements.
    """

    balance: HarmonicBalance
    frequency: Float[Array, ""]  # rad/s
    seen: Complex[Array, "sensor order"]  # m/s
    there: Bool[Array, " order"]  # whether an order was measured
    load: Float[Array, ""]  # m/s² kg^1/2, the force on the mode of interest: a unit
    held: HeldModes = eqx.field(static=True)

    def equations(self, point: Float[Array, " unknown"]) -> Float[Array, " unknown"]:
        """What is left of the balance, but for held modes by how much they move otherwise."""
        return self._merged(self.balance.residual(self._whole(point)), self._misses(point))

    def linearised(self, point: Float[Array, " unknown"]) -> tuple[Array, Array]:
        """The equations and their exact Jacobian."""
        residual, jacobian = self.balance.linearised(self._whole(point))
        misses = self._misses(point)
        by_point = jax.jacfwd(self._misses)(point)
        return (
            self._merged(residual, misses),
            jax.vmap(self._merged, in_axes=1, out_axes=1)(jacobian[:, :-1], by_point),
        )

    def solved(self, start: Float[Array, " unknown"]) -> Float[Array, " unknown"]:
        """The solution near `start` by Newton's method, NaN where it did not converge."""
        return newton_solved(self, start)[0]

    def grown(self) -> Float[Array, " unknown"]:
        """The held modes as measured and nothing else, as a start for `solved`."""
        at_rest = jnp.zeros(self.balance.size)
        return self._merged(at_rest, -self._misses(at_rest))

    def columns(self, point: Float[Array, " unknown"]) -> Complex[Array, "order sensor"]:
        """Forces left on the held modes, over that on the mode of interest; then at each order what
        further sensors see otherwise, over the fundamental of the first.
        """
        residual = self.balance.residual(self._whole(point)).reshape(self._shape)
        unit = self.balance.frequency_scale**2 * self.balance.displacement_scale / self.load
        phasors = _phasors(residual, self.held.orders) * unit
        missed = (self.seen.T - self._velocity(point)) / jnp.abs(self.seen[0, 0])
        rows = []
        for k, modes in enumerate(map(np.array, self.held.modes)):
            rows.append(jnp.append(phasors[k, modes], missed[k] @ self._others(modes)))
        return jnp.stack(rows)

    @property
    def _shape(self) -> tuple[int, int]:
        return self.balance.n_coefficients, self.balance.model.n_modes

    def _whole(self, point: Array) -> Array:
        return jnp.append(point, self.frequency / self.balance.frequency_scale)

    def _rows(self) -> Float[np.ndarray | Array, "sensor mode"]:
        return self.balance.model.modes.mode_shape[np.array(self.held.sensors)]

    def _velocity(self, point: Array) -> Complex[Array, "order sensor"]:
        coefficients = self.balance.coefficients(point)
        every = velocity_phasors(coefficients, self.frequency, self._rows())
        return every[np.array(self.held.orders)]

    def _misses(self, point: Array) -> Float[Array, " unknown"]:
        """By how much the held modes move otherwise than measured, scaled."""
        missed = self._velocity(point) - self.seen.T
        whole = jnp.zeros(self._shape)
        for k, (order, modes) in enumerate(zip(self.held.orders, self.held.modes, strict=True)):
            at = np.array(modes)
            moved = jnp.linalg.pinv(self._rows()[:, at]) @ missed[k] / (1j * order * self.frequency)
            moved = moved / self.balance.displacement_scale
            whole = whole.at[2 * order - 1, at].set(moved.real).at[2 * order, at].set(-moved.imag)
        return whole.reshape(-1)

    def _merged(self, residual: Array, misses: Array) -> Array:
        """Misses where a mode is held at an order that was measured, residuals elsewhere."""
        whole = jnp.zeros(self._shape, dtype=bool)
        for k, (order, modes) in enumerate(zip(self.held.orders, self.held.modes, strict=True)):
            whole = whole.at[np.ix_([2 * order - 1, 2 * order], modes)].set(self.there[k])
        return jnp.where(whole.reshape(-1), misses, residual)

    def _others(self, modes: np.ndarray) -> Float[Array, "sensor other"]:
        """What the sensors see that no held mode can do: directions, each of unit length."""
        shapes = self._rows()[:, modes]
        complete, _ = jnp.linalg.qr(shapes, mode="complete")
        return jax.lax.stop_gradient(complete[:, shapes.shape[1] :])


def _phasors(parts: Array, orders: tuple[int, ...]) -> Complex[Array, "order mode"]:
    places = np.array(orders)
    return parts[2 * places - 1] - 1j * parts[2 * places]


def held_columns(chosen: ComparedColumns) -> ComparedColumns:
    """The states with errors of harmonics as inputs of their own, for columns of held modes.

    Columns of a state: one a sensor for the fundamental, then one a sensor and harmonic. A state
    that a sensor missed has none; of a harmonic that one missed the columns are not known.
    """
    states, n = chosen.states, len(chosen.sensors)
    known, own = np.asarray(states.known), np.asarray(states.own_std)
    by_order = known[:, 2 * n :].reshape(len(known), n, len(chosen.orders), 2).all(axis=(1, 3))
    whole = np.all(known[:, : 2 * n], axis=1, keepdims=True)
    there = np.concatenate([np.tile(whole, n), np.tile(by_order, n) & whole], axis=1)
    parts: dict[str, Any] = {
        "error": np.concatenate([np.asarray(states.error), own[:, 2 * n :]], axis=1),
        "own_std": np.full(known.shape, _FLOOR),
        "known": np.repeat(there, 2, axis=1),
    }
    return chosen._replace(states=states._replace(**jax.device_put(parts)))


def held_motion(
    erring: StateWithErrors, model: Structure, held: HeldModes, harmonic_order: int
) -> HeldState:
    """The equations of a state whose records have some errors.

    Modes that are not held move under the measured force.
    """
    state, modes = erring.state, model.modes
    n, orders = len(held.sensors), held.orders[1:]
    own = erring.error[2 * n + 1 :].reshape(n, len(orders), 2)
    size = jnp.abs(state.velocity[0])
    higher = erring.harmonics(orders) - size * (own[..., 0] + 1j * own[..., 1])
    force = state.force * jnp.exp(erring.error[0])
    seen = jnp.concatenate([erring.velocity()[:, None], higher], axis=1)
    if modes.rigid_body_shape.shape[1]:
        per_force = (modes.rigid_body_shape @ modes.rigid_body_participation)[
            np.array(held.sensors)
        ]
        seen = seen.at[:, 0].add(1j * force / state.frequency * per_force)
    j = modes.mode_of_interest
    scale = size / (state.frequency * jnp.abs(modes.mode_shape[held.sensors[0], j]))
    balance = harmonic_balance(
        simulated_structure(eqx.tree_at(lambda m: m.test_order, model, state.order)),
        *(force, jax.lax.stop_gradient(scale)),
        harmonic_order=harmonic_order,
    )
    load = jnp.abs(modes.participation[j]) * state.force
    known = state.known.reshape(-1, 2)[:, 0]
    there = jnp.concatenate([known[:1], known[n:].reshape(n, len(orders))[0]])
    return HeldState(balance, state.frequency, seen, there, load, held)


def columns_of_held(
    motion: HeldState, state: CalibrationStates, point: Float[Array, " unknown"]
) -> Float[Array, " column"]:
    """Real and imaginary parts of what is left, in the order of `held_columns`."""
    by_order = motion.columns(point)
    each = jnp.concatenate([by_order[0], by_order[1:].T.reshape(-1)])
    parts = jnp.stack([each.real, each.imag], axis=1).reshape(-1)
    return jnp.where(state.known, parts, 0.0)
