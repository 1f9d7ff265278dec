"""Whether a completed model predicts levels that it has not seen."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from snrmjax.diagnose.evidence import Bench, Fit


class HeldOut(NamedTuple):
    """Root-mean-square misfit of one level in units of what is foretold of its scatter."""

    level: int
    before: float
    after: float


def held_out(bench: Bench, nothing: Fit, fit: Fit, level: int) -> HeldOut:
    """Fit to the other levels alone, and compare with the one left out.

    The misfit is that of the level given the others: what it shares with them through the
    baseline's stated errors is foretold too; its own gain and phase are not.
    """
    levels = np.asarray(bench.predictions.chosen.states.level)
    out = levels[bench.weighing.state] == level
    number = int(bench.level_numbers[level])
    return HeldOut(number, _gap(bench, nothing, out), _gap(bench, fit, out))


def gap(bench: Bench, fit: Fit) -> float:
    """Root-mean-square misfit of all rows in units of noise."""
    return float(np.sqrt(bench.chi_square(fit.rows) / bench.n_rows))


def _gap(bench: Bench, fit: Fit, out: Bool[np.ndarray, " row"]) -> float:
    shared = bench.weighing.shared
    covariance = np.eye(len(shared)) + shared @ shared.T
    kept = ~out
    inverse = np.linalg.inv(covariance[np.ix_(kept, kept)])
    rows, slopes = fit.rows, fit.slopes
    if slopes.shape[1]:
        size = np.linalg.norm(slopes, axis=0)
        scaled = slopes / np.where(size > 0, size, 1.0)
        matrix = scaled[kept].T @ inverse @ scaled[kept]
        change = -np.linalg.pinv(matrix, rcond=1e-12) @ (scaled[kept].T @ inverse @ rows[kept])
        rows = rows + scaled @ change
    across = covariance[np.ix_(out, kept)] @ inverse
    left = rows[out] - across @ rows[kept]
    own = covariance[np.ix_(out, out)] - across @ covariance[np.ix_(kept, out)]
    return float(np.sqrt(left @ np.linalg.solve(own, left) / out.sum()))
