"""Inverse harmonic balance with the motions of several modes prescribed as measured.

The fundamental at one sensor determines the motion as long as one mode is nonlinear; inside an
internal resonance several motions share it. With as many sensors as modes that take part, the
measured motion of each mode is known at every recorded order. The other modes are solved for, and
the residual of each prescribed mode's balance is a force that should vanish. No branch has to be
chosen, and the residual forces are linear in the coefficients of a potential.
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

_FLOOR = 1e-6  # 1σ of every column, over the force: above rounding errors


class PrescribedModes(NamedTuple):
    """Modes prescribed at the fundamental and at each recorded harmonic, equally many at each."""

    modes: tuple[tuple[int, ...], ...]  # of each order
    sensors: tuple[int, ...]
    orders: tuple[int, ...]  # the fundamental first


def prescribed_at_orders(
    model: Structure, modes: Sequence[int], frequency: float, orders: Sequence[int], n_sensors: int
) -> tuple[tuple[int, ...], ...]:
    """The modes prescribed at each order: as many as sensors, those nearest to its frequency.

    These respond most and are best observed; the others are solved for.
    """
    natural = np.asarray(model.modes.natural_frequency)

    def distance(mode: int, order: int) -> float:
        return abs(float(np.log(natural[mode] / (order * frequency))))

    return tuple(
        tuple(sorted(sorted(modes, key=lambda m: distance(m, order))[:n_sensors]))
        for order in orders
    )


class PrescribedModesState(eqx.Module):
    """The equations of one state: harmonic balance, with some modes prescribed in place of theirs.

    A point holds the scaled displacements of the balance.
    """

    balance: HarmonicBalance
    frequency: Float[Array, ""]  # rad/s
    measured: Complex[Array, "sensor order"]  # m/s
    known_orders: Bool[Array, " order"]  # whether an order was measured
    load: Float[Array, ""]  # m/s² kg^1/2, the force on the mode of interest, as a unit
    prescribed: PrescribedModes = eqx.field(static=True)

    def equations(self, point: Float[Array, " unknown"]) -> Float[Array, " unknown"]:
        """Residual of the balance; for prescribed modes, the deviation from the measured motion."""
        return self._merged(self.balance.residual(self._whole(point)), self._deviation(point))

    def linearised(self, point: Float[Array, " unknown"]) -> tuple[Array, Array]:
        """The equations and their exact Jacobian."""
        residual, jacobian = self.balance.linearised(self._whole(point))
        deviation = self._deviation(point)
        by_point = jax.jacfwd(self._deviation)(point)
        return (
            self._merged(residual, deviation),
            jax.vmap(self._merged, in_axes=1, out_axes=1)(jacobian[:, :-1], by_point),
        )

    def solved(self, start: Float[Array, " unknown"]) -> Float[Array, " unknown"]:
        """The solution near `start` by Newton's method, NaN where it did not converge."""
        return newton_solved(self, start)[0]

    def grown(self) -> Float[Array, " unknown"]:
        """The prescribed modes as measured, the others at rest: a start for `solved`."""
        at_rest = jnp.zeros(self.balance.size)
        return self._merged(at_rest, -self._deviation(at_rest))

    def columns(self, point: Float[Array, " unknown"]) -> Complex[Array, "order sensor"]:
        """Residual forces on the prescribed modes, over the force on the mode of interest; then at
        each order the misfit of further sensors, over the fundamental of the first.
        """
        residual = self.balance.residual(self._whole(point)).reshape(self._shape)
        unit = self.balance.frequency_scale**2 * self.balance.displacement_scale / self.load
        phasors = _phasors(residual, self.prescribed.orders) * unit
        misfit = (self.measured.T - self._velocity(point)) / jnp.abs(self.measured[0, 0])
        rows = []
        for k, modes in enumerate(map(np.array, self.prescribed.modes)):
            rows.append(jnp.append(phasors[k, modes], misfit[k] @ self._unreachable(modes)))
        return jnp.stack(rows)

    @property
    def _shape(self) -> tuple[int, int]:
        return self.balance.n_coefficients, self.balance.model.n_modes

    def _whole(self, point: Array) -> Array:
        return jnp.append(point, self.frequency / self.balance.frequency_scale)

    def _shapes(self) -> Float[np.ndarray | Array, "sensor mode"]:
        return self.balance.model.modes.mode_shape[np.array(self.prescribed.sensors)]

    def _velocity(self, point: Array) -> Complex[Array, "order sensor"]:
        coefficients = self.balance.coefficients(point)
        every = velocity_phasors(coefficients, self.frequency, self._shapes())
        return every[np.array(self.prescribed.orders)]

    def _deviation(self, point: Array) -> Float[Array, " unknown"]:
        """Scaled deviation of the prescribed modes from their measured motion."""
        misfit = self._velocity(point) - self.measured.T
        whole = jnp.zeros(self._shape)
        for k, (order, modes) in enumerate(
            zip(self.prescribed.orders, self.prescribed.modes, strict=True)
        ):
            at = np.array(modes)
            moved = (
                jnp.linalg.pinv(self._shapes()[:, at]) @ misfit[k] / (1j * order * self.frequency)
            )
            moved = moved / self.balance.displacement_scale
            whole = whole.at[2 * order - 1, at].set(moved.real).at[2 * order, at].set(-moved.imag)
        return whole.reshape(-1)

    def _merged(self, residual: Array, deviation: Array) -> Array:
        """Deviations where a mode is prescribed at a measured order, residuals elsewhere."""
        whole = jnp.zeros(self._shape, dtype=bool)
        for k, (order, modes) in enumerate(
            zip(self.prescribed.orders, self.prescribed.modes, strict=True)
        ):
            whole = whole.at[np.ix_([2 * order - 1, 2 * order], modes)].set(self.known_orders[k])
        return jnp.where(whole.reshape(-1), deviation, residual)

    def _unreachable(self, modes: np.ndarray) -> Float[Array, "sensor other"]:
        """Orthonormal sensor patterns that no prescribed mode can produce."""
        shapes = self._shapes()[:, modes]
        complete, _ = jnp.linalg.qr(shapes, mode="complete")
        return jax.lax.stop_gradient(complete[:, shapes.shape[1] :])


def _phasors(parts: Array, orders: tuple[int, ...]) -> Complex[Array, "order mode"]:
    # Coefficients run 1, cos, sin, cos 2, sin 2, …
    index = np.array(orders)
    return parts[2 * index - 1] - 1j * parts[2 * index]


def prescribed_mode_columns(chosen: ComparedColumns) -> ComparedColumns:
    """The states with errors of harmonics as separate inputs, for columns of prescribed modes.

    Columns of a state: one per sensor for the fundamental, then one per sensor and harmonic. A
    state not measured by all sensors has none; likewise a harmonic not measured by all.
    """
    states, n = chosen.states, len(chosen.sensors)
    known, own = np.asarray(states.known), np.asarray(states.own_std)
    by_order = known[:, 2 * n :].reshape(len(known), n, len(chosen.orders), 2).all(axis=(1, 3))
    whole = np.all(known[:, : 2 * n], axis=1, keepdims=True)
    known_orders = np.concatenate([np.tile(whole, n), np.tile(by_order, n) & whole], axis=1)
    parts: dict[str, Any] = {
        "error": np.concatenate([np.asarray(states.error), own[:, 2 * n :]], axis=1),
        "own_std": np.full(known.shape, _FLOOR),
        "known": np.repeat(known_orders, 2, axis=1),
    }
    return chosen._replace(states=states._replace(**jax.device_put(parts)))


def prescribed_mode_motion(
    erring: StateWithErrors, model: Structure, prescribed: PrescribedModes, harmonic_order: int
) -> PrescribedModesState:
    """The equations of a state whose records have given errors.

    Modes that are not prescribed move under the measured force.
    """
    state, modes = erring.state, model.modes
    n, orders = len(prescribed.sensors), prescribed.orders[1:]
    own = erring.error[2 * n + 1 :].reshape(n, len(orders), 2)
    amplitude = jnp.abs(state.velocity[0])
    higher = erring.harmonics(orders) - amplitude * (own[..., 0] + 1j * own[..., 1])
    force = state.force * jnp.exp(erring.error[0])
    measured = jnp.concatenate([erring.velocity()[:, None], higher], axis=1)
    if modes.rigid_body_shape.shape[1]:
        per_force = (modes.rigid_body_shape @ modes.rigid_body_participation)[
            np.array(prescribed.sensors)
        ]
        measured = measured.at[:, 0].add(1j * force / state.frequency * per_force)
    j = modes.mode_of_interest
    scale = amplitude / (state.frequency * jnp.abs(modes.mode_shape[prescribed.sensors[0], j]))
    balance = harmonic_balance(
        simulated_structure(eqx.tree_at(lambda m: m.test_order, model, state.order)),
        force,
        jax.lax.stop_gradient(scale),
        harmonic_order=harmonic_order,
    )
    load = jnp.abs(modes.participation[j]) * state.force
    known = state.known.reshape(-1, 2)[:, 0]
    known_orders = jnp.concatenate([known[:1], known[n:].reshape(n, len(orders))[0]])
    return PrescribedModesState(balance, state.frequency, measured, known_orders, load, prescribed)


def columns_of_prescribed(
    motion: PrescribedModesState, state: CalibrationStates, point: Float[Array, " unknown"]
) -> Float[Array, " column"]:
    """Real and imaginary parts of the residuals, in the order of `prescribed_mode_columns`."""
    by_order = motion.columns(point)
    each = jnp.concatenate([by_order[0], by_order[1:].T.reshape(-1)])
    parts = jnp.stack([each.real, each.imag], axis=1).reshape(-1)
    return jnp.where(state.known, parts, 0.0)
