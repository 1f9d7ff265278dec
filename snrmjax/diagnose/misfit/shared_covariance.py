"""The covariance of numbers that share a few errors, at a cost in proportion to the numbers."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class SharedCovariance(NamedTuple):
    """The covariance C = I + S Sᵀ of rows: errors of their own, of unit variance, and shared ones.

    S has one column for every shared error: what its 1σ adds to each row. By the singular values
    S = U D Vᵀ the inverse and its symmetric root are I and a correction of low rank,
    C⁻¹ = I − U D²(1 + D²)⁻¹ Uᵀ and C^(−½) = I − U (1 − (1 + D²)^(−½)) Uᵀ: no matrix of rows by
    rows is formed.
    """

    shared: Float[np.ndarray, "row shared"]  # S
    directions: Float[np.ndarray, "row shared"]  # U, zero where there are fewer rows than errors
    size: Float[np.ndarray, " shared"]  # D
    errors: Float[np.ndarray, "shared shared"]  # Vᵀ, whole

    def decorrelated(
        self, rows: Float[np.ndarray, "*entry row"]
    ) -> Float[np.ndarray, "*entry row"]:
        """C^(−½) times rows: independent and of unit variance."""
        return self._less(rows, 1 - 1 / np.hypot(1.0, self.size))

    def solved(self, rows: Float[np.ndarray, "*entry row"]) -> Float[np.ndarray, "*entry row"]:
        """C⁻¹ times rows: rows less the most likely part of the shared errors."""
        return self._less(rows, self.size**2 / (1 + self.size**2))

    def most_likely_errors(self, rows: Float[np.ndarray, " row"]) -> Float[np.ndarray, " shared"]:
        """SᵀC⁻¹ times rows: the shared errors, in units of their 1σ, that are in rows."""
        return (self.size / (1 + self.size**2) * (rows @ self.directions)) @ self.errors

    def of_rows(self, keep: Bool[np.ndarray, " row"]) -> "SharedCovariance":
        """The covariance of some of the rows."""
        return shared_covariance(self.shared[keep])

    def given_rows(self, known: Bool[np.ndarray, " row"]) -> "ConditionalCovariance":
        """The covariance of the rows that are not known, given those that are."""
        others = self.of_rows(known)
        root = others.errors.T / np.hypot(1.0, others.size)  # of what is open of the errors
        own = self.shared[~known]
        return ConditionalCovariance(known, own, others, shared_covariance(own @ root))

    def _less(
        self, rows: Float[np.ndarray, "*entry row"], part: Float[np.ndarray, " shared"]
    ) -> Float[np.ndarray, "*entry row"]:
        return rows - (rows @ self.directions * part) @ self.directions.T


class ConditionalCovariance(NamedTuple):
    """The covariance of some rows given all others, which determine a part of the shared errors."""

    known: Bool[np.ndarray, " row"]
    shared: Float[np.ndarray, "other shared"]  # of the rows that are not known
    others: SharedCovariance  # of the known rows
    left: SharedCovariance  # of the other rows, with what is open of the shared errors

    def decorrelated(
        self, rows: Float[np.ndarray, "*entry row"]
    ) -> Float[np.ndarray, "*entry other"]:
        """Rows less what the known ones let expect, independent and of unit variance."""
        expected = self.others.most_likely_errors(rows[..., self.known]) @ self.shared.T
        return self.left.decorrelated(rows[..., ~self.known] - expected)


def shared_covariance(shared: Float[np.ndarray, "row shared"]) -> SharedCovariance:
    """The covariance I + S Sᵀ for the shared errors S.

    >>> one = shared_covariance(np.ones((3, 1)))
    >>> one.solved(np.ones(3))  # of a mean of three and a shared error, all of unit variance
    array([0.25, 0.25, 0.25])
    """
    n, errors = shared.shape
    # With fewer rows than errors the rest of the errors is in none: zeros complete V.
    filled = np.concatenate([shared, np.zeros((max(errors - n, 0), errors))])
    directions, size, own = np.linalg.svd(filled, full_matrices=False)
    return SharedCovariance(shared, directions[:n], size, own)
