"""Penalised least squares for points whose errors are partly shared by a whole level."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class LeastSquares(NamedTuple):
    """Estimate and the two parts of its covariance."""

    values: Float[np.ndarray, " parameter"]
    unshared_covariance: Float[np.ndarray, "parameter parameter"]  # for errors std, independent
    shared_covariance: Float[np.ndarray, "parameter parameter"]  # for an error 1 of each level


def penalised_least_squares(
    design: Float[np.ndarray, "point parameter"],
    target: Float[np.ndarray, " point"],
    std: Float[np.ndarray, " point"],
    members: Bool[np.ndarray, "point level"] | Float[np.ndarray, "point level"],
    penalty: Float[np.ndarray, "row parameter"],
    penalty_target: Float[np.ndarray, " row"],
) -> LeastSquares:
    """Fit target = design · values + error with a roughness penalty and a sandwich covariance.

    Minimises Σ((target − design·values)/std)² + Σ(penalty·values − penalty_target)². Points are
    weighted by 1/std² alone: errors shared by a level would otherwise push all weight on the
    differences inside a level, where the method's own small systematic errors sit. The
    covariance is the sandwich for cov(error) = s²·diag(std²) + τ²·(same level), returned as its
    two parts for s = 1 and τ = 1.

    Arguments: `members` says which points a level has, or how far an error 1 of it moves them.
    Reference: Liang & Zeger, Biometrika 73 (1986) 13, doi:10.1093/biomet/73.1.13 (working
    independence and sandwich covariance).
    """
    x, y = design / std[:, None], target / std
    shared = members / std[:, None]
    # By singular values, not normal equations: with a strong penalty those lose the points' part.
    inverse = np.linalg.pinv(np.concatenate([x, penalty]), rcond=1e-15)
    of_points = inverse[:, : len(x)]
    arms = of_points @ shared
    return LeastSquares(
        values=of_points @ y + inverse[:, len(x) :] @ penalty_target,
        unshared_covariance=of_points @ of_points.T,
        shared_covariance=arms @ arms.T,
    )


class ErrorSizes(NamedTuple):
    """Sizes of the two kinds of error that left-out levels show."""

    noise_scale: float  # s, what the stated standard deviations would have to be multiplied by
    level_std: float  # τ, 1σ of the error that a level shares, unit of the values


def error_sizes(
    errors: list[Float[np.ndarray, " point"]],
    std: list[Float[np.ndarray, " point"]],
    shared: list[Float[np.ndarray, "point kind"]] | None = None,
) -> ErrorSizes:
    """How large the errors of points and of whole levels are, from predicting left-out levels.

    Around its own mean the error of a level shows s. Its mean shows τ and the error of the
    prediction from the other levels, taken as half as large in variance, which is what two
    neighbours with errors of their own give: τ² = ⟨mean²⟩/1.5 − ⟨s²/Σ std⁻²⟩.

    Arguments: errors and stated 1σ of every left-out level, and the 1σ of the errors that a level
    is known to share, of which τ is what comes on top. τ is 0 for fewer than three levels, and
    where the means do not exceed the rest by more than their own standard error √(2/levels).
    """
    within, count, means, floors, known = 0.0, 0, [], [], []
    for k, (error, spread) in enumerate(zip(errors, std, strict=True)):
        weight = 1.0 / spread**2
        mean = float(np.sum(weight * error) / np.sum(weight))
        within += float(np.sum(weight * (error - mean) ** 2))
        count += len(error) - 1
        means.append(mean**2)
        floors.append(1.0 / float(np.sum(weight)))
        if shared is not None:
            known.append(float(np.sum((weight @ shared[k] / np.sum(weight)) ** 2)))
    squared = within / count if count > 0 else 0.0
    if len(means) < 3:
        return ErrorSizes(float(np.sqrt(squared)), 0.0)
    expected = squared * np.mean(floors) + (np.mean(known) if known else 0.0)
    level = np.mean(means) / 1.5 - expected
    shared = level > np.sqrt(2 / len(means)) * expected
    return ErrorSizes(float(np.sqrt(squared)), float(np.sqrt(level)) if shared else 0.0)


def inverse_of(jacobian: np.ndarray) -> np.ndarray:
    """(JᵀJ)⁻¹, by singular values of the scaled columns."""
    root = root_of_inverse(jacobian)
    return root @ root.T


def root_of_inverse(jacobian: np.ndarray) -> np.ndarray:
    """K with (JᵀJ)⁻¹ = KKᵀ."""
    size = np.linalg.norm(jacobian, axis=0)
    size = np.where(size > 0, size, 1.0)
    _, values, rows = np.linalg.svd(jacobian / size, full_matrices=False)
    return (rows.T / values) / size[:, None]


def degrees_spent(jacobian: np.ndarray, n_rows: int) -> float:
    """Degrees of freedom that the unknowns take from the first rows."""
    size = np.linalg.norm(jacobian, axis=0)
    basis = np.linalg.qr(jacobian / np.where(size > 0, size, 1.0))[0]
    return float(np.sum(basis[:n_rows] ** 2))
