"""Covariances and degrees of freedom of linear least squares, by scaled columns."""

import numpy as np


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
