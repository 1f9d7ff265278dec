"""Batches of response curves: stacked balances, starts, and their continuation in parallel."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import stacked, taken
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.lanes import TOGETHER, StateRows, in_lanes, in_rows, iterated
from snrmjax.simulate.balance.harmonic_balance import (
    HarmonicBalance,
    linear_coefficients,
    resonance_displacement,
    resonant_modes,
    samples_for,
)
from snrmjax.simulate.continuation.continuation import (
    RUNNING,
    CurveRange,
    CurveStatus,
    CurveTracer,
    StepControl,
    TracedCurve,
    Tracing,
)

_RISING_POINTS = 300  # over the force: longer curves wind around without reaching another motion
_PAST = 4.0  # times the force, up to which a rising force is continued
_NEAR = 5e-3  # distance in scaled unknowns below which a motion lies on a known curve
_ALONE = 512  # points of a single curve in one call of the program
_COUNTED = 2  # `max_points` of every program: its curves end after `CurveRange.most_points`


def response_balances(
    models: Sequence[Structure],
    forces: Float[np.ndarray, " member"],
    harmonic_order: int,
    n_samples: int | None,
    within: Float[np.ndarray, " end"] | None = None,
) -> HarmonicBalance:
    """The balances of all members under their forces (N), stacked.

    Their scales are those of the resonant modes `within` two frequencies (rad/s).
    """
    together, every = stacked(models), list(zip(models, forces, strict=True))
    scales = [resonance_displacement(m, float(f), within) for m, f in every]
    first = [resonant_modes(m, within)[:1] or [m.modes.mode_of_interest] for m in models]
    natural = np.asarray(together.modes.natural_frequency)
    # On the host: on the device another number of members would recompile.
    columns: dict[str, Any] = {
        "force": np.asarray(forces),
        "displacement_scale": np.asarray(scales),
        "frequency_scale": np.take_along_axis(natural, np.array(first), axis=1)[:, 0],
    }
    return HarmonicBalance(
        model=together,
        **columns,
        harmonic_order=harmonic_order,
        n_samples=samples_for(models[0], harmonic_order, n_samples),
    )


def trace_from_rest(
    balances: HarmonicBalance,
    index: np.ndarray,
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
    lanes: int,
    *,
    downward: bool,
    starts: Float[np.ndarray, "member unknown"] | None = None,
) -> list[TracedCurve]:
    """The curves of the members `index` from an end of the range (rad/s), `lanes` at a time.

    From the scaled `starts` (NaN gives no curve), by default from the linear response.
    """
    if not len(index):
        return []
    return _traced(taken(balances, index), ends, steps, starts, lanes, downward=downward)


def under_rising_force(
    balances: HarmonicBalance,
    index: np.ndarray,
    end: float,
    steps: StepControl,
    lanes: int,
    *,
    rest: Float[np.ndarray, "member mode"] | None = None,
) -> Float[np.ndarray, "member unknown"]:
    """Motions of the members `index` reached by raising the force from zero, scaled.

    At the frequency `end` (rad/s), from the equilibria at `rest` (kg^1/2 m), by default from zero.
    NaN where the curve over the force folds back to zero.
    """
    mine = taken(balances, index)
    starts = np.full((len(index), balances.size + 1), np.nan)
    if not len(index):
        return starts
    initial = np.zeros_like(starts)
    if rest is not None:  # the mean comes first among the coefficients
        initial[:, : rest.shape[1]] = rest / np.asarray(mine.displacement_scale)[:, None]
    at, steps = np.array([end, end]), _over_force(steps)
    risen = _traced(mine, at, steps, initial, lanes, downward=False, up_to=1.0)
    for start, curve in zip(starts, risen, strict=True):
        if curve.status == CurveStatus.UPPER_END:
            start[:-1] = curve.points[-1, :-1]
    starts[:, -1] = end / np.asarray(mine.frequency_scale)
    return starts


def motions_at(
    balances: HarmonicBalance,
    index: np.ndarray,
    end: float,
    steps: StepControl,
    lanes: int,
) -> Float[np.ndarray, "member unknown"]:
    """Solutions of Newton's method from rest at a frequency (rad/s), scaled; NaN if none."""
    starts = np.zeros((len(index), balances.size + 1))
    starts[:, -1] = end / np.asarray(balances.frequency_scale)[index]
    one = dataclasses.replace(steps, max_points=2)
    curves = trace_from_rest(
        balances, index, np.array([end, end]), one, lanes, downward=False, starts=starts
    )
    nothing = np.full(balances.size + 1, np.nan)
    return np.array([one.points[0] if len(one.points) else nothing for one in curves]).reshape(
        starts.shape
    )


def _over_force(steps: StepControl) -> StepControl:
    return dataclasses.replace(steps, max_points=min(steps.max_points, _RISING_POINTS))


def at_force(
    balances: HarmonicBalance, member: int, frequency: float, steps: StepControl, lanes: int
) -> Float[np.ndarray, "motion unknown"]:
    """Motions of one member at a frequency (rad/s) that a rising force connects with rest, scaled.

    The curve is traced over the force to several times its value and around its folds; every
    crossing of its value is a motion, interpolated between two points and not corrected.
    """
    mine = taken(balances, np.array([member]))
    at, begin = np.array([frequency, frequency]), np.zeros((1, balances.size + 1))
    (curve,) = _traced(mine, at, _over_force(steps), begin, lanes, downward=False, up_to=_PAST)
    beyond = curve.points[:, -1] > 1
    k = np.flatnonzero(beyond[1:] != beyond[:-1])
    here, there = curve.points[k], curve.points[k + 1]
    fraction = (1 - here[:, -1:]) / (there[:, -1:] - here[:, -1:])
    motions = here + fraction * (there - here)
    motions[:, -1] = frequency / float(np.asarray(mine.frequency_scale)[0])
    return motions


def trace_both_ways(
    balances: HarmonicBalance,
    point: Float[np.ndarray, " unknown"],
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
) -> TracedCurve:
    """The curve through a point of a single member: closed, or from one end to the other."""
    ways = []
    for downward in (False, True):
        way = trace_through(balances, ends, steps, downward=downward, starts=point[None])[0]
        ways.append(way)
        if way.status == CurveStatus.CLOSED:
            return way
    up, down = ways
    back = down.reversed()
    solves = up.n_solves + down.n_solves
    if not len(up.points) or not len(back.points):
        whole = up if len(up.points) else back
        return whole._replace(n_solves=solves)
    ends_there = down.status in (CurveStatus.LOWER_END, CurveStatus.UPPER_END)
    status = up.status if ends_there or up.status != CurveStatus.UPPER_END else down.status
    return TracedCurve(
        np.concatenate([back.points[:-1], up.points]),
        np.concatenate([back.tangents[:-1], up.tangents]),
        status,
        solves,
    )


def lies_on(
    point: Float[np.ndarray, " unknown"],
    curve: Float[np.ndarray, "point unknown"],
    near: float = _NEAR,
) -> bool:
    """Whether a scaled point lies on the polyline through a curve's points, or as `near` to it."""
    begin, step = curve[:-1], np.diff(curve, axis=0)
    square = np.maximum(np.sum(step**2, axis=1), 1e-300)
    along = np.clip(np.sum((point - begin) * step, axis=1) / square, 0.0, 1.0)
    nearest = np.linalg.norm(begin + along[:, None] * step - point, axis=1)
    return bool(np.min(nearest, initial=np.inf) < min(near, _NEAR))


def trace_through(
    balances: HarmonicBalance,
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
    *,
    downward: bool,
    starts: Float[np.ndarray, "member unknown"],
) -> list[TracedCurve]:
    """Curves through given scaled points, towards one end of the range (rad/s)."""
    starts = np.asarray(starts)
    return _traced(balances, ends, steps, starts, 1, downward=downward, may_close=True)


class _Way(NamedTuple):
    """How curves are traced; in arrays, so that all ways are one program."""

    from_linear: Array | np.bool_  # response; else from given starts
    downward: Array | np.bool_
    may_close: Array | np.bool_
    over_force: Array | np.bool_  # at the lower end of the range; else over the frequency
    up_to: Array | np.float64  # times the force
    most_points: Array | np.int64


def _traced(
    balances: HarmonicBalance,
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
    starts: Float[np.ndarray, "member unknown"] | None,
    lanes: int,
    *,
    downward: bool,
    may_close: bool = False,
    up_to: float | None = None,
) -> list[TracedCurve]:
    """Curves from given starts, or from the linear response; or over a force rising `up_to`."""
    way = _Way(
        from_linear=np.bool_(starts is None),
        downward=np.bool_(downward),
        may_close=np.bool_(may_close),
        over_force=np.bool_(up_to is not None),
        up_to=np.float64(up_to or 1.0),
        most_points=np.int64(steps.max_points),
    )
    common = (np.asarray(ends), dataclasses.replace(steps, max_points=_COUNTED), way)
    if starts is None:
        starts = np.zeros((len(balances.force), balances.size + 1))
    further, length = (_advanced_alone, _ALONE) if lanes == 1 else (_advanced_together, TOGETHER)

    def initial(jobs: tuple, wanted: Bool[np.ndarray, " lane"]) -> StateRows:
        return _initial(jobs, wanted, *common)

    def advanced(jobs: tuple, states: StateRows, idle: int) -> tuple:
        return further(jobs, states, *common, np.array(idle), length=length)

    (status, n_solves), rows = in_lanes(initial, advanced, (balances, starts), lanes)
    curves = []
    for k, given in enumerate(rows):
        points, tangents = given or (np.zeros((0, balances.size + 1)),) * 2
        curves.append(TracedCurve(points, tangents, CurveStatus(int(status[k])), int(n_solves[k])))
    return curves


def _tracer(balance: HarmonicBalance, ends: Array, steps: StepControl, way: _Way) -> CurveTracer:
    """Along the response, or at the lower end of the range over a rising force."""
    lower, upper = ends / balance.frequency_scale
    load = balance.newtons(lower) * balance.load()

    def linearised(point: Array) -> tuple[Array, Array]:
        """Unknowns x and the frequency, or the fraction of the force."""
        last = point[-1]
        factor, omega = jnp.where(way.over_force, jnp.array([last, lower]), jnp.array([1.0, last]))
        now = eqx.tree_at(lambda b: b.force, balance, balance.force * factor)
        residual, jacobian = now.linearised(point.at[-1].set(omega))
        column = jnp.where(way.over_force, -load, jacobian[:, -1])
        return residual, jnp.concatenate([jacobian[:, :-1], column[:, None]], axis=1)

    within = CurveRange(
        lower=jnp.where(way.over_force, -1.0, lower),
        upper=jnp.where(way.over_force, way.up_to, upper),
        most_points=way.most_points,
    )
    # A harmonic may change sign over the force.
    change = jnp.where(way.over_force, jnp.inf, steps.largest_change)
    control = dataclasses.replace(steps, largest_change=change)
    groups = balance.n_coefficients, balance.model.n_modes
    return CurveTracer(linearised, within, control, groups, way.may_close)


def _first(job: tuple, ends: Array, steps: StepControl, way: _Way) -> Tracing:
    """The initial state of one job."""
    balance, start = job
    begin = jnp.where(way.downward, ends[1], ends[0])
    linear = linear_coefficients(balance.model, balance.force, begin, balance.harmonic_order)
    start = jnp.where(way.from_linear, balance.point(linear, begin), start)
    sense = jnp.where(way.downward & ~way.over_force, -1.0, 1.0)
    direction = jnp.zeros_like(start).at[-1].set(sense)
    return _tracer(balance, ends, steps, way).initial(start, direction)


@compiled
def _initial(
    jobs: tuple, wanted: Bool[Array, " lane"], ends: Array, steps: StepControl, way: _Way
) -> StateRows:
    def initial(job: tuple, wanted: Array) -> Tracing:
        status = jnp.where(wanted, RUNNING, int(CurveStatus.NO_START))
        return _first(job, ends, steps, way)._replace(status=status)

    return in_rows(jax.vmap(initial)(jobs, wanted))


def _advanced(
    jobs: tuple,
    states: StateRows,
    ends: Array,
    steps: StepControl,
    way: _Way,
    idle: Int[Array, ""],
    length: int,
) -> tuple[StateRows, tuple, tuple]:
    def result(state: Tracing) -> tuple:
        return state.status == RUNNING, state.status, state.n_solves

    def step(job: tuple, state: Tracing) -> tuple[Tracing, tuple]:
        tracer = _tracer(job[0], ends, steps, way)
        state, kept = tracer.corrected(state) if length == _ALONE else tracer.advanced(state)
        return state, (kept, state.here, state.tangent)

    initial = partial(_first, ends=ends, steps=steps, way=way)
    return iterated(initial, step, result, jobs, states, length, idle)


_advanced_alone = compiled(_advanced)
_advanced_together = compiled(_advanced, thoroughly=True)
