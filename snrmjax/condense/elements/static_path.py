"""Equilibrium paths through limit points, by arc length."""

import enum

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.condense.elements.beam import Beam
from snrmjax.condense.elements.statics import free_force, free_tangent
from snrmjax.condense.elements.strain_energy import strain_energy

_ITERATIONS = 12
_SETTLED = 1e-9  # last correction over the step
_GROWTH, _SMALLEST = 1.5, 1e-4  # of a step, against the largest


class PathStatus(enum.IntEnum):
    """How a path ended: all points asked for, or where no step converged."""

    COMPLETE = 0
    STOPPED = 1


class StaticPath(eqx.Module):
    """Equilibria under a growing, falling and growing load, in order along the path from rest."""

    load_fraction: Float[np.ndarray, " point"]
    displacement: Float[np.ndarray, "point dof"]
    energy: Float[np.ndarray, " point"]  # strain energy, J
    stable: Bool[np.ndarray, " point"]  # under a load held constant
    status: PathStatus = eqx.field(static=True)


def static_path(
    beam: Beam, load: Float[Array | np.ndarray, " dof"], step: float, *, points: int = 100
) -> StaticPath:
    """Trace ∂U/∂u = λF from rest, through limit points, with λ an unknown.

    Each step goes along the tangent of the path and is corrected at right angles to it; a step
    that does not converge is halved. Where the path branches (a symmetric arch that may escape
    sideways) it stays on its branch, and `stable` turns false.

    Arguments: `load` F in N and N m on all degrees of freedom; `step` the largest of one step, in
    m: root of the sum of squares of the nodes' displacements.
    Returns a `StaticPath`, whose status is STOPPED with the points found so far where no step
    converges. Raises `ValueError` for a step that is not positive and a load of zero.
    Reference: E. Riks, Int. J. Solids Struct. 15 (1979) 529, doi:10.1016/0020-7683(79)90081-7.
    """
    if not (np.isfinite(step) and step > 0):
        raise ValueError(f"`step` must be positive (m), but is {step:g}.")
    force = jnp.asarray(load)[beam.free]
    if not np.any(np.asarray(force)):
        raise ValueError("`load` must act on a degree of freedom that is not held, but is zero.")
    u, fraction = jnp.zeros(force.size), jnp.array(0.0)
    direction, size = jnp.zeros(force.size), float(step)
    whole = np.zeros((1, beam.n_dof))
    rows, status = [(0.0, whole[0], 0.0, True)], PathStatus.COMPLETE
    while len(rows) < points:
        found = _arc_step(beam, force, u, fraction, direction, jnp.asarray(size))
        if not found[-1]:
            size *= 0.5
            if size < _SMALLEST * step:
                status = PathStatus.STOPPED
                break
            continue
        u, fraction, direction, energy, stable, _ = found
        moved = np.zeros(beam.n_dof)
        moved[beam.free] = u
        rows.append((float(fraction), moved, float(energy), bool(stable)))
        size = min(_GROWTH * size, step)
    fractions, moves, energies, stables = zip(*rows, strict=True)
    return StaticPath(
        np.array(fractions), np.array(moves), np.array(energies), np.array(stables), status
    )


@eqx.filter_jit
def _arc_step(
    beam: Beam, force: Array, u: Array, fraction: Array, direction: Array, size: Array
) -> tuple[Array, ...]:
    """The next point, its direction, energy, stability, and whether it converged."""
    counted = jnp.asarray(beam.free % 3 != 2, dtype=jnp.float64)  # translations

    def correct(
        count: int | Array, carry: tuple[Array, Array, Array, Array]
    ) -> tuple[Array, Array, Array, Array]:
        new, load, along, _ = carry
        tangent = free_tangent(beam, new)
        residual = load * force - free_force(beam, new)
        solved = jnp.linalg.solve(tangent, jnp.stack([force, residual], axis=1))
        by_load, by_residual = solved.T
        # The first pass, at the last point, is the step along the tangent.
        length = jnp.sqrt(by_load @ (counted * by_load))
        turned = jnp.where(direction @ (counted * by_load) < 0, -1.0, 1.0)
        along = jnp.where(count == 0, turned * by_load / length, along)
        row = counted * along
        wanted = jnp.where(count == 0, size, 0.0)
        more = (wanted - row @ by_residual) / (row @ by_load)
        change = by_residual + more * by_load
        moved = jnp.sqrt(change @ (counted * change))
        return new + change, load + more, along, moved

    start = u, fraction, direction, jnp.array(jnp.inf)
    new, load, along, moved = jax.lax.fori_loop(0, _ITERATIONS, correct, start)
    whole = jnp.zeros(beam.n_dof).at[beam.free].set(new)
    stable = jnp.all(jnp.isfinite(jnp.linalg.cholesky(free_tangent(beam, new))))
    far = jnp.sqrt((new - u) @ (counted * (new - u)))
    good = jnp.isfinite(load) & (moved < _SETTLED * size) & (far < 2 * size)
    return new, load, along, strain_energy(beam, whole), stable, good
