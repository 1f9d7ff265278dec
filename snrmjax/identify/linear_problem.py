"""A linearised least-squares problem: its solution, what data tell, what is left out of it."""

import numpy as np
from jaxtyping import Float

from snrmjax.identify.level_scatter import Linearised


def effective_parameters(problem: Linearised, own: np.ndarray) -> float:
    """Parameters that the data, and not their priors, tell, of some of the unknowns."""
    keep, matrix, size = _normal(problem)
    at = np.flatnonzero(np.isin(np.flatnonzero(keep), own))
    variance = np.diagonal(np.linalg.inv(matrix))[at] / size[at] ** 2
    return float(np.sum(1.0 - variance / problem.prior_std[keep][at] ** 2))


def _normal(problem: Linearised) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unknowns that may move, JᵀJ with priors, and their units."""
    keep = problem.prior_std > 0
    x = problem.slopes[:, keep]
    prior = 1.0 / problem.prior_std[keep]
    size = np.hypot(np.linalg.norm(x, axis=0), prior)
    size = np.where(size > 0, size, 1.0)
    matrix = (x / size).T @ (x / size) + np.diag((prior / size) ** 2)
    return keep, matrix + 1e-12 * np.eye(len(matrix)), size


def solved(problem: Linearised) -> Float[np.ndarray, " unknown"]:
    """The change of the unknowns that least squares with the priors asks for."""
    keep, matrix, size = _normal(problem)
    right = (problem.slopes[:, keep] / size).T @ problem.residuals
    change = np.zeros(len(keep))
    change[keep] = -np.linalg.solve(matrix, right) / size
    return change


def left_out_scores(problem: Linearised, folds: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Log predictive density of every left-out part, and the error over what was foretold."""
    keep, matrix, size = _normal(problem)
    x = problem.slopes[:, keep] / size
    change = -np.linalg.solve(matrix, x.T @ problem.residuals)
    left = problem.residuals + x @ change
    scores, squares, count = [], 0.0, 0
    for rows in folds:
        own = x[rows]
        without = matrix - own.T @ own + 1e-10 * np.eye(len(matrix))
        arms = np.linalg.solve(without, own.T)
        error = left[rows] + own @ (arms @ left[rows])
        covariance = np.eye(rows.sum()) + own @ arms
        covariance = 0.5 * (covariance + covariance.T)
        sign, logarithm = np.linalg.slogdet(covariance)
        square = float(error @ np.linalg.solve(covariance, error))
        scores.append(-0.5 * (square + logarithm) if sign > 0 else -np.inf)
        squares, count = squares + square, count + len(error)
    return np.array(scores), float(np.sqrt(squares / count))
