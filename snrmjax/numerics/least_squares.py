"""Covariances of linear least squares, with scaled columns."""

import numpy as np


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
