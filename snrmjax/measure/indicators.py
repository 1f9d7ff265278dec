"""Indicators of how close a measured steady state is to a (non)linear resonance."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.measure.signals import require_orders
from snrmjax.measure.states import SteadyStates
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.rules import InputError


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
