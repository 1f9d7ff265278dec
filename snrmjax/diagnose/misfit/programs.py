"""The compiled programs behind predictions: rows of states, each with its own parameters.

The motion for a trial's parameters is solved from the baseline's by secant steps with the
baseline's Jacobian, for many rows at once. One program serves all effects: those with zero strength
are skipped.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import partial
from typing import ClassVar, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from snrmjax.identify.calibrate.calibration_states import CalibrationStates
from snrmjax.identify.calibrate.inverse_force import StateWithErrors, residual_columns, state_motion
from snrmjax.model.effect_base import (
    AbstractEffect,
    AbstractForce,
    AbstractMemoryless,
    AbstractNonsmooth,
)
from snrmjax.model.library.internal_resonances import AbstractInternalResonance
from snrmjax.model.parameters import with_parameters
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import mapped
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.balance.harmonics import displacement_phasors, harmonic_basis
from snrmjax.simulate.balance.prescribed_motion import Secants, batched_zero, start_of

HARMONICS = 5
"""Harmonics of the motions: three are compared, two more influence those."""


COMPARED = (2, 3)
"""Higher harmonics in the programs, measured or not."""

_STEP = 2.5e-4  # finite difference, in units of a direction's length


class ComparedMotion(NamedTuple):
    """Compared sensors and orders of a motion, and its number of harmonics."""

    sensors: tuple[int, ...]  # the reference first
    orders: tuple[int, ...]  # of the harmonics that are compared
    harmonic_order: int  # of the motion


@compiled
def grown(
    model: Structure, states: CalibrationStates, compared: ComparedMotion
) -> tuple[Float[Array, "row entry"], Float[Array, "row entry entry"]]:
    """Motions by continuation from small amplitudes (NaN where it fails), and inverse Jacobians."""

    def one(*row: Array) -> tuple[Array, Array]:
        state = CalibrationStates(*row)
        motion = state_motion(
            model, state, state.velocity[0], compared.sensors[0], compared.harmonic_order
        )
        point, jacobian = motion.grown_with_jacobian()
        return point, jnp.linalg.inv(jacobian)

    return mapped(one, *states)


class Stored(NamedTuple):
    """States, baseline motions and their inverse Jacobians, padded."""

    states: CalibrationStates
    near: Float[Array, "state entry"]
    inverse: Float[Array, "state entry entry"]


class Trials(NamedTuple):
    """Rows of states with trials' parameters, and the directions of derivatives."""

    values: Float[Array, "trial parameter"]
    length: Float[Array, "trial direction"]  # unit of a direction: of a parameter, or of errors
    parameter: Int[Array, " direction"]  # index of the parameter; −1: errors
    by_error: Float[Array, "input direction"]
    active: Bool[Array, " force"]  # which of the added `forces_of` have nonzero strength
    n_directions: Int[Array, ""]  # number of used directions
    state: Int[Array, " row"]
    trial: Int[Array, " row"]


class Settings(NamedTuple):
    """Static settings of a program, in addition to the structure."""

    names: tuple[str, ...]  # of all parameters of the structure
    compared: ComparedMotion
    n_given: int  # number of the baseline's effects, which come first


@compiled
def misfit_columns(
    model: Structure,
    settings: Settings,
    stored: Stored,
    trials: Trials,
) -> tuple[Float[Array, "row column"], Float[Array, "row column direction"]]:
    """The misfit of every row, and its derivatives along the used directions, else zero.

    NaN without convergence. Derivatives are finite differences of motions: the second is solved in
    a step or two from the first, and the equations are compiled only once.
    """
    names, compared, n_given = settings
    n_directions, n_wanted = len(trials.parameter), trials.n_directions
    close = jnp.where(n_wanted > 0, 1e-8, 1e-5)  # tolerance of the last step

    def one(state: Array, trial: Array) -> tuple[Array, Array]:
        measured, near, inverse = jax.tree.map(lambda a: a[state], stored)
        values, length = trials.values[trial], trials.length[trial]

        def solved(
            number: Array, start: Secants, columns: Float[Array, "column direction"]
        ) -> tuple[Secants, Float[Array, "column direction"]]:
            along = jnp.where(jnp.arange(n_directions) == number - 1, _STEP, 0.0)
            is_parameter = trials.parameter[number - 1] == jnp.arange(len(names))
            changed = with_parameters(model, names, values + (length @ along) * is_parameter)
            added = changed.effects[n_given:]
            order = compared.harmonic_order
            forces = [_force(added[k], order) for k in forces_of(added)]
            rest = [e for k, e in enumerate(added) if k not in forces_of(added)]
            changed = dataclasses.replace(changed, effects=(*changed.effects[:n_given], *rest))
            perturbed = StateWithErrors(measured, 1.0, trials.by_error @ along)
            motion = perturbed.motion(changed, compared.sensors[0], compared.harmonic_order)
            parts = {f.name: getattr(motion.balance, f.name) for f in fields(motion.balance)}
            balance = _ForcedBalance(**parts, forces=tuple(forces), active=trials.active)
            motion = dataclasses.replace(motion, balance=balance)
            fraction = jnp.where(number > 0, 1e-2, 0.0)  # tolerance relative to the first step
            end = motion.solved_by_secants(inverse, start, close, fraction)
            # Without convergence of the second motion, use its first step.
            lost = (number > 0) & ~jnp.all(jnp.isfinite(end.point))
            point = jnp.where(lost, start.point + end.moves[0], end.point)
            own_columns = residual_columns(
                perturbed, motion, point, compared.sensors, compared.orders
            )
            start = jax.tree.map(lambda a, b: jnp.where(number == 0, a, b), end, start)
            used = jnp.arange(n_directions + 1) == number
            return start, jnp.where(used, own_columns[:, None], columns)

        none = batched_zero(near) + jnp.zeros((measured.known.shape[0], n_directions + 1))
        columns = jax.lax.fori_loop(
            0, n_wanted + 1, lambda k, now: solved(k, *now), (start_of(near), none)
        )[1]
        change = columns[:, 1:] - columns[:, :1]
        tolerance = 1e-9  # change of a column within solver tolerance
        significant = (jnp.arange(n_directions) < n_wanted) & ~(jnp.abs(change) < tolerance)
        return columns[:, 0], jnp.where(significant, change / _STEP, 0.0)

    return jax.vmap(one)(trials.state, trials.trial)


def forces_of(effects: Sequence[AbstractEffect]) -> list[int]:
    """Indices of effects that are forces on the mode of interest."""
    kinds = (AbstractForce, AbstractInternalResonance)
    return [k for k, effect in enumerate(effects) if isinstance(effect, kinds)]


class _ForcedBalance(HarmonicBalance):
    """A harmonic balance with further forces, sampled as each needs; few are active."""

    forces: tuple[AbstractForce, ...] = ()
    active: Bool[Array, " force"] = eqx.field(default_factory=lambda: jnp.zeros(0, dtype=bool))

    def residual(self, point: Float[Array, " unknown"]) -> Float[Array, " equation"]:
        """See `HarmonicBalance.residual`."""
        j = self.model.modes.mode_of_interest
        x, omega = self.coefficients(point)[:, j], point[-1] * self.frequency_scale
        added = jnp.zeros_like(x)
        for n_samples in sorted({_samples(force) for force in self.forces}):
            members = [k for k, force in enumerate(self.forces) if _samples(force) == n_samples]
            some = jnp.any(self.active[jnp.array(members)])
            added = added + _where(some, partial(self._harmonics, members, n_samples), x, omega)
        unit = self.frequency_scale**2 * self.displacement_scale
        own_mode = jnp.asarray(self.model.own_mode)
        return super().residual(point) + jnp.outer(added / unit, own_mode).reshape(-1)

    def _harmonics(
        self, members: list[int], n_samples: int, x: Float[Array, " coefficient"], omega: Array
    ) -> Float[Array, " coefficient"]:
        """Fourier coefficients of some of the forces along the motion of a mode."""
        basis = harmonic_basis((self.n_coefficients - 1) // 2, n_samples)
        q = jnp.asarray(basis.synthesis) @ x
        v = omega * (jnp.asarray(basis.synthesis @ basis.derivative) @ x)
        force = jnp.zeros_like(q)
        for k in members:
            force = force + _where(self.active[k], self.forces[k].cycle_force, q, v)
        return jnp.asarray(basis.analysis) @ force


def _where(
    active: Bool[Array, ""], function: Callable[[Array, Array], Array], first: Array, second: Array
) -> Array:
    """A function of two arrays where `active`, else zeros of the first one's shape."""
    # By lambda: a method of a module with arrays has no hash.
    values = jax.lax.cond(
        active, lambda a, b: function(a, b), lambda a, _: jnp.zeros_like(a), first, second
    )
    return values


def _samples(force: AbstractForce) -> int:
    plain = isinstance(force, AbstractMemoryless) and not isinstance(force, AbstractNonsmooth)
    return 128 if plain else 256


def _force(effect: AbstractEffect, harmonics: int) -> AbstractForce:
    if isinstance(effect, AbstractInternalResonance):
        return _Resonance(effect, harmonics)
    return cast(AbstractForce, effect)  # one of `forces_of`


class _Resonance(AbstractForce):
    """The force of a coupled mode in steady motion on the mode of interest."""

    kind: ClassVar[str] = "resonance"
    effect: AbstractInternalResonance
    harmonics: int = eqx.field(static=True)

    def cycle_force(
        self, displacement: Float[Array, " time"], velocity: Float[Array, " time"]
    ) -> Float[Array, " time"]:
        mode, q, n = self.effect, displacement, self.effect.order
        basis = harmonic_basis(self.harmonics, q.shape[0])
        slope = jnp.asarray(basis.synthesis @ basis.derivative) @ (jnp.asarray(basis.analysis) @ q)
        omega = jnp.sqrt(jnp.sum(velocity**2) / jnp.sum(slope**2))
        load = displacement_phasors((jnp.asarray(basis.analysis) @ q**n)[:, None])[:, 0]
        natural = HERTZ * jnp.asarray(mode.frequency_hz)
        rate = jnp.arange(self.harmonics + 1) * omega
        stiffness = natural**2 - rate**2 + 2j * mode.damping_ratio * natural * rate
        response = -mode.coefficient * load / stiffness
        parts = jnp.stack([response.real, -response.imag], axis=1).reshape(-1)
        parts = jnp.concatenate([parts[:1], parts[2:]])  # the mean has no sine
        return n * mode.coefficient * q ** (n - 1) * (jnp.asarray(basis.synthesis) @ parts)
