"""Families of curves by name, fitted to the exact force balance by Levenberg–Marquardt."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.identify.checks.residual_autocorrelation import share_told_by
from snrmjax.identify.joint.force_balance import BalanceProblem, Unknowns, nearest_errors
from snrmjax.identify.joint.free_unknowns import (
    Unravel,
    corrected_residuals,
    packed_unknowns,
    padded_problem,
)
from snrmjax.identify.joint.notes import NoiseEstimate
from snrmjax.identify.joint.posterior_view import LEAST_LEFT
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.least_squares import degrees_spent, root_of_inverse
from snrmjax.numerics.status import Status

MOST_STEPS = 200  # of Levenberg–Marquardt in a fit
_ROUNDS = 6  # of fitting and estimating the noise anew, at most
_SETTLED = 0.01  # relative change of the noise, in the last of them
_TRUST = 100.0  # columns' size to the solver: its damping, one at first, is 1e-4 of theirs


class FitStatus(Status):
    """How a joint fit ended."""

    CONVERGED = 0, "converged"
    STEP_LIMIT = 1, f"not converged: the solver used up its {MOST_STEPS} steps"
    NOT_SETTLED = (
        2,
        "not converged: fit and noise estimate still changed one another in the last round",
    )
    NOT_FINITE = 3, "failed: the residuals became infinite or undefined"


class FamilyFit(NamedTuple):
    """Where the fit of named families ended."""

    unknowns: Unknowns
    covariance: Float[np.ndarray, "unknown unknown"]
    problem: BalanceProblem  # with the corrections and the noise of the last round
    noise: NoiseEstimate
    residuals: Float[np.ndarray, "state part"]  # of unit variance where the noise is as found
    status: FitStatus


def fit_families(
    start: Unknowns,
    problem: BalanceProblem,
    free: tuple[str, ...],
    noise: NoiseEstimate,
    stated: Float[np.ndarray, "state input"],
    *,
    believed: bool,
) -> FamilyFit:
    """Fit, estimate anew how large the noise is, and fit again.

    The families may leave more than the smooth curves do, from which the unknowns start: then
    noise is larger, and states whose neighbours miss the curves alike count as fewer.

    Arguments: `stated` 1σ of the states' errors, of whose size only `noise.scale` is known unless
    they are `believed`.
    Raises `ValueError` where residuals are not finite.
    """
    program, n = packed_unknowns(start, free, padded_problem(problem).data.n_levels), len(stated)
    size, status = 1.0 if believed else noise.scale, FitStatus.NOT_SETTLED
    share = 1.0
    for _ in range(_ROUNDS):
        problem = problem.with_data(std=jnp.asarray(stated * size / np.sqrt(share)))
        given = (program.unravel, padded_problem(problem))
        size_of = np.linalg.norm(np.asarray(_linearised(program.vector, *given).jacobian), axis=0)
        unit = jnp.asarray(_TRUST / np.where(size_of > 0, size_of, 1.0))
        vector, good = _solved(program.vector, *given, unit)
        program = program._replace(vector=vector)
        answer = _linearised(vector, *given)
        jacobian = np.asarray(answer.jacobian)[:, program.own]
        if not (np.all(np.isfinite(answer.residuals)) and np.all(np.isfinite(jacobian))):
            raise ValueError(f"{FitStatus.NOT_FINITE.message}: try other families.")
        problem = problem.with_data(correction=answer.correction[:n])
        residuals = np.asarray(answer.residuals)[:n] / np.sqrt(share)
        level, frequency = (np.asarray(a) for a in (problem.data.level, problem.data.frequency))
        independent = share_told_by(residuals, level, frequency)
        rows = independent * residuals.size
        left = max(rows - degrees_spent(jacobian, answer.residuals.size), LEAST_LEFT * rows)
        scale = size * float(np.sqrt(independent * np.sum(residuals**2) / left))
        std = scale / float(np.sqrt(2 * left))
        noise = dataclasses.replace(noise, scale=scale, scale_std=std)
        wanted = 1.0 if believed and not noise.exceeded else max(scale, 1e-12)
        change = np.hypot(np.log(wanted / size), np.log(independent / share))
        size, share = (size, share) if change < _SETTLED else (wanted, independent)
        if change < _SETTLED:
            status = FitStatus.CONVERGED if bool(good) else FitStatus.STEP_LIMIT
            break
    root = root_of_inverse(jacobian)
    unknowns = Unravel(start, free)(np.asarray(program.vector)[program.own])
    return FamilyFit(unknowns, root @ root.T, problem, noise, residuals, status)


class _Answer(NamedTuple):
    """The whitened problem at the end of a fit."""

    residuals: Array  # of the states
    jacobian: Array  # of all residuals, priors included
    correction: Array  # of every state's record: its most likely error, taken back


@compiled
def _linearised(vector: Array, unravel: Unravel, problem: BalanceProblem) -> _Answer:
    def residuals(vector: Array) -> tuple[Array, Array]:
        left = corrected_residuals(vector, unravel, problem)
        return left, left

    jacobian, left = jax.jacfwd(residuals, has_aux=True)(vector)
    errors, _ = nearest_errors(unravel(vector), problem)
    return _Answer(left[: 2 * len(problem.data.level)].reshape(-1, 2), jacobian, errors)


@compiled
def _solved(
    vector: Array, unravel: Unravel, problem: BalanceProblem, unit: Array
) -> tuple[Array, Array]:
    """Levenberg–Marquardt from the present unknowns: where it ended, and whether it converged.

    Every unknown counts in its own `unit`, so that the solver's damping treats all alike; states
    are corrected for their most likely errors at every step.
    """
    with jax.ensure_compile_time_eval():  # late, as in `snrmjax.identify.pointwise.inversion`
        import lineax as lx
        import optimistix as optx

    # A round starts near its end: cost to 1e-7, unknowns to 1 % of their 1σ.
    solver: Any = optx.LevenbergMarquardt(rtol=1e-7, atol=1e-4, linear_solver=lx.QR())
    solution: optx.Solution = optx.least_squares(
        lambda y, _: corrected_residuals(y * unit, unravel, problem),
        *(solver, vector / unit),
        max_steps=MOST_STEPS,
        throw=False,
    )
    return solution.value * unit, jnp.asarray(solution.result == optx.RESULTS.successful)
