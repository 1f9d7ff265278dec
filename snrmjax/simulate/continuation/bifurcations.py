"""Bifurcations along curves of periodic motions: where a multiplier crosses the unit circle."""

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex

from snrmjax.numerics.blocks import taken
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.continuation.continuation import StepControl
from snrmjax.simulate.continuation.events import (
    CurvePoints,
    NewPoint,
    inserted,
    points_between,
    with_missed,
)
from snrmjax.simulate.continuation.stability import MARGIN, floquet_multipliers

BIFURCATIONS = ("branch_point", "period_doubling", "neimark_sacker")
_FOLDS_OWN = 12  # points from a fold at which its multiplier may cross
_CROSSING = 5e-7  # of a step, to which the crossing of the circle is located


def with_bifurcations(
    balance: HarmonicBalance,
    curve: CurvePoints,
    multipliers: Complex[np.ndarray, "point multiplier"],
    steps: StepControl,
) -> CurvePoints:
    """The curve with the points inserted where a multiplier crosses the unit circle.

    A real multiplier through −1 is a period doubling, a complex pair a Neimark-Sacker
    bifurcation, and +1 away from a fold a branch point; "bifurcation" in `not_located` stands for
    one that could not be located. Returns the curve with the multipliers of all its points.
    `balance` is stacked, of one member.
    """
    curve = curve._replace(multipliers=multipliers)
    regular = np.array([k for k, label in enumerate(curve.labels) if "fold" not in label], int)
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
        own = abs(int(beyond_one[following]) - int(beyond_one[k]))
        if own == 0:
            quiet_folds.append(k + 1)
        beside = [m for m in range(k, following) if rest[m] != rest[m + 1]]
        beside_fold += beside
        crossings += beside or ([following - 1] if own > 1 else [])
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
    curve: CurvePoints,
    crossings: list[int],
    without_one: Bool[np.ndarray, " crossing"],
    steps: StepControl,
) -> CurvePoints:
    """Where the last multiplier that crosses is on the circle, to a millionth of a step.

    Its modulus is interpolated by secants within the bracket, and two points, one on either side of
    where it should cross, make the next one. Where it is to be found `without_one`, crossings of
    +1 do not count.
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

    def trials(shares: np.ndarray, which: np.ndarray) -> list[_Trial]:
        position = [crossings[e] for e in which.tolist()]
        owner = [0] * len(position)
        found, tangents, ok = points_between(
            balance, [curve], owner, position, shares.tolist(), steps
        )
        rows = _multipliers_of(member, found)
        values = heights(rows, which)
        ok = ok & np.isfinite(values)
        values = np.where(ok, values, np.nan)
        parts = zip(shares.tolist(), values.tolist(), ok.tolist(), strict=True)
        return [_Trial(*part, found[k], tangents[k], rows[k]) for k, part in enumerate(parts)]

    every = np.arange(len(crossings))
    brackets = [
        _Bracket(_Trial(0.0, float(first)), _Trial(1.0, float(second)))
        for first, second in zip(*(heights(rows, every) for rows in ends), strict=True)
    ]
    while any(bracket.width > _CROSSING for bracket in brackets):
        open_ones = [e for e, bracket in enumerate(brackets) if bracket.width > _CROSSING]
        shares = np.array([share for e in open_ones for share in brackets[e].next_shares()])
        found = trials(shares, np.repeat(open_ones, 2))
        for k, e in enumerate(open_ones):
            brackets[e] = brackets[e].narrowed(found[2 * k], found[2 * k + 1])
    new = []
    for k, bracket in zip(crossings, brackets, strict=True):
        best = min((bracket.low, bracket.high), key=lambda t: (not t.ok, abs(t.height)))
        if best.ok:
            kind = _crossing_kind(best.multipliers)
            new.append(NewPoint(0, k, best.point, best.tangent, kind, best.multipliers))
        else:
            curve = with_missed(curve, "bifurcation")
    return inserted([curve], new)[0]


class _Trial(NamedTuple):
    """A point of an interval, and how far a multiplier is beyond the circle there."""

    share: float  # of the way through the interval
    height: float
    ok: bool = False  # whether the point was found
    point: np.ndarray = np.zeros(0)
    tangent: np.ndarray = np.zeros(0)
    multipliers: np.ndarray = np.zeros(0)


class _Bracket(NamedTuple):
    """Two points between which a multiplier crosses the circle, and the nearest one outside."""

    low: _Trial
    high: _Trial
    beside: _Trial | None = None
    slow: bool = False  # whether the last estimate hardly narrowed it

    @property
    def width(self) -> float:
        """Share of the interval between both."""
        return self.high.share - self.low.share

    def next_shares(self) -> tuple[float, float]:
        """Where to look next: on both sides of the estimate, or at thirds."""
        low, high, width = self.low.share, self.high.share, self.width
        if self.slow or not np.isfinite(self.high.height - self.low.height):
            return low + width / 3, high - width / 3
        middle, reach = self._estimate(), max(0.05 * width**2, 0.45 * _CROSSING)
        middle = min(max(middle, low + 2 * reach), high - 2 * reach)
        return middle - reach, middle + reach

    def _estimate(self) -> float:
        """The zero of the secant, or of the parabola through three heights, in the share."""
        x0, f0, x1, f1 = *self.low[:2], *self.high[:2]
        secant = x0 - f0 * (x1 - x0) / (f1 - f0)
        if self.beside is None:
            return secant
        x2, f2 = self.beside[:2]
        slope = (f1 - f0) / (x1 - x0)
        bend = ((f2 - f1) / (x2 - x1) - slope) / (x2 - x0)
        # Newton's form: f0 + (x − x0)(slope + bend (x − x1)); one step from the secant's zero.
        value = f0 + (secant - x0) * (slope + bend * (secant - x1))
        steep = slope + bend * (2 * secant - x0 - x1)
        better = secant - value / steep if steep != 0 else secant
        return better if x0 < better < x1 else secant

    def narrowed(self, first: _Trial, second: _Trial) -> "_Bracket":
        """The part of the three in which the sign changes first; unknown points count as low."""
        below = self.low.height <= 0
        row = [self.low, first, second, self.high]
        over = [t.ok and (t.height <= 0) != below for t in row[1:3]] + [True]
        k = over.index(True)
        low, high = row[k], row[k + 1]
        others = [t for t in row if t is not low and t is not high and np.isfinite(t.height)]
        if self.beside is not None:
            others.append(self.beside)
        middle = 0.5 * (low.share + high.share)
        beside = min(others, key=lambda t: abs(t.share - middle))
        slow = not self.slow and high.share - low.share > 0.25 * self.width
        return _Bracket(low, high, beside, slow)


def _outside(multipliers: np.ndarray) -> np.ndarray:
    return np.sum(np.abs(multipliers) > 1.0 + MARGIN, axis=-1)


def _beyond_one(multipliers: np.ndarray) -> np.ndarray:
    """How many multipliers are real and beyond +1, where a fold sends one of them."""
    return np.sum(_is_beyond_one(multipliers), axis=-1)


def _is_beyond_one(multipliers: np.ndarray) -> np.ndarray:
    real = np.abs(multipliers.imag) < 1e-9 * np.abs(multipliers)
    return real & (multipliers.real > 1.0 + MARGIN)


def _multipliers_of(balance: HarmonicBalance, points: np.ndarray) -> np.ndarray:
    size = (balance.n_coefficients, balance.model.n_modes)
    x = points[:, :-1].reshape(-1, *size) * np.asarray(balance.displacement_scale)
    return floquet_multipliers(
        balance.model, x, points[:, -1] * np.asarray(balance.frequency_scale)
    )


def _crossing_kind(multipliers: Complex[np.ndarray, " multiplier"]) -> str:
    """What kind of bifurcation the multiplier nearest to the unit circle makes."""
    nearest = multipliers[np.argmin(np.abs(np.abs(multipliers) - 1.0))]
    # At a crossing of +1 or −1 two multipliers of a light damped mode may be close by.
    if abs(nearest.imag) > 1e-4:
        return "neimark_sacker"
    return "period_doubling" if nearest.real < 0 else "branch_point"
