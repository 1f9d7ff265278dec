"""Pseudo-arclength continuation of curves of solutions, with steps chosen by curvature."""

from enum import StrEnum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.numerics.status import Status
from snrmjax.simulate.continuation.newton import Linearised, Number, Point, Trial

_FARTHEST = 3.0  # steps over the last one, beyond which the cubic is no guess
_FIRST, _ORDINARY, _TO_END = 0, 1, 2  # what a trial is for
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


class StepControl(eqx.Module):
    """How a curve is traced: step sizes in the scaled unknowns (order one), and what they pass.

    A step is accepted when Newton's method converges to a point near the guess, where the curve
    has turned little; it is halved otherwise. All but the two whole numbers may change without
    another compilation. Raises `ValueError` for fewer than two points.
    """

    first: Number = 0.01
    smallest: Number = 1e-7
    largest: Number = 0.05
    angle: Number = 0.1  # rad, aimed at between neighbouring tangents
    tolerance: Number = 1e-9  # on the error that is left after the last Newton step
    nonsmooth_point: Number = (
        2e-4  # steps below it may turn sharply: a kinked force bends the curve
    )
    # Guesses are cubic, so a solution farther from one than a third of the step is on another
    # part of the curve, or on another curve.
    largest_miss: Number = 0.3  # distance of the solution from the guess, over the step
    nonsmooth_miss: Number = (
        2.0  # the same for steps below `nonsmooth_point`, where the cubic says nothing
    )
    largest_turn: Number = 3.0  # between neighbouring tangents, over `angle`
    # A harmonic that turns its sign within a step has jumped from one flank of a light damped
    # resonance to the other: it changes by twice its norm, on a smooth curve by less than one.
    largest_change: Number = 0.9  # of one harmonic in a step, over its norm
    slight: Number = 0.05  # harmonics below this share of the motion may change as they like
    closing: Number = 0.2  # a closed curve passes its first point nearer than this share of a step
    iterations: int = eqx.field(static=True, default=8)  # of Newton's method, at most
    max_points: int = eqx.field(static=True, default=4000)

    def __check_init__(self) -> None:
        if self.max_points < 2:
            raise ValueError(f"`max_points` must be 2 or more, but is {self.max_points}.")

    def is_near(self, step: Array, miss: Array, turn: Array) -> Bool[Array, ""]:
        """Whether a point is so near its guess that it is the next of the curve."""
        smooth = (miss < self.largest_miss * step) & (turn < self.largest_turn * self.angle)
        nonsmooth = (
            (step < self.nonsmooth_point)
            & (turn < 0.5 * jnp.pi)
            & (miss < self.nonsmooth_miss * step)
        )
        return smooth | nonsmooth

    def growth(self, turn: Array, n_solves: Array, good: Array) -> Float[Array, ""]:
        """The next step over the last one, after a turn of the tangent (rad)."""
        factor = jnp.clip(self.angle / jnp.maximum(turn, 1e-3), 0.5, 2.0)
        factor = jnp.where(n_solves >= 4, jnp.minimum(factor, 0.7), factor)
        return jnp.where(good, factor, 0.5)


class CurveRange(NamedTuple):
    """Where a curve ends: the range of its last unknown, and the largest of the others."""

    lower: Number
    upper: Number
    largest_amplitude: Number | None = None


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


class Tracing(NamedTuple):
    """A curve that is being traced: where it is, where it came from, and the trial under way."""

    here: Point
    tangent: Point  # at first which way to go
    back: Point
    back_tangent: Point
    origin: Point
    origin_tangent: Point
    trial: Trial
    n_points: Int[Array, ""]
    step: Float[Array, ""]
    aim: Int[Array, ""]  # what the trial is for
    status: Int[Array, ""]  # of a `CurveStatus`, or RUNNING
    n_solves: Int[Array, ""]


class CurveTracer(eqx.Module):
    """How a curve R(x, λ) = 0 is walked along, one trial after the other.

    `linearised` gives R and its Jacobian, `within` says where the curve ends. The next point is
    guessed by the cubic through the last two points and their tangents. A step is halved when
    Newton's method fails, when it ends far from the guess, or when the tangent turns by too much
    (but at a nonsmooth event, which steps below `control.nonsmooth_point` may pass); otherwise it
    is chosen so that the next turn comes near `control.angle`.
    With `groups` = (rows, columns), into which the first unknowns unfold, no column may change by
    more than `control.largest_change` of its norm in a step: across a light damped resonance the
    response turns its sign, and on the scale of the peak the two flanks far below it are
    neighbours.
    The last point of a curve that left the range lies on its end; that of a closed one is the
    first again (a curve that begins at an end of its range does not close: `may_close`).
    """

    linearised: Linearised
    within: CurveRange
    control: StepControl
    groups: tuple[int, int] | None = eqx.field(static=True, default=None)
    may_close: bool = eqx.field(static=True, default=True)

    def begun(self, start: Point, direction: Point, across: Point | None = None) -> Tracing:
        """Before the first point: `start` is a guess of it, corrected at its own λ or `across`."""
        unset = jnp.array(0)
        return Tracing(
            *(start, direction, start, direction, start, direction),
            trial=Trial.at(start, _at_lambda(start) if across is None else across),
            n_points=unset,
            step=jnp.minimum(jnp.asarray(self.control.first), self.control.largest),
            aim=jnp.array(_FIRST),
            status=jnp.array(RUNNING),
            n_solves=unset,
        )

    def patience(self, walk: Tracing) -> Int[Array, ""]:
        """Steps that Newton's method has for the trial under way."""
        usual = self.control.iterations
        return jnp.where(walk.aim == _ORDINARY, usual, 5 * usual)

    def advanced(self, walk: Tracing) -> tuple[Tracing, Bool[Array, ""]]:
        """After one step of Newton's method, and whether `here` is a new point of the curve."""
        trial = walk.trial.stepped(self.linearised, self.control.tolerance)
        going = trial.goes_on(self.patience(walk))
        unjudged = walk._replace(trial=trial), jnp.array(False)
        return jax.lax.cond(going, lambda: unjudged, lambda: self.judged(unjudged[0]))

    def corrected(self, walk: Tracing) -> tuple[Tracing, Bool[Array, ""]]:
        """After the whole trial under way, and whether `here` is a new point of the curve."""
        patience, tolerance = self.patience(walk), self.control.tolerance
        trial = jax.lax.while_loop(
            lambda trial: trial.goes_on(patience),
            lambda trial: trial.stepped(self.linearised, tolerance),
            walk.trial,
        )
        return self.judged(walk._replace(trial=trial))

    def judged(self, walk: Tracing) -> tuple[Tracing, Bool[Array, ""]]:
        """After a trial that has ended, with the next one begun; and whether it gave a point."""
        control, trial, (lower, upper, _) = self.control, walk.trial, self.within
        here, tangent, new = walk.here, walk.tangent, trial.point
        is_first, is_end = walk.aim == _FIRST, walk.aim == _TO_END
        new_tangent = trial.tangent * jnp.where(trial.tangent @ tangent < 0, -1.0, 1.0)
        turn = jnp.arccos(jnp.clip(new_tangent @ tangent, -1.0, 1.0))
        near = control.is_near(walk.step, jnp.linalg.norm(new - trial.start), turn)
        near &= _steady(here, new, self.groups, control)
        good = trial.converged & (is_first | is_end | near)

        outside = (new[-1] > upper) | (new[-1] < lower)
        leaving = good & outside & ~is_first & ~is_end
        end = jnp.where(new[-1] > upper, upper, lower)
        fraction = (end - here[-1]) / (new[-1] - here[-1])
        to_end = (here + fraction * (new - here)).at[-1].set(end)

        closed = jnp.array(False)
        if self.may_close:
            passed = _passes(walk, new, new_tangent, control.closing)
            closed = good & (walk.n_points > 4) & passed
            new = jnp.where(closed, walk.origin, new)
            walk = walk._replace(
                origin=jnp.where(is_first, new, walk.origin),
                origin_tangent=jnp.where(is_first, new_tangent, walk.origin_tangent),
            )
        kept = good & ~leaving
        n_points = walk.n_points + kept
        longer = jnp.minimum(
            walk.step * control.growth(turn, trial.n_solves, good), control.largest
        )
        step = jnp.where(is_first | leaving, walk.step, longer)
        status = self._status(
            walk, new, good=good, kept=kept, closed=closed, n_points=n_points, step=step
        )
        onward = walk._replace(
            here=jnp.where(kept, new, here),
            tangent=jnp.where(kept, new_tangent, tangent),
            back=jnp.where(kept, here, walk.back),
            back_tangent=jnp.where(kept, tangent, walk.back_tangent),
            n_points=n_points,
            step=step,
            aim=jnp.where(leaving, _TO_END, _ORDINARY),
            status=status,
            n_solves=walk.n_solves + trial.n_solves,
        )
        guess = jnp.where(leaving, to_end, _extrapolated(onward))
        across = jnp.where(leaving, _at_lambda(guess), onward.tangent)
        return onward._replace(trial=Trial.at(guess, across)), kept

    def _status(
        self,
        walk: Tracing,
        new: Point,
        *,
        good: Array,
        kept: Array,
        closed: Array,
        n_points: Array,
        step: Array,
    ) -> Int[Array, ""]:
        """Whether and how the curve has ended."""
        lower, upper, largest_amplitude = self.within
        is_first, is_end = walk.aim == _FIRST, walk.aim == _TO_END
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
            (n_points >= self.control.max_points, CurveStatus.POINT_LIMIT),
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
    """Trace the curve R(x, λ) = 0 from `start` until λ leaves its range, as `CurveTracer` says.

    Arguments: `linearised` gives R and its Jacobian; `start` is a guess of the first point,
    corrected at its own λ, or across `start_across`; `direction` says which way to go.
    Reference: Seydel, Practical Bifurcation and Stability Analysis (2010), chapter 4,
    doi:10.1007/978-1-4419-1740-9.
    """
    walker = CurveTracer(linearised, within, control, groups)

    def body(state: tuple) -> tuple:
        walk, points, tangents = state
        place = walk.n_points
        walk, kept = walker.corrected(walk)
        # Rows are only written here, never read, so that the loop need not copy them; a row that
        # is not kept is written again later, or is beyond the last.
        points = points.at[place].set(jnp.where(kept, walk.here, jnp.nan))
        tangents = tangents.at[place].set(jnp.where(kept, walk.tangent, jnp.nan))
        return walk, points, tangents

    unset = jnp.full((control.max_points, start.shape[0]), jnp.nan)
    walk, points, tangents = jax.lax.while_loop(
        lambda state: state[0].status == RUNNING,
        body,
        (walker.begun(start, direction, start_across), unset, unset),
    )
    return Curve(points, tangents, walk.n_points, walk.status, walk.n_solves)


def _at_lambda(point: Point) -> Point:
    """The direction along λ, the last unknown."""
    return jnp.zeros_like(point).at[-1].set(1.0)


def _passes(walk: Tracing, new: Point, new_tangent: Point, closing: Number) -> Bool[Array, ""]:
    """Whether the curve passes its first point between `here` and `new`, in the same direction."""
    here, tangent, origin = walk.here, walk.tangent, walk.origin
    to_origin, to_new = tangent @ (origin - here), tangent @ (new - here)
    passed = (to_origin > 0) & (to_origin <= to_new)
    passed &= jnp.linalg.norm(origin - here) <= 2.0 * to_origin
    passed &= new_tangent @ walk.origin_tangent > 0.5
    # A point that only happens to lie on the way has others where the curve passes it.
    nearest = here + to_origin / jnp.maximum(to_new, 1e-300) * (new - here)
    return passed & (jnp.linalg.norm(nearest - origin) < closing * jnp.linalg.norm(new - here))


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


def _extrapolated(walk: Tracing) -> Point:
    """Where the cubic through the last two points and their tangents is, a step farther."""
    here, tangent, step = walk.here, walk.tangent, walk.step
    known = walk.n_points >= 2
    gap = jnp.where(known, jnp.linalg.norm(here - walk.back), 1.0)
    fraction = jnp.where(known, step / gap, 0.0)
    chord = (here - walk.back) / gap
    # here + step·t + (step²)·a + (step² · (step + gap))·b, from Hermite's divided differences.
    second = (tangent - chord) / gap
    third = (tangent - 2 * chord + walk.back_tangent) / gap**2
    bend = step**2 * (second + (step + gap) * third)
    trusted = known & (fraction < _FARTHEST)
    return here + step * tangent + jnp.where(trusted, bend, 0.0)
