"""A curve through given knots, as its users test curves: PCHIP in the squared amplitude."""

import interpax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from snrmjax.identify.curves.family_base import AbstractCurve


class ShapePreservingCurve(AbstractCurve):
    """A monotonicity-preserving cubic (PCHIP) in the squared amplitude, through `parameters`.

    Beyond its knots it goes on straight in the square of the amplitude.
    """

    knots: Float[Array, " parameter"]  # amplitudes, increasing

    def amplitude(self, displacement: Array, velocity: Array) -> Array:
        """See `AbstractCurve`."""
        return displacement

    def __call__(self, amplitude: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """See `AbstractCurve`."""
        knots = self.knots**2
        x = jnp.asarray(amplitude) ** 2
        inside = jnp.clip(x, knots[0], knots[-1])
        slopes = jax.vmap(jax.grad(lambda u: self._within(u[None])[0]))(knots[jnp.array([0, -1])])
        below, above = jnp.minimum(x - knots[0], 0.0), jnp.maximum(x - knots[-1], 0.0)
        value = self._within(inside.reshape(-1)).reshape(x.shape)
        return value + below * slopes[0] + above * slopes[1]

    def _within(self, square: Float[Array, " point"]) -> Float[Array, " point"]:
        method = "monotonic" if self.knots.shape[0] > 2 else "linear"
        return interpax.interp1d(square, self.knots**2, self.parameters, method=method, extrap=True)
