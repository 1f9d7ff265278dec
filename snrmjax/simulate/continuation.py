"""Pseudo-arclength continuation of curves of solutions, with steps chosen by curvature."""

from collections.abc import Callable
from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

Point = Float[Array, " unknown"]
Linearised = Callable[[Point], tuple[Float[Array, " equation"], Float[Array, "equation unknown"]]]


class CurveStatus(IntEnum):
    """How a curve ended."""

    UPPER_END = 0  # left the range of the last unknown at its upper end
    LOWER_END = 1  # left it at its lower end
    POINT_LIMIT = 2  # used up the points it was given
    STEP_TOO_SMALL = 3  # Newton's method failed even for the smallest step
    NO_START = 4  # no solution was found to start from
    AMPLITUDE_LIMIT = 5  # grew past the largest amplitude asked for


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
}


class StepControl(NamedTuple):
    """Step sizes along the curve, in the scaled unknowns (order one)."""

    first: float = 0.01
    smallest: float = 1e-7
    largest: float = 0.04
    angle: float = 0.08  # rad, aimed at between neighbouring tangents
    tolerance: float = 1e-8  # on the last Newton step
    iterations: int = 8


class Curve(NamedTuple):
    """Points of one curve; rows from `n_points` on are unused."""

    points: Float[Array, "point unknown"]
    tangents: Float[Array, "point unknown"]
    n_points: Int[Array, ""]
    status: Int[Array, ""]


def correct(
    linearised: Linearised, start: Point, direction: Point, tolerance: float, iterations: int
) -> tuple[Point, Point, Int[Array, ""], Bool[Array, ""]]:
    """Newton's method in the hyperplane through `start` across `direction`.

    One LU factorisation gives both the Newton step and the tangent. Returns the point, its unit
    tangent (along `direction`), the iterations used and whether the last step was below
    `tolerance`.
    """
    last = jnp.zeros(start.shape[0]).at[-1].set(1.0)

    def body(state: tuple) -> tuple:
        point, _, count, _, _ = state
        residual, jacobian = linearised(point)
        matrix = jnp.concatenate([jacobian, direction[None]])
        offset = direction @ (point - start)
        right = jnp.stack([jnp.append(residual, offset), last], axis=1)
        solved = jnp.linalg.solve(matrix, right)
        step = jnp.max(jnp.abs(solved[:, 0]))
        return point - solved[:, 0], solved[:, 1], count + 1, step, jnp.isfinite(step)

    def going(state: tuple) -> Array:
        _, _, count, step, finite = state
        return finite & (count < iterations) & (step > tolerance)

    state = (start, direction, jnp.array(0), jnp.array(jnp.inf), jnp.array(True))
    # The first comparison must not stop on the infinite step: `going` sees finite = True.
    point, tangent, count, step, finite = jax.lax.while_loop(going, body, state)
    tangent = tangent / jnp.linalg.norm(tangent)
    return point, tangent, count, finite & (step <= tolerance)


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
) -> Curve:
    """Follow a curve of solutions of R(x, λ) = 0 from `start` until λ leaves [lower, upper].

    Arguments: `linearised` gives R and its Jacobian; `start` is a guess of the first point,
    corrected at its own λ, or across `start_across`; `direction` says which way to go. A step is
    halved when Newton's method fails or the tangent turns by more than three times
    `control.angle`, otherwise it is chosen so that the next turn comes near `control.angle`.
    The last point of a curve that left the range lies on its end.
    Raises `ValueError` when `max_points` is below 2.
    """
    if max_points < 2:
        raise ValueError(f"`max_points` must be 2 or more, but is {max_points}.")
    size = start.shape[0]
    at_lambda = jnp.zeros(size).at[-1].set(1.0)
    first, tangent, _, found = correct(
        linearised,
        start,
        at_lambda if start_across is None else start_across,
        control.tolerance,
        5 * control.iterations,
    )
    tangent = tangent * jnp.where(tangent @ direction < 0, -1.0, 1.0)
    points = jnp.full((max_points, size), jnp.nan).at[0].set(jnp.where(found, first, jnp.nan))
    tangents = jnp.full((max_points, size), jnp.nan).at[0].set(tangent)
    running = jnp.array(-1)
    status = jnp.where(found, running, int(CurveStatus.NO_START))

    def body(state: tuple) -> tuple:
        points, tangents, n, step, _ = state
        here, tangent = points[n - 1], tangents[n - 1]
        guess = here + step * tangent
        new, new_tangent, count, converged = correct(
            linearised, guess, tangent, control.tolerance, control.iterations
        )
        cosine = jnp.clip(new_tangent @ tangent, -1.0, 1.0)
        turn = jnp.arccos(cosine)
        good = converged & (turn < 3 * control.angle)
        beyond_upper, beyond_lower = new[-1] > upper, new[-1] < lower
        leaving = good & (beyond_upper | beyond_lower)
        end = jnp.where(beyond_upper, upper, lower)

        def to_end(_: None) -> tuple[Array, Array, Array]:
            share = (end - here[-1]) / (new[-1] - here[-1])
            on_end = (here + share * (new - here)).at[-1].set(end)
            last, last_tangent, _count, ok = correct(
                linearised, on_end, at_lambda, control.tolerance, 5 * control.iterations
            )
            sign = jnp.where(last_tangent @ tangent < 0, -1.0, 1.0)
            return last, sign * last_tangent, ok

        def keep(_: None) -> tuple[Array, Array, Array]:
            return new, new_tangent, good

        new, new_tangent, good = jax.lax.cond(leaving, to_end, keep, None)
        points = points.at[n].set(jnp.where(good, new, points[n]))
        tangents = tangents.at[n].set(jnp.where(good, new_tangent, tangents[n]))
        grow = jnp.clip(control.angle / jnp.maximum(turn, 1e-3), 0.5, 1.5)
        grow = jnp.where(count >= control.iterations - 2, jnp.minimum(grow, 0.7), grow)
        factor = jnp.where(good, grow, 0.5)
        new_step = jnp.minimum(step * factor, control.largest)
        n = n + good
        status = jnp.where(
            leaving & good,
            jnp.where(beyond_upper, int(CurveStatus.UPPER_END), int(CurveStatus.LOWER_END)),
            jnp.where(
                good & (jnp.max(jnp.abs(new[:-1])) > largest_amplitude),
                int(CurveStatus.AMPLITUDE_LIMIT),
                jnp.where(
                    new_step < control.smallest,
                    int(CurveStatus.STEP_TOO_SMALL),
                    jnp.where(n >= max_points, int(CurveStatus.POINT_LIMIT), running),
                ),
            ),
        )
        return points, tangents, n, new_step, status

    state = (points, tangents, jnp.array(1), jnp.array(control.first), status)
    points, tangents, n, _, status = jax.lax.while_loop(lambda s: s[-1] == running, body, state)
    started = status != int(CurveStatus.NO_START)
    return Curve(points, tangents, jnp.where(started, n, 0), status)


def locate_event(
    linearised: Linearised,
    test: Callable[[Point, Point], Float[Array, ""]],
    here: Point,
    tangent: Point,
    there: Point,
    control: StepControl,
) -> tuple[Point, Point, Bool[Array, ""]]:
    """The point between two neighbours where `test(point, tangent)` changes sign.

    Illinois' variant of the secant method in the arclength, each trial corrected across the
    tangent. Returns the point, its tangent and whether the sign change was resolved between the
    neighbours, or beside them by less than the tangents of a curve are late.
    """
    length = tangent @ (there - here)

    def trial(share: Array) -> tuple[Array, Array, Array, Array]:
        # Interpolating between the neighbours keeps every guess near the curve.
        guess = here + share * (there - here)
        guess = guess + (share * length - tangent @ (guess - here)) * tangent
        point, direction, _, ok = correct(
            linearised, guess, tangent, 1e-3 * control.tolerance, 2 * control.iterations
        )
        return test(point, direction), point, direction, ok

    low, high = jnp.array(0.0), jnp.array(1.0)
    f_low, *_ = trial(low)
    f_high, *_ = trial(high)

    def body(_step: int, state: tuple) -> tuple:
        low, high, f_low, f_high, side = state
        share = (low * f_high - high * f_low) / (f_high - f_low)
        share = jnp.where(jnp.isfinite(share), share, 0.5 * (low + high))
        value, *_ = trial(share)
        in_upper = jnp.sign(value) == jnp.sign(f_low)
        new_low, new_high = jnp.where(in_upper, share, low), jnp.where(in_upper, high, share)
        f_new_low = jnp.where(in_upper, value, jnp.where(side == -1, 0.5 * f_low, f_low))
        f_new_high = jnp.where(in_upper, jnp.where(side == 1, 0.5 * f_high, f_high), value)
        return new_low, new_high, f_new_low, f_new_high, jnp.where(in_upper, 1, -1)

    state = (low, high, f_low, f_high, jnp.array(0))
    low, high, f_low, f_high, _ = jax.lax.fori_loop(0, 16, body, state)
    share = jnp.where(jnp.abs(f_low) < jnp.abs(f_high), low, high)
    _, point, direction, ok = trial(share)
    inside = jnp.abs(share - 0.5) < 0.51
    return point, direction, ok & inside & (f_low * f_high <= 0)
