"""Folds, peaks and phase resonances along curves of periodic motions."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from snrmjax.model.modes import STILL
from snrmjax.numerics.blocks import over_cores, taken
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.lanes import TOGETHER, StateRows, in_lanes, in_rows, iterated, lanes_for
from snrmjax.numerics.newton import correct
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.continuation.continuation import CurveEvent, StepControl, TracedCurve
from snrmjax.simulate.continuation.event_location import Bracket, EventSearch

EVENT_KINDS = (CurveEvent.FOLD, CurveEvent.PEAK, CurveEvent.PHASE_RESONANCE)
_INSIDE = 7  # points added inside an interval that is refined
_MANY = 8  # factor on the number of lanes, if there are enough points


def velocities_along(
    balance: HarmonicBalance,
    points: Float[Array | np.ndarray, "*point unknown"],
    tangents: Float[Array | np.ndarray, "*point unknown"],
) -> tuple[Float[Array, "*point 4"], Float[Array, "*point 4"]]:
    """Test quantities of events and their derivatives by arclength, of one point or many.

    λ, |velocity fundamental|² at the first sensor, and the parts of that of the mode of interest a
    quarter period ahead of the force and in phase with it, all scaled. NumPy arrays are computed on
    the host: for a few hundred points that is faster than a call of a program.
    """
    xp: Any = np if isinstance(points, np.ndarray) else jnp
    modes, j = balance.model.modes, balance.model.modes.mode_of_interest
    shape = modes.mode_shape[0] / xp.max(xp.abs(modes.mode_shape[0]))
    drive = xp.abs(modes.participation)
    drive = drive / xp.maximum(xp.max(drive), np.finfo(float).tiny)
    # If the force does not drive the mode of interest, the driven modes define the phase.
    of_interest = np.eye(balance.model.n_modes)[j]
    weight = xp.sign(modes.participation) * xp.where(drive[j] > STILL, of_interest, drive)
    shape_of_pairs = (*points.shape[:-1], balance.n_coefficients, balance.model.n_modes)
    pairs, rates = (
        rows[..., :-1].reshape(shape_of_pairs)[..., 1:3, :] for rows in (points, tangents)
    )
    omega, faster = points[..., -1], tangents[..., -1]
    seen, change = pairs @ shape, rates @ shape
    square = xp.sum(seen**2, axis=-1)
    growth = 2 * omega * (faster * square + omega * xp.sum(seen * change, axis=-1))
    # The velocity is Ω (sine + i cosine).
    modal, rate = pairs @ weight, rates @ weight
    parts = omega[..., None] * modal
    slopes = faster[..., None] * modal + omega[..., None] * rate
    return (
        xp.concatenate([xp.stack([omega, omega**2 * square], axis=-1), parts], axis=-1),
        xp.concatenate([xp.stack([faster, growth], axis=-1), slopes], axis=-1),
    )


def height(balance: HarmonicBalance, point: Float[Array, " unknown"]) -> Float[Array, ""]:
    """|velocity fundamental|² at the first sensor, scaled."""
    return velocities_along(balance, point, jnp.zeros_like(point))[0][1]


def quadrature(balance: HarmonicBalance, point: Float[Array, " unknown"]) -> Float[Array, ""]:
    """The part of the mode's velocity a quarter period ahead of the force, scaled."""
    return velocities_along(balance, point, jnp.zeros_like(point))[0][2]


def sign_changes(heights: Any, slopes: Any) -> list[Any]:
    """What changes sign at each of `EVENT_KINDS` along a curve, given `velocities_along`."""
    return [slopes[..., 0], slopes[..., 1], heights[..., 2]]


def _search(job: tuple, steps: StepControl) -> EventSearch:
    balance, kind, here, tangent, there = job

    def test(point: Array, direction: Array) -> Array:
        return jnp.stack(sign_changes(*velocities_along(balance, point, direction)))[kind]

    return EventSearch(balance.linearised, test, here, tangent, there, steps)


@compiled
def _initial(jobs: tuple, wanted: Bool[Array, " lane"], steps: StepControl) -> StateRows:
    def initial(job: tuple, wanted: Array) -> Bracket:
        return _search(job, steps).initial()._replace(ended=~wanted)

    return in_rows(jax.vmap(initial)(jobs, wanted))


@compiled
def _advanced(
    jobs: tuple, states: StateRows, steps: StepControl, idle: Int[Array, ""]
) -> tuple[StateRows, tuple, tuple]:
    def result(end: Bracket) -> tuple:
        return ~end.ended, end.last.point, end.last.tangent, end.resolved, end.missed

    def step(job: tuple, state: Bracket) -> tuple[Bracket, tuple]:
        return _search(job, steps).advanced(state), (jnp.array(False),)

    return iterated(
        lambda j: _search(j, steps).initial(), step, result, jobs, states, TOGETHER, idle
    )


def _searched(jobs: tuple, steps: StepControl) -> tuple[np.ndarray, ...]:
    """Event searches of jobs (balance, kind, neighbour, its tangent, other neighbour).

    Returns last points and tangents, whether they are events, and whether events were missed.
    """

    def initial(jobs: tuple, wanted: Bool[np.ndarray, " lane"]) -> StateRows:
        return _initial(jobs, wanted, steps)

    def advanced(jobs: tuple, states: StateRows, idle: int) -> tuple[StateRows, tuple, tuple]:
        return _advanced(jobs, states, steps, np.array(idle))

    return in_lanes(initial, advanced, jobs, lanes_for(jobs[0].size + 1))[0]


@compiled
def _between(
    balances: HarmonicBalance,
    here: Array,
    tangent: Array,
    there: Array,
    arriving: Array,
    fraction: Array,
    steps: StepControl,
) -> tuple:
    """Points of the curve at fractions of the interval between neighbours, with tangents.

    The guesses are those of the cubic through both neighbours with their tangents.
    """

    def corrected(balance: HarmonicBalance, *row: Array) -> tuple:
        here, tangent, there, arriving, fraction = row
        length = tangent @ (there - here)
        chord = there - here
        early, late = (jnp.linalg.norm(chord) * t - chord for t in (tangent, arriving))
        curvature = fraction * (1 - fraction) * ((1 - fraction) * early - fraction * late)
        guess = here + fraction * chord + curvature
        guess = guess + (fraction * length - tangent @ (guess - here)) * tangent
        solution = correct(
            balance.linearised, guess, tangent, steps.tolerance, 2 * steps.iterations
        )
        return solution.point, solution.tangent, solution.converged

    return jax.vmap(corrected)(balances, here, tangent, there, arriving, fraction)


def with_events(
    balances: HarmonicBalance, curves: list[TracedCurve], steps: StepControl
) -> list[TracedCurve]:
    """The curves with their folds, peaks and phase resonances inserted.

    Those that could not be located are named in `not_located`.

    Arguments: `balances` stacked, one for every curve. Every sign change between neighbours is
    located; where the cubic through both suggests two, the interval is subdivided first. A peak is
    a maximum of the velocity fundamental at the first sensor; at a phase resonance the velocity is
    in phase with the force.
    """

    def heights_of(number: int, curve: TracedCurve) -> tuple:
        return velocities_along(taken(balances, number), curve.points, curve.tangents)

    known = [heights_of(number, curve) for number, curve in enumerate(curves)]
    divided = _divided(balances, curves, known, steps)
    owner, kind, position = [], [], []
    for number, curve in enumerate(divided):
        if len(curve.points) < 2:
            continue
        same = curve is curves[number]
        heights, slopes = known[number] if same else heights_of(number, curve)
        values = np.stack(sign_changes(heights, slopes), axis=1)
        change = np.signbit(values[:-1]) != np.signbit(values[1:])
        # A peak is a maximum: the slope falls through zero. A phase resonance has Re V > 0.
        change[:, 1] &= values[:-1, 1] > 0
        change[:, 2] &= (heights[:-1, 3] > 0) & (heights[1:, 3] > 0)
        # The fundamental of a subharmonic motion has another frequency than the force.
        change[:, 2] &= balances.subharmonic == 1
        where, what = np.nonzero(change)
        owner += [number] * len(where)
        kind += what.tolist()
        position += where.tolist()
    if not owner:
        return divided
    here, ahead, there, _ = neighbours_of(divided, owner, position)
    jobs = (taken(balances, np.array(owner)), np.array(kind), here, ahead, there)
    located, tangents, resolved, missed = _searched(jobs, steps)
    for e in np.flatnonzero(missed).tolist():
        curve = divided[owner[e]]
        missed_too = (*curve.not_located, EVENT_KINDS[kind[e]])
        divided[owner[e]] = curve._replace(not_located=missed_too)
    new = [
        NewPoint(owner[e], position[e], located[e], tangents[e], EVENT_KINDS[kind[e]])
        for e in np.flatnonzero(resolved).tolist()
    ]
    return inserted(divided, new)


def _divided(
    balances: HarmonicBalance, curves: list[TracedCurve], known: list[tuple], steps: StepControl
) -> list[TracedCurve]:
    """The curves with points added where two events may lie between neighbours."""
    owner, position, fraction = [], [], []
    for number, curve in enumerate(curves):
        if len(curve.points) < 2:
            continue
        heights, slopes = known[number]
        length = np.linalg.norm(np.diff(curve.points, axis=0), axis=1)
        suspect = np.zeros(len(length), dtype=bool)
        for column in range(2):
            suspect |= _slope_may_vanish_twice(heights[:, column], slopes[:, column], length)
        suspect |= _may_vanish_twice(heights[:, 2], slopes[:, 2], length)
        for k in np.flatnonzero(suspect):
            owner += [number] * _INSIDE
            position += [int(k)] * _INSIDE
            fraction += [(i + 1) / (_INSIDE + 1) for i in range(_INSIDE)]
    if not owner:
        return list(curves)
    between = neighbours_of(curves, owner, position)
    added, tangents, ok = points_between(
        balances, np.array(owner), between, np.array(fraction), steps
    )
    keep = np.flatnonzero(ok).tolist()
    return inserted(
        curves,
        [NewPoint(owner[k], position[k], added[k], tangents[k], CurveEvent.NONE) for k in keep],
    )


def points_between(
    balances: HarmonicBalance,
    owner: Int[np.ndarray, " point"],
    neighbours: tuple[np.ndarray, ...],
    fraction: Float[np.ndarray, " point"],
    steps: StepControl,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points at fractions of intervals between neighbours, tangents, and whether they converged.

    Arguments: `owner` is the index of each point's balance, `neighbours` are its own.
    """
    n, ahead, rows = len(owner), neighbours[1], (*neighbours, fraction)
    lanes = lanes_for(balances.size + 1)
    lanes *= _MANY if n >= _MANY * lanes else 1

    def corrected(begin: int) -> list[np.ndarray]:
        index = np.minimum(np.arange(begin, begin + lanes), n - 1)
        mine = taken(balances, owner[index])
        solutions = _between(mine, *(row[index] for row in rows), steps)
        return [np.asarray(part)[: n - begin] for part in solutions]

    parts = over_cores(corrected, range(0, n, lanes))
    points, tangents, ok = (np.concatenate(column) for column in zip(*parts, strict=True))
    reversed_ = np.einsum("ku,ku->k", tangents, ahead) < 0
    return points, np.where(reversed_[:, None], -tangents, tangents), ok


def neighbours_of(
    curves: list[TracedCurve], owner: Sequence[int], position: Sequence[int]
) -> tuple[np.ndarray, ...]:
    """Points and tangents at positions on curves, then those of the next points."""
    pairs = list(zip(owner, position, strict=True))
    return tuple(
        np.stack([(curves[o].points, curves[o].tangents)[which][k + ahead] for o, k in pairs])
        for ahead in (0, 1)
        for which in (0, 1)
    )


def _slope_may_vanish_twice(
    height: np.ndarray, slope: np.ndarray, length: np.ndarray
) -> Bool[np.ndarray, " interval"]:
    """Whether the slope has one sign at both ends but may vanish on the cubic in between."""
    first, last = slope[:-1], slope[1:]
    chord = np.diff(height) / length
    # p'(u) = first + u(6 chord − 4 first − 2 last) + u²(3 first + 3 last − 6 chord), u in 0…1.
    a, b = 3 * (first + last) - 6 * chord, 6 * chord - 4 * first - 2 * last
    with np.errstate(divide="ignore", invalid="ignore"):
        u = -b / (2 * a)
        extreme = first - b**2 / (4 * a)
    same = np.signbit(first) == np.signbit(last)
    least = np.minimum(np.abs(first), np.abs(last))
    # With a margin, since the cubic only approximates the curve.
    vanishes = extreme * np.sign(first) < 0.3 * least
    return same & (u > 0) & (u < 1) & vanishes


def _may_vanish_twice(
    height: np.ndarray, slope: np.ndarray, length: np.ndarray
) -> Bool[np.ndarray, " interval"]:
    """Whether the height has one sign at both ends but may vanish in between."""
    first, last = height[:-1], height[1:]
    same = np.signbit(first) == np.signbit(last)
    towards = (slope[:-1] * first < 0) & (slope[1:] * last > 0)
    # The tangents at both ends bound a convex piece from below.
    bound = np.minimum(
        np.abs(first) - np.abs(slope[:-1]) * length, np.abs(last) - np.abs(slope[1:]) * length
    )
    return same & towards & (bound < 0)


class NewPoint(NamedTuple):
    """A point to be inserted between two neighbours of a curve."""

    owner: int  # which curve
    position: int  # the neighbour before it
    point: np.ndarray
    tangent: np.ndarray
    event: CurveEvent
    multipliers: np.ndarray | None = None


def inserted(curves: list[TracedCurve], new: list[NewPoint]) -> list[TracedCurve]:
    """The curves with new points inserted, in order along each step."""
    result = list(curves)
    for number in sorted({e.owner for e in new}):
        curve, mine = curves[number], [e for e in new if e.owner == number]
        where = np.array([e.position for e in mine])
        ahead = curve.tangents[where]
        points = np.stack([e.point for e in mine])
        tangents = np.stack([e.tangent for e in mine])
        along = np.einsum("ku,ku->k", points - curve.points[where], ahead)
        tangents = np.where(
            (np.einsum("ku,ku->k", tangents, ahead) < 0)[:, None], -tangents, tangents
        )
        n = len(curve.points)
        order = np.lexsort((np.append(np.zeros(n), along), np.append(np.arange(n), where)))
        events = [*curve.events, *(e.event for e in mine)]
        multipliers = curve.multipliers
        if multipliers is not None:
            multipliers = np.concatenate([multipliers, [e.multipliers for e in mine]])[order]
        result[number] = curve._replace(
            points=np.concatenate([curve.points, points])[order],
            tangents=np.concatenate([curve.tangents, tangents])[order],
            events=tuple(events[k] for k in order),
            multipliers=multipliers,
        )
    return result
