"""Pseudo-arclength continuation of solution curves with curvature-controlled steps."""

from enum import StrEnum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.numerics.newton import Linearised, Number, Point, Trial
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.status import Status

_FARTHEST = 3.0  # largest step over the last one at which the cubic predictor is used
_FIRST, _ORDINARY, _TO_END = 0, 1, 2  # the aim of a trial
RUNNING = -1  # the status of a curve that has not ended


class CurveStatus(Status):
    """How a curve ended."""

    UPPER_END = 0, "traced to the upper end of the frequency range"
    LOWER_END = 1, "came back to the lower end of the frequency range"
    POINT_LIMIT = (
        2,
        "stopped at the largest number of points; take a narrower range of frequencies (or, in "
        "Python, `StepControl` with more `max_points`)",
    )
    STEP_TOO_SMALL = (
        3,
        "stopped early: Newton's method fails at the smallest step; use more harmonics or samples",
    )
    NO_START = (
        4,
        "no solution at the start; start farther from resonance, or change the force: less of it "
        "where the structure is strongly nonlinear, more where friction holds it",
    )
    AMPLITUDE_LIMIT = 5, "stopped at the largest amplitude asked for"
    CLOSED = 6, "came back to where it started: an isolated loop"
    INVALID = (
        7,
        "not traced: the force or a parameter of the model is not finite, or the force is zero",
    )
    BRANCH_POINT = 8, "ended at a branch point, on another curve"


class StepControl(eqx.Module):
    """How a curve is traced: step lengths in the scaled unknowns (order one) and tolerances.

    A step is accepted when Newton's method converges to a point near the prediction and the
    tangent has rotated little; it is halved otherwise. All but the two integers may change without
    recompilation. Raises `ValueError` for fewer than two points.
    """

    first: Number = 0.01
    smallest: Number = 1e-7
    largest: Number = 0.05
    angle: Number = 0.1  # rad, target between neighbouring tangents
    tolerance: Number = 1e-9  # of the error remaining after the last Newton step
    corner_step: Number = (
        2e-4  # shorter steps may pass a corner: of the curve, by a nonsmooth force
    )
    # The predictor is cubic, so a solution farther from it than a third of the step is on another
    # part of the curve, or on another curve.
    largest_miss: Number = 0.3  # distance of the solution from the prediction, over the step
    corner_miss: Number = (
        2.0  # the same for steps below `corner_step`, where no cubic predicts the curve
    )
    largest_rotation: Number = 3.0  # between neighbouring tangents, over `angle`
    # A harmonic that changes sign within a step has jumped from one flank of a lightly damped
    # resonance to the other: it changes by twice its norm, on a smooth curve by less than one.
    largest_change: Number = 0.9  # of one harmonic in a step, over its norm
    slight: Number = 0.05  # harmonics below this fraction of the motion may change freely
    closing: Number = 0.2  # a closed curve passes its first point within this fraction of a step
    iterations: int = eqx.field(static=True, default=8)  # of Newton's method, at most
    max_points: int = eqx.field(static=True, default=4000)

    def __check_init__(self) -> None:
        if self.max_points < 2:
            raise InputError(f"`max_points` must be 2 or more, but is {self.max_points}.")

    def is_near(self, step: Array, miss: Array, rotation: Array) -> Bool[Array, ""]:
        """Whether a point is near enough to its prediction to be the next one of the curve."""
        smooth = (miss < self.largest_miss * step) & (rotation < self.largest_rotation * self.angle)
        corner = (
            (step < self.corner_step) & (rotation < 0.5 * jnp.pi) & (miss < self.corner_miss * step)
        )
        return smooth | corner

    def growth(self, rotation: Array, n_solves: Array, good: Array) -> Float[Array, ""]:
        """The next step over the last one, given the rotation of the tangent (rad)."""
        factor = jnp.clip(self.angle / jnp.maximum(rotation, 1e-3), 0.5, 2.0)
        factor = jnp.where(n_solves >= 4, jnp.minimum(factor, 0.7), factor)
        return jnp.where(good, factor, 0.5)


class CurveRange(NamedTuple):
    """Where a curve ends: the range of its last unknown, and the largest of the others.

    With `most_points` it ends after so many points, with one program for any number of them,
    instead of after `max_points` of its `StepControl`.
    """

    lower: Number
    upper: Number
    largest_amplitude: Number | None = None
    most_points: Array | np.int64 | None = None


class Curve(NamedTuple):
    """Points of one curve; rows from `n_points` on are unused."""

    points: Float[Array, "point unknown"]
    tangents: Float[Array, "point unknown"]
    n_points: Int[Array, ""]
    status: Int[Array, ""]
    n_solves: Int[Array, ""]  # linear systems factorised


class CurveEvent(StrEnum):
    """Event at a point of a curve; `NONE` at most of them."""

    NONE = ""
    FOLD = "fold"
    PEAK = "peak"
    PHASE_RESONANCE = "phase_resonance"
    BRANCH_POINT = "branch_point"
    PERIOD_DOUBLING = "period_doubling"
    NEIMARK_SACKER = "neimark_sacker"


class TracedCurve(NamedTuple):
    """Points along one curve, with events and multipliers, on the host."""

    points: Float[np.ndarray, "point unknown"]
    tangents: Float[np.ndarray, "point unknown"]
    status: CurveStatus = CurveStatus.UPPER_END
    n_solves: int = 0
    events: tuple[CurveEvent, ...] = ()  # at the points; empty before the search for events
    not_located: tuple[str, ...] = ()  # kinds of events that could not be located
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


class Tracing(NamedTuple):
    """State of a continuation: current, last and first points with tangents, and the trial."""

    here: Point
    tangent: Point  # at first the direction of tracing
    back: Point
    back_tangent: Point
    origin: Point
    origin_tangent: Point
    trial: Trial
    n_points: Int[Array, ""]
    step: Float[Array, ""]
    aim: Int[Array, ""]  # of the trial
    status: Int[Array, ""]  # of a `CurveStatus`, or RUNNING
    n_solves: Int[Array, ""]


class CurveTracer(eqx.Module):
    """Pseudo-arclength continuation of a curve R(x, λ) = 0, one trial after the other.

    `linearised` returns R and its Jacobian, `within` is the range. The predictor is the cubic
    through the last two points and their tangents. A step is halved when Newton's method fails,
    converges far from the prediction, or the tangent rotates too much (but for steps below
    `control.corner_step`, which may pass a nonsmooth event); otherwise its length is chosen so
    that the next rotation is about `control.angle`.
    With `groups` = (rows, columns), the shape of the first unknowns as a matrix, no column may
    change by more than `control.largest_change` of its norm in a step: across a lightly damped
    resonance the response changes sign, and on the scale of the peak its two flanks are close
    neighbours.
    The last point of a curve that leaves the range lies on its end; that of a closed one repeats
    the first (a curve that begins at an end of its range does not close: `may_close`).
    """

    linearised: Linearised
    within: CurveRange
    control: StepControl
    groups: tuple[int, int] | None = eqx.field(static=True, default=None)
    may_close: bool | np.bool_ | Array = True

    def initial(self, start: Point, direction: Point, across: Point | None = None) -> Tracing:
        """The initial state: `start` is a guess, corrected at its own λ or across `across`."""
        unset = jnp.array(0)
        return Tracing(
            start,
            direction,
            start,
            direction,
            start,
            direction,
            trial=Trial.at(start, _at_lambda(start) if across is None else across),
            n_points=unset,
            step=jnp.minimum(jnp.asarray(self.control.first), self.control.largest),
            aim=jnp.array(_FIRST),
            status=jnp.array(RUNNING),
            n_solves=unset,
        )

    def patience(self, state: Tracing) -> Int[Array, ""]:
        """Most Newton steps of the current trial."""
        usual = self.control.iterations
        return jnp.where(state.aim == _ORDINARY, usual, 5 * usual)

    def advanced(self, state: Tracing) -> tuple[Tracing, Bool[Array, ""]]:
        """The state after one Newton step, and whether `here` is a new point of the curve."""
        trial = state.trial.stepped(self.linearised, self.control.tolerance)
        going = trial.goes_on(self.patience(state))
        pending = state._replace(trial=trial), jnp.array(False)
        return jax.lax.cond(going, lambda: pending, lambda: self.assessed(pending[0]))

    def corrected(self, state: Tracing) -> tuple[Tracing, Bool[Array, ""]]:
        """The state after the whole trial, and whether `here` is a new point of the curve."""
        patience, tolerance = self.patience(state), self.control.tolerance
        trial = jax.lax.while_loop(
            lambda trial: trial.goes_on(patience),
            lambda trial: trial.stepped(self.linearised, tolerance),
            state.trial,
        )
        return self.assessed(state._replace(trial=trial))

    def assessed(self, state: Tracing) -> tuple[Tracing, Bool[Array, ""]]:
        """Accept or reject a finished trial and start the next; and whether it gave a point."""
        control, trial, lower, upper = self.control, state.trial, *self.within[:2]
        here, tangent, new = state.here, state.tangent, trial.point
        is_first, is_end = state.aim == _FIRST, state.aim == _TO_END
        new_tangent = trial.tangent * jnp.where(trial.tangent @ tangent < 0, -1.0, 1.0)
        rotation = jnp.arccos(jnp.clip(new_tangent @ tangent, -1.0, 1.0))
        near = control.is_near(state.step, jnp.linalg.norm(new - trial.start), rotation)
        near &= _steady(here, new, self.groups, control)
        good = trial.converged & (is_first | is_end | near)

        outside = (new[-1] > upper) | (new[-1] < lower)
        leaving = good & outside & ~is_first & ~is_end
        end = jnp.where(new[-1] > upper, upper, lower)
        fraction = (end - here[-1]) / (new[-1] - here[-1])
        to_end = (here + fraction * (new - here)).at[-1].set(end)

        passed = _passes(state, new, new_tangent, control.closing)
        closed = good & (state.n_points > 4) & passed & self.may_close
        new = jnp.where(closed, state.origin, new)
        state = state._replace(
            origin=jnp.where(is_first, new, state.origin),
            origin_tangent=jnp.where(is_first, new_tangent, state.origin_tangent),
        )
        kept = good & ~leaving
        n_points = state.n_points + kept
        longer = jnp.minimum(
            state.step * control.growth(rotation, trial.n_solves, good), control.largest
        )
        step = jnp.where(is_first | leaving, state.step, longer)
        status = self._status(
            state, new, good=good, kept=kept, closed=closed, n_points=n_points, step=step
        )
        onward = state._replace(
            here=jnp.where(kept, new, here),
            tangent=jnp.where(kept, new_tangent, tangent),
            back=jnp.where(kept, here, state.back),
            back_tangent=jnp.where(kept, tangent, state.back_tangent),
            n_points=n_points,
            step=step,
            aim=jnp.where(leaving, _TO_END, _ORDINARY),
            status=status,
            n_solves=state.n_solves + trial.n_solves,
        )
        guess = jnp.where(leaving, to_end, _extrapolated(onward))
        across = jnp.where(leaving, _at_lambda(guess), onward.tangent)
        return onward._replace(trial=Trial.at(guess, across)), kept

    def _status(
        self,
        state: Tracing,
        new: Point,
        *,
        good: Array,
        kept: Array,
        closed: Array,
        n_points: Array,
        step: Array,
    ) -> Int[Array, ""]:
        """Whether and how the curve has ended."""
        lower, upper, largest_amplitude, limit = self.within
        is_first, is_end = state.aim == _FIRST, state.aim == _TO_END
        most_points = jnp.asarray(self.control.max_points if limit is None else limit)
        large = jnp.array(False)
        if largest_amplitude is not None:
            large = jnp.max(jnp.abs(new[:-1])) > largest_amplitude
        ends = (
            (is_first & ~good, CurveStatus.NO_START),
            (is_end & good & (new[-1] >= upper), CurveStatus.UPPER_END),
            (is_end & good & (new[-1] <= lower), CurveStatus.LOWER_END),
            (closed & kept, CurveStatus.CLOSED),
            (kept & ~is_first & large, CurveStatus.AMPLITUDE_LIMIT),
            (step < self.control.smallest, CurveStatus.STEP_TOO_SMALL),
            (n_points >= most_points, CurveStatus.POINT_LIMIT),
        )
        status = jnp.array(RUNNING)
        for happened, what in reversed(ends):
            status = jnp.where(happened, int(what), status)
        return status


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
    """Trace the curve R(x, λ) = 0 from `start` until λ leaves its range, by `CurveTracer`.

    Arguments: `linearised` returns R and its Jacobian; `start` is a guess of the first point,
    corrected at its own λ, or across `start_across`; `direction` is that of tracing.
    Reference: Seydel, Practical Bifurcation and Stability Analysis (2010), chapter 4,
    doi:10.1007/978-1-4419-1740-9.
    """
    tracer = CurveTracer(linearised, within, control, groups)

    def body(carry: tuple) -> tuple:
        state, points, tangents = carry
        index = state.n_points
        state, kept = tracer.corrected(state)
        # Rows are only written here, never read, so that the loop need not copy them; a rejected
        # row is overwritten later, or lies beyond the last.
        points = points.at[index].set(jnp.where(kept, state.here, jnp.nan))
        tangents = tangents.at[index].set(jnp.where(kept, state.tangent, jnp.nan))
        return state, points, tangents

    unset = jnp.full((control.max_points, start.shape[0]), jnp.nan)
    state, points, tangents = jax.lax.while_loop(
        lambda carry: carry[0].status == RUNNING,
        body,
        (tracer.initial(start, direction, start_across), unset, unset),
    )
    return Curve(points, tangents, state.n_points, state.status, state.n_solves)


def _at_lambda(point: Point) -> Point:
    """The direction along λ, the last unknown."""
    return jnp.zeros_like(point).at[-1].set(1.0)


def _passes(state: Tracing, new: Point, new_tangent: Point, closing: Number) -> Bool[Array, ""]:
    """Whether the curve passes its first point between `here` and `new`, in the same direction."""
    here, tangent, origin = state.here, state.tangent, state.origin
    to_origin, to_new = tangent @ (origin - here), tangent @ (new - here)
    passed = (to_origin > 0) & (to_origin <= to_new)
    passed &= jnp.linalg.norm(origin - here) <= 2.0 * to_origin
    passed &= new_tangent @ state.origin_tangent > 0.5
    # A point ahead by chance alone is not near the chord from `here` to `new`.
    nearest = here + to_origin / jnp.maximum(to_new, 1e-300) * (new - here)
    return passed & (jnp.linalg.norm(nearest - origin) < closing * jnp.linalg.norm(new - here))


def _steady(
    here: Point, new: Point, groups: tuple[int, int] | None, control: StepControl
) -> Bool[Array, ""]:
    """Whether no column of the unknowns changes by most of its norm."""
    if groups is None:
        return jnp.array(True)
    rows, columns = groups
    old, now = (point[: rows * columns].reshape(rows, columns) for point in (here, new))
    norms = [jnp.linalg.norm(part, axis=0) for part in (old, now, now - old)]
    largest = jnp.maximum(norms[0], norms[1])
    slight = control.slight * jnp.linalg.norm(largest)
    return jnp.all((norms[2] <= control.largest_change * largest) | (largest <= slight))


def _extrapolated(state: Tracing) -> Point:
    """Predictor: the cubic through the last two points and their tangents, a step ahead."""
    here, tangent, step = state.here, state.tangent, state.step
    known = state.n_points >= 2
    gap = jnp.where(known, jnp.linalg.norm(here - state.back), 1.0)
    fraction = jnp.where(known, step / gap, 0.0)
    chord = (here - state.back) / gap
    # here + step·t + (step²)·a + (step² · (step + gap))·b, from Hermite's divided differences.
    second = (tangent - chord) / gap
    third = (tangent - 2 * chord + state.back_tangent) / gap**2
    curvature = step**2 * (second + (step + gap) * third)
    trusted = known & (fraction < _FARTHEST)
    return here + step * tangent + jnp.where(trusted, curvature, 0.0)
