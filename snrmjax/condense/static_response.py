"""Static displacement of a reduced-order model under modal forces."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from snrmjax.model.potential import PolynomialPotential
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.newton import newton

_STEPS, _ITERATIONS = 40, 6
_TOLERANCE = 1e-9  # of the force
_JUMP = 2.0


@compiled
def static_displacement(
    frequency: Float[Array, " mode"],
    potential: PolynomialPotential,
    force: Float[Array, "case mode"],
) -> Float[Array, "case mode"]:
    """Solve ω²q + ∂V/∂q = f, each case on the equilibrium path from rest.

    The load increases in steps, each with Newton's method. NaN if the path ends before the full
    load, such as at a snap-through.

    Arguments: `frequency` in rad/s, `force` f in kg^1/2 m/s². Returns q in kg^1/2 m.

    >>> hardening = PolynomialPotential(jnp.ones(1), jnp.zeros(1), ((0, 0, 0, 0),), 1)
    >>> static_displacement(jnp.array([2.0]), hardening, jnp.array([[8.0]])).round(9)
    Array([[1.]], dtype=float64)
    """
    squared = jnp.asarray(frequency) ** 2

    def balance(q: Array, f: Array) -> Array:
        return squared * q + potential.force(q) - f

    def tangent(q: Array) -> Array:
        return jnp.diag(squared) + potential.stiffness(q)

    def linearised(q: Array, f: Array) -> tuple[Array, Array]:
        return balance(q, f), tangent(q)

    def from_rest(full: Array) -> Array:
        def step(carry: tuple[Array, Array], fraction: Array) -> tuple[tuple[Array, Array], None]:
            before, good = carry
            load = fraction * full
            predicted = before - jnp.linalg.solve(tangent(before), balance(before, load))
            size = jnp.max(jnp.abs(load) / squared)
            root = newton(partial(linearised, f=load), predicted, most=_ITERATIONS, scale=size)
            q, solved = root.one_more()
            scaled = tangent(q) / jnp.sqrt(squared[:, None] * squared)
            moved, expected = (jnp.linalg.norm((x - before) * frequency) for x in (q, predicted))
            # A step much longer than the tangent prediction has jumped to another path.
            is_stable = jnp.linalg.eigvalsh(scaled)[0] > 0
            good = good & solved & is_stable & (moved <= _JUMP * expected)
            return (q, good), None

        fractions = jnp.arange(1, _STEPS + 1) / _STEPS
        start = jnp.zeros_like(full), jnp.array(True)
        (q, stable), _ = jax.lax.scan(step, start, fractions)
        largest = jnp.max(jnp.abs(full))
        converged = stable & (jnp.max(jnp.abs(balance(q, full))) <= _TOLERANCE * largest)
        return jnp.where(converged, q, jnp.nan)

    return jax.vmap(from_rest)(jnp.asarray(force))
