"""Static solutions under dead loads by Newton's method with load steps."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from snrmjax.condense.elements.beam import Beam
from snrmjax.condense.elements.strain_energy import (
    internal_force,
    strain_energy,
    tangent_stiffness,
)
from snrmjax.condense.load_cases import ReductionBasis, StaticCases
from snrmjax.numerics.blocks import mapped
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.status import Status

_ITERATIONS = 25
_TOLERANCE = (
    1e-16  # of the work of the load, in one correction; the error of the result is its square
)
_SMALLEST_STEP = 2.0**-14  # of the load
_JUMP = 2.0  # largest step over the tangent prediction
_LIMIT_STIFFNESS = 0.1  # smallest stiffness over that at rest, below which a limit point is near


class StaticStatus(Status):
    """Outcome of a static solution; `.message` explains it."""

    CONVERGED = 0, "in equilibrium, on the stable path from rest"
    DIVERGED = 1, "Newton's method solutions no equilibrium: check the model, or reduce the load"
    SNAPPED_THROUGH = (
        2,
        "the path from rest loses its stability before the full load "
        "(limit point or buckling): reduce the load",
    )


class StaticSolutions(eqx.Module):
    """Static solutions, one row per load case; NaN where `status` is not CONVERGED."""

    displacement: Float[Array, "case dof"]  # from the stress-free shape
    energy: Float[Array, " case"]  # strain energy, J
    status: Int[Array, " case"]  # as `StaticStatus`
    load_fraction: Float[Array, " case"]  # fraction of the load reached on the path from rest

    @property
    def converged(self) -> Bool[Array, " case"]:
        """Which cases have a solution."""
        return self.status == StaticStatus.CONVERGED


@compiled
def static_solutions(beam: Beam, load: Float[Array, "case dof"]) -> StaticSolutions:
    """Solve ∂U/∂u = F for each load case, on the stable path from rest.

    The full load is tried first; a load step is halved if it does not converge, ends at a tangent
    stiffness that is not positive definite, or jumps further than the tangent predicts. The
    solution is differentiable by everything in `beam` and by `load` (implicit function theorem,
    first and second derivatives).

    Arguments: `load` F in N and N m on all degrees of freedom (x, y, rotation of each node); those
    on fixed ones have no effect. Loads keep their direction (dead loads).
    Returns `StaticSolutions`; for SNAPPED_THROUGH and DIVERGED `load_fraction` is what was reached.
    """
    free = beam.free
    fixed_beam = jax.lax.stop_gradient(beam)
    loads = load[:, free]
    start, stiffness, status, fraction = mapped(
        lambda load: _followed(fixed_beam, load), jax.lax.stop_gradient(loads)
    )

    def polished(u: Array, k: Array, load: Array, good: Array) -> tuple[Array, Array]:
        # Newton steps with a fixed matrix: the value changes by rounding only, and each makes one
        # more order of derivatives exact.
        factor = jax.scipy.linalg.lu_factor(k)
        for _ in range(2):
            u = u - jax.scipy.linalg.lu_solve(factor, _free_force(beam, u) - load)
        whole = jnp.where(good, jnp.zeros(beam.n_dof).at[free].set(u), jnp.nan)
        return whole, strain_energy(beam, whole)

    rows = start, stiffness, loads, status == StaticStatus.CONVERGED
    displacement, energy = mapped(polished, *rows)
    return StaticSolutions(displacement, energy, status, fraction)


@compiled
def static_cases(
    beam: Beam, basis: ReductionBasis, force: Float[Array | np.ndarray, "case mode"]
) -> StaticCases:
    """Run load cases F = M Φ f with all displacements and the strain energy.

    Cases that diverge or snap through are marked as not converged; `static_solutions`
    distinguishes them.
    Differentiable by `beam`, by `basis` (from `beam_modes(beam, …)`) and by `force`.

    Arguments: `force` f in kg^1/2 m/s², one row per case, such as from `modal_loads`.
    """
    loads = jnp.asarray(force)
    # The filter is ΦᵀM: loads @ filter = (M Φ f)ᵀ.
    solutions = static_solutions(beam, loads @ basis.filter)
    return StaticCases(
        force=loads,
        modal_displacement=solutions.displacement @ basis.filter.T,
        converged=solutions.converged,
        energy=solutions.energy,
        displacement=solutions.displacement,
    )


class _Path(NamedTuple):
    """State of the load stepping; the path is known up to `reached` of the load."""

    u: Array  # the iterate
    accepted: Array  # displacement at `reached`
    stiffness: Array  # there
    at_rest: Array  # stiffness without load
    predicted: Array  # work of the load by the tangent, in this step
    reached: Array
    step_size: Array  # of this step, in loads
    iterations: Array  # in it


def _free_force(beam: Beam, u: Array) -> Array:
    """Internal force on the free degrees of freedom, for displacements of these."""
    return internal_force(beam, jnp.zeros(beam.n_dof).at[beam.free].set(u))[beam.free]


def _free_tangent(beam: Beam, u: Array) -> Array:
    """Tangent stiffness of the free degrees of freedom."""
    free = beam.free
    whole = tangent_stiffness(beam, jnp.zeros(beam.n_dof).at[free].set(u))
    return whole[free[:, None], free]


def _followed(beam: Beam, load: Array) -> tuple[Array, Array, Array, Array]:
    """Displacement, stiffness, status and load fraction at the end of the stable path from rest.

    One loop for load steps and their iterations, so that the tangent is compiled once.
    """

    def step(path: _Path) -> _Path:
        target = jnp.minimum(path.reached + path.step_size, 1.0)
        residual = target * load - _free_force(beam, path.u)
        stiffness = _free_tangent(beam, path.u)
        change = jnp.linalg.solve(stiffness, residual)
        u, first = path.u + change, path.iterations == 0
        predicted = jnp.where(first, jnp.abs(load @ change), path.predicted)
        settled = jnp.abs(change @ residual) <= _TOLERANCE * jnp.abs(load @ u)
        done = ~first & settled
        stable = jnp.all(jnp.isfinite(jnp.linalg.cholesky(stiffness)))
        near = jnp.abs(load @ (u - path.accepted)) <= _JUMP * predicted
        good = done & stable & near
        failed = ~good & (done | (path.iterations >= _ITERATIONS) | ~jnp.all(jnp.isfinite(u)))
        return _Path(
            u=jnp.where(failed, path.accepted, u),
            accepted=jnp.where(good, u, path.accepted),
            stiffness=jnp.where(good, stiffness, path.stiffness),
            at_rest=jnp.where(first & (path.reached == 0), stiffness, path.at_rest),
            predicted=predicted,
            reached=jnp.where(good, target, path.reached),
            step_size=path.step_size * jnp.where(good, 2.0, jnp.where(failed, 0.5, 1.0)),
            iterations=jnp.where(good | failed, 0, path.iterations + 1),
        )

    zero, flat = jnp.zeros_like(load), jnp.eye(load.size)
    start = _Path(
        zero, zero, flat, flat, jnp.array(0.0), jnp.array(0.0), jnp.array(1.0), jnp.array(0)
    )
    end = jax.lax.while_loop(
        lambda path: (path.reached < 1) & (path.step_size >= _SMALLEST_STEP), step, start
    )
    complete = end.reached >= 1
    failed = jax.lax.cond(complete, lambda _: jnp.array(0), _failure, end)
    return end.accepted, end.stiffness, failed, end.reached


def _failure(end: _Path) -> Array:
    """SNAPPED_THROUGH if a direction has lost its stiffness, else DIVERGED."""
    root = jnp.linalg.cholesky(end.at_rest)
    half = jax.scipy.linalg.solve_triangular(root, end.stiffness, lower=True)
    whole = jax.scipy.linalg.solve_triangular(root, half.T, lower=True)
    softest = jnp.linalg.eigvalsh(whole)[0]
    limit = (end.reached > 0) & (softest < _LIMIT_STIFFNESS)
    return jnp.where(limit, int(StaticStatus.SNAPPED_THROUGH), int(StaticStatus.DIVERGED))
