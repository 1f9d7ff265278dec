"""Static solutions under dead loads: Newton's method with load steps from the stress-free shape."""

import enum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from snrmjax.condense.elements.beam import Beam
from snrmjax.condense.elements.strain_energy import (
    internal_force,
    strain_energy,
    tangent_stiffness,
)
from snrmjax.numerics.blocks import mapped

_ITERATIONS = 25
_TOLERANCE = 1e-16  # of the work of the load, in one correction; its error is squared once more
_SMALLEST_STEP = 2.0**-14  # of the load
_JUMP = 2.0  # times as far as the tangent predicts
_LIMIT_STIFFNESS = 0.1  # smallest stiffness over that at rest which tells a limit point


class StaticStatus(enum.IntEnum):
    """How a static solution ended; `STATIC_MESSAGE` says each in a sentence."""

    CONVERGED = 0
    DIVERGED = 1
    SNAPPED_THROUGH = 2


STATIC_MESSAGE = {
    StaticStatus.CONVERGED: "in equilibrium, on the stable path from rest",
    StaticStatus.DIVERGED: "Newton's method found no equilibrium: check the model, or load less",
    StaticStatus.SNAPPED_THROUGH: "the path from rest loses its stability before the load is "
    "reached (limit point or buckling): load less, or trace it by `static_path`",
}


class StaticSolutions(eqx.Module):
    """Static solutions, one row a load case; NaN where `status` is not CONVERGED."""

    displacement: Float[Array, "case dof"]  # from the stress-free shape
    energy: Float[Array, " case"]  # strain energy, J
    status: Int[Array, " case"]  # as `StaticStatus`
    load_fraction: Float[Array, " case"]  # of the load, up to which the path from rest was followed

    @property
    def converged(self) -> Bool[Array, " case"]:
        """Which cases have a solution."""
        return self.status == StaticStatus.CONVERGED


@eqx.filter_jit
def static_solutions(beam: Beam, load: Float[Array, "case dof"]) -> StaticSolutions:
    """Solve ∂U/∂u = F for each load case, on the stable path that starts at rest.

    The whole load is tried first; a load step that does not converge, ends where the tangent
    stiffness is not positive definite or jumps further than the tangent predicts is halved. The
    answer is differentiable by everything in `beam` and by `load` (implicit function theorem,
    first derivatives).

    Arguments: `load` F in N and N m on all degrees of freedom (x, y, rotation of each node); those
    on held ones have no effect. Loads keep their direction.
    Returns `StaticSolutions`; for SNAPPED_THROUGH and DIVERGED `load_fraction` says how far it got.
    """
    free = beam.free
    fixed_beam = jax.lax.stop_gradient(beam)
    loads = load[:, free]
    found = mapped(lambda one: _followed(fixed_beam, one), jax.lax.stop_gradient(loads))

    def polished(u: Array, one: Array, status: Array) -> tuple[Array, Array]:
        # One more Newton step: nothing but rounding in value, the whole of the derivative.
        stiffness = jax.lax.stop_gradient(_tangent(fixed_beam, u))
        u = u - jnp.linalg.solve(stiffness, _force(beam, u) - one)
        u = jnp.where(status == StaticStatus.CONVERGED, u, jnp.nan)
        whole = jnp.zeros(beam.n_dof).at[free].set(u)
        return whole, strain_energy(beam, whole)

    displacement, energy = mapped(lambda row: polished(*row), (found.u, loads, found.status))
    return StaticSolutions(displacement, energy, found.status, found.fraction)


class _Followed(NamedTuple):
    u: Array
    status: Array
    fraction: Array


def _force(beam: Beam, u: Array) -> Array:
    return internal_force(beam, jnp.zeros(beam.n_dof).at[beam.free].set(u))[beam.free]


def _tangent(beam: Beam, u: Array) -> Array:
    free = beam.free
    whole = tangent_stiffness(beam, jnp.zeros(beam.n_dof).at[free].set(u))
    return whole[free[:, None], free]


def _newton(beam: Beam, start: Array, load: Array) -> tuple[Array, Array]:
    """The equilibrium near `start`, and whether it converged."""

    def step(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        u, _, count = carry
        residual = load - _force(beam, u)
        change = jnp.linalg.solve(_tangent(beam, u), residual)
        new = u + change
        work = jnp.abs(change @ residual)
        return new, work <= _TOLERANCE * jnp.abs(load @ new), count + 1

    def going(carry: tuple[Array, Array, Array]) -> Array:
        u, done, count = carry
        return ~done & (count < _ITERATIONS) & jnp.all(jnp.isfinite(u))

    u, done, _ = jax.lax.while_loop(going, step, (start, jnp.array(False), jnp.array(0)))
    return u, done


def _followed(beam: Beam, load: Array) -> _Followed:
    """The path from rest by load steps, as far as it is stable."""
    at_rest = _tangent(beam, jnp.zeros_like(load))

    def step(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        u, fraction, size = carry
        target = jnp.minimum(fraction + size, 1.0)
        predicted = jnp.linalg.solve(_tangent(beam, u), (target - fraction) * load)
        new, good = _newton(beam, u, target * load)
        stable = jnp.all(jnp.isfinite(jnp.linalg.cholesky(_tangent(beam, new))))
        work = jnp.abs(load @ (new - u))
        good &= stable & (work <= _JUMP * jnp.abs(load @ predicted))
        return (
            jnp.where(good, new, u),
            jnp.where(good, target, fraction),
            jnp.where(good, 2 * size, 0.5 * size),
        )

    def going(carry: tuple[Array, Array, Array]) -> Array:
        _, fraction, size = carry
        return (fraction < 1) & (size >= _SMALLEST_STEP)

    start = jnp.zeros_like(load), jnp.array(0.0), jnp.array(1.0)
    u, fraction, _ = jax.lax.while_loop(going, step, start)
    # Softest direction now against rest: zero at a limit point or a bifurcation.
    root = jnp.linalg.cholesky(at_rest)
    half = jax.scipy.linalg.solve_triangular(root, _tangent(beam, u), lower=True)
    whole = jax.scipy.linalg.solve_triangular(root, half.T, lower=True)
    softest = jax.lax.cond(
        fraction < 1, lambda one: jnp.linalg.eigvalsh(one)[0], lambda _: jnp.array(1.0), whole
    )
    failed = jnp.where(
        softest < _LIMIT_STIFFNESS, StaticStatus.SNAPPED_THROUGH, StaticStatus.DIVERGED
    )
    return _Followed(u, jnp.where(fraction >= 1, StaticStatus.CONVERGED, failed), fraction)
