"""Intervals of single unknowns of a joint fit by the profile of its cost."""

from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from snrmjax.identify.joint.fitting import SOLVER
from snrmjax.identify.joint.force_balance import (
    BalanceData,
    Spread,
    weighing_at,
)
from snrmjax.identify.joint.free_unknowns import Restore
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.joint.residuals import (
    freed_residuals,
)
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.compiled import compiled

_PIN = 1e4  # weight, in its own 1σ, with which a profile holds an unknown
_RISE = 3.84  # of χ² at the ends of a 95 % interval


class IntervalEnd(IntEnum):
    """How an end of a profile's 95 % interval is known."""

    BRACKETED = 0  # between two values whose refits converged
    BEYOND_REACH = 1  # χ² rises by less than 3.84 up to the last value tried: farther away
    NOT_COMPUTED = 2  # the refits that would bracket it failed


END_MESSAGE: dict[IntervalEnd, str] = {
    IntervalEnd.BRACKETED: "between two computed values",
    IntervalEnd.BEYOND_REACH: "beyond the values tried: ask for a larger `reach`",
    IntervalEnd.NOT_COMPUTED: "not computed: the refits that would bracket it failed",
}


class Profile(NamedTuple):
    """The best fit's cost against one unknown, the others fitted anew."""

    name: str
    values: Float[np.ndarray, " point"]
    rise: Float[np.ndarray, " point"]  # of χ² over its least value; NaN where the refit failed
    lower: float  # 95 %, where the rise is 3.84; −∞ beyond the values tried, NaN not computed
    upper: float  # likewise, +∞
    lower_status: IntervalEnd
    upper_status: IntervalEnd


def profile(fit: JointFit, name: str, *, n_points: int = 15, reach: float = 3.5) -> Profile:
    """χ² against one unknown, everything else fitted anew at each of its values.

    Where the interval differs from ±1.96σ the unknown is not quadratic: believe the profile. It
    takes states for independent, though: where the residuals of neighbours are alike
    (`fit.neighbour_correlation`), it is too narrow, and ±1.96σ is right.

    Arguments: `name` one of `fit.names()`; `reach` in standard deviations on either side.
    Raises `ValueError` for a name that the fit does not have.
    """
    names = fit.names()
    if name not in names:
        raise ValueError(f"the fit has no unknown {name!r}; it has {', '.join(names[:6])}, …")
    index, (vector, restore) = names.index(name), fit.vector()
    std = np.sqrt(np.diag(fit.covariance))
    offsets = np.linspace(-reach, reach, n_points | 1)
    values = float(vector[index]) + std[index] * offsets
    cost = np.asarray(
        _pinned(
            *(vector, restore, fit.data, fit.modes, fit.spread),
            *(np.array(fit.freed), jnp.asarray(std), np.array(index), jnp.asarray(values)),
        )
    )
    middle = len(cost) // 2
    # The value in the middle is the fit's own.
    rise = cost - cost[middle]
    below, below_status = _crossing(values[middle::-1], rise[middle::-1])
    above, above_status = _crossing(values[middle:], rise[middle:])
    return Profile(name, values, rise, below, above, below_status, above_status)


def _crossing(values: np.ndarray, rise: np.ndarray) -> tuple[float, IntervalEnd]:
    """Where the rise first passes 3.84, going outwards from the fit's own value.

    Values at which the refit failed are left out: neighbours that were computed bracket the end.
    """
    known = np.isfinite(rise)
    outside = np.flatnonzero(rise[known] >= _RISE)
    if outside.size and outside[0] > 0:
        pair = slice(outside[0] - 1, outside[0] + 1)
        end = np.interp(_RISE, rise[known][pair], values[known][pair])
        return float(end), IntervalEnd.BRACKETED
    if known[-1] and known[0]:
        return float(np.sign(values[-1] - values[0]) * np.inf), IntervalEnd.BEYOND_REACH
    return float("nan"), IntervalEnd.NOT_COMPUTED


@compiled
def _pinned(
    vector: Array,
    restore: Restore,
    data: BalanceData,
    modes: LinearModes,
    spread: Spread,
    freed: Array,
    std: Array,
    index: Array,
    values: Array,
) -> Float[Array, " value"]:
    weighing = weighing_at(restore(vector), data, modes, spread)
    unit = jnp.where(std > 0, std, 1.0)

    def one(value: Array) -> Array:
        def residuals(y: Array, _: None = None) -> Array:
            point = vector + y * unit
            free = freed_residuals(point, restore, data, modes, spread, weighing, freed)
            held = _PIN * (point[index] - value) / unit[index]
            return jnp.append(free, held)

        start = jnp.zeros_like(vector).at[index].set((value - vector[index]) / unit[index])
        found: optx.Solution = optx.least_squares(
            residuals, SOLVER, start, max_steps=200, throw=False
        )
        good = found.result == optx.RESULTS.successful
        return jnp.where(good, jnp.sum(residuals(found.value)[:-1] ** 2), jnp.nan)

    return jax.lax.map(one, values)
