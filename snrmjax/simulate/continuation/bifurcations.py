"""Bifurcations along curves of periodic motions: where a multiplier crosses the unit circle."""

import itertools

import numpy as np
from jaxtyping import Bool, Complex

from snrmjax.numerics.blocks import taken
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.continuation.continuation import CurveEvent, StepControl, TracedCurve
from snrmjax.simulate.continuation.events import (
    NewPoint,
    inserted,
    points_between,
)
from snrmjax.simulate.continuation.stability import MARGIN, floquet_multipliers

BIFURCATIONS = (
    CurveEvent.BRANCH_POINT,
    CurveEvent.PERIOD_DOUBLING,
    CurveEvent.NEIMARK_SACKER,
)
_FOLDS_OWN = 12  # points from a fold at which its multiplier may cross
_CROSSING = 5e-7  # of a step, to which the crossing of the circle is located


def with_bifurcations(
    balance: HarmonicBalance,
    curve: TracedCurve,
    multipliers: Complex[np.ndarray, "point multiplier"],
    steps: StepControl,
) -> TracedCurve:
    """The curve with the points inserted where a multiplier crosses the unit circle.

    A real multiplier through −1 is a period doubling, a complex pair a Neimark-Sacker
    bifurcation, and +1 away from a fold a branch point; "bifurcation" in `not_located` stands for
    one that could not be located. Returns the curve with the multipliers of all its points.
    `balance` is stacked, of one member.
    """
    curve = curve._replace(multipliers=multipliers)
    regular = np.flatnonzero([event != CurveEvent.FOLD for event in curve.events])
    outside, beyond_one = _outside(multipliers), _beyond_one(multipliers)
    rest = outside - beyond_one
    crossings, beside_fold, quiet_folds = [], [], []
    for k, following in itertools.pairwise(regular.tolist()):
        if not np.all(np.isfinite(multipliers[[k, following]])):
            continue
        if following == k + 1:
            crossings += [k] if outside[k] != outside[following] else []
            continue
        # At a fold one multiplier crosses +1 anyway; others may cross elsewhere beside it.
        of_the_fold = abs(int(beyond_one[following]) - int(beyond_one[k]))
        if of_the_fold == 0:
            quiet_folds.append(k + 1)
        beside = [m for m in range(k, following) if rest[m] != rest[m + 1]]
        beside_fold += beside
        crossings += beside or ([following - 1] if of_the_fold > 1 else [])
    # Truncated harmonics turn the curve a little beside the place where the motion loses its
    # stability: a crossing of +1 next to a fold without one is the fold's own.
    for fold in quiet_folds:
        near = [k for k in crossings if abs(k - fold) <= _FOLDS_OWN and _real_plus(multipliers, k)]
        if near:
            crossings.remove(min(near, key=lambda k: abs(k - fold)))
    if not crossings:
        return curve
    without_one = np.isin(crossings, beside_fold)
    return _located_bifurcations(balance, curve, crossings, without_one, steps)


def _real_plus(multipliers: np.ndarray, k: int) -> bool:
    """Whether the multiplier that crosses between a point and the next does so near +1."""
    count = max(_outside(multipliers[k : k + 2]))
    row = multipliers[k + 1] if _outside(multipliers[k + 1]) == count else multipliers[k]
    last = row[np.argsort(-np.abs(row))[count - 1]]
    return bool(abs(last.imag) < 1e-9 * abs(last) and last.real > 0)


def _located_bifurcations(
    balance: HarmonicBalance,
    curve: TracedCurve,
    crossings: list[int],
    without_one: Bool[np.ndarray, " crossing"],
    steps: StepControl,
) -> TracedCurve:
    """Where the last multiplier that crosses is on the circle, to a millionth of a step.

    Where it is to be found `without_one`, crossings of +1 do not count.
    Reference: T. R. Chandrupatla, Adv. Eng. Softw. 28 (1997) 145,
    doi:10.1016/S0965-9978(96)00051-8.
    """
    member, known = taken(balance, 0), np.asarray(curve.multipliers)
    ends = np.stack([known[crossings], known[np.array(crossings) + 1]])
    counts = _outside(ends) - np.where(without_one, _beyond_one(ends), 0)
    last = np.max(counts, axis=0)

    def heights(rows: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Modulus beyond the circle, of the multiplier that is outside at one end only."""
        free = without_one[which][:, None] & _is_beyond_one(rows)
        radius = np.sort(np.where(free, 0.0, np.abs(rows)), axis=1)
        return radius[np.arange(len(rows)), -last[which]] - (1.0 + MARGIN)

    numbers = np.arange(len(crossings))
    begin, end = (heights(rows, numbers) for rows in ends)

    def motions(share: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, ...]:
        position = [crossings[e] for e in which.tolist()]
        points, tangents, ok = points_between(
            balance, [curve], [0] * len(position), position, share.tolist(), steps
        )
        rows = floquet_multipliers(member.model, *member.motions(points))
        return points, tangents, rows, ok & np.all(np.isfinite(rows), axis=1)

    def height(share: np.ndarray, which: np.ndarray) -> np.ndarray:
        values, inner = np.where(share > 0, end[which], begin[which]), (share > 0) & (share < 1)
        if inner.any():
            *_, rows, ok = motions(share[inner], which[inner])
            # A point that is not found counts as one before the crossing.
            values[inner] = np.where(ok, heights(rows, which[inner]), begin[which[inner]])
        return values

    from scipy.optimize import elementwise  # slow to import

    found = elementwise.find_root(
        *(height, (np.zeros(len(numbers)), np.ones(len(numbers)))),
        args=(numbers,),
        tolerances={"xatol": _CROSSING, "xrtol": 0.0, "fatol": 0.0, "frtol": 0.0},
    )
    points, tangents, rows, ok = motions(found.x, numbers)
    new = []
    for e, k in enumerate(crossings):
        if ok[e] and found.success[e]:
            kind = _crossing_kind(rows[e])
            new.append(NewPoint(0, k, points[e], tangents[e], kind, rows[e]))
        else:
            curve = curve._replace(not_located=(*curve.not_located, "bifurcation"))
    return inserted([curve], new)[0]


def _outside(multipliers: np.ndarray) -> np.ndarray:
    return np.sum(np.abs(multipliers) > 1.0 + MARGIN, axis=-1)


def _beyond_one(multipliers: np.ndarray) -> np.ndarray:
    """How many multipliers are real and beyond +1, where a fold sends one of them."""
    return np.sum(_is_beyond_one(multipliers), axis=-1)


def _is_beyond_one(multipliers: np.ndarray) -> np.ndarray:
    real = np.abs(multipliers.imag) < 1e-9 * np.abs(multipliers)
    return real & (multipliers.real > 1.0 + MARGIN)


def _crossing_kind(multipliers: Complex[np.ndarray, " multiplier"]) -> CurveEvent:
    """What kind of bifurcation the multiplier nearest to the unit circle makes."""
    nearest = multipliers[np.argmin(np.abs(np.abs(multipliers) - 1.0))]
    # At a crossing of +1 or −1 two multipliers of a light damped mode may be close by.
    if abs(nearest.imag) > 1e-4:
        return CurveEvent.NEIMARK_SACKER
    return CurveEvent.PERIOD_DOUBLING if nearest.real < 0 else CurveEvent.BRANCH_POINT
