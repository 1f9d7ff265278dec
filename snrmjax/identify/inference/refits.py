"""The unknowns of a joint fit, fitted anew to resampled states."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from snrmjax.identify.joint.family_fit import SOLVER
from snrmjax.identify.joint.force_balance import BalanceProblem, filled
from snrmjax.identify.joint.free_unknowns import Unravel, corrected_residuals, padded_problem
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.numerics.compiled import compiled

_MOST_STEPS = 200  # of a refit


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
    refit, places = _refit_of(fit)
    room = len(refit.problem.data.level)
    padded_weights = np.stack([filled(row, room, 0.0) for row in weights])
    return np.asarray(_resampled(refit, jnp.asarray(padded_weights)))[:, places]


class _Refit(eqx.Module):
    """A fit's problem and where it ended, as compiled programs take them."""

    vector: Float[Array, " entry"]
    std: Float[Array, " entry"]
    unravel: Unravel
    problem: BalanceProblem

    def solved(self, residuals: Callable[[Array], Array], start: Array) -> Float[Array, " entry"]:
        """The unknowns that make residuals least, from a start on; NaN if none are found."""
        unit = jnp.where(self.std > 0, self.std, 1.0)
        solution: optx.Solution = optx.least_squares(
            lambda y, _: residuals(self.vector + y * unit),
            *(SOLVER, (start - self.vector) / unit),
            max_steps=_MOST_STEPS,
            throw=False,
        )
        good = solution.result == optx.RESULTS.successful
        return jnp.where(good, self.vector + solution.value * unit, jnp.nan)


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
