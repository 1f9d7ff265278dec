"""The unknowns of a joint fit, fitted anew to resampled states."""

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from snrmjax.identify.joint.force_balance import BalanceProblem, filled
from snrmjax.identify.joint.free_unknowns import Unravel, corrected_residuals, padded_problem
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.numerics.compiled import compiled, on_numbers

SOLVER: optx.AbstractLeastSquaresSolver = optx.LevenbergMarquardt(
    rtol=1e-10, atol=1e-10, linear_solver=lx.QR()
)
_MOST_STEPS = 200  # of a refit


@on_numbers(
    "Differentiate `sj.identify.identify_points`, or the fitted curves themselves (`fit.unknowns`)."
)
def bootstrap(
    fit: JointFit, n_samples: int = 200, *, seed: int = 0, levels: bool = False
) -> Float[np.ndarray, "sample unknown"]:
    """Unknowns of refits to states drawn with replacement, within every level.

    With `levels` whole levels are drawn instead, which needs more of them than a curve has
    parameters. A refit that does not converge is a row of NaN.

    Not differentiable: differentiate `snrmjax.identify.identify_points`, or the fitted curves
    themselves (`fit.unknowns`).
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
    program, problem = fit.packed(), padded_problem(fit.problem)
    std = np.sqrt(np.diag(program.padded_covariance(fit.covariance)))
    room, weights = len(problem.data.level), weights * np.asarray(fit.data.weight)
    rows = jnp.asarray(np.stack([filled(row, room, 0.0) for row in weights]))
    unit = jnp.asarray(np.where(std > 0, std, 1.0))
    found = _resampled(program.vector, program.unravel, problem, unit, rows)
    return np.asarray(found)[:, program.own]


@compiled
def _resampled(
    vector: Array, unravel: Unravel, problem: BalanceProblem, unit: Array, weights: Array
) -> Float[Array, "sample entry"]:
    """Unknowns that make the residuals of weighted states least; NaN where none are found."""

    def refit(weight: Array) -> Array:
        weighted = problem.with_data(weight=weight)
        solution: optx.Solution = optx.least_squares(
            lambda y, _: corrected_residuals(vector + y * unit, unravel, weighted),
            *(SOLVER, jnp.zeros_like(vector)),
            max_steps=_MOST_STEPS,
            throw=False,
        )
        good = solution.result == optx.RESULTS.successful
        return jnp.where(good, vector + solution.value * unit, jnp.nan)

    return jax.lax.map(refit, weights)
