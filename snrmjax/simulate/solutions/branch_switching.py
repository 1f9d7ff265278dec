"""Curves that cross a known response at a branch point, onto which a sweep passes there.

Where a symmetric motion loses its symmetry, or a mode that the force does not drive starts to move,
the known curve goes on unstable, and the stable motions are on the other curve through that point.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from snrmjax.numerics.blocks import as_arrays, taken
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.newton import Trial, correct
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.continuation.continuation import (
    CurveEvent,
    CurveStatus,
    StepControl,
    TracedCurve,
)
from snrmjax.simulate.continuation.curve_tracing import lies_on, trace_both_ways
from snrmjax.simulate.continuation.response_curve import Branch, ResponseCurve, assembled

_MOST_CURVES = 16  # of one member; branches of branches end there
_OFF = (0.1, 0.03)  # distances from a branch point at which the other curve is sought, relative
_CLOSE = 0.02  # of that distance: where the branches are cut, the frequency differs by its square
_SAME = 1e-5  # relative difference in frequency below which two branch points are one
_KNOWN = 0.3  # of that distance: nearer to a known curve a motion is on it


class Crossing(NamedTuple):
    """A branch point, scaled, with motions on the other curve through it, on both sides."""

    point: Float[np.ndarray, " unknown"]
    away: Float[np.ndarray, " unknown"]  # direction of the other curve
    distance: float  # of the motions `off` the point
    off: tuple[Float[np.ndarray, " unknown"], ...]
    close: tuple[Float[np.ndarray, " unknown"], ...]  # on the sides −, + of `away`

    def side(self, point: Float[np.ndarray, " unknown"]) -> float:
        """The distance of a motion from the branch point along `away`."""
        return float(self.away @ (point - self.point))

    def is_between(self, pair: Float[np.ndarray, "2 unknown"]) -> bool:
        """Whether the other curve passes the branch point between two of its points."""
        passes = self.side(pair[0]) * self.side(pair[1]) < 0
        return passes and lies_on(self.point, pair, _KNOWN * self.distance)


def add_branches(
    curves: list[ResponseCurve],
    known: list[Float[np.ndarray, "point unknown"]],
    balances: HarmonicBalance,
    member: int,
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
) -> None:
    """Add to one member's curves the branches with stable points that leave them, and theirs.

    Arguments: `known` are the scaled points of curves that are not sought again; those of the new
    branches are added. No more are sought when there are 16 curves.
    """
    for curve in curves:  # and those that are added on the way
        new = from_branch_points(balances, member, curve, known, ends, steps)
        if not new or len(curves) >= _MOST_CURVES:
            continue
        own = taken(balances, np.full(len(new), member))
        found = assembled(own, new, steps, branch=Branch.BRANCH_POINT)
        curves.extend(with_named_ends(one, ends) for one in found if np.any(one.is_stable))
        known.extend(branch.points for branch in new)


def with_named_ends(
    branch: ResponseCurve,
    ends: Float[np.ndarray, " end"],
    kind: CurveEvent = CurveEvent.BRANCH_POINT,
) -> ResponseCurve:
    """A branch with its branch points named as `kind`, where it begins or ends at one."""
    events = list(branch.event)
    if not np.isclose(branch.frequency[0], ends).any():
        events[0] = kind
    if branch.status == CurveStatus.BRANCH_POINT:
        events[-1] = kind
    # Next to its end a branch is stable or not by rounding alone.
    for end, inner in ((0, 1), (-1, -2)):
        same = np.isclose(branch.frequency[end], branch.frequency[inner], rtol=_SAME)
        if same and events[end] == kind and events[inner] == CurveEvent.BRANCH_POINT:
            events[inner] = CurveEvent.NONE
    return dataclasses.replace(branch, event=tuple(events))


def from_branch_points(
    balances: HarmonicBalance,
    member: int,
    curve: ResponseCurve,
    known: Sequence[Float[np.ndarray, "point unknown"]],
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
    *,
    unstable_too: bool = False,
) -> list[TracedCurve]:
    """The branches of one member that leave `curve` at the branch points where it loses stability.

    With `unstable_too` also those that leave it where it is unstable on both sides.

    At a branch point the Jacobian of R(x, λ) has two null vectors; the other curve leaves along
    the one that is orthogonal to the tangent of the known curve. It is traced through the branch
    point and cut there: its halves are separate branches, mirror images for a symmetric structure.

    Reference: Seydel, Practical Bifurcation and Stability Analysis (2010), section 5.5,
    doi:10.1007/978-1-4419-1740-9.
    """
    last = len(curve.frequency) - 1
    at = [k for k in curve.at_events(CurveEvent.BRANCH_POINT).tolist() if 0 < k < last]
    if not at:
        return []
    own, balance = taken(balances, np.array([member])), as_arrays(taken(balances, member))
    crossings = {k: _crossing(balance, curve, k) for k in at}
    cuts = [one for one in crossings.values() if one is not None]
    lower, upper = ends / float(balance.frequency_scale)
    curves: list[TracedCurve] = []
    for k, crossing in crossings.items():
        stable = unstable_too or bool(np.any(curve.is_stable[k - 1 : k + 2]))
        if crossing is None or not stable:
            continue
        for start in crossing.off:
            near = _KNOWN * crossing.distance
            every = (*known, *(one.points for one in curves))
            is_known = any(lies_on(start, points, near) for points in every)
            if is_known or not lower <= start[-1] <= upper:
                continue
            curves += _cut(trace_both_ways(own, start, ends, steps), cuts)
    return curves


def _crossing(balance: HarmonicBalance, curve: ResponseCurve, k: int) -> Crossing | None:
    """The branch point `k` of a curve, or None where no motion off the curve was found."""
    here, before, behind = (
        np.asarray(balance.point(*map(jnp.asarray, curve.point(i)))) for i in (k, k - 1, k + 1)
    )
    null = np.linalg.svd(np.asarray(_slope(balance, here)))[2][-2:]
    along = null @ (behind - before)
    away = np.array([-along[1], along[0]]) @ null / np.linalg.norm(along)
    for fraction in _OFF:
        distance = fraction * float(np.linalg.norm(here[:-1]))
        trials = [
            corrected(balance, here + side * part * distance * away, away)
            for part in (1.0, _CLOSE)
            for side in (-1.0, 1.0)
        ]
        if all(bool(trial.converged) for trial in trials):
            points = [np.asarray(trial.point) for trial in trials]
            return Crossing(here, away, distance, tuple(points[:2]), tuple(points[2:]))
    return None


def _cut(curve: TracedCurve, crossings: Sequence[Crossing]) -> list[TracedCurve]:
    """A curve in pieces between branch points, each from a branch point on."""
    cuts = [
        (k, crossing)
        for k in range(len(curve.points) - 1)
        for crossing in crossings
        if crossing.is_between(curve.points[k : k + 2])
    ]
    if not cuts:
        return [curve] if len(curve.points) > 1 else []
    rows = np.split(np.arange(len(curve.points)), [k + 1 for k, _ in cuts])
    at: list[Crossing | None] = [crossing for _, crossing in cuts]
    if curve.status == CurveStatus.CLOSED:  # the last piece continues in the first
        rows, begins, ends = [*rows[1:-1], np.append(rows[-1], rows[0][1:])], at, [*at[1:], at[0]]
    else:
        begins, ends = [None, *at], [*at, None]
    pieces = [
        _piece(curve, *one) for one in zip(rows, begins, ends, strict=True) if len(one[0]) > 1
    ]
    return pieces


def _piece(
    curve: TracedCurve,
    rows: Int[np.ndarray, " row"],
    begin: Crossing | None,
    end: Crossing | None,
) -> TracedCurve:
    """Rows of a curve with points close to the branch points at its ends, if there are any."""
    points, tangents, status = curve.points[rows], curve.tangents[rows], curve.status
    if begin is None and end is not None:
        points, tangents, begin, end = points[::-1], -tangents[::-1], end, begin
        ends = {CurveStatus.UPPER_END: CurveStatus.LOWER_END}
        status = ends.get(status, status)
    for crossing, place, first in ((begin, 0, 0), (end, len(rows), -1)):
        if crossing is not None:
            close = crossing.close[int(crossing.side(points[first]) > 0)]
            points = np.insert(points, place, close, axis=0)
            tangents = np.insert(tangents, place, tangents[first], axis=0)
    return TracedCurve(points, tangents, status if end is None else CurveStatus.BRANCH_POINT)


@compiled
def _slope(
    balance: HarmonicBalance, point: Float[Array, " unknown"]
) -> Float[Array, "equation unknown"]:
    return balance.linearised(point)[1]


@compiled
def corrected(
    balance: HarmonicBalance, point: Float[Array, " unknown"], across: Float[Array, " unknown"]
) -> Trial:
    """A scaled motion of the balance nearest to `point` in the hyperplane `across`."""
    return correct(balance.linearised, point, across, 1e-10, 30)
