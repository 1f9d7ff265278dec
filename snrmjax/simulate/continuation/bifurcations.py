"""Bifurcations along curves of periodic motions: where a multiplier crosses the unit circle."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.continuation.continuation import CurveEvent, StepControl, TracedCurve
from snrmjax.simulate.continuation.events import (
    NewPoint,
    inserted,
    neighbours_of,
    points_between,
)
from snrmjax.simulate.continuation.stability import MARGIN, many_multipliers

_FOLDS_OWN = 12  # most points between a fold and the crossing of +1 that belongs to it
_CROSSING = 5e-7  # tolerance of the located crossing, as a fraction of a step
_JUMP = 1e-4  # change of a modulus within that tolerance: larger than on any smooth branch
_FRACTIONS = 4  # trial points in an interval, computed as a batch
_ROUNDS = 24  # most refinements; three or four suffice


class _Crossing(NamedTuple):
    """An interval of a curve in which a multiplier crosses the unit circle."""

    owner: int  # which curve
    position: int  # the point before it
    without_one: bool  # ignore crossings of +1: they belong to a fold


def with_bifurcations(
    balances: HarmonicBalance, curves: Sequence[TracedCurve], steps: StepControl
) -> list[TracedCurve]:
    """The curves with points inserted where a multiplier crosses the unit circle.

    A real multiplier through −1 is a period doubling, a complex pair a Neimark-Sacker
    bifurcation, and +1 away from a fold a branch point; multipliers that cross or jump over the
    circle at a fold itself make no separate event. "bifurcation" in `not_located` stands for one
    that could not be located. Arguments: `balances` stacked, one for every curve, whose
    multipliers are known.
    """
    crossings = [
        _Crossing(owner, *crossing)
        for owner, curve in enumerate(curves)
        for crossing in _crossings(curve, np.asarray(curve.multipliers))
    ]
    return _located_bifurcations(balances, list(curves), crossings, steps)


def _crossings(
    curve: TracedCurve, multipliers: Complex[np.ndarray, "point multiplier"]
) -> list[tuple[int, bool]]:
    """The points before crossings, and whether crossings of +1 are ignored there."""
    regular = np.flatnonzero([event != CurveEvent.FOLD for event in curve.events])
    outside, beyond_one = _outside(multipliers), _beyond_one(multipliers)
    rest = outside - beyond_one
    finite = np.all(np.isfinite(multipliers), axis=1)
    first, second = regular[:-1], regular[1:]
    known, plain = finite[first] & finite[second], second == first + 1
    crossings = first[known & plain & (outside[first] != outside[second])].tolist()
    near_fold, quiet_folds = [], []
    passing = np.flatnonzero(known & ~plain)
    for k, following in zip(first[passing].tolist(), second[passing].tolist(), strict=True):
        # At a fold one multiplier crosses +1 anyway; others may cross elsewhere nearby.
        of_the_fold = abs(int(beyond_one[following]) - int(beyond_one[k]))
        if of_the_fold == 0:
            quiet_folds.append(k + 1)
        nearby = [m for m in range(k, following) if rest[m] != rest[m + 1]]
        near_fold += nearby
        crossings += nearby or ([following - 1] if of_the_fold > 1 else [])
    # By truncation of harmonics the computed fold lies slightly off the loss of stability: a
    # crossing of +1 next to a fold without one belongs to that fold.
    for fold in quiet_folds:
        near = [k for k in crossings if abs(k - fold) <= _FOLDS_OWN and _real_plus(multipliers, k)]
        if near:
            crossings.remove(min(near, key=lambda k: abs(k - fold)))
    return [(k, k in near_fold) for k in crossings]


def _real_plus(multipliers: np.ndarray, k: int) -> bool:
    """Whether the multiplier that crosses between a point and the next does so near +1."""
    count = max(_outside(multipliers[k : k + 2]))
    row = multipliers[k + 1] if _outside(multipliers[k + 1]) == count else multipliers[k]
    last = row[np.argsort(-np.abs(row))[count - 1]]
    return bool(abs(last.imag) < 1e-9 * abs(last) and last.real > 0)


def _located_bifurcations(
    balances: HarmonicBalance,
    curves: list[TracedCurve],
    crossings: list[_Crossing],
    steps: StepControl,
) -> list[TracedCurve]:
    """Locate where the last crossing multiplier is on the circle, to a millionth of a step.

    All crossings are located at once, each with four trial points per refinement.
    """
    if not crossings:
        return curves
    owner, before, without_one = (np.array(column) for column in zip(*crossings, strict=True))
    ends = [
        np.stack([np.asarray(curves[o].multipliers)[k + ahead] for o, k, _ in crossings])
        for ahead in (0, 1)
    ]
    last = np.max(
        [_outside(rows) - np.where(without_one, _beyond_one(rows), 0) for rows in ends], axis=0
    )

    def heights(rows: np.ndarray, which: np.ndarray) -> Float[np.ndarray, "crossing trial"]:
        """Modulus minus that of the circle, of the multiplier that is outside at one end only."""
        free = without_one[which, None, None] & _is_beyond_one(rows)
        radius = np.sort(np.where(free, 0.0, np.abs(rows)), axis=-1)
        rank = np.broadcast_to(-last[which, None, None], (*radius.shape[:2], 1))
        return np.take_along_axis(radius, rank, axis=-1)[..., 0] - (1.0 + MARGIN)

    count = len(crossings)
    known = heights(np.stack(ends, axis=1), np.arange(count))
    sense = np.sign(known[:, 1] - known[:, 0])[:, None]
    low, high = np.zeros(count), np.ones(count)
    value_low, value_high = (sense * known).T
    fraction = np.tile(np.arange(1, _FRACTIONS + 1) / (_FRACTIONS + 1), (count, 1))
    # Points known to lie beyond the crossing: at first the neighbours after it.
    neighbours = neighbours_of(curves, owner.tolist(), before.tolist())
    point, tangent = (rows.copy() for rows in neighbours[2:])
    passed, inside, missed = ends[1], np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    for _ in range(_ROUNDS):
        still = np.flatnonzero(high - low > _CROSSING)
        if not still.size:
            break
        which = np.repeat(still, _FRACTIONS)
        owners, ways = owner[which], tuple(rows[which] for rows in neighbours)
        points, tangents, converged = points_between(
            balances, owners, ways, fraction[still].ravel(), steps
        )
        rows = many_multipliers(balances, owners, points)
        known_there = (converged & np.all(np.isfinite(rows), axis=1)).reshape(-1, _FRACTIONS)
        points, tangents, rows = (
            part.reshape(len(still), _FRACTIONS, -1) for part in (points, tangents, rows)
        )
        missed[still] |= ~np.all(known_there, axis=1)
        # A point that did not converge counts as one before the crossing.
        values = np.where(known_there, sense[still] * heights(rows, still), value_low[still, None])
        whole = np.concatenate([low[still, None], fraction[still], high[still, None]], axis=1)
        height = np.concatenate([value_low[still, None], values, value_high[still, None]], axis=1)
        behind = np.argmax(height[:, 1:] > 0, axis=1) + 1
        new = behind <= _FRACTIONS
        inside[still] |= new
        for kept, fresh in ((point, points), (tangent, tangents), (passed, rows)):
            kept[still[new]] = fresh[new, behind[new] - 1]
        at = np.arange(len(still))
        low[still], high[still] = whole[at, behind - 1], whole[at, behind]
        value_low[still], value_high[still] = height[at, behind - 1], height[at, behind]
        fraction[still] = _closer(whole, height, behind)
    located = (high - low <= _CROSSING) & (inside | ~missed)
    # Where a contact or slip sets in the curve has a corner and multipliers may jump over the
    # circle; and a crossing within the tolerance of a fold is not a separate event.
    jumps = value_high - value_low > _JUMP
    own = without_one & (jumps | _at_folds(curves, crossings, low, high))
    new_points = [
        NewPoint(int(o), int(k), point[e], tangent[e], _crossing_kind(passed[e]), passed[e])
        for e, (o, k, _) in enumerate(crossings)
        if located[e] and not own[e]
    ]
    for o in owner[~located].tolist():
        curves[o] = curves[o]._replace(not_located=(*curves[o].not_located, "bifurcation"))
    return inserted(curves, new_points)


def _at_folds(
    curves: list[TracedCurve], crossings: list[_Crossing], low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Which crossings, bracketed in their intervals, coincide with a fold at an end."""
    before, behind = (
        np.array([curves[o].events[k + ahead] == CurveEvent.FOLD for o, k, _ in crossings])
        for ahead in (0, 1)
    )
    return (before & (low <= _CROSSING)) | (behind & (high >= 1.0 - _CROSSING))


def _closer(fraction: np.ndarray, height: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """Four trial positions for the next refinement of a bracket that ends at `behind`.

    Two divide the bracket into thirds. The others lie on either side of the root by inverse cubic
    interpolation, at its distance from the root by the parabola.
    """
    rows = np.arange(len(fraction))
    low, high = fraction[rows, behind - 1], fraction[rows, behind]
    nodes = behind[:, None] + np.array([-1, 0, -2, 1])
    x, y = (
        np.take_along_axis(part, np.clip(nodes, 0, fraction.shape[1] - 1), axis=1)
        for part in (fraction, height)
    )

    def root(count: int) -> np.ndarray:
        """Inverse interpolation with the first `count` nodes."""
        weight = [
            np.prod([y[:, j] / (y[:, j] - y[:, i]) for j in range(count) if j != i], axis=0)
            for i in range(count)
        ]
        return sum(w * x[:, i] for i, w in enumerate(weight))

    with np.errstate(divide="ignore", invalid="ignore"):
        cubic = root(4)
        uncertainty = np.maximum(np.abs(cubic - root(3)), 0.45 * _CROSSING)
    good = (cubic > low) & (cubic < high) & np.isfinite(uncertainty)
    guess = np.where(good, cubic, 0.5 * (low + high))
    uncertainty = np.where(good, uncertainty, 0.45 * _CROSSING)
    third = (high - low) / 3
    trials = [low + third, high - third, guess - uncertainty, guess + uncertainty]
    return np.sort(np.clip(trials, low, high), axis=0).T


def _outside(multipliers: np.ndarray) -> np.ndarray:
    return np.sum(np.abs(multipliers) > 1.0 + MARGIN, axis=-1)


def _beyond_one(multipliers: np.ndarray) -> np.ndarray:
    """How many multipliers are real and beyond +1, as one is after a fold."""
    return np.sum(_is_beyond_one(multipliers), axis=-1)


def _is_beyond_one(multipliers: np.ndarray) -> np.ndarray:
    real = np.abs(multipliers.imag) < 1e-9 * np.abs(multipliers)
    return real & (multipliers.real > 1.0 + MARGIN)


def _crossing_kind(multipliers: Complex[np.ndarray, " multiplier"]) -> CurveEvent:
    """The kind of bifurcation, by the multiplier nearest to the unit circle."""
    nearest = multipliers[np.argmin(np.abs(np.abs(multipliers) - 1.0))]
    # At a crossing of +1 or −1 two multipliers of a lightly damped mode may be close.
    if abs(nearest.imag) > 1e-4:
        return CurveEvent.NEIMARK_SACKER
    return CurveEvent.PERIOD_DOUBLING if nearest.real < 0 else CurveEvent.BRANCH_POINT
