"""The compiled programs behind predictions: rows of states, each with parameters of its own.

A motion with a trial's parameters is reached from the baseline's by steps with the baseline's
Jacobian, for many rows at once. One program serves all effects: those with zero strength are
skipped.
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
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.balance.harmonics import displacement_phasors, harmonic_basis
from snrmjax.simulate.balance.prescribed_motion import Secants, batched_zero, start_of

HARMONICS = 5
"""Of the motions: three that are compared, and two more that influence those."""


COMPARED = (2, 3)
"""Harmonics that the programs hold, measured or not."""

_STEP = 2.5e-4  # of a direction, between the two ends of a slope


class ComparedMotion(NamedTuple):
    """What of a motion is compared with the measured one, and with how many harmonics it moves."""

    sensors: tuple[int, ...]  # the reference first
    orders: tuple[int, ...]  # of the harmonics that are compared
    harmonic_order: int  # of the motion


@compiled
def grown(
    model: Structure, states: CalibrationStates, compared: ComparedMotion
) -> tuple[Float[Array, "row entry"], Float[Array, "row entry entry"]]:
    """Motions grown from small amplitudes, NaN where none was found, and inverse Jacobians."""

    def one(*row: Array) -> tuple[Array, Array]:
        state = CalibrationStates(*row)
        motion = state_motion(
            model, state, state.velocity[0], compared.sensors[0], compared.harmonic_order
        )
        point, jacobian = motion.grown_with_jacobian()
        return point, jnp.linalg.inv(jacobian)

    return mapped(one, *states)


class Stored(NamedTuple):
    """States, baseline motions and inverse Jacobians there; a row for every state, and spare."""

    states: CalibrationStates
    near: Float[Array, "state entry"]
    inverse: Float[Array, "state entry entry"]


class Asked(NamedTuple):
    """Rows of states under trials' parameters, and the directions of their slopes."""

    values: Float[Array, "trial parameter"]
    length: Float[Array, "trial direction"]  # of a slope's step: of one parameter, or of errors
    place: Int[Array, " direction"]  # of the parameter
    by_error: Float[Array, "input direction"]
    active: Bool[Array, " force"]  # which of the added `forces_of` have strength
    n_directions: Int[Array, ""]  # of the directions, that have slopes
    state: Int[Array, " row"]
    trial: Int[Array, " row"]


class Settings(NamedTuple):
    """What is compiled into a program beside the structure."""

    names: tuple[str, ...]  # of all parameters of the structure
    compared: ComparedMotion
    n_given: int  # how many effects are the baseline's: the first ones
    quick: bool  # whether friction is taken by formulas for cycles that turn only twice


@compiled
def missed(
    model: Structure,
    settings: Settings,
    stored: Stored,
    asked: Asked,
) -> tuple[Float[Array, "row column"], Float[Array, "row column direction"]]:
    """The misfit of every row, and its slopes along the wanted directions, else zero.

    NaN where no motion was found, and with `quick` formulas for cycles to which they do not apply.
    Slopes are differences between motions a small step apart: the second is a step or two from
    the first, and the equations are compiled only once.
    """
    names, compared, n_given, quick = settings
    n_directions, n_wanted = len(asked.place), asked.n_directions
    close = jnp.where(n_wanted > 0, 1e-8, 1e-5)  # the last step of a motion's solution

    def one(state: Array, trial: Array) -> tuple[Array, Array]:
        measured, near, inverse = jax.tree.map(lambda a: a[state], stored)
        values, length = asked.values[trial], asked.length[trial]

        def found(
            number: Array, start: Secants, columns: Float[Array, "column direction"]
        ) -> tuple[Secants, Float[Array, "column direction"]]:
            along = jnp.where(jnp.arange(n_directions) == number - 1, _STEP, 0.0)
            is_parameter = asked.place[number - 1] == jnp.arange(len(names))
            changed = with_parameters(model, names, values + (length @ along) * is_parameter)
            added = changed.effects[n_given:]
            order = compared.harmonic_order
            forces = [_quick(added[k], order, quick=quick) for k in forces_of(added)]
            rest = [e for k, e in enumerate(added) if k not in forces_of(added)]
            changed = dataclasses.replace(changed, effects=(*changed.effects[:n_given], *rest))
            erring = StateWithErrors(measured, 1.0, asked.by_error @ along)
            motion = erring.motion(changed, compared.sensors[0], compared.harmonic_order)
            parts = {f.name: getattr(motion.balance, f.name) for f in fields(motion.balance)}
            balance = _ForcedBalance(**parts, forces=tuple(forces), active=asked.active)
            motion = dataclasses.replace(motion, balance=balance)
            fraction = jnp.where(number > 0, 1e-2, 0.0)  # of a slope's first step: the last one
            end = motion.solved_by_secants(inverse, start, close, fraction)
            # Where the second motion is not found, the first step towards it is its slope.
            lost = (number > 0) & ~jnp.all(jnp.isfinite(end.point))
            point = jnp.where(lost, start.point + end.moves[0], end.point)
            own_columns = residual_columns(erring, motion, point, compared.sensors, compared.orders)
            start = jax.tree.map(lambda a, b: jnp.where(number == 0, a, b), end, start)
            place = jnp.arange(n_directions + 1) == number
            return start, jnp.where(place, own_columns[:, None], columns)

        none = batched_zero(near) + jnp.zeros((measured.known.shape[0], n_directions + 1))
        columns = jax.lax.fori_loop(
            0, n_wanted + 1, lambda k, now: found(k, *now), (start_of(near), none)
        )[1]
        change = columns[:, 1:] - columns[:, :1]
        chance = 1e-9  # of a column, by which solutions may differ
        seen = (jnp.arange(n_directions) < n_wanted) & ~(jnp.abs(change) < chance)
        return columns[:, 0], jnp.where(seen, change / _STEP, 0.0)

    return jax.vmap(one)(asked.state, asked.trial)


def forces_of(effects: Sequence[AbstractEffect]) -> list[int]:
    """Which effects are taken as forces on the mode of interest."""
    kinds = (AbstractForce, AbstractInternalResonance)
    return [k for k, effect in enumerate(effects) if isinstance(effect, kinds)]


class _ForcedBalance(HarmonicBalance):
    """A balance with further forces, each sampled as it needs; few of them count."""

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
        """Coefficients of some of the forces over the cycle of a mode's coefficients."""
        basis = harmonic_basis((self.n_coefficients - 1) // 2, n_samples)
        q = jnp.asarray(basis.synthesis) @ x
        v = omega * (jnp.asarray(basis.synthesis @ basis.derivative) @ x)
        force = jnp.zeros_like(q)
        for k in members:
            force = force + _where(self.active[k], self.forces[k].cycle_force, q, v)
        return jnp.asarray(basis.analysis) @ force


def _where(
    counts: Bool[Array, ""], function: Callable[[Array, Array], Array], first: Array, second: Array
) -> Array:
    """A function of two arrays of the first one's shape where it counts, else nothing."""
    # A method of a module with arrays has no hash.
    taken = jax.lax.cond(
        counts, lambda a, b: function(a, b), lambda a, _: jnp.zeros_like(a), first, second
    )
    return taken


def _samples(force: AbstractForce) -> int:
    plain = isinstance(force, AbstractMemoryless) and not isinstance(force, AbstractNonsmooth)
    return 128 if plain else 256


def _quick(effect: AbstractEffect, harmonics: int, *, quick: bool) -> AbstractForce:
    if isinstance(effect, AbstractInternalResonance):
        return _Resonance(effect, harmonics)
    force = cast(AbstractForce, effect)  # one of `forces_of`
    return _Quick(force) if quick and force.has_quick_formula() else force


class _Quick(AbstractForce):
    """A force by its quick formula, which is NaN over cycles for which it does not hold."""

    kind: ClassVar[str] = "quick"
    effect: AbstractForce

    def cycle_force(
        self, displacement: Float[Array, " time"], velocity: Float[Array, " time"]
    ) -> Float[Array, " time"]:
        return self.effect.quick_cycle_force(displacement, velocity)


class _Resonance(AbstractForce):
    """What a coupled mode in steady motion does to the mode of interest."""

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
        natural = 2 * jnp.pi * jnp.asarray(mode.frequency_hz)
        rate = jnp.arange(self.harmonics + 1) * omega
        stiffness = natural**2 - rate**2 + 2j * mode.damping_ratio * natural * rate
        answer = -mode.coefficient * load / stiffness
        parts = jnp.stack([answer.real, -answer.imag], axis=1).reshape(-1)
        parts = jnp.concatenate([parts[:1], parts[2:]])  # the mean has no sine
        return n * mode.coefficient * q ** (n - 1) * (jnp.asarray(basis.synthesis) @ parts)
