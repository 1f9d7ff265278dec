"""Folds, peaks and phase resonances along curves of periodic motions."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from snrmjax.numerics.blocks import mapped, taken
from snrmjax.numerics.compiled import compiled
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.continuation.continuation import StepControl, correct
from snrmjax.simulate.continuation.event_location import LocatedEvent, locate_event

EVENT_KINDS = ("fold", "peak", "phase_resonance")
_BLOCK = 8  # intervals that one call works on
_INSIDE = 7  # points inside an interval that is looked at more closely


class CurvePoints(NamedTuple):
    """Points along one curve and what was found at them, on the host."""

    points: Float[np.ndarray, "point unknown"]
    tangents: Float[np.ndarray, "point unknown"]
    labels: tuple[str, ...]
    not_located: tuple[str, ...] = ()  # kinds of the events whose place was not found
    multipliers: Complex[np.ndarray, "point multiplier"] | None = None


def mode_velocity(balance: HarmonicBalance, point: Array) -> Complex[Array, ""]:
    """Phasor of the velocity fundamental of the mode of interest, scaled."""
    modes = balance.model.modes
    x = point[:-1].reshape(balance.n_coefficients, -1)[:, modes.mode_of_interest]
    return (
        1j * point[-1] * (x[1] - 1j * x[2]) * jnp.sign(modes.participation[modes.mode_of_interest])
    )


def sensor_velocity(balance: HarmonicBalance, point: Array) -> Float[Array, ""]:
    """|velocity fundamental|² at the first sensor, scaled."""
    shape = balance.model.modes.mode_shape[0]
    x = point[:-1].reshape(balance.n_coefficients, -1) @ shape
    return point[-1] ** 2 * (x[1] ** 2 + x[2] ** 2) / jnp.max(jnp.abs(shape)) ** 2


def test_values(balance: HarmonicBalance, point: Array, tangent: Array) -> Float[Array, " kind"]:
    """Functions that vanish at a fold, at a peak and at a phase resonance."""
    slope = jax.jvp(lambda p: sensor_velocity(balance, p), (point,), (tangent,))[1]
    return jnp.stack([tangent[-1], slope, mode_velocity(balance, point).imag])


@compiled
def _locate(
    balances: HarmonicBalance,
    kind: Array,
    here: Array,
    tangent: Array,
    there: Array,
    wanted: Array,
    steps: StepControl,
) -> LocatedEvent:
    def one(balance: HarmonicBalance, *row: Array) -> LocatedEvent:
        kind, here, tangent, there, wanted = row

        def test(point: Array, direction: Array) -> Array:
            return test_values(balance, point, direction)[kind]

        return locate_event(balance.linearised, test, here, tangent, there, steps, wanted)

    return mapped(one, balances, kind, here, tangent, there, wanted)


@compiled
def _between(
    balances: HarmonicBalance,
    here: Array,
    tangent: Array,
    there: Array,
    arriving: Array,
    share: Array,
    wanted: Array,
    steps: StepControl,
) -> tuple:
    """Points of the curve at shares of the way between neighbours, with their tangents.

    Guessed by the cubic through both neighbours with their tangents.
    """

    def one(balance: HarmonicBalance, *row: Array) -> tuple:
        here, tangent, there, arriving, share, wanted = row
        length = tangent @ (there - here)
        chord = there - here
        early, late = (jnp.linalg.norm(chord) * t - chord for t in (tangent, arriving))
        bend = share * (1 - share) * ((1 - share) * early - share * late)
        guess = here + share * chord + bend
        guess = guess + (share * length - tangent @ (guess - here)) * tangent
        patience = jnp.where(wanted, 2 * steps.iterations, 0)
        found = correct(balance.linearised, guess, tangent, steps.tolerance, patience)
        return found.point, found.tangent, found.converged

    return mapped(one, balances, here, tangent, there, arriving, share, wanted)


def _in_blocks(
    function: Callable[..., tuple],
    balances: HarmonicBalance,
    owner: np.ndarray,
    rows: tuple[np.ndarray, ...],
    steps: StepControl,
) -> list[np.ndarray]:
    """A compiled function of rows, called with blocks of one size."""
    n = len(owner)
    parts = []
    for begin in range(0, n, _BLOCK):
        index = np.minimum(np.arange(begin, begin + _BLOCK), n - 1)
        wanted = np.arange(begin, begin + _BLOCK) < n
        arguments = tuple(row[index] for row in rows)
        mine = taken(balances, owner[index])
        found = function(mine, *arguments, wanted, steps)
        parts.append([np.asarray(part)[: n - begin] for part in found])
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def with_events(
    balances: HarmonicBalance, curves: list[CurvePoints], steps: StepControl
) -> list[CurvePoints]:
    """The curves with their folds, peaks and phase resonances inserted.

    Those that could not be located are named in `not_located`.

    Arguments: `balances` stacked, one for every curve. Between neighbours every change of sign
    is located; where the cubic through both hints at two changes, the interval is divided first.
    A peak is a maximum of the velocity fundamental at the first sensor; a phase resonance has
    the velocity in phase with the force.
    """
    known = [_heights(balances, number, curve) for number, curve in enumerate(curves)]
    divided = _divided(balances, curves, known, steps)
    owner, kind, position = [], [], []
    for number, curve in enumerate(divided):
        if len(curve.points) < 2:
            continue
        same = curve is curves[number]
        heights, slopes = known[number] if same else _heights(balances, number, curve)
        values = np.stack([slopes[:, 0], slopes[:, 1], heights[:, 2]], axis=1)
        change = np.signbit(values[:-1]) != np.signbit(values[1:])
        # A peak is a maximum: the slope falls through zero. A phase resonance has Re V > 0.
        change[:, 1] &= values[:-1, 1] > 0
        change[:, 2] &= (heights[:-1, 3] > 0) & (heights[1:, 3] > 0)
        where, what = np.nonzero(change)
        owner += [number] * len(where)
        kind += what.tolist()
        position += where.tolist()
    if not owner:
        return divided
    here = np.stack([divided[o].points[k] for o, k in zip(owner, position, strict=True)])
    ahead = np.stack([divided[o].tangents[k] for o, k in zip(owner, position, strict=True)])
    there = np.stack([divided[o].points[k + 1] for o, k in zip(owner, position, strict=True)])
    rows = (np.array(kind), here, ahead, there)
    found, tangents, resolved, missed = _in_blocks(_locate, balances, np.array(owner), rows, steps)
    for e in np.flatnonzero(missed).tolist():
        divided[owner[e]] = with_missed(divided[owner[e]], EVENT_KINDS[kind[e]])
    new = [
        NewPoint(owner[e], position[e], found[e], tangents[e], EVENT_KINDS[kind[e]])
        for e in np.flatnonzero(resolved).tolist()
    ]
    return inserted(divided, new)


def _heights(
    balances: HarmonicBalance, number: int, curve: CurvePoints
) -> tuple[np.ndarray, np.ndarray]:
    """λ, sensor velocity and both parts of the mode's velocity, and their slopes in arclength.

    What `sensor_velocity` and `mode_velocity` say, on the host: for a few hundred points that is
    done before a program would have its arguments.
    """
    modes, j = balances.model.modes, balances.model.modes.mode_of_interest
    shape = np.asarray(modes.mode_shape)[number, 0]
    sign = np.sign(np.asarray(modes.participation)[number, j])
    size = (len(curve.points), balances.n_coefficients, len(shape))
    x, dx = (a[:, :-1].reshape(size) for a in (curve.points, curve.tangents))
    omega, domega = curve.points[:, -1], curve.tangents[:, -1]
    shape = shape / np.max(np.abs(shape))
    (a, b), (da, db) = ((part[:, 1:3] @ shape).T for part in (x, dx))
    own, down = sign * x[:, 1:3, j], sign * dx[:, 1:3, j]  # the velocity is Ω(sine + i cosine)
    square = a**2 + b**2
    heights = (omega, omega**2 * square, omega * own[:, 0], omega * own[:, 1])
    slopes = (
        domega,
        2 * omega * domega * square + 2 * omega**2 * (a * da + b * db),
        domega * own[:, 0] + omega * down[:, 0],
        domega * own[:, 1] + omega * down[:, 1],
    )
    return np.stack(heights, axis=1), np.stack(slopes, axis=1)


def _divided(
    balances: HarmonicBalance, curves: list[CurvePoints], known: list[tuple], steps: StepControl
) -> list[CurvePoints]:
    """The curves with points added where two events may lie between neighbours."""
    owner, position, share = [], [], []
    for number, curve in enumerate(curves):
        if len(curve.points) < 2:
            continue
        heights, slopes = known[number]
        length = np.linalg.norm(np.diff(curve.points, axis=0), axis=1)
        doubtful = np.zeros(len(length), dtype=bool)
        for column in range(2):
            doubtful |= _slope_may_vanish_twice(heights[:, column], slopes[:, column], length)
        doubtful |= _may_vanish_twice(heights[:, 2], slopes[:, 2], length)
        for k in np.flatnonzero(doubtful):
            owner += [number] * _INSIDE
            position += [int(k)] * _INSIDE
            share += [(i + 1) / (_INSIDE + 1) for i in range(_INSIDE)]
    if not owner:
        return list(curves)
    found, tangents, ok = points_between(balances, curves, owner, position, share, steps)
    keep = np.flatnonzero(ok).tolist()
    return inserted(
        curves, [NewPoint(owner[k], position[k], found[k], tangents[k], "") for k in keep]
    )


def points_between(
    balances: HarmonicBalance,
    curves: list[CurvePoints],
    owner: list,
    position: list,
    share: list,
    steps: StepControl,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points at shares of the way to the next one, their tangents, and whether they were found."""
    pairs = list(zip(owner, position, strict=True))
    here = np.stack([curves[o].points[k] for o, k in pairs])
    ahead = np.stack([curves[o].tangents[k] for o, k in pairs])
    there = np.stack([curves[o].points[k + 1] for o, k in pairs])
    arriving = np.stack([curves[o].tangents[k + 1] for o, k in pairs])
    rows = (here, ahead, there, arriving, np.array(share))
    found, tangents, ok = _in_blocks(_between, balances, np.array(owner), rows, steps)
    turned = np.einsum("ku,ku->k", tangents, ahead) < 0
    return found, np.where(turned[:, None], -tangents, tangents), ok


def _slope_may_vanish_twice(
    height: np.ndarray, slope: np.ndarray, length: np.ndarray
) -> Bool[np.ndarray, " interval"]:
    """Whether the slope keeps its sign at both ends but the cubic between them turns back."""
    first, last = slope[:-1], slope[1:]
    chord = np.diff(height) / length
    # p'(u) = first + u(6 chord − 4 first − 2 last) + u²(3 first + 3 last − 6 chord), u in 0…1.
    a, b = 3 * (first + last) - 6 * chord, 6 * chord - 4 * first - 2 * last
    with np.errstate(divide="ignore", invalid="ignore"):
        u = -b / (2 * a)
        extreme = first - b**2 / (4 * a)
    same = np.signbit(first) == np.signbit(last)
    least = np.minimum(np.abs(first), np.abs(last))
    # A margin, since the cubic is only near the curve.
    turns = extreme * np.sign(first) < 0.3 * least
    return same & (u > 0) & (u < 1) & turns


def _may_vanish_twice(
    height: np.ndarray, slope: np.ndarray, length: np.ndarray
) -> Bool[np.ndarray, " interval"]:
    """Whether the height keeps its sign at both ends but the cubic between them comes near zero."""
    first, last = height[:-1], height[1:]
    same = np.signbit(first) == np.signbit(last)
    towards = (slope[:-1] * first < 0) & (slope[1:] * last > 0)
    # The tangents from both ends bound a convex piece from below.
    bound = np.minimum(
        np.abs(first) - np.abs(slope[:-1]) * length, np.abs(last) - np.abs(slope[1:]) * length
    )
    return same & towards & (bound < 0)


class NewPoint(NamedTuple):
    """A point to be put between two neighbours of a curve."""

    owner: int  # which curve
    position: int  # the neighbour before it
    point: np.ndarray
    tangent: np.ndarray
    label: str
    multipliers: np.ndarray | None = None


def inserted(curves: list[CurvePoints], new: list[NewPoint]) -> list[CurvePoints]:
    """The curves with new points put in their places, in order along each step."""
    result = list(curves)
    for number in sorted({e.owner for e in new}):
        curve, mine = curves[number], [e for e in new if e.owner == number]
        where = np.array([e.position for e in mine])
        ahead = curve.tangents[where]
        points = np.stack([e.point for e in mine])
        turn = np.stack([e.tangent for e in mine])
        along = np.einsum("ku,ku->k", points - curve.points[where], ahead)
        turn = np.where((np.einsum("ku,ku->k", turn, ahead) < 0)[:, None], -turn, turn)
        n = len(curve.points)
        order = np.lexsort((np.append(np.zeros(n), along), np.append(np.arange(n), where)))
        names = [*curve.labels, *(e.label for e in mine)]
        multipliers = curve.multipliers
        if multipliers is not None:
            multipliers = np.concatenate([multipliers, [e.multipliers for e in mine]])[order]
        result[number] = curve._replace(
            points=np.concatenate([curve.points, points])[order],
            tangents=np.concatenate([curve.tangents, turn])[order],
            labels=tuple(names[k] for k in order),
            multipliers=multipliers,
        )
    return result


def with_missed(curve: CurvePoints, kind: str) -> CurvePoints:
    """The curve with one more event that was not located."""
    return curve._replace(not_located=(*curve.not_located, kind))
