"""The noise of measured states: each by itself, and all that they have in common.

Numbers that share a few errors are decorrelated at a cost in proportion to the numbers.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import chdtrc


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


class NoiseModel(NamedTuple):
    """Covariance of the misfits of all states, in units of each state's own noise.

    A row is one measured number: a column of a state. Every row has the noise of its own state;
    rows share the errors of a level and those of the baseline model's parameters.
    """

    whiten: Float[np.ndarray, "state column column"]
    known: Bool[np.ndarray, "state column"]
    covariance: SharedCovariance
    shared_kind: Int[np.ndarray, " shared"]  # of the levels' errors by kind; −1: of no level
    state: Int[np.ndarray, " row"]
    column: Int[np.ndarray, " row"]

    @property
    def shared(self) -> Float[np.ndarray, "row shared"]:
        """Slopes of the rows by the shared errors, times their 1σ."""
        return self.covariance.shared

    def noise_units(
        self, columns: Float[np.ndarray, "trial state column"]
    ) -> Float[np.ndarray, "trial row"]:
        """Measured columns in units of their own noise; NaN stays NaN."""
        return np.einsum("sij,...sj->...si", self.whiten, columns)[..., self.known]

    def decorrelated(
        self, rows: Float[np.ndarray, "*entry row"], kept: Bool[np.ndarray, " row"] | None = None
    ) -> Float[np.ndarray, "*entry row"]:
        """Rows, or the rows `kept`, made independent and of unit variance.

        An entry that is not finite throughout is NaN.
        """
        if kept is not None:
            return self.covariance.of_rows(kept).decorrelated(rows[..., kept])
        good = np.all(np.isfinite(rows), axis=-1, keepdims=True)
        return np.where(good, self.covariance.decorrelated(np.where(good, rows, 0.0)), np.nan)

    def without_shared(self, rows: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
        """Rows less the most likely values of the shared errors."""
        return self.covariance.solved(rows)

    def shared_errors(
        self, rows: Float[np.ndarray, " row"], kept: Bool[np.ndarray, " row"] | None = None
    ) -> Float[np.ndarray, " shared"]:
        """Most likely values of the shared errors in units of their 1σ, from all rows or some."""
        if kept is not None:
            return -self.covariance.of_rows(kept).most_likely_errors(rows[kept])
        return -self.covariance.most_likely_errors(rows)

    def shared_std(self, slopes: Float[np.ndarray, "row parameter"], place: int) -> float:
        """1σ of a shared error that the rows leave beside parameters, in units of its own 1σ."""
        columns = np.concatenate([slopes, self.shared], axis=1)
        known = np.append(np.zeros(slopes.shape[1]), np.ones(self.shared.shape[1]))
        size = np.linalg.norm(np.vstack([columns, np.diag(known)]), axis=0)
        size = np.where(size > 0, size, 1.0)
        scaled = columns / size
        covariance = np.linalg.pinv(scaled.T @ scaled + np.diag(known / size**2), hermitian=True)
        at = slopes.shape[1] + place
        return float(np.sqrt(max(covariance[at, at], 0.0))) / size[at]


def chi_square_p_value(chi_square: float, freedom: int) -> float:
    """Probability of at least this χ² by chance, for so many degrees of freedom."""
    # Rounding may have made a sum of squares negative.
    return float(chdtrc(max(freedom, 1), np.maximum(chi_square, 0.0)))
