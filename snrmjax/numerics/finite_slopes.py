"""Functions with finite derivatives where those of `jax.numpy` have none."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def safe_root(square: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Square root whose slope at zero is zero: 0 · ∞ would make derivatives of others NaN."""
    there = square != 0
    return jnp.where(there, jnp.sqrt(jnp.where(there, square, 1.0)), 0.0)
