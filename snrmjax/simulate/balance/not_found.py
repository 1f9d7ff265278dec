"""What a solver did not find: NaN, and its derivatives NaN as well."""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

T = TypeVar("T")


def nan_unless(found: Bool[Array, ""], values: T, by: PyTree) -> T:
    """`values` where they were found; else NaN, with derivatives by the numbers of `by` of NaN.

    Derivatives of zero would say to an optimiser that it has arrived. In reverse mode they are NaN
    only where the result depends on the missing values: a member of a batch that a sum leaves out
    adds zero to the derivatives by what all members share.
    """
    moved = jnp.zeros(())
    for k, a in enumerate(jax.tree.leaves(by)):
        if isinstance(a, jax.Array) and jnp.issubdtype(a.dtype, jnp.floating):
            # Weights that no direction is across, but by chance.
            weight = np.random.default_rng(k).uniform(1.0, 2.0, a.shape)
            change = jnp.where(jnp.isfinite(a), a - jax.lax.stop_gradient(a), 0.0)
            moved += jnp.sum(weight * change)
    zero = jnp.expm1(moved)  # whose derivatives are none of them zero, of whatever order

    def or_nan(value: Array) -> Array:
        if jnp.iscomplexobj(value):
            return jax.lax.complex(or_nan(value.real), or_nan(value.imag))
        missing = _missing(jnp.broadcast_to(zero, jnp.shape(value)), found)
        return jnp.where(found, value, jnp.nan + missing)

    return jax.tree.map(or_nan, values)


def _missing(zero: Float[Array, "*shape"], found: Bool[Array, ""]) -> Float[Array, "*shape"]:
    """Zero, with a derivative of NaN but for what does not move, and where nothing asks for it.

    A linear map that is defined with its transpose. Of the two ways in which JAX lets one do that,
    this is the one that it also batches.
    """

    def missed(_: object, right: Array) -> Array:
        return jnp.where(found | (right == 0), 0.0, jnp.nan)

    return jax.lax.custom_linear_solve(lambda x: x, zero, missed, missed)
