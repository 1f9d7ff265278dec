"""Many response curves of one kind: stacked balances, starts, and their walks side by side."""

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

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

_Way = Literal["from_end", "rising", "through"]  # an end of the range, a force, or a point
_ALONE = 512  # points of a single curve before the host sees them


def response_balances(
    models: Sequence[Structure],
    forces: Float[np.ndarray, " member"],
    harmonic_order: int,
    n_samples: int | None,
    within: Float[np.ndarray, " end"] | None = None,
) -> HarmonicBalance:
    """The balances of all members under their forces (N), stacked.

    Their scales are those of the modes that move `within` two frequencies (rad/s).
    """
    together, every = stacked(models), list(zip(models, forces, strict=True))
    scales = [resonance_displacement(m, float(f), within) for m, f in every]
    first = [resonant_modes(m, within)[:1] or [m.modes.mode_of_interest] for m in models]
    natural = np.asarray(together.modes.natural_frequency)
    # On the host: on the device another number of members would compile anew.
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
    ramp: bool = False,
) -> list[TracedCurve]:
    """The curves of the members `index`, so many side by side.

    From the linear response at an end of the range (rad/s), or with `ramp` from the response to a
    force that rises from zero at the lower end; that leads nowhere where the start is NaN.
    """
    if not len(index):
        return []
    mine, starts = taken(balances, index), None
    if ramp:
        risen = _walked(mine, ends, steps, None, lanes, downward=downward, way="rising")
        starts = np.full((len(index), balances.size + 1), np.nan)
        for start, curve in zip(starts, risen, strict=True):
            if curve.status == CurveStatus.UPPER_END:
                start[:-1] = curve.points[-1, :-1]
        starts[:, -1] = ends[0] / np.asarray(mine.frequency_scale)
    return _walked(mine, ends, steps, starts, lanes, downward=downward)


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
    return _walked(balances, ends, steps, starts, 1, downward=downward, way="through")


def _walked(
    balances: HarmonicBalance,
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
    starts: Float[np.ndarray, "member unknown"] | None,
    lanes: int,
    *,
    downward: bool,
    way: _Way = "from_end",
) -> list[TracedCurve]:
    """Curves from given starts, or from the linear response; or under a rising force."""
    walk = (np.asarray(ends), steps, np.array(downward))
    further, length = (_advanced_alone, _ALONE) if lanes == 1 else (_advanced_together, TOGETHER)

    def begun(jobs: tuple, wanted: Bool[np.ndarray, " lane"]) -> StateRows:
        return _begun(jobs, wanted, *walk, way=way)

    def advanced(jobs: tuple, walks: StateRows, idle: int) -> tuple:
        return further(jobs, walks, *walk, np.array(idle), way=way, length=length)

    (status, n_solves), rows = in_lanes(begun, advanced, (balances, starts), lanes)
    curves = []
    for k, given in enumerate(rows):
        points, tangents = given or (np.zeros((0, balances.size + 1)),) * 2
        curves.append(TracedCurve(points, tangents, CurveStatus(int(status[k])), int(n_solves[k])))
    return curves


def _tracer(balance: HarmonicBalance, ends: Array, steps: StepControl, way: _Way) -> CurveTracer:
    """Along the response, or along that at the lower end to a force that rises from zero."""
    lower, upper = ends / balance.frequency_scale
    if way != "rising":
        groups, closes = (balance.n_coefficients, balance.model.n_modes), way == "through"
        return CurveTracer(balance.linearised, CurveRange(lower, upper), steps, groups, closes)
    load = balance.newtons(lower) * balance.load()

    def linearised(point: Array) -> tuple[Array, Array]:
        """Unknowns x and the share of the force."""
        now = eqx.tree_at(lambda b: b.force, balance, balance.force * point[-1])
        residual, jacobian = now.linearised(point.at[-1].set(lower))
        return residual, jacobian.at[:, -1].set(-load)

    return CurveTracer(linearised, CurveRange(lower=-1.0, upper=1.0), steps, None, False)


def _first(job: tuple, ends: Array, steps: StepControl, downward: Array, way: _Way) -> Tracing:
    """The walk of one job before its first point."""
    balance, start = job
    if way == "rising":
        start = jnp.zeros(balance.size + 1)
    elif start is None:
        begin = jnp.where(downward, ends[1], ends[0])
        order = balance.harmonic_order
        linear = linear_coefficients(balance.model, balance.force, begin, order)
        start = balance.point(linear, begin)
    sense = 1.0 if way == "rising" else jnp.where(downward, -1.0, 1.0)
    direction = jnp.zeros_like(start).at[-1].set(sense)
    return _tracer(balance, ends, steps, way).begun(start, direction)


@compiled
def _begun(
    jobs: tuple,
    wanted: Bool[Array, " lane"],
    ends: Array,
    steps: StepControl,
    downward: Array,
    way: _Way,
) -> StateRows:
    def begun(job: tuple, wanted: Array) -> Tracing:
        status = jnp.where(wanted, RUNNING, int(CurveStatus.NO_START))
        return _first(job, ends, steps, downward, way)._replace(status=status)

    return in_rows(jax.vmap(begun)(jobs, wanted))


def _advanced(
    jobs: tuple,
    walks: StateRows,
    ends: Array,
    steps: StepControl,
    downward: Array,
    idle: Int[Array, ""],
    way: _Way,
    length: int,
) -> tuple[StateRows, tuple, tuple]:
    def result(walk: Tracing) -> tuple:
        return walk.status == RUNNING, walk.status, walk.n_solves

    def step(job: tuple, walk: Tracing) -> tuple[Tracing, tuple]:
        tracer = _tracer(job[0], ends, steps, way)
        walk, kept = tracer.corrected(walk) if length == _ALONE else tracer.advanced(walk)
        return walk, (kept, walk.here, walk.tangent)

    begun = partial(_first, ends=ends, steps=steps, downward=downward, way=way)
    return iterated(begun, step, result, jobs, walks, length, idle)


_advanced_alone = compiled(_advanced)
_advanced_together = compiled(_advanced, thoroughly=True)
