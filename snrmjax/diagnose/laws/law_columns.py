"""The misfit of a model with drawn laws, and its slopes by what the laws are at their knots.

A law is linear in its secants at the knots. The motion that a measured fundamental has with it is
solved for, harmonics included, so that a law may be strong; slopes follow by the implicit function
theorem, all knots at once. Splines are those of `model.library.free_laws`, with their slopes at
the knots as a matrix that is made once.
"""

from dataclasses import fields, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.diagnose.misfit.predictions import Predictions
from snrmjax.diagnose.misfit.programs import ComparedMotion
from snrmjax.diagnose.misfit.weighted_misfit import ErrorPropagation
from snrmjax.identify.calibrate.calibration_states import CalibrationStates
from snrmjax.identify.calibrate.inverse_force import StateWithErrors, residual_columns
from snrmjax.model.library.friction import slipped_position
from snrmjax.model.parameters import with_parameters
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import by_blocks
from snrmjax.numerics.compiled import compiled
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.balance.harmonics import harmonic_basis
from snrmjax.simulate.balance.prescribed_motion import PrescribedMotion, start_of

_SAMPLES = 256  # of a cycle

TABLES = 5
"""Of secants: springs in either direction, dampers, damping by displacement, slip."""


class LawKnots(NamedTuple):
    """Where laws have their knots, all equally many."""

    displacement: Float[np.ndarray, " knot"]  # kg^1/2 m
    velocity: Float[np.ndarray, " knot"]  # kg^1/2 m/s
    slip: Float[np.ndarray, " knot"]  # kg^1/2 m


class LawColumns(NamedTuple):
    """Columns of all states for some laws, and their slopes; NaN where no motion was found.

    See `Predicted` for the columns. The motions and their inverse Jacobians are starts for others.
    """

    columns: Float[np.ndarray, "state column"]
    by_secant: Float[np.ndarray, "state column table knot"]
    passed_on: ErrorPropagation
    point: Float[np.ndarray, "state entry"]
    inverse: Float[np.ndarray, "state entry entry"]


def law_columns(
    predictions: Predictions,
    knots: LawKnots,
    secants: Float[np.ndarray, "table knot"],
    start: LawColumns | None = None,
) -> LawColumns:
    """Columns and slopes for laws with these secants.

    Arguments: `start` is an earlier answer, from whose motions these are found.
    """
    from scipy.interpolate import CubicSpline  # takes as long to import as JAX

    p, n = predictions, len(predictions.chosen.rows)
    stated, j = p.stated, p.model.modes.mode_of_interest + 1
    linear = (f"mode_{j}.natural_frequency", f"mode_{j}.damping_ratio")
    names = tuple(dict.fromkeys((*stated, *linear)))
    values = jnp.asarray(p.group.values[p.group.places(names)])
    slopes = []
    for some in (knots.displacement, knots.velocity):
        spline = CubicSpline(np.log(some), np.eye(len(some)))
        slope = np.array(spline(np.log(some), 1))
        slope[0] = 0.0
        slopes.append(slope)
    drawn = _Drawn(*(jnp.asarray(a) for a in (secants, *knots, *slopes)))

    def answered(*rows: Any) -> tuple:
        shared = (names, p.compared, drawn, values, CalibrationStates(*rows[:-2]))
        return _law_columns(p.model, *shared, *rows[-2:])

    near = [np.asarray(part)[:n] for part in p.motions[1:]]
    if start is not None:
        near = [start.point, start.inverse]
    states = [np.asarray(part) for part in p.states]
    found = by_blocks(answered, 32, *states, *near)
    columns, by_secant, by_value, by_error = (part[:, p.own_columns] for part in found[:4])
    columns = columns if p.offset is None else columns + p.offset
    std = np.array([*(std for _, std in stated.values()), 1.0, 1.0])
    phasors = p.sizes.phasors(columns[None])[0]
    by_baseline = by_value[:, :, [names.index(name) for name in (*stated, *linear)]]
    own_mode = [float(values[names.index(name)]) for name in linear]
    by_baseline[..., -2] -= own_mode[1] / own_mode[0] * by_baseline[..., -1]  # as a stiffness does
    passed_on = ErrorPropagation(by_error, phasors, by_baseline * std)
    shape = (*columns.shape, *secants.shape)
    return LawColumns(columns, by_secant.reshape(shape), passed_on, *found[4:])


class _Drawn(eqx.Module):
    """The laws: secants, knots, and the splines' slopes at the knots by their values there."""

    secants: Float[Array, "table knot"]
    displacement: Float[Array, " knot"]
    velocity: Float[Array, " knot"]
    slip: Float[Array, " knot"]
    slopes_of_displacement: Float[Array, "knot knot"]
    slopes_of_velocity: Float[Array, "knot knot"]

    def by_secant(
        self, q: Float[Array, " time"], v: Float[Array, " time"]
    ) -> Float[Array, "table time knot"]:
        """The force of every table at time samples for a secant of one at each knot."""
        eye = jnp.eye(len(self.displacement))
        of_q = _spline(jnp.abs(q), self.displacement, eye, self.slopes_of_displacement)
        of_v = _spline(jnp.abs(v), self.velocity, eye, self.slopes_of_velocity)
        slip = -slipped_position(q, self.slip)
        q, v = q[:, None], v[:, None]
        one_sided = (of_q * jnp.maximum(q, 0), of_q * jnp.minimum(q, 0))
        return jnp.stack([*one_sided, of_v * v, of_q * v, slip])

    def force(self, q: Float[Array, " time"], v: Float[Array, " time"]) -> Float[Array, " time"]:
        """The force of all tables at time samples: `by_secant` times the secants, for less work."""
        w = self.secants
        tables, dampers = jnp.stack([w[0], w[1], w[3]], axis=1), w[2][:, None]
        of_q = _spline(jnp.abs(q), self.displacement, tables, self.slopes_of_displacement @ tables)
        of_v = _spline(jnp.abs(v), self.velocity, dampers, self.slopes_of_velocity @ dampers)
        spring = q * jnp.where(q < 0, of_q[:, 1], of_q[:, 0]) + of_q[:, 2] * v
        return spring + v * of_v[:, 0] - slipped_position(q, self.slip) @ w[4]


def _spline(
    size: Float[Array, " time"],
    knots: Float[Array, " knot"],
    values: Float[Array, "knot column"],
    slopes: Float[Array, "knot column"],
) -> Float[Array, "time column"]:
    """Splines at samples by values and slopes at the knots: see `free_laws.secant_at`."""
    place, last = jnp.log(knots), knots[-1]
    inside = jnp.log(jnp.clip(size, knots[0], last))
    k = jnp.clip(jnp.searchsorted(place, inside, side="right") - 1, 0, len(knots) - 2)
    step = (place[k + 1] - place[k])[:, None]
    t = (inside - place[k])[:, None] / step
    found = (1 + 2 * t) * (1 - t) ** 2 * values[k] + t**2 * (3 - 2 * t) * values[k + 1]
    found = found + step * t * (1 - t) * ((1 - t) * slopes[k] - t * slopes[k + 1])
    beyond = jnp.maximum(1.0 - last / jnp.maximum(size, last), 0.0)
    return found + beyond[:, None] * slopes[-1]


class _DrawnBalance(HarmonicBalance):
    """A balance with drawn laws on the mode of interest."""

    drawn: _Drawn | None = None

    def by_secant(self, point: Float[Array, " unknown"]) -> Float[Array, "equation table knot"]:
        """Slopes of the residual by the secants."""
        if self.drawn is None:
            return jnp.zeros((self.size, TABLES, 0))
        force = self.drawn.by_secant(*self._motion(point))
        return self._on_mode(jnp.moveaxis(force, 1, 0))

    def residual(self, point: Float[Array, " unknown"]) -> Float[Array, " equation"]:
        """See `HarmonicBalance.residual`."""
        balance = super().residual(point)
        if self.drawn is None:
            return balance
        return balance + self._on_mode(self.drawn.force(*self._motion(point)))

    def _motion(self, point: Array) -> tuple[Array, Array]:
        """q and q̇ of the mode of interest at time samples."""
        basis = harmonic_basis((self.n_coefficients - 1) // 2, _SAMPLES)
        x = self.coefficients(point)[:, self.model.modes.mode_of_interest]
        slope = jnp.asarray(basis.synthesis @ basis.derivative) @ x
        return jnp.asarray(basis.synthesis) @ x, point[-1] * self.frequency_scale * slope

    def _on_mode(self, force: Float[Array, "time *kind"]) -> Float[Array, "equation *kind"]:
        """Scaled balance of a force on the mode of interest."""
        basis = harmonic_basis((self.n_coefficients - 1) // 2, _SAMPLES)
        unit = self.frequency_scale**2 * self.displacement_scale
        added = jnp.tensordot(jnp.asarray(basis.analysis), force, axes=1) / unit
        of_modes = jnp.tensordot(added, jnp.asarray(self.model.own_mode), axes=0)
        return jnp.moveaxis(of_modes, -1, 1).reshape(-1, *force.shape[1:])


@compiled
def _law_columns(
    model: Structure,
    names: tuple[str, ...],
    compared: ComparedMotion,
    drawn: _Drawn,
    values: Float[Array, " parameter"],
    states: CalibrationStates,
    near: Float[Array, "state entry"],
    inverse: Float[Array, "state entry entry"],
) -> tuple:
    sensors, orders, order = compared

    def one(measured: CalibrationStates, near: Array, inverse: Array) -> tuple:
        def motion(changed: tuple[Array, Array]) -> tuple[StateWithErrors, PrescribedMotion]:
            structure = with_parameters(model, names, changed[0])
            erring = StateWithErrors(measured, 1.0, changed[1])
            found = erring.motion(structure, sensors[0], order)
            parts = {f.name: getattr(found.balance, f.name) for f in fields(found.balance)}
            return erring, replace(found, balance=_DrawnBalance(**parts, drawn=drawn))

        def both(point: Array, changed: tuple[Array, Array]) -> tuple[Array, Array]:
            erring, held = motion(changed)
            return held.equations(point), residual_columns(erring, held, point, sensors, orders)

        here = values, jnp.zeros_like(measured.error)
        held, none = motion(here)[1], jnp.zeros(())
        point = held.solved_by_secants(inverse, start_of(near), none + 1e-8, none).point
        jacobian, of_point = jax.jacfwd(both)(point, here)
        exact = jnp.linalg.inv(jacobian)
        of_point = of_point @ exact
        moved, direct = jax.jacfwd(both, argnums=1)(point, here)
        slopes = [
            b - jnp.tensordot(of_point, a, axes=1) for a, b in zip(moved, direct, strict=True)
        ]
        balance: Any = held.balance
        at = jnp.append(point[:-2], held.frequency / balance.frequency_scale)
        of_secant = balance.by_secant(at)
        by_secant = -jnp.tensordot(of_point[:, : of_secant.shape[0]], of_secant, axes=1)
        by_secant = by_secant.reshape(measured.known.shape[0], -1)
        return (both(point, here)[1], by_secant, *slopes, point, exact)

    return jax.vmap(one)(states, near, inverse)
