"""Pseudo-arclength continuation of curves of solutions, with steps chosen by curvature."""

from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

Point = Float[Array, " unknown"]
Number = float | Array | np.ndarray
Linearised = Callable[[Point], tuple[Float[Array, " equation"], Float[Array, "equation unknown"]]]


class CurveStatus(IntEnum):
    """How a curve ended."""

    UPPER_END = 0  # left the range of the last unknown at its upper end
    LOWER_END = 1  # left it at its lower end
    POINT_LIMIT = 2  # used up the points it was given
    STEP_TOO_SMALL = 3  # Newton's method failed even for the smallest step
    NO_START = 4  # no solution was found to start from
    AMPLITUDE_LIMIT = 5  # grew past the largest amplitude asked for
    CLOSED = 6  # came back to its first point: an isolated loop
    INVALID = 7  # asked for with numbers that are no structure or no force


STATUS_MESSAGE: dict[CurveStatus, str] = {
    CurveStatus.UPPER_END: "followed to the upper end of the frequency range",
    CurveStatus.LOWER_END: "came back to the lower end of the frequency range",
    CurveStatus.POINT_LIMIT: "stopped at the largest number of points; raise `max_points`",
    CurveStatus.STEP_TOO_SMALL: (
        "stopped early: Newton's method fails at the smallest step; use more harmonics or samples"
    ),
    CurveStatus.NO_START: (
        "no solution at the start; start farther from resonance or lower the force"
    ),
    CurveStatus.AMPLITUDE_LIMIT: "stopped at the largest amplitude asked for",
    CurveStatus.INVALID: (
        "not followed: the force or a parameter of the model is not finite, or the force is zero"
    ),
    CurveStatus.CLOSED: "came back to where it started: an isolated loop",
}


class StepControl(NamedTuple):
    """Step sizes along the curve, in the scaled unknowns (order one)."""

    first: Number = 0.01
    smallest: Number = 1e-7
    largest: Number = 0.05
    angle: Number = 0.1  # rad, aimed at between neighbouring tangents
    tolerance: Number = 1e-9  # on the error that is left after the last Newton step
    iterations: Number = 8
    kink: Number = 2e-4  # steps below it may turn sharply: a kinked force bends the curve


def traced(control: StepControl) -> StepControl:
    """The same settings as arrays, so that other numbers do not compile anew."""
    return StepControl(*(np.asarray(value) for value in control))


class Curve(NamedTuple):
    """Points of one curve; rows from `n_points` on are unused."""

    points: Float[Array, "point unknown"]
    tangents: Float[Array, "point unknown"]
    n_points: Int[Array, ""]
    status: Int[Array, ""]
    n_solves: Int[Array, ""]  # linear systems factorised on the way


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


def follow_curve(
    linearised: Linearised,
    start: Point,
    direction: Point,
    lower: Float[Array, ""],
    upper: Float[Array, ""],
    largest_amplitude: Float[Array, ""],
    control: StepControl,
    max_points: int,
    start_across: Point | None = None,
    groups: tuple[int, int] | None = None,
) -> Curve:
    """Follow a curve of solutions of R(x, λ) = 0 from `start` until λ leaves [lower, upper].

    Arguments: `linearised` gives R and its Jacobian; `start` is a guess of the first point,
    corrected at its own λ, or across `start_across`; `direction` says which way to go. The next
    point is guessed by the cubic through the last two points and their tangents. A step is
    halved when Newton's method fails, when it ends far from the guess, or when the tangent turns
    by more than three times `control.angle` (but for a kink, which steps below `control.kink`
    may pass); otherwise it is chosen so that the next turn comes near `control.angle`.
    With `groups` = (rows, columns), into which the first unknowns unfold, no column may change by
    more than nine tenths of its norm in a step: across a light damped resonance the response turns
    its sign, and on the scale of the peak the two flanks far below it are neighbours.
    The last point of a curve that left the range lies on its end; that of a closed one is the
    first again.
    Raises `ValueError` when `max_points` is below 2.
    """
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
        smooth = (miss < 0.3 * state.step) & (turn < 3 * control.angle)
        kinked = (state.step < control.kink) & (miss < 2 * state.step) & (turn < 0.5 * jnp.pi)
        near = (smooth | kinked) & _steady(here, new, groups)
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
        closed &= jnp.linalg.norm(passed - origin) < 0.2 * jnp.linalg.norm(new - here)
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


def _steady(here: Point, new: Point, groups: tuple[int, int] | None) -> Bool[Array, ""]:
    """Whether no column of the unknowns changes by most of itself."""
    if groups is None:
        return jnp.array(True)
    rows, columns = groups
    old, now = (point[: rows * columns].reshape(rows, columns) for point in (here, new))
    norms = [jnp.linalg.norm(part, axis=0) for part in (old, now, now - old)]
    largest = jnp.maximum(norms[0], norms[1])
    # What is small beside the motion as a whole may turn as it likes.
    slight = 0.05 * jnp.linalg.norm(largest)
    return jnp.all((norms[2] <= 0.9 * largest) | (largest <= slight))


class _Walk(NamedTuple):
    """The state of a curve that is being followed."""

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
    trusted = known & (share < 3.0)
    return here + step * tangent + jnp.where(trusted, bend, 0.0)


def locate_event(
    linearised: Linearised,
    test: Callable[[Point, Point], Float[Array, ""]],
    here: Point,
    tangent: Point,
    there: Point,
    control: StepControl,
    wanted: Bool[Array, ""] | bool = True,
) -> tuple[Point, Point, Bool[Array, ""]]:
    """The point between two neighbours where `test(point, tangent)` changes sign.

    Illinois' variant of the secant method in the arclength, each trial corrected across the
    tangent. Returns the point, its tangent and whether the sign change was resolved between the
    neighbours, or beside them by less than the tangents of a curve are late. Where it is not
    `wanted` nothing is computed.
    """
    length = tangent @ (there - here)
    trials = 40

    def trial(share: Array, guess: Point) -> tuple[_Known, Bool[Array, ""]]:
        guess = guess + (share * length - tangent @ (guess - here)) * tangent
        found = correct(
            linearised, guess, tangent, 1e-3 * control.tolerance, 2 * control.iterations
        )
        # With the slope against the share of the way the curve between two trials is a cubic.
        slope = found.tangent * (length / (tangent @ found.tangent))
        value = test(found.point, found.tangent)
        return _Known(share, value, found.point, found.tangent, slope), found.converged

    def body(state: tuple) -> tuple:
        count, low, high, side, share, _, _, _ = state
        is_low, is_high = count == 0, count == 1
        guess = jnp.where(is_low, here, jnp.where(is_high, there, _cubic(low, high, share)))
        found, converged = trial(share, guess)
        inner = ~is_low & ~is_high
        in_upper = inner & (jnp.sign(found.value) == jnp.sign(low.value))
        in_lower = inner & ~in_upper
        halved = jnp.where(in_lower & (side == -1), 0.5, 1.0)
        low = low._replace(value=low.value * halved)
        halved = jnp.where(in_upper & (side == 1), 0.5, 1.0)
        high = high._replace(value=high.value * halved)
        low = _chosen(in_upper | is_low, found, low)
        high = _chosen(in_lower | is_high, found, high)
        side = jnp.where(in_upper, 1, jnp.where(in_lower, -1, 0))
        secant = (low.share * high.value - high.share * low.value) / (high.value - low.value)
        secant = jnp.where(jnp.isfinite(secant), secant, 0.5 * (low.share + high.share))
        next_share = jnp.where(is_low, 1.0, secant)
        settled = (inner & (jnp.abs(next_share - share) < 1e-12)) | (inner & (found.value == 0))
        share = jnp.where(settled, share, next_share)
        return count + 1, low, high, side, share, found, converged, settled

    zero = jnp.array(0.0)
    nothing = _Known(zero, zero, here, tangent, tangent)
    state = (
        *(jnp.array(0), nothing, nothing, jnp.array(0), zero, nothing),
        *(jnp.array(True), ~jnp.asarray(wanted)),
    )
    state = jax.lax.while_loop(lambda s: ~s[-1] & (s[0] < trials), body, state)
    _, low, high, _, share, last, converged, _ = state
    inside = jnp.abs(share - 0.5) < 0.51
    resolved = converged & inside & (low.value * high.value <= 0) & jnp.asarray(wanted)
    return last.point, last.tangent, resolved


class _Known(NamedTuple):
    """What a trial between two neighbours found."""

    share: Array  # of the way
    value: Array  # of the test function, halved where the other end keeps moving
    point: Array
    tangent: Array  # of unit length
    slope: Array  # dpoint/dshare


def _chosen(first: Bool[Array, ""], yes: _Known, no: _Known) -> _Known:
    return _Known(*(jnp.where(first, a, b) for a, b in zip(yes, no, strict=True)))


def _cubic(low: _Known, high: _Known, share: Array) -> Point:
    """Where the cubic through two trials and their tangents is."""
    width = high.share - low.share
    s = (share - low.share) / width
    chord = high.point - low.point
    bend_low, bend_high = low.slope * width - chord, high.slope * width - chord
    return low.point + s * chord + s * (1 - s) * ((1 - s) * bend_low - s * bend_high)
