"""Many response curves of one kind: stacked balances, starts, blocks over the cores."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import mapped, over_cores, stacked, taken
from snrmjax.numerics.compiled import compiled
from snrmjax.simulate.balance.harmonic_balance import (
    HarmonicBalance,
    linear_coefficients,
    resonance_displacement,
    samples_for,
)
from snrmjax.simulate.continuation.continuation import (
    Curve,
    CurveRange,
    CurveStatus,
    StepControl,
    TracedCurve,
    on_host,
    trace_curve,
)

_BLOCK = 8  # curves that one program traces


def response_balances(
    models: Sequence[Structure],
    forces: Float[np.ndarray, " member"],
    harmonic_order: int,
    n_samples: int | None,
) -> HarmonicBalance:
    """The balances of all members under their forces (N), stacked."""
    together = stacked(models)
    j = models[0].modes.mode_of_interest
    scales = [resonance_displacement(m, float(f)) for m, f in zip(models, forces, strict=True)]
    # On the host: on the device another number of members would compile anew.
    columns: dict[str, Any] = {
        "force": np.asarray(forces),
        "displacement_scale": np.asarray(scales),
        "frequency_scale": np.asarray(together.modes.natural_frequency)[:, j],
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
    *,
    downward: bool,
    ramp: bool = False,
) -> list[TracedCurve]:
    """The curves of the members `index`, in blocks over the cores.

    From the linear response at an end of the range (rad/s), or with `ramp` from the response to a
    force that rises from zero at the lower end.
    """
    # A single one of many takes the program of all.
    size = 1 if np.size(balances.force) == 1 else _BLOCK
    jobs = [index[b : b + size] for b in range(0, len(index), size)]

    def trace(job: np.ndarray) -> list[TracedCurve]:
        rows = job[np.minimum(np.arange(size), len(job) - 1)]
        mine = taken(balances, rows)
        wanted = np.arange(size) < len(job)
        if ramp:
            starts, ready = _ramped(mine, ends, steps)
            curve = _trace(
                *(mine, ends, steps, np.array(downward)), wanted=wanted & ready, starts=starts
            )
        else:
            curve = _trace(mine, ends, steps, np.array(downward), wanted)
        return _trimmed(curve, len(job))

    return [curve for block in over_cores(trace, jobs) for curve in block]


def trace_through(
    balances: HarmonicBalance,
    ends: Float[Array, " end"],
    steps: StepControl,
    *,
    downward: bool,
    starts: Float[Array, "member unknown"],
) -> list[TracedCurve]:
    """Curves through given scaled points, towards one end of the range (rad/s)."""
    wanted = np.ones(len(starts), dtype=bool)
    curve = _trace(balances, ends, steps, np.array(downward), wanted, starts)
    return _trimmed(curve, len(starts))


def _trimmed(curve: Curve, count: int) -> list[TracedCurve]:
    """The first `count` curves without their unused rows, on the host."""
    rows = [np.asarray(part) for part in curve]
    return [on_host(Curve(*(part[k] for part in rows))) for k in range(count)]


@compiled
def _ramped(
    balances: HarmonicBalance, ends: Array, steps: StepControl
) -> tuple[Float[Array, "member unknown"], Bool[Array, " member"]]:
    """Starts from the response at the lower frequency to a force that rises from zero."""

    def ramped(balance: HarmonicBalance) -> tuple[Array, Array]:
        load = balance.force * balance.load()
        frequency = ends[0] / balance.frequency_scale

        def rising(point: Array) -> tuple[Array, Array]:
            now = eqx.tree_at(lambda b: b.force, balance, balance.force * point[-1])
            residual, jacobian = now.linearised(point.at[-1].set(frequency))
            return residual, jacobian.at[:, -1].set(-load)

        rest = jnp.zeros(balance.size + 1)
        curve = trace_curve(
            rising, rest, rest.at[-1].set(1.0), CurveRange(lower=-1.0, upper=1.0), steps
        )
        last = curve.points[jnp.maximum(curve.n_points - 1, 0)]
        return last.at[-1].set(frequency), curve.status == int(CurveStatus.UPPER_END)

    return mapped(ramped, balances)


@compiled
def _trace(
    balances: HarmonicBalance,
    ends: Float[Array, " end"],
    steps: StepControl,
    downward: Bool[Array, ""],
    wanted: Bool[Array, " member"],
    starts: Float[Array, "member unknown"] | None = None,
) -> Curve:
    """Curves through the frequency range from `starts`, or from the linear response.

    Those not wanted do not start.
    """

    def traced(balance: HarmonicBalance, wanted: Array, start: Array | None = None) -> Curve:
        if start is None:
            begin = jnp.where(downward, ends[1], ends[0])
            order = balance.harmonic_order
            linear = linear_coefficients(balance.model, balance.force, begin, order)
            start = balance.point(linear, begin)
        direction = jnp.zeros_like(start).at[-1].set(jnp.where(downward, -1.0, 1.0))
        lower, upper = ends / balance.frequency_scale
        return trace_curve(
            balance.linearised,
            jnp.where(wanted, start, jnp.nan),
            direction,
            CurveRange(lower, upper),
            steps,
            groups=(balance.n_coefficients, balance.model.n_modes),
        )

    return mapped(traced, balances, wanted, *(() if starts is None else (starts,)))
