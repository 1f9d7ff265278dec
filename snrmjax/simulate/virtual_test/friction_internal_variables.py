"""Friction in time integration: the internal variables from step to step."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from snrmjax.model.effect_base import AbstractHysteresis, StateAt
from snrmjax.model.elements import elements_of
from snrmjax.model.structures import Structure

InternalVariables = tuple[Float[Array, " state"], ...]


def friction_influence(model: Structure) -> Float[Array, "friction mode"]:
    """Influence vectors of the hysteretic elements, the first of each."""
    vectors = [elements_of([effect], model.modes).influence[0] for effect in model.hysteretic]
    return jnp.stack(vectors) if vectors else jnp.zeros((0, model.n_modes))


def scaled_friction(
    model: Structure, displacement: Float[Array, " friction"], velocity: Float[Array, " friction"]
) -> tuple[AbstractHysteresis, ...]:
    """The hysteretic elements, scaled for time integration of motions of these amplitudes."""
    return tuple(
        effect.scaled_for(displacement[k], velocity[k]) for k, effect in enumerate(model.hysteretic)
    )


def internal_variables_at_rest(
    model: Structure, effects: tuple[AbstractHysteresis, ...], q: Float[Array, " mode"]
) -> InternalVariables:
    """Internal variables of a structure that was moved to a displacement and rests there."""
    return tuple(effect.states_at_rest(_acts_on(model, effect, q)) for effect in effects)


def _acts_on(model: Structure, effect: AbstractHysteresis, q: Float[Array, " mode"]) -> StateAt:
    """The displacement (of q̇ the velocity) of an element; several for several influence vectors."""
    local = elements_of([effect], model.modes).displacement(q)
    return local if len(effect.influence_vectors) > 1 else local[0]


def inner_force(
    model: Structure,
    effects: tuple[AbstractHysteresis, ...],
    q: Array,
    v: Array,
    internal: InternalVariables,
) -> tuple[Float[Array, " mode"], InternalVariables]:
    """Internal forces of the structure, and the rates of friction's internal variables.

    Slider positions are constant within a step: see `internal_variables_after_step`.
    """
    terms = model.linear_terms()
    inner = terms.stiffness * q + terms.damped(v) + model.memoryless_force(q[None], v[None])[0]
    rates = []
    for effect, states in zip(effects, internal, strict=True):
        x, rate = _acts_on(model, effect, q), _acts_on(model, effect, v)
        values = effect.state_force(x, rate, states)
        inner = inner + elements_of([effect], model.modes).on_modes(jnp.atleast_1d(values))
        constant = effect.constant_in_steps
        rates.append(jnp.zeros_like(states) if constant else effect.state_rate(x, rate, states))
    return inner, tuple(rates)


def internal_variables_after_step(
    model: Structure,
    effects: tuple[AbstractHysteresis, ...],
    internal: InternalVariables,
    begin: tuple[Float[Array, " mode"], Float[Array, " mode"]],
    end: tuple[Float[Array, " mode"], Float[Array, " mode"]],
    time: Array,
) -> InternalVariables:
    """Internal variables after a step of an integrator in which sliders were constant.

    Arguments: `internal` as integrated; q and q̇ at the `begin` and the `end` of the step, of
    length `time` in s.
    """

    def after(effect: AbstractHysteresis, states: Array) -> Array:
        q0, v0, q1, v1 = (_acts_on(model, effect, part) for part in (*begin, *end))
        return effect.after_step(states, (q0, v0), (q1, v1), time)

    return tuple(map(after, effects, internal))
