"""Harmonic signals: synthesis, peak values, force-velocity loops, and indicators of resonance."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from snrmjax.measure.states import SteadyStates
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.rules import InputError


def synthesise(
    amplitudes: Complex[Array, "*batch harmonic"],
    orders: tuple[int, ...],
    frequency: float | Float[Array, ""],
    time: Float[Array, " sample"],
) -> Float[Array, "*batch sample"]:
    """Signal from its harmonics, x(t) = Re Σ_k X_k e^{ikΩt}.

    Arguments: `amplitudes` in any unit, one column per order of `orders`; `frequency` Ω in rad/s;
    `time` in s. Returns the unit of `amplitudes`; differentiable.
    Raises `ValueError` when `orders` does not match.

    >>> synthesise(jnp.array([2.0, 1j]), (0, 1), 1.0, jnp.array([0.0, jnp.pi / 2])).round(12)
    Array([2., 1.], dtype=float64)
    """
    orders = require_orders("orders", orders)
    values = checked_amplitudes("amplitudes", amplitudes, orders)
    angle = jnp.outer(jnp.asarray(orders, dtype=float), frequency * jnp.asarray(time))
    return values.real @ jnp.cos(angle) - values.imag @ jnp.sin(angle)


def peak_amplitude(
    amplitudes: Complex[Array, "*batch harmonic"], orders: tuple[int, ...]
) -> Float[Array, "*batch"]:
    """Largest magnitude of a signal over one period, max_t |Re Σ_k X_k e^{ikΩt}|.

    The largest of 32 samples per period of the highest harmonic, refined by Newton's method.

    Arguments: `amplitudes` in any unit, one column per harmonic of `orders` (order 0 is used if
    listed). Returns the unit of `amplitudes`. Raises `ValueError` when `orders` does not match.
    Validity: twice differentiable, except where two peaks are equally high; there the gradient
    is that of one of them.

    >>> peak_amplitude(jnp.array([3.0 + 4.0j]), (1,)).round(12)
    Array(5., dtype=float64)
    """
    orders = require_orders("orders", orders)
    return _peak(checked_amplitudes("amplitudes", amplitudes, orders), orders)


@compiled
def _peak(
    values: Complex[Array, "*batch harmonic"], orders: tuple[int, ...]
) -> Float[Array, "*batch"]:
    order = jnp.asarray(orders, dtype=float)
    n_samples = 32 * max(1, *orders)
    spacing = 2 * jnp.pi / n_samples

    def derivative(amplitude: Array, angle: Array, power: int) -> Array:
        terms = amplitude * (1j * order) ** power * jnp.exp(1j * angle[..., None] * order)
        return jnp.sum(terms, axis=-1).real

    def newton_step(amplitude: Array, angle: Array) -> Array:
        curvature = derivative(amplitude, angle, 2)
        flat = curvature == 0
        step = derivative(amplitude, angle, 1) / jnp.where(flat, 1.0, curvature)
        return jnp.where(flat, 0.0, jnp.clip(step, -spacing, spacing))

    fixed = jax.lax.stop_gradient(values)
    samples = synthesise(fixed, orders, 1.0, spacing * jnp.arange(n_samples))
    start = spacing * jnp.argmax(jnp.abs(samples), axis=-1)
    angle = jax.lax.fori_loop(
        0,
        6,
        lambda _, a: jnp.clip(a - newton_step(fixed, a), start - spacing, start + spacing),
        start,
    )
    # If the curve is too flat for Newton's method, the sample is the better estimate.
    refined, sampled = derivative(fixed, angle, 0), derivative(fixed, start, 0)
    angle = jnp.where(jnp.abs(refined) >= jnp.abs(sampled), angle, start)
    sign = jnp.where(sampled < 0, -1.0, 1.0)
    # One more differentiated step accounts for the shift of the peak in second derivatives.
    return sign * derivative(values, angle - newton_step(values, angle), 0)


class ForceVelocityLoop(NamedTuple):
    """One closed period of force against velocity, and the mean input power."""

    phase: Float[Array, " point"]  # Ωt in rad, 0…2π
    force: Float[Array, "*batch point"]  # N
    velocity: Float[Array, "*batch point"]  # m/s
    mean_power: Float[Array, "*batch"]  # W


@compiled
def force_velocity_loop(
    force: float | Float[Array, "*batch"],
    velocity_amplitudes: Complex[Array, "*batch harmonic"],
    orders: tuple[int, ...],
    n_points: int = 201,
) -> ForceVelocityLoop:
    """Lissajous figure of a force F cos Ωt and a velocity: a line at phase resonance.

    The mean power is P = ½ F Re V₁, the area of the force-displacement loop over the period.

    Arguments: `force` F in N; `velocity_amplitudes` in m/s relative to the force, one column per
    harmonic of `orders`, which must contain 1; `n_points`, the last repeats the first.
    Returns `ForceVelocityLoop`. Raises `ValueError` when `orders` does not match.
    Reference: Kwarta & Allen, Fig. 2 and Eq. (5b).

    >>> force_velocity_loop(2.0, jnp.array([0.5 + 0.1j]), (1,)).mean_power
    Array(0.5, dtype=float64)
    """
    orders = require_fundamental("orders", orders)
    values = checked_amplitudes("velocity_amplitudes", velocity_amplitudes, orders)
    peak = jnp.asarray(force, dtype=float)
    phase = jnp.linspace(0.0, 2 * jnp.pi, n_points)
    return ForceVelocityLoop(
        phase=phase,
        force=peak[..., None] * jnp.cos(phase),
        velocity=synthesise(values, orders, 1.0, phase),
        mean_power=0.5 * peak * values[..., orders.index(1)].real,
    )


def checked_amplitudes(
    name: str, amplitudes: Complex[Array, "*batch harmonic"], orders: tuple[int, ...]
) -> Complex[Array, "*batch harmonic"]:
    """Amplitudes as a complex array; raises `ValueError` if `orders` does not match the columns."""
    values = jnp.asarray(amplitudes, dtype=complex)
    if values.ndim == 0 or values.shape[-1] != len(orders) or not orders:
        raise InputError(
            f"`{name}` must end in an axis of {len(orders)} harmonics, as many as `orders` "
            f"{orders} names (one at least), but has shape {values.shape}."
        )
    return values


def require_orders(name: str, orders: Sequence[int] | Int[np.ndarray, " order"]) -> tuple[int, ...]:
    """Harmonic orders as a tuple, from a list or an array.

    Raises `ValueError` for repeated, negative or non-integer ones.
    """
    given = tuple(np.asarray(orders).tolist()) if isinstance(orders, np.ndarray) else tuple(orders)
    whole = all(isinstance(order, int | np.integer) and order >= 0 for order in given)
    if not whole or len(set(given)) != len(given):
        raise InputError(f"`{name}` must be distinct whole numbers from 0 on, but is {given}.")
    return tuple(int(order) for order in given)


def require_fundamental(name: str, orders: Sequence[int]) -> tuple[int, ...]:
    """As `require_orders`, for orders that must contain the fundamental, 1."""
    checked = require_orders(name, orders)
    if 1 not in checked:
        raise InputError(f"`{name}` must contain the fundamental, 1, but is {checked}.")
    return checked


def nnm_appropriation(
    velocity_amplitudes: Complex[Array, "*batch sensor harmonic"] | Complex[Array, " harmonic"],
    orders: tuple[int, ...],
) -> Float[Array, "*batch"]:
    """Nonlinear normal mode appropriation indicator: 1 at phase resonance.

    Δ = (1/N) Σ_k Re{X_k}ᵀRe{X_k} / X_kᴴX_k, where the X_k are displacements relative to a sine
    force. With velocities relative to a cosine force X_k = V_k e^{−ikπ/2}/(ikΩ), so that the
    relevant part is Re V_k for odd k and Im V_k for even k; the frequency cancels. For the
    fundamental of one sensor Δ is cos² of the velocity phase, and for that of several it is the
    mode indicator of Eq. (21).

    Arguments: `velocity_amplitudes` in m/s (any unit), one column per harmonic of `orders`; a
    vector is one sensor. NaN means not measured: such entries are ignored, and so are a harmonic
    that is exactly zero at every sensor, and harmonic 0, which has no phase.
    Returns a number from 0 to 1; NaN without any harmonic. Differentiable.
    Raises `ValueError` when `orders` does not match.
    Validity: every harmonic has the same weight, however small it is; harmonics of pure noise
    bias Δ towards one half.
    Reference: Kwarta & Allen, Eqs. (20) and (21).

    >>> nnm_appropriation(jnp.array([1.0 + 1.0j, 0.01j]), (1, 2)).round(12)
    Array(0.75, dtype=float64)
    """
    orders = require_orders("orders", orders)
    amplitudes = jnp.asarray(velocity_amplitudes)
    if amplitudes.ndim == 1:
        amplitudes = amplitudes[None]
    if amplitudes.ndim == 0 or amplitudes.shape[-1] != len(orders):
        raise InputError(
            f"`velocity_amplitudes` must end in an axis of {len(orders)} harmonics, as many as "
            f"`orders` {orders} names, but has shape {jnp.shape(velocity_amplitudes)}."
        )
    return _appropriation(amplitudes, orders)


@compiled
def _appropriation(
    amplitudes: Complex[Array, "*batch sensor harmonic"], orders: tuple[int, ...]
) -> Float[Array, "*batch"]:
    order = np.asarray(orders, dtype=int)
    aligned, total = _aligned_and_total(amplitudes, np.asarray(order % 2 == 1))
    counts = (total > 0) & (order > 0)
    ratio = jnp.where(counts, aligned / jnp.where(counts, total, 1.0), 0.0)
    n_counted = jnp.sum(counts, axis=-1)
    return jnp.where(n_counted > 0, jnp.sum(ratio, axis=-1) / jnp.maximum(n_counted, 1), jnp.nan)


@compiled
def appropriation_of(data: SteadyStates) -> Float[Array, " state"]:
    """Appropriation indicator of every measured state, from all its measured harmonics.

    Eq. (20) over the fundamental (`velocity`) and the stored `harmonics`, without harmonic 0.

    Returns one number per state; NaN for a state without any measurement. Differentiable.
    Reference: Kwarta & Allen, Eq. (20).

    >>> from snrmjax.measure.states import steady_states
    >>> data = steady_states([1, 1], [500.0, 510.0], [1.0, 1.0], [0.6 + 0.0j, 0.5 - 0.5j])
    >>> appropriation_of(data).round(12)
    Array([1. , 0.5], dtype=float64)
    """
    higher = [k for k, order in enumerate(data.harmonic_order) if order > 1]
    harmonics = data.harmonics[..., np.asarray(higher, dtype=int)]
    amplitudes = jnp.concatenate(
        [
            jnp.where(data.measured, data.velocity, jnp.nan)[..., None],
            jnp.where(data.measured[..., None], harmonics, jnp.nan),
        ],
        axis=-1,
    )
    return nnm_appropriation(amplitudes, (1, *(data.harmonic_order[k] for k in higher)))


def _aligned_and_total(
    amplitudes: Complex[Array, "*batch sensor harmonic"], odd: np.ndarray
) -> tuple[Float[Array, "*batch harmonic"], Float[Array, "*batch harmonic"]]:
    """Sums over the sensors of the squared in-phase part and of the squared magnitude."""
    measured = jnp.isfinite(amplitudes)
    values = jnp.where(measured, amplitudes, 0.0)
    # Scaled, so that the squares of tiny amplitudes do not underflow.
    largest = jnp.max(jnp.abs(values), axis=-2, keepdims=True, initial=0.0)
    values = values / jax.lax.stop_gradient(jnp.where(largest > 0, largest, 1.0))
    part = jnp.where(odd, values.real, values.imag)
    return jnp.sum(part**2, axis=-2), jnp.sum(values.real**2 + values.imag**2, axis=-2)
