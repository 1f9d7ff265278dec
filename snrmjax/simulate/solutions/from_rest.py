"""The branches of a response to one force that slow sweeps through a range would visit.

A sweep starts from one of the structure's stable equilibria, at an end of the range or beyond a
resonance outside it. Two of these motions may lie on the same curve.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from snrmjax.model.modes import STILL
from snrmjax.model.moving_base import newtons
from snrmjax.model.structures import Structure, equilibria, linear_terms_of
from snrmjax.numerics.blocks import taken
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.continuation.continuation import CurveStatus, StepControl, TracedCurve
from snrmjax.simulate.continuation.curve_tracing import (
    at_force,
    lies_on,
    motions_at,
    trace_both_ways,
    trace_from_rest,
    under_rising_force,
)
from snrmjax.simulate.continuation.response_curve import Branch

_MARGIN = 0.5  # factor on the criterion that excludes further equilibria in a direction
_NEAR_LINEAR = 0.5  # relative difference from the linear response of a motion from rest
# Resonances outside the range are included where their hysteresis may extend into it: a softening
# mode seldom loses more than a third of its frequency; hardening has no such limit.
_REACH_OF_MODE_ABOVE, _REACH_OF_MODE_BELOW = 1.5, 2.5  # ratios of frequencies
_INSIDE = 0.02  # depth into a gap between stable responses at which others are sought, relative
_SAME = 1e-5  # distance below which scaled points coincide


class CurvesFromRest(NamedTuple):
    """The distinct curves of one member, first one through the whole range if there is one."""

    curves: list[TracedCurve]
    branches: list[Branch]
    has_no_start: bool  # a branch enters at the upper end without a start


def curves_from_rest(
    models: Sequence[Structure],
    balances: HarmonicBalance,
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
    lanes: int,
) -> list[CurvesFromRest]:
    """The curves of every member through a range (rad/s).

    A curve is traced from the linear response, and if that is not near or fails, from the motion
    under a force raised from zero. It is also traced from the upper end if the curve from the
    lower end does not end near the linear response there. Further curves start from further stable
    equilibria, and from beyond resonances outside the range.
    """
    settings = (balances, ends, steps, lanes)
    upward = _from_end(*settings, np.arange(len(models)), downward=False)
    unmatched = [k for k, curve in enumerate(upward) if not _ends_near_rest(balances, k, curve)]
    backward = dict.fromkeys(range(len(models)))
    backward |= zip(
        unmatched, _from_end(*settings, np.array(unmatched, int), downward=True), strict=True
    )
    members = []
    for curve, back in zip(upward, backward.values(), strict=True):
        parts = [curve] if back is None else _joined(curve, back)
        lost = back is not None and not len(back.points) and _is_whole(curve)
        members.append(CurvesFromRest(parts, [Branch.MAIN] * len(parts), lost))
    _add_other_equilibria(models, members, *settings)
    for downward in (False, True):
        _add_from_beyond(members, *settings, downward=downward)
    return [_without_empty(one) for one in members]


def curves_where_sweeps_land(
    balances: HarmonicBalance,
    member: int,
    known: Sequence[Float[np.ndarray, "point unknown"]],
    folds: Sequence[tuple[float, float]],
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
) -> list[TracedCurve]:
    """Further curves of one member on which a sweep lands beyond a fold of the known ones.

    They need not reach an end of the range. Arguments: scaled points of `known` curves; `folds` are
    frequencies (rad/s) of folds and of the other end of the range without stable response. Motions
    are sought just beyond the fold, over a force raised past its value.
    """
    curves: list[TracedCurve] = []
    own = taken(balances, np.array([member]))
    for fold, beyond in folds:
        for point in at_force(own, 0, fold + _INSIDE * (beyond - fold), steps, 1):
            every = [*known, *(one.points for one in curves)]
            if any(lies_on(point, points) for points in every):
                continue
            curve = trace_both_ways(own, point, ends, steps)
            # The point was interpolated: the curve traced from it may be a known one.
            middle = curve.points[len(curve.points) // 2 :][:1]
            if len(middle) and not any(lies_on(middle[0], points) for points in every):
                curves.append(curve)
    return curves


def _from_end(
    balances: HarmonicBalance,
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
    lanes: int,
    index: Int[np.ndarray, " member"],
    *,
    downward: bool,
) -> list[TracedCurve]:
    """Curves from an end: from the linear response there, or from the motion from rest."""
    settings = (ends, steps, lanes)
    curves = trace_from_rest(balances, index, *settings, downward=downward)
    # From a large linear response Newton's method may converge to another solution.
    far = [
        i
        for i, k in enumerate(index)
        if not len(curves[i].points) or not _is_near_rest(balances, k, curves[i].points[0])
    ]
    end = float(ends[int(downward)])
    # If Newton's method from rest and from the linear response agree, the motion is unique.
    small = motions_at(balances, index[far], end, steps, lanes)
    far = [i for i, start in zip(far, small, strict=True) if not _passes(curves[i], start)]
    starts = under_rising_force(balances, index[far], end, steps, lanes)
    new = [
        j
        for j, i in enumerate(far)
        if np.isfinite(starts[j]).all() and not _passes(curves[i], starts[j])
    ]
    again = trace_from_rest(
        balances, index[far][new], *settings, downward=downward, starts=starts[new]
    )
    for j, curve in zip(new, again, strict=True):
        if len(curve.points):
            curves[far[j]] = curve
    return curves


def _joined(curve: TracedCurve, back: TracedCurve) -> list[TracedCurve]:
    """The curve from the lower end and the one from the upper end, which may be the same."""
    if not len(back.points):
        return [curve] if _is_whole(curve) else [curve, back]
    if not len(curve.points) and back.status != CurveStatus.LOWER_END:
        return [curve, back.reversed()]
    if not len(curve.points) or _passes(back, curve.points[0]):
        return [back.reversed()]
    if _passes(curve, back.points[0]):
        return [curve]
    if back.status == CurveStatus.LOWER_END:
        return [back.reversed(), curve]
    return [curve, back if _is_whole(curve) else back.reversed()]


def _without_empty(member: CurvesFromRest) -> CurvesFromRest:
    """Without curves that have no start, if another begins or ends at the lower end.

    A motion that leaves its equilibrium under the rising force settles on one of the others.
    """
    at_lower_end = [
        one.status == CurveStatus.LOWER_END or branch is not Branch.MAIN
        for one, branch in zip(member.curves, member.branches, strict=True)
    ]
    if not any(at_lower_end):
        return member
    kept = [k for k, one in enumerate(member.curves) if len(one.points)]
    return member._replace(
        curves=[member.curves[k] for k in kept], branches=[member.branches[k] for k in kept]
    )


def _add_other_equilibria(
    models: Sequence[Structure],
    members: list[CurvesFromRest],
    balances: HarmonicBalance,
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
    lanes: int,
) -> None:
    """Add new curves from further stable equilibria, from both ends."""
    owners, rests = [], []
    for k in np.flatnonzero(_may_have_other_equilibria(models)).tolist():
        for other in equilibria(models[k]):
            if other.stable and np.any(other.displacement):
                owners.append(k)
                rests.append(other.displacement)
    if not owners:
        return
    index, rest, settings = np.array(owners), np.array(rests), (balances, ends, steps, lanes)
    for downward in (False, True):
        end = float(ends[int(downward)])
        starts = under_rising_force(balances, index, end, steps, lanes, rest=rest)
        _add(members, owners, starts, Branch.EQUILIBRIUM, *settings, downward=downward)


def _may_have_other_equilibria(models: Sequence[Structure]) -> Bool[np.ndarray, " member"]:
    """Whether members may have further equilibria: a quick test for polynomial forces.

    On the line s d through an equilibrium the potential ½ω²s² + V₃(d)s³ + V₄(d)s⁴ is stationary
    there, which requires 9 V₃² ≥ 16 ω² V₄. Tested in many directions d, with a margin.
    """
    potential = models[0].potential
    degrees = [len(monomial) for monomial in potential.monomials]
    if models[0].effects or max(degrees, default=0) > 4:
        return np.ones(len(models), dtype=bool)
    n = models[0].n_modes
    drawn = np.random.default_rng(0).normal(size=(64 if n > 1 else 0, n))
    directions = np.concatenate([np.eye(n), drawn])
    terms = [np.prod(directions[:, list(monomial)], axis=1) for monomial in potential.monomials]
    coefficients = np.array([np.asarray(model.potential.coefficient) for model in models])
    cubic, quartic = (
        sum(
            (
                coefficients[:, k, None] * term
                for k, term in enumerate(terms)
                if degrees[k] == degree
            ),
            np.zeros((len(models), len(directions))),
        )
        for degree in (3, 4)
    )
    stiffness = np.array([np.asarray(linear_terms_of(model).stiffness) for model in models])
    squared = stiffness @ (directions**2).T
    return np.any(9 * cubic**2 > _MARGIN * 16 * squared * quartic, axis=1)


def _add_from_beyond(
    members: list[CurvesFromRest],
    balances: HarmonicBalance,
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
    lanes: int,
    *,
    downward: bool,
) -> None:
    """Add curves that enter the range from beyond a resonance outside it."""
    end = float(ends[int(downward)])
    natural = np.asarray(balances.model.modes.natural_frequency)  # of every member
    # A mass without a linear spring has no natural frequency.
    ratio = (
        natural if downward else np.where(natural > 0, end**2 / np.maximum(natural, 1e-300), 0.0)
    ) / end
    reach = _REACH_OF_MODE_ABOVE if downward else _REACH_OF_MODE_BELOW
    near = (ratio > 1) & (ratio < reach)
    owners = np.flatnonzero(near.any(axis=1)).tolist()
    if not owners:
        return
    # One start for all: well beyond the resonances that may extend in, and short of the next.
    farthest = float(np.max(ratio[near]))
    others = ratio[owners][(ratio[owners] > farthest)]
    away = farthest * np.sqrt(min(np.min(others, initial=2 * farthest) / farthest, 2.0))
    begin = end * away if downward else end / away
    outside = trace_from_rest(
        balances, np.array(owners), np.sort([begin, end]), steps, lanes, downward=downward
    )
    starts = np.full((len(owners), balances.size + 1), np.nan)
    for start, curve in zip(starts, outside, strict=True):
        if curve.status == (CurveStatus.LOWER_END if downward else CurveStatus.UPPER_END):
            start[:] = curve.points[-1]
    settings = (balances, ends, steps, lanes)
    _add(members, owners, starts, Branch.BEYOND, *settings, downward=downward)


def _add(
    members: list[CurvesFromRest],
    owners: Sequence[int],
    starts: Float[np.ndarray, "start unknown"],
    branch: Branch,
    balances: HarmonicBalance,
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
    lanes: int,
    *,
    downward: bool,
) -> None:
    """Add curves through starts at an end that lie on no known curve of their member."""

    def is_new(owner: int, start: np.ndarray) -> bool:
        finite = bool(np.isfinite(start).all())
        return finite and not any(_passes(one, start) for one in members[owner].curves)

    new = [i for i, k in enumerate(owners) if is_new(k, starts[i])]
    index = np.array(owners, dtype=int)[new]
    curves = trace_from_rest(
        balances, index, ends, steps, lanes, downward=downward, starts=starts[new]
    )
    for k, curve in zip(index.tolist(), curves, strict=True):
        if len(curve.points) and is_new(k, curve.points[0]):
            members[k].curves.append(curve.reversed() if downward else curve)
            members[k].branches.append(branch)


def _is_whole(curve: TracedCurve) -> bool:
    return curve.status == CurveStatus.UPPER_END


def _passes(curve: TracedCurve, point: Float[np.ndarray, " unknown"]) -> bool:
    """Whether a curve begins or ends at a point, which lies at an end of the range."""
    return any(
        np.max(np.abs(curve.points[k] - point)) < _SAME for k in (0, -1) if len(curve.points)
    )


def _ends_near_rest(balances: HarmonicBalance, member: int, curve: TracedCurve) -> bool:
    """Whether a curve crosses the whole range and ends near the linear response."""
    return _is_whole(curve) and _is_near_rest(balances, member, curve.points[-1])


def _is_near_rest(
    balances: HarmonicBalance, member: int, point: Float[np.ndarray, " unknown"]
) -> bool:
    """Whether a point is near the linear response."""
    modes, j = balances.model.modes, balances.model.modes.mode_of_interest
    drive = np.asarray(modes.participation)[member]
    own = np.abs(drive[j]) > STILL * np.max(np.abs(drive))
    some = [j] if own else np.flatnonzero(drive)
    natural, damping = (
        np.asarray(part)[member, some] for part in (modes.natural_frequency, modes.damping_ratio)
    )
    omega = float(point[-1] * balances.frequency_scale[member])
    force = newtons(taken(modes, member).unbalance, omega, float(balances.force[member]))
    linear = force * drive[some] / (natural**2 - omega**2 + 2j * damping * natural * omega)
    x = point[:-1].reshape(balances.n_coefficients, -1)[1:3, some]
    fundamental = (x[0] - 1j * x[1]) * float(balances.displacement_scale[member])
    return bool(np.linalg.norm(fundamental - linear) < _NEAR_LINEAR * np.linalg.norm(linear))
