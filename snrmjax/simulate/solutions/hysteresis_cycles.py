"""One cycle of a force, integrated in time: state and friction's memory go on to the next."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from snrmjax.model.effect_base import AbstractHysteresis, StateAt
from snrmjax.model.elements import elements_of
from snrmjax.model.library.friction import AbstractSliders
from snrmjax.model.structures import Structure

Memory = tuple[Float[Array, " state"], ...]

_STEPS_PER_SAMPLE = 1000  # beyond which the integration is given up


class CyclePoint(NamedTuple):
    """Where an integration is: the state, friction's memory and the length of a step."""

    q: Float[Array, " mode"]
    v: Float[Array, " mode"]
    memory: Memory
    step: Float[Array, ""]  # of the phase Ωt
    size: Float[Array, ""]  # largest |q| over the last cycle, kg^1/2 m
    range: Float[Array, " friction"]  # half that of what each friction acts on over it
    speed: Float[Array, " friction"]  # its rms rate over it, per second


def integrated_cycle(
    model: Structure,
    force: Array,
    frequency: Array,
    point: CyclePoint,
    n_samples: int,
    rtol: Array,
) -> tuple[CyclePoint, Float[Array, "time mode"]]:
    """One cycle of the force, and the displacements at equally spaced samples of it."""
    diffrax = _diffrax()
    solver = diffrax.Tsit5(scan_kind="lax")
    rows, terms = friction_rows(model), model.linear_terms()
    load, orders = force * model.modes.participation, model.load_orders()
    lag = model.modes.participation_lag
    lagging = jnp.zeros_like(load) if lag is None else force * orders[1] * lag
    # What the linear modes would do: the scale before the first cycle, and against rest.
    receptance = terms.stiffness - terms.mass * frequency**2 + 1j * terms.damping * frequency
    linear = jnp.max(jnp.abs(load) / jnp.maximum(jnp.abs(receptance), 1e-3 * terms.stiffness))
    sprung = terms.stiffness > 0
    springs = jnp.where(sprung, terms.stiffness, 1.0)
    static = jnp.max(jnp.where(sprung, jnp.abs(load) / springs, 0.0))
    fresh = point.size == 0
    start = jnp.maximum(jnp.max(jnp.abs(point.q)), jnp.max(jnp.abs(point.v)) / frequency)
    first = jnp.maximum(linear, start)
    size = jnp.maximum(jnp.where(fresh, first, point.size), 1e-2 * static)
    share = jnp.sum(jnp.abs(rows), axis=1)
    reach = jnp.maximum(jnp.where(fresh, share * first, point.range), 1e-3 * share * static)
    speed = jnp.where(fresh, share * first * frequency / np.sqrt(2), point.speed)
    speed = jnp.maximum(speed, 1e-2 * share * static * frequency)
    effects = scaled_friction(model, reach, speed)
    memory = point.memory
    if effects:
        old = scaled_friction(model, jnp.where(fresh, reach, point.range), speed)
        memory = tuple(map(_moved_memory, old, effects, point.memory))

    flat, whole = ravel_pytree((point.q, point.v, memory))
    n = model.n_modes

    def slope(phase: Array, state: Array, _: None) -> Array:
        q, v, memory = whole(state)
        drive = load * (orders @ jnp.cos(jnp.arange(len(orders)) * phase))
        drive = drive + lagging * jnp.sin(phase)
        inner, rates = inner_force(model, effects, q, v, memory)
        return ravel_pytree((v, (drive - inner) / terms.mass, rates))[0] / frequency

    term, width = diffrax.ODETerm(slope), 2 * jnp.pi / n_samples

    def sample(carry: tuple, number: Array) -> tuple[tuple, tuple[Array, Array]]:
        begin, end = number * width, (number + 1) * width

        def going(now: tuple) -> Array:
            phase, _, _, count = now
            return (phase < end) & (count < _STEPS_PER_SAMPLE)

        def advance(now: tuple) -> tuple:
            phase, state, step, count = now
            last = phase + 1.01 * step >= end
            to = jnp.where(last, end, phase + step)
            held = solver.init(term, phase, to, state, None)
            new, error, _, _, _ = solver.step(term, phase, to, state, None, held, made_jump=True)
            miss = jnp.maximum(
                jnp.max(jnp.abs(error[:n])), jnp.max(jnp.abs(error[n : 2 * n])) / frequency
            ) / (rtol * size)
            # A step that is no number is too long.
            miss = jnp.where(jnp.isfinite(miss), miss, 1e6)
            factor = jnp.clip(0.9 * jnp.maximum(miss, 1e-10) ** -0.2, 0.2, 4.0)
            taken, good = to - phase, miss <= 1
            longer = jnp.where(last, jnp.maximum(step, taken * factor), taken * factor)
            step = jnp.where(good, longer, taken * factor)
            if effects:
                (q0, v0, _), (q1, v1, held) = whole(state), whole(new)
                ends = (q0, v0), (q1, v1)
                states = memory_after_step(model, effects, held, *ends, taken / frequency)
                new = ravel_pytree((q1, v1, states))[0]
            return jnp.where(good, to, phase), jnp.where(good, new, state), step, count + 1

        state, step = carry
        phase, new, step, _ = jax.lax.while_loop(going, advance, (begin, state, step, 0))
        new = jnp.where(phase >= end, new, jnp.nan)
        step = jnp.where(jnp.isfinite(step), jnp.minimum(step, 1.0), 1e-3)
        return (new, step), (state[:n], rows @ state[n : 2 * n])

    (end, step), (samples, speeds) = jax.lax.scan(sample, (flat, point.step), jnp.arange(n_samples))
    own, (q, v, memory) = samples @ rows.T, whole(end)
    after = CyclePoint(
        q=q,
        v=v,
        memory=memory,
        step=step,
        size=jnp.max(jnp.abs(samples)),
        range=jnp.maximum(0.5 * (jnp.max(own, 0) - jnp.min(own, 0)), 1e-3 * share * static),
        speed=jnp.sqrt(jnp.mean(speeds**2, axis=0)),
    )
    return after, samples


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


def memory_at_rest(
    model: Structure, effects: tuple[AbstractHysteresis, ...], q: Float[Array, " mode"]
) -> Memory:
    """Memory of a structure that was brought to a displacement and held there."""
    return tuple(effect.states_at_rest(_acts_on(model, effect, q)) for effect in effects)


def _acts_on(model: Structure, effect: AbstractHysteresis, q: Float[Array, " mode"]) -> StateAt:
    """The displacement, or of q̇ the rate, on which an effect acts; of several rows all of them."""
    there = elements_of([effect], model.modes).displacement(q)
    return there if len(effect.rows) > 1 else there[0]


def _moved_memory(old: AbstractHysteresis, new: AbstractHysteresis, states: Array) -> Array:
    """Positions of sliders after their slip displacements were chosen anew.

    A position is a function of the slip displacement, piecewise linear, whatever the history.
    """
    if not isinstance(old, AbstractSliders) or not isinstance(new, AbstractSliders):
        return states
    slip, wanted = old.sliders().slip_displacement, new.sliders().slip_displacement
    return jnp.interp(wanted, slip, states)


def inner_force(
    model: Structure, effects: tuple[AbstractHysteresis, ...], q: Array, v: Array, memory: Memory
) -> tuple[Float[Array, " mode"], Memory]:
    """What stiffness, damping and effects pull with, and the rates of friction's memory in a step.

    Sliders are held through a step: see `memory_after_step`.
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


def memory_after_step(
    model: Structure,
    effects: tuple[AbstractHysteresis, ...],
    memory: Memory,
    begin: tuple[Float[Array, " mode"], Float[Array, " mode"]],
    end: tuple[Float[Array, " mode"], Float[Array, " mode"]],
    time: Array,
) -> Memory:
    """Memory after a step of an integrator through which sliders were held.

    Arguments: `memory` as the integrator leaves it; q and q̇ at the `begin` and at the `end` of the
    step, of length `time` in s.
    """

    def after(effect: AbstractHysteresis, states: Array) -> Array:
        q0, v0, q1, v1 = (_acts_on(model, effect, part) for part in (*begin, *end))
        return effect.after_step(states, (q0, v0), (q1, v1), time)

    return tuple(map(after, effects, memory))


def _diffrax() -> Any:
    try:
        import diffrax
    except ImportError as error:
        raise ImportError(
            "time integration needs diffrax, which is not installed: "
            "pip install 'snrmjax[integrate]'."
        ) from error
    return diffrax
