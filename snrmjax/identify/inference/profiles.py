"""Intervals of single unknowns of a joint fit by the profile of its cost."""

from enum import IntEnum

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from snrmjax.identify.joint.family_fit import SOLVER
from snrmjax.identify.joint.force_balance import BalanceProblem
from snrmjax.identify.joint.free_unknowns import Unravel, padded_problem
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.joint.residuals import (
    corrected_residuals,
)
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.result import AbstractResult, Variable

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


class Profile(AbstractResult):
    """The best fit's cost against one unknown, the others fitted anew."""

    coordinates = ("value",)

    name: str = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    values: Float[np.ndarray, " point"]
    rise: Float[np.ndarray, " point"]  # of χ² over its least value; NaN where the refit failed
    lower: float  # 95 %, where the rise is 3.84; −∞ beyond the values tried, NaN not computed
    upper: float  # likewise, +∞
    lower_status: IntervalEnd = eqx.field(static=True)
    upper_status: IntervalEnd = eqx.field(static=True)

    @property
    def n_failed(self) -> int:
        """Values at which the refit did not converge."""
        return int(np.sum(~np.isfinite(self.rise)))

    def summary(self) -> tuple[str, ...]:
        """See `AbstractResult`."""
        return (
            f"Profile of {self.name} ({self.unit}): {len(self.values)} values from "
            f"{self.values[0]:.6g} to {self.values[-1]:.6g}, {self.n_failed} refits failed",
            f"lower end of the 95 % interval {self.lower:.6g} ({END_MESSAGE[self.lower_status]})",
            f"upper end {self.upper:.6g} ({END_MESSAGE[self.upper_status]})",
        )

    def variables(self) -> dict[str, Variable]:
        """See `AbstractResult`."""
        per = ("value",)
        return {
            "value": Variable(per, self.values, self.unit, self.name),
            "rise": Variable(per, self.rise, "1", "rise of χ² over its least value"),
        }

    def attributes(self) -> dict[str, str | float | int]:
        """See `AbstractResult`."""
        return {
            "parameter": self.name,
            "lower": self.lower,
            "upper": self.upper,
            "lower_status": END_MESSAGE[self.lower_status],
            "upper_status": END_MESSAGE[self.upper_status],
        }


def profile(fit: JointFit, name: str, *, n_points: int = 15, reach: float = 3.5) -> Profile:
    """χ² against one unknown, everything else fitted anew at each of its values.

    Where the interval differs from ±1.96σ the unknown is not quadratic: believe the profile.

    Arguments: `name` one of `fit.names()`; `reach` in standard deviations on either side.
    Raises `ValueError` for a name that the fit does not have.
    """
    names = fit.names()
    if name not in names:
        raise ValueError(f"the fit has no unknown {name!r}; it has {', '.join(names[:6])}, …")
    program = fit.packed()
    vector, unravel, index = program.vector, program.unravel, int(program.own[names.index(name)])
    std = np.sqrt(np.diag(program.padded_covariance(fit.covariance)))
    offsets = np.linspace(-reach, reach, n_points | 1)
    values = float(vector[index]) + std[index] * offsets
    cost = np.asarray(
        _pinned(
            *(vector, unravel, padded_problem(fit.problem)),
            *(jnp.asarray(std), np.array(index), jnp.asarray(values)),
        )
    )
    middle = len(cost) // 2
    # The value in the middle is the fit's own.
    rise = cost - cost[middle]
    below, below_status = _crossing(values[middle::-1], rise[middle::-1])
    above, above_status = _crossing(values[middle:], rise[middle:])
    ends = (below, above, below_status, above_status)
    return Profile(name, fit.units()[names.index(name)], values, rise, *ends)


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
    unravel: Unravel,
    problem: BalanceProblem,
    std: Array,
    index: Array,
    values: Array,
) -> Float[Array, " value"]:
    unit = jnp.where(std > 0, std, 1.0)

    def one(value: Array) -> Array:
        def residuals(y: Array, _: None = None) -> Array:
            point = vector + y * unit
            free = corrected_residuals(point, unravel, problem)
            held = _PIN * (point[index] - value) / unit[index]
            return jnp.append(free, held)

        start = jnp.zeros_like(vector).at[index].set((value - vector[index]) / unit[index])
        found: optx.Solution = optx.least_squares(
            residuals, SOLVER, start, max_steps=200, throw=False
        )
        good = found.result == optx.RESULTS.successful
        return jnp.where(good, jnp.sum(residuals(found.value)[:-1] ** 2), jnp.nan)

    return jax.lax.map(one, values)
