"""Stability of periodic motions from the monodromy matrix of the linearised equations."""

from enum import Enum, IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.model.effect_base import AbstractHysteresis
from snrmjax.model.library.friction import AbstractSliders
from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import over_cores, padded
from snrmjax.numerics.compiled import compiled

_BLOCK = 32  # points whose linearised motions are integrated side by side
_MOST_SEGMENTS = 256
MARGIN = 1e-6  # beyond the unit circle: what the multipliers of a conservative motion may err by
_SEGMENT = 32  # steps whose propagators are computed side by side
_GAUSS = np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)])


class Stability(IntEnum):
    """Whether a periodic motion is stable: what a small disturbance does to it."""

    NOT_COMPUTED = -1  # not asked for, or the multipliers could not be computed
    UNSTABLE = 0
    STABLE = 1


class StabilityLoss(Enum):
    """How the multiplier farthest outside the unit circle leaves it."""

    NOT_COMPUTED = "not_computed"
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
    steps_per_cycle: int = 6,
) -> Complex[np.ndarray, "point multiplier"]:
    """Floquet multipliers of periodic motions: eigenvalues of the map over one period.

    Integrates m δq̈ + C(t)δq̇ + K(t)δq = 0 with the tangent matrices along the motion by Magnus'
    method of order 6, which keeps a conservative structure's multipliers on the unit circle,
    however light the damping. Sliders are linearised as they are: dragged or stuck. A motion is
    stable when all multipliers lie inside the unit circle.

    Arguments: Fourier coefficients (kg^1/2 m) of the structure as simulated, `frequency` in
    rad/s, `steps_per_cycle` of the fastest tangent frequency. Points are worked on in blocks of
    one size, so that neither their number nor that of the steps compiles anew.
    Returns NaN for points that are not finite, and where more than 8192 steps would be needed.
    Reference: Blanes, Casas & Ros, BIT 40 (2000) 434, Eq. (3.10), doi:10.1023/A:1022311628317.
    """
    values = np.asarray(coefficients, dtype=np.float64)
    omega = np.asarray(frequency, dtype=np.float64)
    if not len(values):
        return np.zeros((0, 2 * model.n_modes), dtype=np.complex128)

    def block(begin: int) -> np.ndarray:
        here = slice(begin, begin + _BLOCK)
        rows = padded(values[here], _BLOCK)
        speed = padded(omega[here], _BLOCK)
        found = monodromy(model, rows, speed, steps_per_cycle)
        maps = np.asarray(found)[: len(values[here])]
        finite = np.all(np.isfinite(maps), axis=(1, 2))[:, None]
        finite &= np.all(np.isfinite(values[here]), axis=(1, 2))[:, None]
        return np.where(finite, np.linalg.eigvals(np.where(finite[:, :, None], maps, 0.0)), np.nan)

    return np.concatenate(over_cores(block, range(0, len(values), _BLOCK)))


def stability_of(
    multipliers: Complex[np.ndarray, "*batch multiplier"],
) -> Int[np.ndarray, "*batch"]:
    """A `Stability` for every motion: stable when all its multipliers are inside the unit circle.

    On the circle but for rounding counts as inside; multipliers of NaN were not computed.
    """
    largest = np.max(np.abs(multipliers), axis=-1)
    known = np.where(largest < 1.0 + MARGIN, int(Stability.STABLE), int(Stability.UNSTABLE))
    return np.where(np.isnan(largest), int(Stability.NOT_COMPUTED), known)


def stability_loss(
    multipliers: Complex[np.ndarray, "point multiplier"],
) -> tuple[StabilityLoss, ...]:
    """By which kind of multiplier each point is unstable, the largest one deciding."""
    kinds = []
    for row, stability in zip(multipliers, stability_of(multipliers).tolist(), strict=True):
        largest = row[np.argmax(np.abs(row))]
        if stability == Stability.NOT_COMPUTED:
            kinds.append(StabilityLoss.NOT_COMPUTED)
        elif stability == Stability.STABLE:
            kinds.append(StabilityLoss.STABLE)
        elif abs(largest.imag) > 1e-9 * abs(largest):
            kinds.append(StabilityLoss.NEIMARK_SACKER)
        else:
            real = StabilityLoss.REAL if largest.real > 0 else StabilityLoss.PERIOD_DOUBLING
            kinds.append(real)
    return tuple(kinds)


def _tangents(
    model: Structure, friction: list, coefficients: Array, frequency: Array, tau: Array
) -> tuple[Float[Array, "time point mode mode"], Float[Array, "time point mode"]]:
    """K/mΩ² and C/mΩ (by mode) of all points at phases τ (time,) or (time, point)."""
    j, (n_points, _, n) = model.modes.mode_of_interest, coefficients.shape
    terms = model.linear_terms()
    q, v = _states_at(coefficients, frequency, jnp.broadcast_to(tau.T, (n_points, len(tau))).T)
    flat_q, flat_v = q.reshape(-1, n), v.reshape(-1, n)
    k = model.tangent_stiffness(flat_q, flat_v).reshape(*q.shape, n)
    viscous = model.tangent_damping(flat_q, flat_v).reshape(q.shape[:2])
    for effect in friction:
        viscous = viscous + _viscous_slope(effect, q[..., j], v[..., j])
    c = jnp.broadcast_to(terms.damping, q.shape).at[..., j].add(viscous)
    per_mass = terms.mass * frequency[:, None]
    k = (k + jnp.diag(terms.stiffness)) / (per_mass * frequency[:, None])[:, :, None]
    return k, c / per_mass


def _viscous_slope(
    effects: AbstractHysteresis, q: Float[Array, "time point"], v: Float[Array, "time point"]
) -> Float[Array, "time point"]:
    """∂f/∂q̇ of friction without memory, one effect for every point."""

    def slope(effect: AbstractHysteresis, q: Array, v: Array) -> Array:
        return jax.grad(effect.state_force, argnums=1)(q, v, effect.initial_states())

    return jax.vmap(lambda q, v: jax.vmap(slope)(effects, q, v))(q, v)


def _states_at(coefficients: Array, frequency: Array, tau: Array) -> tuple[Array, Array]:
    """q and q̇ of all points at phases τ (time, point), as (time, point, mode)."""
    orders = jnp.arange(1, (coefficients.shape[1] - 1) // 2 + 1)
    angle = tau[..., None] * orders
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    mean, a, b = coefficients[:, 0], coefficients[:, 1::2], coefficients[:, 2::2]
    q = mean + jnp.einsum("tph,phm->tpm", cosine, a) + jnp.einsum("tph,phm->tpm", sine, b)
    rate = jnp.einsum("tph,phm->tpm", cosine, orders[:, None] * b)
    rate = rate - jnp.einsum("tph,phm->tpm", sine, orders[:, None] * a)
    return q, frequency[:, None] * rate


@compiled
def monodromy(
    model: Structure,
    coefficients: Float[Array, "point coefficient mode"],
    frequency: Float[Array, " point"],
    steps_per_cycle: int | Int[Array, ""],
) -> Float[Array, "point state state"]:
    """The linearised map of (δq, δq̇ over the fastest natural frequency) over one period.

    The steps resolve the fastest tangent frequency of all points. The propagators of a segment
    of steps are computed side by side and then applied one after the other.
    """
    n, j, n_points = model.n_modes, model.modes.mode_of_interest, frequency.shape[0]
    terms = model.linear_terms()
    begin, friction, memory = _sliders(model, coefficients, frequency)
    phases = 2 * jnp.pi * jnp.arange(48)[:, None] / 48
    k, c = _tangents(model, friction, coefficients, frequency, phases)
    rate = jnp.sqrt(jnp.max(jnp.sum(jnp.abs(k), axis=-1)))
    cycles = jnp.nan_to_num(jnp.maximum(rate, 0.5 * jnp.max(c)))
    least = 512 if model.effects else 6 * (coefficients.shape[1] // 2)
    n_steps = jnp.maximum(steps_per_cycle * cycles, least)
    needed = jnp.ceil(n_steps / _SEGMENT)
    # A motion that needs more is so far off that its tangents overflow anyway.
    n_segments = jnp.where(needed <= _MOST_SEGMENTS, needed, 0).astype(int)
    step = 2 * jnp.pi / (n_segments * _SEGMENT)
    unit = jnp.sqrt(jnp.max(terms.stiffness / terms.mass)) / frequency  # of δq̇, over Ω
    size = 2 * n + (memory is not None)

    def generators(start: Array, held: Array | None) -> Array:
        """The matrices A of y' = A y at the Gauss points of a segment's steps."""
        tau = start + step * (jnp.arange(_SEGMENT)[:, None] + _GAUSS).reshape(-1)
        k, c = _tangents(model, friction, coefficients, frequency, begin + tau[:, None])
        a = jnp.zeros((len(tau), n_points, size, size))
        if memory is not None and held is not None:
            per_mass = memory.stiffness / (terms.mass[j] * frequency**2)[:, None]
            dragged = jnp.repeat(jnp.sum(jnp.where(held, 0.0, per_mass), axis=2), 3, axis=0)
            k = k.at[:, :, j, j].add(-dragged)
            a = a.at[:, :, n + j, 2 * n].set(1.0 / unit)
        own = np.arange(n)
        a = a.at[:, :, own, n + own].set(unit[:, None])
        a = a.at[:, :, n : 2 * n, :n].set(-k / unit[:, None, None])
        a = a.at[:, :, n + own, n + own].set(-c)
        return a.reshape(_SEGMENT, 3, n_points, size, size)

    def segment(number: Array, state: tuple) -> tuple:
        held = None
        if memory is not None:
            index = (number * _SEGMENT + jnp.arange(_SEGMENT)) * len(memory.dragged)
            held = ~memory.dragged[index // (n_segments * _SEGMENT)]
        start = number * _SEGMENT * step
        propagators = _magnus(generators(start, held), step)

        def advance(state: tuple, item: tuple) -> tuple[tuple, None]:
            y, z = state
            propagator, stuck = item
            if memory is None:
                return (propagator @ y, z), None
            per_mass = memory.stiffness / (terms.mass[j] * frequency**2)[:, None]
            pull = jnp.sum(jnp.where(stuck, per_mass, 0.0)[:, :, None] * z, axis=1)
            y = propagator[:, :-1, :-1] @ y + propagator[:, :-1, -1:] * pull[:, None, :]
            return (y, jnp.where(stuck[:, :, None], z, y[:, j, None, :])), None

        return jax.lax.scan(advance, state, (propagators, held))[0]

    y = jnp.broadcast_to(jnp.eye(2 * n), (n_points, 2 * n, 2 * n))
    z = jnp.zeros((n_points, 0, 2 * n))
    if memory is not None:
        slips = jnp.any(memory.dragged, axis=0)
        z = jnp.where(slips[:, :, None], y[:, j, None, :], 0.0)
    y, _ = jax.lax.fori_loop(0, n_segments, segment, (y, z))
    return jnp.where(n_segments > 0, y, jnp.nan)


def _magnus(
    generators: Float[Array, "step gauss point state state"], step: Array
) -> Float[Array, "step point state state"]:
    """Propagators over steps from y' = A(t) y at their three Gauss points."""

    def bracket(a: Array, b: Array) -> Array:
        return a @ b - b @ a

    first, middle, last = (step * generators[:, i] for i in range(3))
    slope = np.sqrt(15.0) / 3.0 * (last - first)
    bend = 10.0 / 3.0 * (last - 2 * middle + first)
    inner = bracket(middle, slope)
    outer = -bracket(middle, 2 * bend + inner) / 60.0
    exponent = middle + bend / 12.0
    exponent = exponent + bracket(-20.0 * middle - bend + inner, slope + outer) / 240.0
    return _exponential(exponent)


def _exponential(matrix: Float[Array, "*batch state state"]) -> Float[Array, "*batch state state"]:
    """e^M by Taylor's series of order 9 of M/16 and squaring: exact to rounding for |M| up to 3."""
    x = matrix / 16.0
    x2 = x @ x
    x3 = x2 @ x
    eye = jnp.eye(matrix.shape[-1])
    high = eye / 720 + x / 5040 + x2 / 40320 + x3 / 362880
    result = (high @ x3 + (eye / 6 + x / 24 + x2 / 120)) @ x3 + (eye + x + x2 / 2)
    for _ in range(4):
        result = result @ result
    return result


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
    every = jnp.broadcast_to(tau[:, None], (n_samples, len(frequency)))
    q, v = (part[:, :, j] for part in _states_at(coefficients, frequency, every))
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
