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
