"""Rounds of fitting the curves and estimating the noise anew, until both belong together."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array

from snrmjax.identify.joint.force_balance import (
    BalanceData,
    Spread,
    Unknowns,
    Weighing,
    weighing_at,
)
from snrmjax.identify.joint.free_unknowns import Restore, programmed, with_room
from snrmjax.identify.joint.residual_autocorrelation import (
    added_covariance,
    along_resonance,
    neighbour_correlation,
)
from snrmjax.identify.joint.residuals import (
    LevelPattern,
    all_residuals,
    freed_of_errors,
    freed_residuals,
    on_levels,
)
from snrmjax.identify.joint.variance_components import Scatter
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.least_squares import degrees_spent, root_of_inverse

SOLVER: optx.AbstractLeastSquaresSolver = optx.LevenbergMarquardt(
    rtol=1e-10, atol=1e-10, linear_solver=lx.QR()
)
# A round starts near its end and another one follows: cost to 1e-7, unknowns to 1 % of their 1σ.
_ROUND: optx.AbstractLeastSquaresSolver = optx.LevenbergMarquardt(
    rtol=1e-7, atol=1e-4, linear_solver=lx.QR()
)
_TRUST = 100.0  # columns' size to the solver: its damping, one at first, is 1e-4 of theirs
_SETTLED = 0.1  # of the squared distance, in standard deviations, that a last round may move
_ROBUST = 2.5  # whitened residuals beyond it lose weight under the robust loss


class NotFinite(ValueError):
    """A fit whose residuals are no numbers."""


class Fitted(NamedTuple):
    """Where the rounds of one fit ended."""

    unknowns: Unknowns
    covariance: np.ndarray
    spread: Spread
    data: BalanceData
    scatter: Scatter
    residuals: np.ndarray
    neighbours: np.ndarray
    converged: bool


def fitted(
    start: Unknowns,
    data: BalanceData,
    modes: LinearModes,
    spread: Spread,
    free: tuple[str, ...],
    scatter: Scatter,
    *,
    stated: bool,
    robust: bool,
    rounds: tuple[int, int],
) -> Fitted:
    """Fit, estimate what levels scatter and how large the noise is, and fit again."""
    stated_std, n, room = data.std, len(data.level), with_room(data)
    program = programmed(start, free, room.n_levels)

    def as_noisy(scatter: Scatter) -> float:
        return scatter.noise if not stated or scatter.contradicts_upward else 1.0

    none = Weighing(jnp.zeros((len(room.level), 2, 2)), jnp.zeros((len(room.level), 2)))
    fewest, most = rounds
    # An outlier has widened the noise at first: its weight falls round by round.
    fewest, most = (2 * fewest, max(2 * fewest, most)) if robust else (fewest, most)
    for turn in range(most):
        widened = as_noisy(scatter)
        data = eqx.tree_at(lambda d: d.std, data, stated_std * widened)
        # What a wrong noise would take for errors can lead far away from the records.
        trusted = stated and not scatter.contradicts_upward
        if not trusted:
            data = eqx.tree_at(lambda d: d.correction, data, jnp.zeros_like(data.correction))
        settings, freed = (program.restore, with_room(data), modes, spread), np.array(trusted)
        linear = _linearised(program.vector, *settings, none, freed, np.array(True))
        size = np.linalg.norm(np.asarray(linear.jacobian), axis=0)
        unit = jnp.asarray(_TRUST / np.where(size > 0, size, 1.0))
        vector, good = _solve(program.vector, *settings, linear.weighing, freed, unit)
        program = program._replace(vector=vector)
        answer = _linearised(vector, *settings, linear.weighing, freed, freed)
        data = eqx.tree_at(lambda d: d.correction, data, answer.correction[:n])
        residuals = np.asarray(answer.residuals)[:n]
        if not np.isfinite(float(answer.cost)):
            raise NotFinite("the fit ran into numbers that are not finite: try other families.")
        jacobian = np.asarray(answer.jacobian)[:, program.own]
        if robust:
            weight = np.sqrt(np.asarray(data.weight))
            lower = _ROBUST / np.maximum(np.linalg.norm(residuals, axis=1) / weight, 1e-9)
            data = eqx.tree_at(lambda d: d.weight, data, jnp.asarray(np.minimum(1.0, lower)))
        settled = float(linear.cost) - float(answer.cost) < _SETTLED
        if turn == most - 1 or (settled and turn >= fewest - 1):
            break
        dof = max(residuals.size - degrees_spent(jacobian, residuals.size), 1.0)
        noise = max(widened * float(np.sqrt(np.sum(residuals**2) / dof)), 1e-12)
        scatter = scatter._replace(noise=noise, noise_std=noise / float(np.sqrt(2 * dof)))
    levels = along_resonance(np.asarray(data.level), np.asarray(data.frequency))
    alike, root = neighbour_correlation(residuals, levels), root_of_inverse(jacobian)
    rows = jacobian[: 2 * len(room.level)].reshape(-1, 2, len(root))[:n]
    # What is left of overstated noise shares no more than it has.
    size = scatter.noise**2 if stated and scatter.contradicts_downward else 1.0
    return Fitted(
        unknowns=Restore(start, free)(program.vector[program.own]),
        covariance=root @ root.T + size * added_covariance(root, rows, alike, levels),
        spread=spread,
        data=data,
        scatter=scatter,
        residuals=residuals,
        neighbours=alike,
        converged=bool(good) and settled,
    )


class _Linear(NamedTuple):
    """The whitened problem at some unknowns."""

    weighing: Weighing
    residuals: Array  # of the states
    jacobian: Array  # of all residuals, priors included
    cost: Array
    correction: Array  # of every state's record: its likeliest error, taken back


@compiled
def _linearised(
    vector: Array,
    restore: Restore,
    data: BalanceData,
    modes: LinearModes,
    spread: Spread,
    weighing: Weighing,
    freed: Array,
    anew: Array,
) -> _Linear:
    """Residuals and slopes, with the whitening given or `anew` with that of these unknowns."""
    unknowns = restore(vector)
    recorded = (data.correction, weighing_at(unknowns, data, modes, spread))
    given = (data.correction, weighing)
    settings = (unknowns, data, modes, spread)
    fresh = jax.lax.cond(freed, lambda: freed_of_errors(*settings), lambda: recorded)
    errors, weighing = jax.tree.map(lambda a, b: jnp.where(anew, a, b), fresh, given)
    data = eqx.tree_at(lambda d: d.correction, data, errors)

    def residuals(vector: Array) -> Array:
        return all_residuals(vector, restore, data, modes, spread, weighing)

    left, push = jax.linearize(residuals, vector)
    pattern = LevelPattern.of(restore, data)
    points = left[: 2 * len(data.level)].reshape(-1, 2)
    return _Linear(
        weighing=weighing,
        residuals=points,
        jacobian=pattern.jacobian(pattern.pushed(push)),
        cost=jnp.sum(left**2),
        correction=errors,
    )


@compiled
def _solve(
    vector: Array,
    restore: Restore,
    data: BalanceData,
    modes: LinearModes,
    spread: Spread,
    weighing: Weighing,
    freed: Array,
    unit: Array,
) -> tuple[Array, Array]:
    """Levenberg–Marquardt from the present unknowns; the vector found and whether it is one.

    Every unknown counts in its own `unit`, so that the solver's damping treats all alike. States
    that are `freed` of their likeliest errors are so at every step: the residuals are then those
    errors in units of their 1σ, and their slopes need no derivative of the errors themselves.
    """

    solution: optx.Solution = optx.least_squares(
        lambda y, _: freed_residuals(y * unit, *(restore, data, modes, spread, weighing, freed)),
        *(on_levels(_ROUND, restore, data), vector / unit),
        max_steps=200,
        throw=False,
    )
    return solution.value * unit, jnp.asarray(solution.result == optx.RESULTS.successful)
