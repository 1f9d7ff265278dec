"""Solutions that did not converge: NaN, with NaN derivatives."""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

T = TypeVar("T")


def nan_unless(found: Bool[Array, ""], values: T, by: PyTree) -> T:
    """`values` if `found`, else NaN, with NaN derivatives with respect to the numbers of `by`.

    Zero derivatives would make an optimiser believe it has converged. In reverse mode they are NaN
    only where the result depends on the missing values: a member of a batch that a sum leaves out
    adds zero to the derivatives by shared parameters.
    """
    moved = jnp.zeros(())
    for k, a in enumerate(jax.tree.leaves(by)):
        if isinstance(a, jax.Array) and jnp.issubdtype(a.dtype, jnp.floating):
            # Generic weights: no direction of differentiation is orthogonal to them.
            weight = np.random.default_rng(k).uniform(1.0, 2.0, a.shape)
            change = jnp.where(jnp.isfinite(a), a - jax.lax.stop_gradient(a), 0.0)
            moved += jnp.sum(weight * change)
    zero = jnp.expm1(moved)  # zero, with non-zero derivatives of every order

    def or_nan(value: Array) -> Array:
        if jnp.iscomplexobj(value):
            return jax.lax.complex(or_nan(value.real), or_nan(value.imag))
        missing = _missing(jnp.broadcast_to(zero, jnp.shape(value)), found)
        return jnp.where(found, value, jnp.nan + missing)

    return jax.tree.map(or_nan, values)


def _missing(zero: Float[Array, "*shape"], found: Bool[Array, ""]) -> Float[Array, "*shape"]:
    """Zero, with NaN derivatives, but zero in directions and cotangents that are zero.

    A linear map defined with its transpose. Of JAX's two ways to do so this one supports
    batching.
    """

    def missed(_: object, right: Array) -> Array:
        return jnp.where(found | (right == 0), 0.0, jnp.nan)

    return jax.lax.custom_linear_solve(lambda x: x, zero, missed, missed)
