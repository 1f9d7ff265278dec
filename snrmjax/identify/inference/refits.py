"""What refits say of a joint fit's unknowns: profiles of its cost, and resampled states."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from snrmjax.identify.joint.family_fit import SOLVER
from snrmjax.identify.joint.force_balance import BalanceProblem, filled
from snrmjax.identify.joint.free_unknowns import Unravel, padded_problem
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.joint.residuals import corrected_residuals
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.numerics.status import Status

_PIN = 1e4  # weight, in its own 1σ, with which a profile holds an unknown
_MOST_STEPS = 200  # of a refit
_RISE = 3.84  # of χ² at the ends of a 95 % interval


class IntervalEnd(Status):
    """How an end of a profile's 95 % interval is known."""

    BRACKETED = 0, "between two computed values"
    BEYOND_REACH = 1, "beyond the values tried: ask for a larger `reach`"
    NOT_COMPUTED = 2, "not computed: the refits that would bracket it failed"


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
            f"lower end of the 95 % interval {self.lower:.6g} ({self.lower_status.message})",
            f"upper end {self.upper:.6g} ({self.upper_status.message})",
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
            "lower_status": self.lower_status.message,
            "upper_status": self.upper_status.message,
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
    refit, own = _refit_of(fit)
    index = int(own[names.index(name)])
    offsets = np.linspace(-reach, reach, n_points | 1)
    values = float(refit.vector[index]) + float(refit.std[index]) * offsets
    cost = np.asarray(_pinned(refit, np.array(index), jnp.asarray(values)))
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


def bootstrap(
    fit: JointFit, n_samples: int = 200, *, seed: int = 0, levels: bool = False
) -> Float[np.ndarray, "sample unknown"]:
    """Unknowns of refits to states drawn with replacement, within every level.

    With `levels` whole levels are drawn instead, which needs more of them than a curve has
    parameters. A refit that does not converge is a row of NaN.
    """
    rng = np.random.default_rng(seed)
    level = np.asarray(fit.data.level)
    weights = np.zeros((n_samples, len(level)))
    for row in weights:
        if levels:
            drawn = rng.integers(fit.data.n_levels, size=fit.data.n_levels)
            row += np.bincount(drawn, minlength=fit.data.n_levels)[level]
        else:
            for number in range(fit.data.n_levels):
                mine = np.flatnonzero(level == number)
                np.add.at(row, rng.choice(mine, size=mine.size), 1.0)
    weights = weights * np.asarray(fit.data.weight)
    refit, own = _refit_of(fit)
    room = len(refit.problem.data.level)
    every = np.stack([filled(row, room, 0.0) for row in weights])
    return np.asarray(_resampled(refit, jnp.asarray(every)))[:, own]


class _Refit(eqx.Module):
    """A fit's problem and where it ended, as compiled programs take them."""

    vector: Float[Array, " entry"]
    std: Float[Array, " entry"]
    unravel: Unravel
    problem: BalanceProblem

    def solved(self, residuals: Callable[[Array], Array], start: Array) -> Float[Array, " entry"]:
        """The unknowns that make residuals least, from a start on; NaN if none are found."""
        unit = jnp.where(self.std > 0, self.std, 1.0)
        found: optx.Solution = optx.least_squares(
            lambda y, _: residuals(self.vector + y * unit),
            *(SOLVER, (start - self.vector) / unit),
            max_steps=_MOST_STEPS,
            throw=False,
        )
        good = found.result == optx.RESULTS.successful
        return jnp.where(good, self.vector + found.value * unit, jnp.nan)


def _refit_of(fit: JointFit) -> tuple[_Refit, Int[np.ndarray, " unknown"]]:
    """The problem of refits, and where in its vector the fit's own unknowns are."""
    program = fit.packed()
    std = np.sqrt(np.diag(program.padded_covariance(fit.covariance)))
    problem = padded_problem(fit.problem)
    return _Refit(program.vector, jnp.asarray(std), program.unravel, problem), program.own


@compiled
def _resampled(refit: _Refit, weights: Array) -> Float[Array, "sample entry"]:
    def one(weight: Array) -> Array:
        given = (refit.unravel, refit.problem.with_data(weight=weight))
        return refit.solved(lambda vector: corrected_residuals(vector, *given), refit.vector)

    return jax.lax.map(one, weights)


@compiled
def _pinned(refit: _Refit, index: Array, values: Array) -> Float[Array, " value"]:
    """The least χ² with one unknown held at each of some values."""
    std = jnp.where(refit.std > 0, refit.std, 1.0)[index]

    def one(value: Array) -> Array:
        def residuals(vector: Array) -> Array:
            free = corrected_residuals(vector, refit.unravel, refit.problem)
            return jnp.append(free, _PIN * (vector[index] - value) / std)

        found = refit.solved(residuals, refit.vector.at[index].set(value))
        return jnp.sum(residuals(found)[:-1] ** 2)

    return jax.lax.map(one, values)
