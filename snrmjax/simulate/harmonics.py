"""Fourier series of periodic motions: sampling, differentiation and phasors.

A motion is stored as real coefficients (coefficient, mode): the mean, then the cosine and the
sine of every harmonic of τ = Ωt. The force is a cosine, so phasors are relative to it.
"""

from functools import lru_cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float


class HarmonicBasis(NamedTuple):
    """Constant matrices of the alternating frequency-time method."""

    synthesis: np.ndarray  # (time, coefficient): samples over one period
    analysis: np.ndarray  # (coefficient, time): its left inverse
    derivative: np.ndarray  # (coefficient, coefficient): d/dτ
    product: np.ndarray  # (coefficient · coefficient, time): analysis ⊗ synthesis
    product_rate: np.ndarray  # the same with the derivative of the synthesis


@lru_cache(maxsize=64)
def harmonic_basis(
    harmonic_order: int, n_samples: int, *, cosine_only: bool = False
) -> HarmonicBasis:
    """The basis of `harmonic_order` harmonics sampled `n_samples` times over a period.

    With `cosine_only` the sine coefficients are left out: motions that start from rest, which
    is what the normal modes of a conservative structure are. `derivative` is then zero.
    """
    tau = 2 * np.pi * np.arange(n_samples) / n_samples
    orders = np.arange(1, harmonic_order + 1)
    cosines, sines = np.cos(np.outer(tau, orders)), np.sin(np.outer(tau, orders))
    ones = np.ones((n_samples, 1))
    if cosine_only:
        synthesis = np.concatenate([ones, cosines], axis=1)
        derivative = np.zeros((harmonic_order + 1, harmonic_order + 1))
    else:
        size = 2 * harmonic_order + 1
        synthesis = np.concatenate([ones, np.empty((n_samples, size - 1))], axis=1)
        synthesis[:, 1::2], synthesis[:, 2::2] = cosines, sines
        derivative = np.zeros((size, size))
        for h in orders:
            derivative[2 * h - 1, 2 * h] = h
            derivative[2 * h, 2 * h - 1] = -h
    analysis = synthesis.T * (2.0 / n_samples)
    analysis[0] *= 0.5
    size = synthesis.shape[1]
    rate = synthesis @ derivative
    product = np.einsum("at,tb->abt", analysis, synthesis).reshape(size * size, n_samples)
    product_rate = np.einsum("at,tb->abt", analysis, rate).reshape(size * size, n_samples)
    return HarmonicBasis(synthesis, analysis, derivative, product, product_rate)


def squared_orders(harmonic_order: int, *, cosine_only: bool = False) -> np.ndarray:
    """h² of every coefficient: minus the second derivative d²/dτ²."""
    orders = np.arange(1, harmonic_order + 1)
    repeated = orders if cosine_only else np.repeat(orders, 2)
    return np.concatenate([[0.0], repeated**2.0])


def alias_free_samples(harmonic_order: int, degree: int) -> int:
    """Samples over a period that make a polynomial force of this degree exact: (d + 1)H + 1.

    Rounded up to a multiple of four, at least 4H + 4.
    """
    needed = max((degree + 1) * harmonic_order + 1, 4 * harmonic_order + 4)
    return 4 * -(-needed // 4)


def displacement_phasors(
    coefficients: Float[Array, "*batch coefficient mode"],
) -> Complex[Array, "*batch harmonic mode"]:
    """Phasors X_h of q = Re Σ X_h e^{ihΩt}, h = 0…H, from the real coefficients."""
    mean = coefficients[..., :1, :].astype(jnp.complex128)
    return jnp.concatenate(
        [mean, coefficients[..., 1::2, :] - 1j * coefficients[..., 2::2, :]], axis=-2
    )


def velocity_phasors(
    coefficients: Float[Array, "*batch coefficient mode"],
    frequency: Float[Array, "*batch"],
    mode_shape: Float[Array, "sensor mode"],
) -> Complex[Array, "*batch harmonic sensor"]:
    """Velocity phasors ihΩ Φ X_h at the sensors, h = 0…H, in m/s."""
    displacement = displacement_phasors(coefficients)
    order = jnp.arange(displacement.shape[-2])
    rate = 1j * order * jnp.asarray(frequency)[..., None]
    return jnp.einsum("...h,...hm,sm->...hs", rate, displacement, mode_shape)
