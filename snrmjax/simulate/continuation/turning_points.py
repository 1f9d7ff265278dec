"""Turning points of event curves in their parameter: cusps, births and mergers of isolas."""

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

_BLOCK = 4  # turning points located in one call


class _TurningPoint(NamedTuple):
    """A turning point in the parameter, and the quantities that classify it."""

    point: Array
    resolved: Array
    missed: Array
    faster: Array  # derivative of the frequency by arclength
    crossing: Array  # fraction of ∂R/∂λ outside the range of the singular matrix
    curvature: Array  # positive where the nearby responses are closed


def with_turning_points(
    equations: EventEquations, curve: TracedCurve, steps: StepControl
) -> tuple[np.ndarray, np.ndarray, int]:
    """The points with turning points of the parameter inserted, their names, and the number of
    turning points that were not located."""
    points, ahead = curve.points, curve.tangents
    events = np.array([""] * len(points), dtype=object)
    where = np.flatnonzero(np.signbit(ahead[1:, -1]) != np.signbit(ahead[:-1, -1]))
    if not where.size:
        return points, events, 0
    rows = [padded(r, _BLOCK) for r in (points[where], ahead[where], points[where + 1])]
    wanted = np.arange(len(rows[0])) < len(where)
    located = taken(_turning_points(equations, *rows, wanted, steps), np.arange(len(where)))
    good = np.flatnonzero(located.resolved)
    names = [_kind_of(equations.kind, *(float(part[k]) for part in located[-3:])) for k in good]
    index = where[good] + 1
    return (
        np.insert(points, index, located.point[good], axis=0),
        np.insert(events, index, names),
        int(np.sum(located.missed)),
    )


def _kind_of(kind: EventKind, faster: float, crossing: float, curvature: float) -> str:
    if kind != "fold":
        return "turn"
    # wᵀ∂R/∂λ dλ vanishes there: at a cusp since dλ = 0, at an isola since wᵀ∂R/∂λ = 0.
    if abs(faster) < abs(crossing):
        return "cusp"
    return "isola_birth" if curvature > 0 else "isola_merging"


@compiled
def _turning_points(
    equations: EventEquations,
    here: Array,
    tangent: Array,
    there: Array,
    wanted: Array,
    steps: StepControl,
) -> _TurningPoint:
    def locate(here: Array, tangent: Array, there: Array, wanted: Array) -> _TurningPoint:
        search = EventSearch(
            equations.linearised, lambda _, along: along[-1], here, tangent, there, steps
        )
        end = search.ended(wanted)
        crossing, curvature = _unfolding(equations, end.last.point)
        return _TurningPoint(
            end.last.point,
            end.resolved & wanted,
            end.missed & wanted,
            end.last.tangent[equations.balance.size],
            crossing,
            curvature,
        )

    return mapped(locate, here, tangent, there, wanted)


def _unfolding(equations: EventEquations, point: Array) -> tuple[Array, Array]:
    """Component of ∂R/∂λ along the left null vector, and determinant of the quadratic form.

    With both null vectors n of [∂R/∂x ∂R/∂λ] the responses near a simple bifurcation obey
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
