"""Rounds of fitting the curves and estimating the noise anew, until both belong together."""

from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array

from snrmjax.identify.checks.residual_autocorrelation import (
    added_covariance,
    along_resonance,
    residual_autocorrelation,
    sizes_off_resonance,
)
from snrmjax.identify.joint.force_balance import (
    BalanceProblem,
    Unknowns,
    Weighting,
    nearest_errors,
)
from snrmjax.identify.joint.free_unknowns import Unravel, packed_unknowns, padded_problem
from snrmjax.identify.joint.residuals import (
    LevelPattern,
    all_residuals,
    corrected_residuals,
    on_levels,
)
from snrmjax.identify.pointwise.backbone_points import OFF_RESONANCE
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.least_squares import degrees_spent, root_of_inverse

SOLVER: optx.AbstractLeastSquaresSolver = optx.LevenbergMarquardt(
    rtol=1e-10, atol=1e-10, linear_solver=lx.QR()
)
# A round starts near its end and another one follows: cost to 1e-7, unknowns to 1 % of their 1σ.
_ROUND: optx.AbstractLeastSquaresSolver = optx.LevenbergMarquardt(
    rtol=1e-7, atol=1e-4, linear_solver=lx.QR()
)
_MOST_STEPS = 200  # of Levenberg–Marquardt in a round
_TRUST = 100.0  # columns' size to the solver: its damping, one at first, is 1e-4 of theirs
_SETTLED = 0.1  # of the squared distance, in standard deviations, that a last round may move
_LEAST_LEFT = 0.25  # of the residuals, that no number of unknowns can take
_ROBUST = 2.5  # whitened residuals beyond it lose weight under the robust loss


class FitStatus(IntEnum):
    """How a least-squares fit ended."""

    CONVERGED = 0
    STEP_LIMIT = 1  # the solver used up its steps
    NOT_SETTLED = 2  # the rounds of estimating the noise were used up while the cost still fell
    NOT_FINITE = 3  # residuals that are not finite numbers


FIT_MESSAGE: dict[FitStatus, str] = {
    FitStatus.CONVERGED: "converged",
    FitStatus.STEP_LIMIT: f"not converged: the solver used up its {_MOST_STEPS} steps",
    FitStatus.NOT_SETTLED: (
        "not converged: fit and noise estimate still changed one another in the last round"
    ),
    FitStatus.NOT_FINITE: "failed: the residuals became infinite or undefined",
}


class NoiseAndLevels(NamedTuple):
    """1σ of the noise and of the errors that the states of a level share."""

    noise: float  # by which the residuals exceed the stated noise
    noise_std: float
    level: tuple[float, ...]  # of every kind of error that a level shares, stated or found
    independent: float = 1.0  # share of the states that count, where neighbours err alike

    @property
    def unit(self) -> float:
        """What residuals are counted in: the noise, larger where few states are independent."""
        return self.noise / float(np.sqrt(self.independent))

    @property
    def contradicts_upward(self) -> bool:
        """Whether the residuals are too large for the stated noise."""
        return self.noise - 3 * self.noise_std > 1

    @property
    def contradicts_downward(self) -> bool:
        """Whether they are too small for it."""
        return self.noise + 3 * self.noise_std < 1


class FitSettings(NamedTuple):
    """What a fit frees and believes."""

    free: tuple[str, ...]  # of `FREE`
    stated: bool  # whether the noise of the states is stated
    robust: bool  # whether outlying states lose weight
    rounds: tuple[int, int]  # of fitting and estimating the noise anew: at least, at most


class Fitted(NamedTuple):
    """Where the rounds of one fit ended."""

    unknowns: Unknowns
    covariance: np.ndarray
    problem: BalanceProblem  # with the corrections and the noise of the last round
    components: NoiseAndLevels
    residuals: np.ndarray
    autocorrelation: np.ndarray
    status: FitStatus


def fitted(
    start: Unknowns,
    problem: BalanceProblem,
    components: NoiseAndLevels,
    settings: FitSettings,
) -> Fitted:
    """Fit, estimate anew how large the noise is, and fit again."""
    free, stated, robust, (fewest, most) = settings
    stated_std, n, padded = problem.data.std, len(problem.data.level), padded_problem(problem)
    program = packed_unknowns(start, free, padded.data.n_levels)
    n_padded = len(padded.data.level)
    none = Weighting(jnp.zeros((n_padded, 2, 2)), jnp.zeros((n_padded, 2)))
    # An outlier has widened the noise at first: its weight falls round by round.
    fewest, most = (2 * fewest, max(2 * fewest, most)) if robust else (fewest, most)
    for turn in range(most):
        # What a wrong noise would take for errors can lead far away from the records.
        trusted = stated and not components.contradicts_upward
        widened = 1.0 if trusted else components.unit
        problem = problem.with_data(std=stated_std * widened)
        if not trusted:
            problem = problem.with_data(correction=jnp.zeros_like(problem.data.correction))
        given, correcting = (program.unravel, padded_problem(problem)), np.array(trusted)
        linear = _linearised(program.vector, *given, none, correcting, np.array(True))
        size = np.linalg.norm(np.asarray(linear.jacobian), axis=0)
        unit = jnp.asarray(_TRUST / np.where(size > 0, size, 1.0))
        vector, good = _solve(program.vector, *given, linear.weighting, correcting, unit)
        program = program._replace(vector=vector)
        answer = _linearised(vector, *given, linear.weighting, correcting, correcting)
        problem = problem.with_data(correction=answer.correction[:n])
        residuals = np.asarray(answer.residuals)[:n]
        jacobian = np.asarray(answer.jacobian)[:, program.own]
        if not (np.isfinite(float(answer.cost)) and np.all(np.isfinite(jacobian))):
            unknown, none_known = len(program.own), np.full(2, np.nan)
            covariance = np.full((unknown, unknown), np.nan)
            ended = (problem, components, residuals, none_known, FitStatus.NOT_FINITE)
            return Fitted(
                Unravel(start, free)(np.asarray(program.vector)[program.own]), covariance, *ended
            )
        if robust:
            weight = np.sqrt(np.asarray(problem.data.weight))
            lower = _ROBUST / np.maximum(np.linalg.norm(residuals, axis=1) / weight, 1e-9)
            problem = problem.with_data(weight=jnp.asarray(np.minimum(1.0, lower)))
        settled = float(linear.cost) - float(answer.cost) < _SETTLED
        if turn == most - 1 or (settled and turn >= fewest - 1):
            break
        share = 1.0 if trusted else components.independent
        # An unknown takes as much of correlated residuals as of the states that count.
        spent = degrees_spent(jacobian, residuals.size) / share
        dof = max(residuals.size - spent, _LEAST_LEFT * residuals.size, 1.0)
        noise = max(widened * float(np.sqrt(np.sum(residuals**2) / dof)), 1e-12)
        noise_std = noise / float(np.sqrt(2 * share * dof))
        components = components._replace(noise=noise, noise_std=noise_std)
    levels = along_resonance(np.asarray(problem.data.level), np.asarray(problem.data.frequency))
    alike, root = residual_autocorrelation(residuals, levels), root_of_inverse(jacobian)
    rows = jacobian[: 2 * n_padded].reshape(-1, 2, len(root))[:n]
    # What is left of overstated noise shares no more than it has.
    size = components.noise**2 if stated and components.contradicts_downward else 1.0
    counted = 1.0 if trusted else components.independent
    unequal = None
    if not stated:
        phase = np.angle(np.asarray(problem.data.velocity))
        unequal = sizes_off_resonance(residuals, rows @ root, phase, OFF_RESONANCE)
    status = FitStatus.CONVERGED if settled else FitStatus.NOT_SETTLED
    return Fitted(
        unknowns=Unravel(start, free)(np.asarray(program.vector)[program.own]),
        covariance=root @ root.T
        + size * added_covariance(root, rows, alike, levels, counted, unequal),
        problem=problem,
        components=components,
        residuals=residuals,
        autocorrelation=alike,
        status=status if bool(good) else FitStatus.STEP_LIMIT,
    )


class _Linear(NamedTuple):
    """The whitened problem at some unknowns."""

    weighting: Weighting
    residuals: Array  # of the states
    jacobian: Array  # of all residuals, priors included
    cost: Array
    correction: Array  # of every state's record: its most likely error, taken back


@compiled
def _linearised(
    vector: Array,
    unravel: Unravel,
    problem: BalanceProblem,
    weighting: Weighting,
    correcting: Array,
    anew: Array,
) -> _Linear:
    """Residuals and slopes, with the whitening given or `anew` with that of these unknowns."""
    unknowns = unravel(vector)
    given = (problem.data.correction, weighting)
    fresh = nearest_errors(unknowns, problem, correcting)
    errors, weighting = jax.tree.map(lambda a, b: jnp.where(anew, a, b), fresh, given)
    problem = problem.with_data(correction=errors)

    def residuals(vector: Array) -> Array:
        return all_residuals(vector, unravel, problem, weighting)

    left, push = jax.linearize(residuals, vector)
    pattern = LevelPattern.of(unravel, problem.data)
    points = left[: 2 * len(problem.data.level)].reshape(-1, 2)
    return _Linear(
        weighting=weighting,
        residuals=points,
        jacobian=pattern.jacobian(pattern.pushed(push)),
        cost=jnp.sum(left**2),
        correction=errors,
    )


@compiled
def _solve(
    vector: Array,
    unravel: Unravel,
    problem: BalanceProblem,
    weighting: Weighting,
    correcting: Array,
    unit: Array,
) -> tuple[Array, Array]:
    """Levenberg–Marquardt from the present unknowns; the vector found and whether it is one.

    Every unknown counts in its own `unit`, so that the solver's damping treats all alike. Where
    `correcting`, states are corrected for their most likely errors at every step: the residuals
    are then those errors in units of their 1σ, whose slopes need no derivative of the errors.
    """
    solution: optx.Solution = optx.least_squares(
        lambda y, _: corrected_residuals(y * unit, unravel, problem, weighting, correcting),
        *(on_levels(_ROUND, unravel, problem.data), vector / unit),
        max_steps=_MOST_STEPS,
        throw=False,
    )
    return solution.value * unit, jnp.asarray(solution.result == optx.RESULTS.successful)


def finite_fit(found: Fitted) -> Fitted:
    """The fit; raises `ValueError` where its residuals are not finite."""
    if found.status == FitStatus.NOT_FINITE:
        raise ValueError(
            "the residuals of the fit became infinite or undefined: try other families."
        )
    return found
