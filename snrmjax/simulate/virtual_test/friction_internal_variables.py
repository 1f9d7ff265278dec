"""Friction in an integration in time: its memory goes on from step to step."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from snrmjax.model.effect_base import AbstractHysteresis, StateAt
from snrmjax.model.elements import elements_of
from snrmjax.model.structures import Structure

InternalVariables = tuple[Float[Array, " state"], ...]


def friction_rows(model: Structure) -> Float[Array, "friction mode"]:
    """The rows over the modes of what the effects with a memory act on, the first of each."""
    rows = [elements_of([effect], model.modes).rows[0] for effect in model.hysteretic]
    return jnp.stack(rows) if rows else jnp.zeros((0, model.n_modes))


def scaled_friction(
    model: Structure, displacement: Float[Array, " friction"], velocity: Float[Array, " friction"]
) -> tuple[AbstractHysteresis, ...]:
    """The effects with a memory, set for integration in time of motions of these sizes."""
    return tuple(
        effect.scaled_for(displacement[k], velocity[k]) for k, effect in enumerate(model.hysteretic)
    )


def internal_variables_at_rest(
    model: Structure, effects: tuple[AbstractHysteresis, ...], q: Float[Array, " mode"]
) -> InternalVariables:
    """Memory of a structure that was brought to a displacement and held there."""
    return tuple(effect.states_at_rest(_acts_on(model, effect, q)) for effect in effects)


def _acts_on(model: Structure, effect: AbstractHysteresis, q: Float[Array, " mode"]) -> StateAt:
    """The displacement, or of q̇ the rate, on which an effect acts; of several rows all of them."""
    there = elements_of([effect], model.modes).displacement(q)
    return there if len(effect.rows) > 1 else there[0]


def inner_force(
    model: Structure,
    effects: tuple[AbstractHysteresis, ...],
    q: Array,
    v: Array,
    memory: InternalVariables,
) -> tuple[Float[Array, " mode"], InternalVariables]:
    """What stiffness, damping and effects pull with, and the rates of friction's memory in a step.

    Sliders are held through a step: see `internal_variables_after_step`.
    """
    terms = model.linear_terms()
    inner = terms.stiffness * q + terms.damped(v) + model.memoryless_force(q[None], v[None])[0]
    rates = []
    for effect, states in zip(effects, memory, strict=True):
        x, rate = _acts_on(model, effect, q), _acts_on(model, effect, v)
        values = effect.state_force(x, rate, states)
        inner = inner + elements_of([effect], model.modes).on_modes(jnp.atleast_1d(values))
        held = effect.held_in_steps
        rates.append(jnp.zeros_like(states) if held else effect.state_rate(x, rate, states))
    return inner, tuple(rates)


def internal_variables_after_step(
    model: Structure,
    effects: tuple[AbstractHysteresis, ...],
    memory: InternalVariables,
    begin: tuple[Float[Array, " mode"], Float[Array, " mode"]],
    end: tuple[Float[Array, " mode"], Float[Array, " mode"]],
    time: Array,
) -> InternalVariables:
    """Memory after a step of an integrator through which sliders were held.

    Arguments: `memory` as the integrator leaves it; q and q̇ at the `begin` and at the `end` of the
    step, of length `time` in s.
    """

    def after(effect: AbstractHysteresis, states: Array) -> Array:
        q0, v0, q1, v1 = (_acts_on(model, effect, part) for part in (*begin, *end))
        return effect.after_step(states, (q0, v0), (q1, v1), time)

    return tuple(map(after, effects, memory))
