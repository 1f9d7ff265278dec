"""Where curves of events turn in their parameter: cusps, isolas that begin or merge."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from snrmjax.numerics.blocks import mapped, padded, taken
from snrmjax.numerics.compiled import compiled
from snrmjax.simulate.continuation.continuation import StepControl, TracedCurve
from snrmjax.simulate.continuation.event_equations import EventEquations, EventKind, bordered
from snrmjax.simulate.continuation.event_location import EventSearch

_BLOCK = 4  # turns that one call locates


class _Turn(NamedTuple):
    """A turn in the parameter, and by what kinds of it differ."""

    point: Array
    resolved: Array
    missed: Array
    faster: Array  # slope of the frequency in arclength
    crossing: Array  # share of ∂R/∂λ that the singular matrix does not reach
    curvature: Array  # above zero where the responses near it are closed


def with_turns(
    equations: EventEquations, curve: TracedCurve, steps: StepControl
) -> tuple[np.ndarray, np.ndarray, int]:
    """The points with those inserted at which the parameter turns, their names, and how many more
    turns were not located."""
    points, ahead = curve.points, curve.tangents
    events = np.array([""] * len(points), dtype=object)
    where = np.flatnonzero(np.signbit(ahead[1:, -1]) != np.signbit(ahead[:-1, -1]))
    if not where.size:
        return points, events, 0
    rows = [padded(r, _BLOCK) for r in (points[where], ahead[where], points[where + 1])]
    wanted = np.arange(len(rows[0])) < len(where)
    turn = taken(_turns(equations, *rows, wanted, steps), np.arange(len(where)))
    good = np.flatnonzero(turn.resolved)
    names = [_kind_of(equations.kind, *(float(part[k]) for part in turn[-3:])) for k in good]
    place = where[good] + 1
    return (
        np.insert(points, place, turn.point[good], axis=0),
        np.insert(events, place, names),
        int(np.sum(turn.missed)),
    )


def _kind_of(kind: EventKind, faster: float, crossing: float, curvature: float) -> str:
    if kind != "fold":
        return "turn"
    # wᵀ∂R/∂λ dλ vanishes at the turn: at a cusp by dλ, at a response that begins by the other.
    if abs(faster) < abs(crossing):
        return "cusp"
    return "isola_birth" if curvature > 0 else "isola_merging"


@compiled
def _turns(
    equations: EventEquations,
    here: Array,
    tangent: Array,
    there: Array,
    wanted: Array,
    steps: StepControl,
) -> _Turn:
    def located(here: Array, tangent: Array, there: Array, wanted: Array) -> _Turn:
        search = EventSearch(
            equations.linearised, lambda _, along: along[-1], here, tangent, there, steps
        )
        found = search.ended(wanted)
        crossing, curvature = _unfolding(equations, found.last.point)
        return _Turn(
            *(found.last.point, found.resolved & wanted, found.missed & wanted),
            *(found.last.tangent[equations.balance.size], crossing, curvature),
        )

    return mapped(located, here, tangent, there, wanted)


def _unfolding(equations: EventEquations, point: Array) -> tuple[Array, Array]:
    """How near ∂R/∂λ is to the range of the singular matrix, and the quadratic form's determinant.

    With both null vectors n of [∂R/∂x ∂R/∂λ] responses near a simple bifurcation obey
    Σ (wᵀ∂²R n_i n_j) s_i s_j + 2 wᵀ∂R/∂μ dμ = 0: ellipses, or branches that cross.
    Reference: Golubitsky & Schaeffer, Singularities and Groups in Bifurcation Theory I (1985),
    chapter I.3, doi:10.1007/978-1-4612-5034-0.
    """
    if equations.kind != "fold":
        return jnp.zeros(()), jnp.zeros(())
    size = equations.balance.size
    motion, balance = point[: size + 1], equations.at(point[-1])
    jacobian = balance.linearised(motion)[1]
    column = jacobian[:, size]
    null = bordered(jacobian[:, :size])
    crossing = null.left @ column / (jnp.linalg.norm(null.left) * jnp.linalg.norm(column))
    right = null.right / jnp.linalg.norm(null.right)
    along = jnp.linalg.pinv(jacobian[:, :size], rtol=1e-6) @ -column
    basis = (jnp.append(right, 0.0), jnp.append(along, 1.0))

    def form(first: Array, second: Array) -> Array:
        def slope(motion: Array) -> Array:
            return jax.jvp(balance.residual, (motion,), (first,))[1]

        return null.left @ jax.jvp(slope, (motion,), (second,))[1]

    (a, b), (_, c) = [[form(one, two) for two in basis] for one in basis]
    return crossing, a * c - b**2
