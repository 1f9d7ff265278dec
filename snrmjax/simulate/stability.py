"""Stability of periodic motions from the monodromy matrix of the linearised equations."""

from enum import Enum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.model.effect_base import AbstractMemoryless
from snrmjax.model.friction import AbstractSliders
from snrmjax.model.structure import Structure
from snrmjax.simulate.blocks import padded

_BLOCK = 64  # points whose linearised motions are integrated side by side
# Symmetric composition of order 6 with 9 stages: Kahan & Li, Math. Comp. 66 (1997) 1089.
_STAGES = (
    *(0.39216144400731413928, 0.33259913678935943860, -0.70624617255763935981),
    *(0.08221359629355080023, 0.79854399093482996340, 0.08221359629355080023),
    *(-0.70624617255763935981, 0.33259913678935943860, 0.39216144400731413928),
)


class StabilityLoss(Enum):
    """How the multiplier farthest outside the unit circle leaves it."""

    STABLE = "stable"
    REAL = "real"  # through +1: a fold or a branch point
    PERIOD_DOUBLING = "period_doubling"  # through −1
    NEIMARK_SACKER = "neimark_sacker"  # as a complex pair: quasi-periodic motion


class _Memory(NamedTuple):
    """Sliders' part in the linearised motion."""

    stiffness: Float[Array, "point slider"]
    dragged: Bool[Array, "step point slider"]


def floquet_multipliers(
    model: Structure,
    coefficients: Float[Array, "point coefficient mode"],
    frequency: Float[Array, " point"],
    *,
    steps_per_cycle: int = 12,
) -> Complex[np.ndarray, "point multiplier"]:
    """Floquet multipliers of periodic motions: eigenvalues of the map over one period.

    Integrates m δq̈ + C(t)δq̇ + K(t)δq = 0 with the tangent matrices along the motion by a
    composition of order 6 that keeps a conservative structure's multipliers on the unit circle,
    however light the damping. Sliders are linearised as they are: dragged or stuck. A motion is
    stable when all multipliers lie inside the unit circle.

    Arguments: Fourier coefficients (kg^1/2 m) of the structure as simulated, `frequency` in
    rad/s, `steps_per_cycle` of the fastest tangent frequency. Points are worked on in blocks of
    one size, so that the number of points does not compile anew.
    Returns NaN for points that are not finite.
    """
    values = np.asarray(coefficients, dtype=np.float64)
    omega = np.asarray(frequency, dtype=np.float64)
    n_points = len(values)
    found = np.full((n_points, 2 * model.n_modes), np.nan, dtype=np.complex128)
    for begin in range(0, n_points, _BLOCK):
        here = slice(begin, begin + _BLOCK)
        rows, speed = padded(values[here], _BLOCK), padded(omega[here], _BLOCK)
        n_steps = _steps(model, jnp.asarray(rows), jnp.asarray(speed), steps_per_cycle)
        maps = np.asarray(monodromy(model, jnp.asarray(rows), jnp.asarray(speed), n_steps))
        finite = np.all(np.isfinite(maps), axis=(1, 2))
        maps = np.where(finite[:, None, None], maps, 0.0)
        multipliers = np.where(finite[:, None], np.linalg.eigvals(maps), np.nan)
        found[here] = multipliers[: len(found[here])]
    return found


def is_stable(
    multipliers: Complex[np.ndarray, "*batch multiplier"],
) -> Bool[np.ndarray, "*batch"]:
    """Whether every multiplier lies inside the unit circle."""
    return np.max(np.abs(multipliers), axis=-1) < 1.0


def stability_loss(
    multipliers: Complex[np.ndarray, "point multiplier"],
) -> tuple[StabilityLoss, ...]:
    """By which kind of multiplier each point is unstable, the largest one deciding."""
    kinds = []
    for row in multipliers:
        if np.any(np.isnan(row)) or np.max(np.abs(row)) < 1.0:
            kinds.append(StabilityLoss.STABLE)
            continue
        largest = row[np.argmax(np.abs(row))]
        if abs(largest.imag) > 1e-9 * abs(largest):
            kinds.append(StabilityLoss.NEIMARK_SACKER)
        else:
            real = StabilityLoss.REAL if largest.real > 0 else StabilityLoss.PERIOD_DOUBLING
            kinds.append(real)
    return tuple(kinds)


@eqx.filter_jit
def _steps(
    model: Structure, coefficients: Array, frequency: Array, steps_per_cycle: int
) -> Int[Array, ""]:
    """Steps over one period that resolve the fastest tangent frequency along the motions."""
    terms = model.linear_terms()
    order = (coefficients.shape[1] - 1) // 2

    def fastest(tau: Array) -> Array:
        q, v = _state_at(coefficients, frequency, tau)
        k = (jnp.diag(terms.stiffness) + model.tangent_stiffness(q, v)) / terms.mass[:, None]
        return jnp.sqrt(jnp.max(jnp.sum(jnp.abs(k), axis=2), axis=1)) / frequency

    cycles = jnp.max(jnp.nan_to_num(jax.lax.map(fastest, 2 * jnp.pi * jnp.arange(48) / 48)))
    smooth = all(isinstance(e, AbstractMemoryless) for e in model.effects)
    least = max(24, 6 * order) if smooth and not model.effects else 512
    return jnp.clip(jnp.ceil(steps_per_cycle * cycles), least, 50_000).astype(int)


def _state_at(coefficients: Array, frequency: Array, tau: Array) -> tuple[Array, Array]:
    """q and q̇ of all points at the phase τ, the same for all or one for each."""
    orders = jnp.arange(1, (coefficients.shape[1] - 1) // 2 + 1)
    angle = jnp.broadcast_to(tau, frequency.shape)[:, None] * orders
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    mean, a, b = coefficients[:, 0], coefficients[:, 1::2], coefficients[:, 2::2]
    q = mean + jnp.einsum("ph,phm->pm", cosine, a) + jnp.einsum("ph,phm->pm", sine, b)
    rate = jnp.einsum("ph,phm->pm", cosine, orders[:, None] * b)
    rate = rate - jnp.einsum("ph,phm->pm", sine, orders[:, None] * a)
    return q, frequency[:, None] * rate


@eqx.filter_jit
def monodromy(
    model: Structure,
    coefficients: Float[Array, "point coefficient mode"],
    frequency: Float[Array, " point"],
    n_steps: Int[Array, ""],
) -> Float[Array, "point state state"]:
    """The linearised map of (δq, δq̇/Ω) over one period, from `n_steps` steps.

    Each stage goes half a step of damping and drift, a kick by the stiffness at its middle, and
    back: second order and symmetric, with the damping exact.
    """
    n, j, n_points = model.n_modes, model.modes.mode_of_interest, frequency.shape[0]
    terms = model.linear_terms()
    begin, friction, memory = _sliders(model, coefficients, frequency)
    step = 2 * jnp.pi / n_steps
    shares = jnp.asarray(_STAGES)
    # Where a stage's middle lies within its step.
    middles = jnp.cumsum(shares) - 0.5 * shares

    def tangents(tau: Array) -> tuple[Array, Array]:
        """K/mΩ² and C/mΩ of all points, the latter by mode."""
        q, v = _state_at(coefficients, frequency, begin + tau)
        k = jnp.diag(terms.stiffness) + model.tangent_stiffness(q, v)
        viscous = model.tangent_damping(q, v)
        for effect in friction:
            slope = jax.vmap(
                lambda e, q, v: jax.grad(e.state_force, argnums=1)(q, v, e.initial_states())
            )
            viscous = viscous + slope(effect, q[:, j], v[:, j])
        c = jnp.broadcast_to(terms.damping, (n_points, n)).at[:, j].add(viscous)
        per_mass = terms.mass * frequency[:, None]
        return k / (per_mass * frequency[:, None])[:, :, None], c / per_mass

    def stage(state: tuple, k: Array, share: Array, middle: Array) -> tuple:
        q, v, z = state
        h = share * step
        stiffness, damping = tangents((k + middle) * step)
        decay = jnp.exp(-0.5 * h * damping)[:, :, None]
        v = v * decay
        q = q + 0.5 * h * v
        # Written out as a sum of products, which vectorises; small batched products do not.
        force = jnp.sum(stiffness[:, :, :, None] * q[:, None, :, :], axis=2)
        if memory is not None:
            dragged = memory.dragged[k * memory.dragged.shape[0] // n_steps]
            block = jnp.where(dragged[:, :, None], q[:, j, None, :], z)
            per_mass = memory.stiffness / (terms.mass[j] * frequency**2)[:, None]
            force = force.at[:, j].add(-jnp.sum(per_mass[:, :, None] * block, axis=1))
        v = v - h * force
        q = q + 0.5 * h * v
        return q, v * decay, z

    def advance(k: Array, state: tuple) -> tuple:
        def one(i: Array, state: tuple) -> tuple:
            return stage(state, k, shares[i], middles[i])

        q, v, z = jax.lax.fori_loop(0, len(_STAGES), one, state)
        if memory is not None:
            dragged = memory.dragged[k * memory.dragged.shape[0] // n_steps]
            z = jnp.where(dragged[:, :, None], q[:, j, None, :], z)
        return q, v, z

    eye = jnp.broadcast_to(jnp.eye(2 * n), (n_points, 2 * n, 2 * n))
    q, v = eye[:, :n], eye[:, n:]
    if memory is None:
        z = jnp.zeros((n_points, 0, 2 * n))
    else:
        slips = jnp.any(memory.dragged, axis=0)
        z = jnp.where(slips[:, :, None], q[:, j, None, :], 0.0)
    q, v, _ = jax.lax.fori_loop(0, n_steps, advance, (q, v, z))
    return jnp.concatenate([q, v], axis=1)


def _sliders(
    model: Structure, coefficients: Array, frequency: Array
) -> tuple[Array, list, _Memory | None]:
    """Where a period begins, friction without memory, and the sliders along the motions.

    The period begins at the largest displacement: there every slider that slips at all is being
    dragged, so that its position is no state of its own.
    """
    if not model.hysteretic:
        return jnp.zeros_like(frequency), [], None
    j, n_samples = model.modes.mode_of_interest, 512
    tau = 2 * jnp.pi * jnp.arange(n_samples) / n_samples
    q, v = jax.vmap(lambda t: _state_at(coefficients, frequency, t))(tau)
    q, v = q[:, :, j], v[:, :, j]
    largest = jnp.argmax(q, axis=0)
    half_range = 0.5 * (jnp.max(q, axis=0) - jnp.min(q, axis=0))
    typical = jnp.sqrt(jnp.mean(v**2, axis=0))
    turned = jax.vmap(lambda row, k: jnp.roll(row, -k), in_axes=(1, 0))(q, largest)
    friction, stiffness, dragged = [], [], []
    for effect in model.hysteretic:
        scaled = jax.vmap(effect.scaled_for)(half_range, typical)
        if isinstance(effect, AbstractSliders):
            sliders = jax.vmap(lambda e: e.sliders())(scaled)
            position = jax.vmap(lambda e, q: e.settled_states(q, q))(scaled, turned)
            moved = position != jnp.roll(position, -1, axis=1)
            stiffness.append(sliders.stiffness)
            dragged.append(jnp.moveaxis(moved, 1, 0))
        else:
            friction.append(scaled)
    memory = None
    if stiffness:
        memory = _Memory(jnp.concatenate(stiffness, axis=1), jnp.concatenate(dragged, axis=2))
    return tau[largest], friction, memory
