"""Whether a completed model predicts levels that it has not seen."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

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
    out = _rows_of(bench, level)
    number = int(bench.level_numbers[level])
    return HeldOut(number, _gap(bench, nothing, out), _gap(bench, fit, out))


class Unseen(NamedTuple):
    """A fit's parameters, and the baseline's, as all levels but one put them."""

    level: int
    values: Float[np.ndarray, " parameter"]
    baseline: dict[str, float]


def without_level(bench: Bench, fit: Fit, level: int) -> Unseen:
    """One step from the whole fit to the best one without a level's rows."""
    kept = ~_rows_of(bench, level)
    change, rows = _refitted(bench, fit, kept)
    values = np.clip(fit.values + change, fit.lower, fit.upper)
    number = int(bench.level_numbers[level])
    return Unseen(number, values, bench.baseline(fit._replace(rows=rows), kept))


def gap(bench: Bench, fit: Fit) -> float:
    """Root-mean-square misfit of all rows in units of noise."""
    return float(np.sqrt(bench.chi_square(fit.rows) / bench.n_rows))


def _rows_of(bench: Bench, level: int) -> Bool[np.ndarray, " row"]:
    levels = np.asarray(bench.predictions.chosen.states.level)
    return np.asarray(levels[bench.weighing.state] == level)


def _refitted(
    bench: Bench, fit: Fit, kept: Bool[np.ndarray, " row"]
) -> tuple[Float[np.ndarray, " parameter"], Float[np.ndarray, " row"]]:
    """The change of a fit's parameters that some rows ask for, and all rows after it."""
    slopes = fit.slopes
    if not slopes.shape[1]:
        return np.zeros(0), fit.rows
    shared = bench.weighing.shared[kept]
    inverse = np.linalg.inv(np.eye(len(shared)) + shared @ shared.T)
    size = np.linalg.norm(slopes, axis=0)
    size = np.where(size > 0, size, 1.0)
    scaled = slopes / size
    matrix = scaled[kept].T @ inverse @ scaled[kept]
    change = -np.linalg.pinv(matrix, rcond=1e-12) @ (scaled[kept].T @ inverse @ fit.rows[kept])
    return change / size, fit.rows + scaled @ change


def _gap(bench: Bench, fit: Fit, out: Bool[np.ndarray, " row"]) -> float:
    shared = bench.weighing.shared
    covariance = np.eye(len(shared)) + shared @ shared.T
    kept = ~out
    inverse = np.linalg.inv(covariance[np.ix_(kept, kept)])
    rows = _refitted(bench, fit, kept)[1]
    across = covariance[np.ix_(out, kept)] @ inverse
    left = rows[out] - across @ rows[kept]
    own = covariance[np.ix_(out, out)] - across @ covariance[np.ix_(kept, out)]
    return float(np.sqrt(left @ np.linalg.solve(own, left) / out.sum()))
