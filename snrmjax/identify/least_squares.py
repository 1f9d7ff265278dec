"""Weighted least squares for points whose errors are partly shared by a whole level."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class LeastSquares(NamedTuple):
    """Estimate, its covariance and the two sizes of error found."""

    values: Float[np.ndarray, " parameter"]
    covariance: Float[np.ndarray, "parameter parameter"]
    noise_scale: float  # s, what the stated standard deviations would have to be multiplied by
    level_std: float  # τ, 1σ of the error that a level shares
    criterion: float  # n log(rss/n) + k log n, or rss + k log n when the scale is known


def weighted_least_squares(
    design: Float[np.ndarray, "point parameter"],
    target: Float[np.ndarray, " point"],
    std: Float[np.ndarray, " point"],
    members: Bool[np.ndarray, "point level"],
    *,
    scale_known: bool,
) -> LeastSquares:
    """Fit target = design · values + error, with an honest covariance for shared errors.

    The estimate weights points by 1/std² alone: errors shared by a level would otherwise push
    all weight on the differences inside a level, where the method's own small systematic errors
    sit. The covariance is the sandwich that belongs to cov(error) = s²·diag(std²) + τ²·(same
    level). s and τ are the unbiased solution of two moments of the residuals, their weighted sum
    of squares and that of their level sums. With `scale_known` s = 1 in the covariance, while
    `noise_scale` still says what the residuals say.

    Reference: Liang & Zeger, Biometrika 73 (1986) 13, doi:10.1093/biomet/73.1.13 (working
    independence and sandwich covariance).
    """
    n, k = design.shape
    x, y = design / std[:, None], target / std
    shared = members / std[:, None]
    q, r = np.linalg.qr(x)
    values = np.linalg.lstsq(r, q.T @ y, rcond=None)[0]
    residual = y - x @ values
    rss = float(residual @ residual)
    dof = max(n - k, 1)
    unshared = rss / dof
    # Moments of P y, P = I − QQᵀ, under the covariance s² I + τ² UUᵀ.
    gram = shared.T @ shared - (shared.T @ q) @ (q.T @ shared)
    trace, square = float(np.trace(gram)), float(np.sum(gram**2))
    sums = float(np.sum((shared.T @ residual) ** 2))
    several = bool(np.max(members.sum(axis=0)) > 1) and members.shape[1] > 2
    scale2, level2 = unshared, 0.0
    if several and square > 0:
        if scale_known:
            level2 = max((sums - trace) / square, 0.0)
        else:
            determinant = dof * square - trace**2
            if determinant > 1e-12 * dof * square:
                level2 = max((dof * sums - trace * rss) / determinant, 0.0)
                scale2 = max((square * rss - trace * sums) / determinant, 0.0)
            if level2 == 0.0 or scale2 == 0.0:
                scale2, level2 = unshared, 0.0
    used = 1.0 if scale_known else scale2
    bread = np.linalg.pinv(r)
    projected = bread @ (q.T @ shared)
    covariance = used * bread @ bread.T + level2 * projected @ projected.T
    misfit = rss if scale_known else n * np.log(max(rss, 1e-300) / n)
    return LeastSquares(
        values=values,
        covariance=covariance,
        noise_scale=float(np.sqrt(unshared)),
        level_std=float(np.sqrt(level2)),
        criterion=float(misfit + k * np.log(n)),
    )
