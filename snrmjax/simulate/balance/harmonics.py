"""Fourier series of periodic motions: sampling, differentiation and phasors.

A motion is stored as real coefficients (coefficient, mode): the mean, then the cosine and the
sine of every harmonic of τ = Ωt. The force is a cosine, so phasors are relative to it.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float


class HarmonicBasis(NamedTuple):
    """Constant matrices of the alternating frequency-time method."""

    synthesis: np.ndarray  # (time, coefficient): samples over one period
    analysis: np.ndarray  # (coefficient, time): its left inverse
    derivative: np.ndarray  # (coefficient, coefficient): d/dτ
    spectrum: np.ndarray  # (order, time): cosine sums of orders 0…2H, then their sine sums
    row: np.ndarray  # (2, coefficient, coefficient): rows of `spectrum` that form each product
    sign: np.ndarray  # (2, coefficient, coefficient): their factors


@lru_cache(maxsize=64)
def harmonic_basis(
    harmonic_order: int, n_samples: int, *, cosine_only: bool = False
) -> HarmonicBasis:
    """The basis of `harmonic_order` harmonics sampled `n_samples` times over a period.

    With `cosine_only` the sine coefficients are left out: motions that start from rest, such as
    the normal modes of a conservative structure. `derivative` is then zero.
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
    double = np.outer(np.arange(2 * harmonic_order + 1), tau)
    spectrum = np.concatenate([np.cos(double), np.sin(double)]) * (2.0 / n_samples)
    row, sign = _product_to_sum(harmonic_order, cosine_only)
    return HarmonicBasis(synthesis, analysis, derivative, spectrum, row, sign)


def _product_to_sum(harmonic_order: int, cosine_only: bool) -> tuple[np.ndarray, np.ndarray]:
    """The two sums that form the product of each pair of basis functions, and their factors.

    cos aτ cos bτ = ½cos(a−b)τ + ½cos(a+b)τ, and likewise with sines.
    """
    orders = np.arange(1, harmonic_order + 1)
    order = np.concatenate([[0], orders if cosine_only else np.repeat(orders, 2)])
    is_sine = np.zeros(order.size, dtype=bool) if cosine_only else np.arange(order.size) % 2 == 0
    is_sine[0] = False
    difference = order[:, None] - order[None, :]
    total = order[:, None] + order[None, :]
    left, right = is_sine[:, None], is_sine[None, :]
    mixed = left ^ right
    offset = np.where(mixed, 2 * harmonic_order + 1, 0)
    first = np.where(mixed, np.where(left, 1, -1) * np.sign(difference), 1.0)
    second = np.where(left & right, -1.0, 1.0)
    half = np.where(order[:, None] == 0, 0.25, 0.5)
    row = np.stack([np.abs(difference) + offset, total + offset])
    return row, np.stack([half * first, half * second])


def tangent_blocks(
    basis: HarmonicBasis, samples: Float[Array, "time *entry"]
) -> Float[Array, "coefficient coefficient *entry"]:
    """∂(coefficients of k·q)/∂(coefficients of q) for every entry k of `samples` over a period.

    The products of two basis functions are sums of harmonics up to 2H, so 2(2H + 1) Fourier
    sums hold all of the blocks.
    """
    sums = jnp.tensordot(basis.spectrum, samples, axes=1)
    sign = jnp.asarray(basis.sign.reshape(*basis.sign.shape, *(1,) * (samples.ndim - 1)))
    return sign[0] * sums[basis.row[0]] + sign[1] * sums[basis.row[1]]


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
    coefficients: Float[Array | np.ndarray, "*batch coefficient mode"],
) -> Complex[Array, "*batch harmonic mode"]:
    """Phasors X_h of q = Re Σ X_h e^{ihΩt}, h = 0…H, from the real coefficients."""
    return _complex(*_real_and_imaginary(coefficients))


def velocity_phasors(
    coefficients: Float[Array | np.ndarray, "*batch coefficient mode"],
    frequency: Float[Array | np.ndarray, "*batch"],
    mode_shape: Float[Array | np.ndarray, "sensor mode"],
) -> Complex[Array, "*batch harmonic sensor"]:
    """Velocity phasors ihΩ Φ X_h at the sensors, h = 0…H, in m/s; differentiable.

    NumPy arrays are computed on the host: that is faster for a curve than a call of a program, and
    does not compile for every number of points.
    """
    real, imaginary = (part @ mode_shape.T for part in _real_and_imaginary(coefficients))
    orders = np.arange(real.shape[-2])
    rate = (orders * _namespace(frequency).asarray(frequency)[..., None])[..., None]
    return _complex(-rate * imaginary, rate * real)


def _real_and_imaginary(coefficients: Array | np.ndarray) -> tuple[Any, Any]:
    """Real and imaginary parts of the displacement phasors."""
    xp = _namespace(coefficients)
    mean, cosines = coefficients[..., :1, :], coefficients[..., 1::2, :]
    sines = coefficients[..., 2::2, :]
    real = xp.concatenate([mean, cosines], axis=-2)
    return real, xp.concatenate([xp.zeros_like(mean), -sines], axis=-2)


def _complex(real: Any, imaginary: Any) -> Any:
    """A complex array from its parts: jax 0.8 warns when it differentiates real to complex."""
    if isinstance(real, np.ndarray) and isinstance(imaginary, np.ndarray):
        return real + 1j * imaginary
    return jax.lax.complex(real, imaginary)


def with_sines(
    cosines: Float[Array | np.ndarray, "*batch order mode"],
) -> Float[Array, "*batch coefficient mode"]:
    """Mean and cosine coefficients with zero sines inserted."""
    xp = _namespace(cosines)
    orders, modes = cosines.shape[-2:]
    pairs = xp.stack([cosines[..., 1:, :], xp.zeros_like(cosines[..., 1:, :])], axis=-2)
    flat = pairs.reshape(*cosines.shape[:-2], 2 * (orders - 1), modes)
    return xp.concatenate([cosines[..., :1, :], flat], axis=-2)


def _namespace(values: object) -> Any:
    """NumPy for arrays on the host, JAX for others."""
    return np if isinstance(values, np.ndarray) else jnp
