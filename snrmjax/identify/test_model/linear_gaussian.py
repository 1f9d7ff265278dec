"""A linear Gaussian model: marginal likelihood of noise and prior variances, with its gradient.

Rows r = H x + e with x ~ N(0, diag v) and e ~ N(0, s²). H is reduced to triangular form once; each
evaluation then factors a matrix of the size of the unknowns.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dtrtrs
from scipy.optimize import minimize

_STEP = 1e-4  # of a logarithm, for finite differences of the gradient
_ROUNDING = 1e-12  # of the diagonal: keeps a matrix regular in floating point
_STEPS = 60  # L-BFGS iterations at most


class LinearRows(NamedTuple):
    """Sufficient statistics of rows that have unit variance where the noise is as stated.

    From H = QR: c = Qᵀr, and the residual |r − Qc|². No cancellation then, however wide the priors
    and small the noise.
    """

    triangle: Float[np.ndarray, "direction unknown"]  # R
    along: Float[np.ndarray, " direction"]  # c
    across: float  # |r − Qc|²
    n_rows: int
    offset: float = 0.0  # ln of the Jacobian from the rows to the record
    fraction: float = 1.0  # effective fraction of independent rows: power of the likelihood
    n_flat: int = 0  # leading directions, taken by unknowns with a flat prior

    @classmethod
    def of(
        cls,
        design: Float[np.ndarray, "row unknown"],
        rows: Float[np.ndarray, " row"],
        offset: float = 0.0,
        flat: Bool[np.ndarray, " unknown"] | None = None,
    ) -> "LinearRows":
        """Of a design matrix H and rows r.

        For unknowns with a `flat` prior the likelihood is the restricted one (REML): that of the
        rows' component they cannot fit, whatever their variances.
        """
        flat = np.zeros(design.shape[1], dtype=bool) if flat is None else flat
        order = np.argsort(~flat, kind="stable")
        directions, triangle = np.linalg.qr(design[:, order])
        along = directions.T @ rows
        residual = rows - directions @ along
        whole = np.empty_like(triangle)
        whole[:, order] = triangle
        square, n_flat = float(residual @ residual), min(int(flat.sum()), len(along))
        return cls(whole, along, square, len(rows), offset, n_flat=n_flat)

    def posterior(
        self, scale: float, variance: Float[np.ndarray, " unknown"]
    ) -> tuple[Float[np.ndarray, " unknown"], Float[np.ndarray, "unknown unknown"]]:
        """Mean and covariance of the unknowns.

        By QR of rows and priors stacked: nearly collinear unknowns with priors of very different
        width would be lost to rounding in the normal equations.
        """
        scale, root = scale / np.sqrt(self.fraction), np.sqrt(variance)
        stacked = np.vstack([self.triangle * (root / scale), np.eye(len(root))])
        directions, triangle = np.linalg.qr(stacked)
        sensitivities = root[:, None] * solve_triangular(triangle, np.eye(len(root)))
        return sensitivities @ (
            directions[: len(self.along)].T @ (self.along / scale)
        ), sensitivities @ sensitivities.T

    def log_likelihood(
        self, scale: float, variance: Float[np.ndarray, " unknown"]
    ) -> tuple[float, float, Float[np.ndarray, " unknown"]]:
        """ln p of the rows, and its derivatives by ln s and by the logarithms of the variances."""
        by_root = self.triangle[self.n_flat :] * np.sqrt(variance)
        n, m = self.fraction * (self.n_rows - self.n_flat), len(by_root)
        constant = n * np.log(2 * np.pi * scale**2)
        if not m:  # which lapack refuses
            square = self.across * self.fraction / scale**2
            return -0.5 * (constant + square) + self.offset, square - n, np.zeros(len(variance))
        scale = scale / np.sqrt(self.fraction)
        covariance = by_root @ by_root.T
        diagonal = covariance.reshape(-1)[:: m + 1]  # a view
        diagonal += scale**2
        # Scaled to a unit diagonal, for conditioning.
        unit = 1 / np.sqrt(diagonal)
        covariance *= unit[:, None] * unit
        diagonal += _ROUNDING
        factor, failed = dpotrf(covariance.T, lower=True, clean=False, overwrite_a=True)
        if failed:
            raise np.linalg.LinAlgError("the matrix is not positive definite.")
        both = np.empty((m, by_root.shape[1] + 1), order="F")
        both[:, :-1], both[:, -1] = by_root, self.along[self.n_flat :]
        both *= unit[:, None]
        both, _ = dtrtrs(factor, both, lower=True, overwrite_b=True)
        sensitivities, along = both[:, :-1], both[:, -1]
        informed = np.einsum(
            "ij,ij->j", sensitivities, sensitivities
        )  # information of the rows on every unknown; sums to m less the noise's part
        weighed = dtrtrs(factor, along, lower=True, trans=1)[0] * unit
        log_det = 2 * float(np.log(factor.diagonal() / unit).sum())
        square = float(along @ along) + self.across / scale**2
        value = -0.5 * (constant - m * np.log(scale**2) + log_det + square)
        by_scale = scale**2 * float(weighed @ weighed) + self.across / scale**2
        by_scale += float(informed.sum()) - n
        return value + self.offset, by_scale, 0.5 * ((along @ sensitivities) ** 2 - informed)


Objective = Callable[[Float[np.ndarray, " hyper"]], tuple[float, Float[np.ndarray, " hyper"]]]


def laplace_evidence(
    objective: Objective, point: Float[np.ndarray, " hyper"], bounds: list[tuple[float, float]]
) -> float:
    """ln p integrated about its maximum over what is not fixed, by Laplace's approximation."""
    free = np.array([high > low for low, high in bounds])
    precision = precision_at(objective, point)[np.ix_(free, free)]
    volume = 0.5 * (len(precision) * np.log(2 * np.pi) - np.linalg.slogdet(precision)[1])
    return objective(point)[0] + float(volume)


def precision_at(
    objective: Objective, point: Float[np.ndarray, " hyper"]
) -> Float[np.ndarray, "hyper hyper"]:
    """Negative Hessian of ln p; flat directions get the precision of a wide prior (σ = 10)."""
    hessian = np.zeros((len(point), len(point)))
    for k, unit in enumerate(_STEP * np.eye(len(point))):
        hessian[k] = (objective(point - unit)[1] - objective(point + unit)[1]) / (2 * _STEP)
    values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
    return (vectors * np.maximum(values, 1e-2)) @ vectors.T


def maximised(
    objective: Objective, start: Float[np.ndarray, " hyper"], bounds: list[tuple[float, float]]
) -> Float[np.ndarray, " hyper"]:
    """The most likely point between bounds."""

    def downhill(point: np.ndarray) -> tuple[float, np.ndarray]:
        value, slopes = objective(point)
        return -value, -slopes

    best = minimize(
        downhill,
        np.clip(start, [low for low, _ in bounds], [high for _, high in bounds]),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": _STEPS, "ftol": 1e-9, "gtol": 1e-3},
    )
    return np.asarray(best.x)
