"""Pseudo-arclength continuation of curves of solutions, with steps chosen by curvature."""

from collections.abc import Callable
from enum import StrEnum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.numerics.status import Status

_FARTHEST = 3.0  # steps over the last one, beyond which the cubic is no guess
Point = Float[Array, " unknown"]
Number = float | Array | np.ndarray
Linearised = Callable[[Point], tuple[Float[Array, " equation"], Float[Array, "equation unknown"]]]


class CurveStatus(Status):
    """How a curve ended."""

    UPPER_END = 0, "traced to the upper end of the frequency range"
    LOWER_END = 1, "came back to the lower end of the frequency range"
    POINT_LIMIT = 2, "stopped at the largest number of points; raise `max_points`"
    STEP_TOO_SMALL = (
        3,
        "stopped early: Newton's method fails at the smallest step; use more harmonics or samples",
    )
    NO_START = 4, "no solution at the start; start farther from resonance or lower the force"
    AMPLITUDE_LIMIT = 5, "stopped at the largest amplitude asked for"
    CLOSED = 6, "came back to where it started: an isolated loop"
    INVALID = (
        7,
        "not traced: the force or a parameter of the model is not finite, or the force is zero",
    )


class StepControl(eqx.Module):
    """How a curve is traced: step sizes in the scaled unknowns (order one), and what they pass.

    A step is accepted when Newton's method converges to a point near the guess, where the curve
    has turned little; it is halved otherwise. All but the two whole numbers may change without
    another compilation.
    """

    first: Number = 0.01
    smallest: Number = 1e-7
    largest: Number = 0.05
    angle: Number = 0.1  # rad, aimed at between neighbouring tangents
    tolerance: Number = 1e-9  # on the error that is left after the last Newton step
    kink: Number = 2e-4  # steps below it may turn sharply: a kinked force bends the curve
    # Guesses are cubic, so a solution farther from one than a third of the step is on another
    # part of the curve, or on another curve.
    largest_miss: Number = 0.3  # distance of the solution from the guess, over the step
    kink_miss: Number = 2.0  # the same for steps below `kink`, where the cubic says nothing
    largest_turn: Number = 3.0  # between neighbouring tangents, over `angle`
    # A harmonic that turns its sign within a step has jumped from one flank of a light damped
    # resonance to the other: it changes by twice its norm, on a smooth curve by less than one.
    largest_change: Number = 0.9  # of one harmonic in a step, over its norm
    slight: Number = 0.05  # harmonics below this share of the motion may change as they like
    closing: Number = 0.2  # a closed curve passes its first point nearer than this share of a step
    iterations: int = eqx.field(static=True, default=8)  # of Newton's method, at most
    max_points: int = eqx.field(static=True, default=4000)


class CurveRange(NamedTuple):
    """Where a curve ends: the range of its last unknown, and the largest of the others."""

    lower: Number
    upper: Number
    largest_amplitude: Number = np.inf


class Curve(NamedTuple):
    """Points of one curve; rows from `n_points` on are unused."""

    points: Float[Array, "point unknown"]
    tangents: Float[Array, "point unknown"]
    n_points: Int[Array, ""]
    status: Int[Array, ""]
    n_solves: Int[Array, ""]  # linear systems factorised on the way


class CurveEvent(StrEnum):
    """What happens at a point of a curve, `NONE` at most of them."""

    NONE = ""
    FOLD = "fold"
    PEAK = "peak"
    PHASE_RESONANCE = "phase_resonance"
    BRANCH_POINT = "branch_point"
    PERIOD_DOUBLING = "period_doubling"
    NEIMARK_SACKER = "neimark_sacker"


class TracedCurve(NamedTuple):
    """Points along one curve and what was found at them, on the host."""

    points: Float[np.ndarray, "point unknown"]
    tangents: Float[np.ndarray, "point unknown"]
    status: CurveStatus = CurveStatus.UPPER_END
    n_solves: int = 0
    events: tuple[CurveEvent, ...] = ()  # at the points; none before they were looked for
    not_located: tuple[str, ...] = ()  # kinds of the events whose place was not found
    multipliers: Complex[np.ndarray, "point multiplier"] | None = None

    def reversed(self) -> "TracedCurve":
        """The same curve in the opposite order, without its events."""
        end = {
            CurveStatus.LOWER_END: CurveStatus.UPPER_END,
            CurveStatus.UPPER_END: CurveStatus.LOWER_END,
        }.get(self.status, self.status)
        return TracedCurve(self.points[::-1], -self.tangents[::-1], end, self.n_solves)


def on_host(curve: Curve) -> TracedCurve:
    """A curve without its unused rows."""
    n = int(curve.n_points)
    points, tangents = (np.asarray(rows)[:n].copy() for rows in (curve.points, curve.tangents))
    return TracedCurve(points, tangents, CurveStatus(int(curve.status)), int(curve.n_solves))


class Correction(NamedTuple):
    """Where Newton's method went."""

    point: Point
    tangent: Point  # of unit length, along the direction asked for
    n_solves: Int[Array, ""]
    converged: Bool[Array, ""]


def correct(
    linearised: Linearised,
    start: Point,
    direction: Point,
    tolerance: Number,
    iterations: Number,
) -> Correction:
    """Newton's method in the hyperplane through `start` across `direction`.

    One LU factorisation of the bordered matrix, with both right-hand sides as further columns,
    gives the Newton step and the tangent. Ends when the error that is left falls below
    `tolerance`; it is judged by the last step times what that step left of the residual. The
    tangent belongs to the iterate before the last step.
    """
    size = start.shape[0]

    def body(state: tuple) -> tuple:
        point, _, count, _, _ = state
        residual, jacobian = linearised(point)
        right = jnp.stack([residual, jnp.zeros(size - 1)], axis=1)
        border = jnp.concatenate([direction, jnp.stack([direction @ (point - start), 1.0])])
        matrix = jnp.concatenate([jnp.concatenate([jacobian, right], axis=1), border[None]])
        # The columns behind the square part come out multiplied by the inverse of L.
        factors = jax.lax.linalg.lu(matrix)[0]
        solved = jax.lax.linalg.triangular_solve(
            factors[:, :size], factors[:, size:], left_side=True, lower=False
        )
        new = point - solved[:, 0]
        step = jnp.max(jnp.abs(solved[:, 0]))
        left = jnp.max(jnp.abs(linearised(new)[0])) / jnp.max(jnp.abs(residual))
        done = (step <= tolerance) | ((step * left <= tolerance) & (step < 0.1))
        return new, solved[:, 1], count + 1, done, jnp.isfinite(step)

    def going(state: tuple) -> Array:
        _, _, count, done, finite = state
        return finite & ~done & (count < iterations)

    state = (start, direction, jnp.array(0), jnp.array(False), jnp.array(True))
    point, tangent, count, done, finite = jax.lax.while_loop(going, body, state)
    return Correction(point, tangent / jnp.linalg.norm(tangent), count, done & finite)


def trace_curve(
    linearised: Linearised,
    start: Point,
    direction: Point,
    within: CurveRange,
    control: StepControl,
    *,
    start_across: Point | None = None,
    groups: tuple[int, int] | None = None,
) -> Curve:
    """Trace the curve R(x, λ) = 0 from `start` until λ leaves its range.

    Arguments: `linearised` gives R and its Jacobian; `start` is a guess of the first point,
    corrected at its own λ, or across `start_across`; `direction` says which way to go; `within`
    says where the curve ends. The next point is guessed by the cubic through the last two points
    and their tangents. A step is halved when Newton's method fails, when it ends far from the
    guess, or when the tangent turns by too much (but for a kink, which steps below `control.kink`
    may pass); otherwise it is chosen so that the next turn comes near `control.angle`.
    With `groups` = (rows, columns), into which the first unknowns unfold, no column may change by
    more than `control.largest_change` of its norm in a step: across a light damped resonance the
    response turns its sign, and on the scale of the peak the two flanks far below it are
    neighbours.
    The last point of a curve that left the range lies on its end; that of a closed one is the
    first again.
    Raises `ValueError` when `control.max_points` is below 2.
    Reference: Seydel, Practical Bifurcation and Stability Analysis (2010), chapter 4,
    doi:10.1007/978-1-4419-1740-9.
    """
    max_points, (lower, upper, largest_amplitude) = control.max_points, within
    if max_points < 2:
        raise ValueError(f"`max_points` must be 2 or more, but is {max_points}.")
    size = start.shape[0]
    at_lambda = jnp.zeros(size).at[-1].set(1.0)
    across = at_lambda if start_across is None else start_across
    first, ordinary, to_end = 0, 1, 2  # what the next correction is for
    running = jnp.array(-1)

    def body(state: _Walk) -> _Walk:
        n, here, tangent = state.n_points, state.here, state.tangent
        guess = _extrapolated(state.back, state.back_tangent, here, tangent, state.step, n >= 2)
        row = tangent
        is_first, is_end = state.aim == first, state.aim == to_end
        guess = jnp.where(is_first, start, jnp.where(is_end, state.pending, guess))
        row = jnp.where(is_first, across, jnp.where(is_end, at_lambda, row))
        patience = jnp.where(is_first | is_end, 5 * control.iterations, control.iterations)
        found = correct(linearised, guess, row, control.tolerance, patience)
        new = found.point
        ahead = jnp.where(is_first, direction, tangent)
        new_tangent = found.tangent * jnp.where(found.tangent @ ahead < 0, -1.0, 1.0)

        turn = jnp.arccos(jnp.clip(new_tangent @ tangent, -1.0, 1.0))
        miss = jnp.linalg.norm(new - guess)
        smooth = miss < control.largest_miss * state.step
        smooth &= turn < control.largest_turn * control.angle
        kinked = (state.step < control.kink) & (turn < 0.5 * jnp.pi)
        kinked &= miss < control.kink_miss * state.step
        near = (smooth | kinked) & _steady(here, new, groups, control)
        good = found.converged & (is_first | is_end | near)
        beyond_upper, beyond_lower = new[-1] > upper, new[-1] < lower
        leaving = good & (beyond_upper | beyond_lower) & (state.aim == ordinary)
        end = jnp.where(beyond_upper, upper, lower)
        share = (end - here[-1]) / (new[-1] - here[-1])
        pending = jnp.where(leaving, (here + share * (new - here)).at[-1].set(end), state.pending)
        origin = state.origin
        on_the_way = tangent @ (origin - here)
        closed = good & (n > 4) & (on_the_way > 0) & (on_the_way <= tangent @ (new - here))
        closed &= jnp.linalg.norm(origin - here) <= 2.0 * on_the_way
        closed &= new_tangent @ state.origin_tangent > 0.5
        # A point that only happens to lie on the way has others where the curve passes it.
        passed = here + on_the_way / jnp.maximum(tangent @ (new - here), 1e-300) * (new - here)
        gap = jnp.linalg.norm(passed - origin)
        closed &= gap < control.closing * jnp.linalg.norm(new - here)
        new = jnp.where(closed, origin, new)
        keep = good & ~leaving
        place = jnp.where(is_first, 0, n)
        # Rows are only written here, never read, so that the loop need not copy them; a row that
        # is not kept is written again later, or is beyond the last.
        points = state.points.at[place].set(jnp.where(keep, new, jnp.nan))
        tangents = state.tangents.at[place].set(jnp.where(keep, new_tangent, jnp.nan))
        n = jnp.where(is_first, 1, n + keep)
        grow = jnp.clip(control.angle / jnp.maximum(turn, 1e-3), 0.5, 2.0)
        grow = jnp.where(found.n_solves >= 4, jnp.minimum(grow, 0.7), grow)
        factor = jnp.where(good, grow, 0.5)
        longest = jnp.minimum(state.step * factor, control.largest)
        step = jnp.where(is_first | leaving, state.step, longest)
        largest_now = jnp.max(jnp.abs(new[:-1]))
        ends = (
            (is_first & ~good, CurveStatus.NO_START),
            (is_end & good & (new[-1] >= upper), CurveStatus.UPPER_END),
            (is_end & good & (new[-1] <= lower), CurveStatus.LOWER_END),
            (closed & keep, CurveStatus.CLOSED),
            (keep & ~is_first & (largest_now > largest_amplitude), CurveStatus.AMPLITUDE_LIMIT),
            (step < control.smallest, CurveStatus.STEP_TOO_SMALL),
            (n >= max_points, CurveStatus.POINT_LIMIT),
        )
        status = running
        for happened, what in reversed(ends):
            status = jnp.where(happened, int(what), status)
        aim = jnp.where(leaving, to_end, ordinary)
        return _Walk(
            points=points,
            tangents=tangents,
            here=jnp.where(keep, new, here),
            tangent=jnp.where(keep, new_tangent, tangent),
            back=jnp.where(keep, here, state.back),
            back_tangent=jnp.where(keep, tangent, state.back_tangent),
            origin=jnp.where(is_first, new, origin),
            origin_tangent=jnp.where(is_first, new_tangent, state.origin_tangent),
            pending=pending,
            n_points=n,
            step=step,
            aim=aim,
            status=status,
            n_solves=state.n_solves + found.n_solves,
        )

    unset = jnp.full((max_points, size), jnp.nan)
    walk = _Walk(
        points=unset,
        tangents=unset,
        here=start,
        tangent=direction,
        back=start,
        back_tangent=direction,
        origin=start,
        origin_tangent=direction,
        pending=start,
        n_points=jnp.array(1),
        step=jnp.minimum(jnp.asarray(control.first), control.largest),
        aim=jnp.array(first),
        status=running,
        n_solves=jnp.array(0),
    )
    walk = jax.lax.while_loop(lambda state: state.status == running, body, walk)
    started = walk.status != int(CurveStatus.NO_START)
    n_points = jnp.where(started, walk.n_points, 0)
    return Curve(walk.points, walk.tangents, n_points, walk.status, walk.n_solves)


def _steady(
    here: Point, new: Point, groups: tuple[int, int] | None, control: StepControl
) -> Bool[Array, ""]:
    """Whether no column of the unknowns changes by most of itself."""
    if groups is None:
        return jnp.array(True)
    rows, columns = groups
    old, now = (point[: rows * columns].reshape(rows, columns) for point in (here, new))
    norms = [jnp.linalg.norm(part, axis=0) for part in (old, now, now - old)]
    largest = jnp.maximum(norms[0], norms[1])
    slight = control.slight * jnp.linalg.norm(largest)
    return jnp.all((norms[2] <= control.largest_change * largest) | (largest <= slight))


class _Walk(NamedTuple):
    """The state of a curve that is being traced."""

    points: Array
    tangents: Array
    here: Array
    tangent: Array
    back: Array
    back_tangent: Array
    origin: Array
    origin_tangent: Array
    pending: Array
    n_points: Array
    step: Array
    aim: Array
    status: Array
    n_solves: Array


def _extrapolated(
    back: Point, back_tangent: Point, here: Point, tangent: Point, step: Array, known: Array
) -> Point:
    """Where the cubic through two points and their tangents is, a step behind the second."""
    gap = jnp.where(known, jnp.linalg.norm(here - back), 1.0)
    share = jnp.where(known, step / gap, 0.0)
    chord = (here - back) / gap
    # here + step·t + (step²)·a + (step² · (step + gap))·b, from Hermite's divided differences.
    second = (tangent - chord) / gap
    third = (tangent - 2 * chord + back_tangent) / gap**2
    bend = step**2 * (second + (step + gap) * third)
    trusted = known & (share < _FARTHEST)
    return here + step * tangent + jnp.where(trusted, bend, 0.0)
