"""Least squares: covariances, and Levenberg–Marquardt from several starts with early stopping.

The joint fit uses optimistix's solver, which is compiled for one problem. Here an evaluation is
costly, covers many points in one call and runs on the host: all starting points step together,
the least promising are dropped after a few steps, and a negligible last step is taken without
another evaluation.
"""

import dataclasses
from collections.abc import Callable, Sequence
from enum import StrEnum
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from jaxtyping import Float


def inverse_of(jacobian: np.ndarray) -> np.ndarray:
    """(JᵀJ)⁻¹, by singular values with columns scaled to unit norm."""
    root = root_of_inverse(jacobian)
    return root @ root.T


def root_of_inverse(jacobian: np.ndarray) -> np.ndarray:
    """K with (JᵀJ)⁻¹ = KKᵀ."""
    norm = np.linalg.norm(jacobian, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    _, values, rows = np.linalg.svd(jacobian / norm, full_matrices=False)
    # Smaller ones are rounding; an exact zero would end in a division by it.
    values = np.maximum(values, np.finfo(float).eps * np.max(values, initial=0.0))
    return (rows.T / values) / norm[:, None]


class MinimisationStatus(StrEnum):
    """How a least-squares fit ended."""

    CONVERGED = "converged"  # a further step changes the sum of squares by less than `settled`
    STALLED = "stalled"  # no step lowers the sum of squares, however short
    STEP_LIMIT = "step_limit"  # still falling after the last step
    GIVEN_UP = "given_up"  # dropped: another starting point, or another fit, was more promising
    NOT_FINITE = "not_finite"  # no finite residuals at the starting point
    NOT_FITTED = "not_fitted"  # a starting point, or a model without free parameters

    @property
    def found_minimum(self) -> bool:
        """Whether the fit ended at a minimum."""
        return self in (MinimisationStatus.CONVERGED, MinimisationStatus.STALLED)


class AbstractLinearisation(Protocol):
    """A least-squares problem evaluated at one point."""

    @property
    def residuals(self) -> Float[np.ndarray, " row"]:
        """Residuals of unit variance; not finite where the problem has no solution."""

    @property
    def jacobian(self) -> Float[np.ndarray, "row unknown"]:
        """Their derivatives with respect to the unknowns."""


Linearisation = TypeVar("Linearisation", bound=AbstractLinearisation)


@dataclasses.dataclass(frozen=True)
class StepRule:
    """How steps are damped, and when a fit ends.

    Marquardt's damping starts at `damping`, is multiplied by `eased` after a step that lowers the
    sum of squares and by `stiffened` after one that does not; above `largest_damping` the fit has
    stalled. A fit ends when a step lowers the sum by less than `settled`, or after `steps`. After
    `screened` steps only the `kept` best starting points continue. With `trust_short_steps` a step
    with a predicted reduction below `settled` is the last and is not evaluated.
    """

    steps: int = 30
    settled: float = 1e-2
    damping: float = 1e-3
    eased: float = 0.1
    stiffened: float = 10.0
    largest_damping: float = 1e6
    screened: int | None = None
    kept: int = 1
    trust_short_steps: bool = False


class Minimum(NamedTuple, Generic[Linearisation]):
    """Where a fit from one starting point ended."""

    point: Float[np.ndarray, " unknown"]
    sum_of_squares: float  # infinite if no finite value was reached
    linearised: Linearisation  # at `point`, or a short last step before it
    last_step: Float[np.ndarray, " unknown"]  # from the point of linearisation; zero if evaluated
    status: MinimisationStatus


def minimise(
    evaluate: Callable[[Float[np.ndarray, "trial unknown"]], Sequence[Linearisation]],
    points: Float[np.ndarray, "trial unknown"],
    at_points: Sequence[Linearisation],
    bounds: tuple[Float[np.ndarray, " unknown"], Float[np.ndarray, " unknown"]],
    rule: StepRule,
) -> list[Minimum[Linearisation]]:
    """Minimise |r(x)|² from several starting points.

    A step solves (JᵀJ + λ diag(JᵀJ)) s = −Jᵀr. It is clipped at the bounds, each unknown by
    itself: with one unknown at its bound the others may end short of their best values.

    Arguments: `evaluate` linearises the problem at several points in one call; `points` are the
    starting points and `at_points` the problem linearised there; `bounds` are the lowest and the
    highest value of every unknown.
    Returns a `Minimum` for every starting point; its `status` shows whether it converged.

    Reference: Marquardt, SIAM J. Appl. Math. 11 (1963) 431, doi:10.1137/0111030.
    """
    lower, upper = bounds
    point, now = np.array(points), list(at_points)
    last_step = np.zeros_like(point)
    square = np.array([_sum_of_squares(value) for value in now])
    damping = np.full(len(point), rule.damping)
    status = [
        MinimisationStatus.STEP_LIMIT if np.isfinite(value) else MinimisationStatus.NOT_FINITE
        for value in square
    ]
    active = np.isfinite(square)
    for iteration in range(rule.steps):
        if iteration == rule.screened:
            behind = active & ~(square <= np.sort(square)[min(rule.kept, len(point)) - 1])
            status = [
                MinimisationStatus.GIVEN_UP if b else s for b, s in zip(behind, status, strict=True)
            ]
            active &= ~behind
        moved = point.copy()
        for t in np.flatnonzero(active):
            residuals, jacobian = now[t].residuals, now[t].jacobian
            step = damped_step(jacobian, residuals, damping[t])
            moved[t] = np.clip(point[t] + step, lower, upper)
            free = np.array_equal(moved[t], point[t] + step)
            after = residuals + jacobian @ step
            predicted = float(residuals @ residuals - after @ after)
            if rule.trust_short_steps and free and predicted < rule.settled:
                point[t], last_step[t], square[t] = moved[t], step, float(after @ after)
                status[t], active[t] = MinimisationStatus.CONVERGED, False
        at = np.flatnonzero(active)
        if not at.size:
            break
        for t, new in zip(at, evaluate(moved[at]), strict=True):
            new_square = _sum_of_squares(new)
            lowered = square[t] - new_square
            if lowered > 0:
                point[t], now[t], square[t] = moved[t], new, new_square
                damping[t] *= rule.eased
                if lowered <= rule.settled:
                    status[t], active[t] = MinimisationStatus.CONVERGED, False
            else:
                damping[t] *= rule.stiffened
                if damping[t] >= rule.largest_damping:
                    status[t], active[t] = MinimisationStatus.STALLED, False
    return [
        Minimum(*row) for row in zip(point, square.tolist(), now, last_step, status, strict=True)
    ]


def damped_step(
    jacobian: Float[np.ndarray, "row unknown"],
    residuals: Float[np.ndarray, " row"],
    damping: float,
) -> Float[np.ndarray, " unknown"]:
    """Marquardt's damped step, with each unknown scaled by the norm of its column of J."""
    norm = np.linalg.norm(jacobian, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    scaled = jacobian / norm
    matrix = scaled.T @ scaled + damping * np.eye(len(norm))
    return -np.linalg.solve(matrix, scaled.T @ residuals) / norm


def _sum_of_squares(linearised: AbstractLinearisation) -> float:
    value = float(np.sum(linearised.residuals**2))
    return value if np.isfinite(value) else np.inf
