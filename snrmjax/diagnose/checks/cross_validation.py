"""Whether a completed model predicts levels that it has not seen."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import solve_triangular

from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.noise_model import chi_square_p_value
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit


class HeldOut(NamedTuple):
    """Root-mean-square misfit of one level in units of what is foretold of its scatter."""

    level: int
    before: float
    after: float
    p_value: float  # of `after` by noise alone
    uncertain_p_value: float  # by noise and what the other levels leave open of the parameters


def held_out(
    misfit: WeightedMisfit, nothing: EffectFit, fit: EffectFit, level: int, noise: float = 1.0
) -> HeldOut:
    """Fit to the other levels alone, and compare with the one left out.

    The misfit is that of the level given the others: what it shares with them through the
    baseline's stated errors is foretold too; its own gain and phase are not. `noise` is the
    variance over the stated one for which probabilities are given.
    """
    out = _rows_of(misfit, level)
    n_out = int(out.sum())
    before, _ = _foretold(misfit, nothing, out)
    after, open_too = _foretold(misfit, fit, out)
    return HeldOut(
        int(misfit.level_numbers[level]),
        float(np.sqrt(before / n_out)),
        float(np.sqrt(after / n_out)),
        chi_square_p_value(after / noise, n_out),
        chi_square_p_value(open_too / noise, n_out),
    )


class Unseen(NamedTuple):
    """A fit's parameters, and the baseline's, as all levels but one put them."""

    level: int
    values: Float[np.ndarray, " parameter"]
    baseline: dict[str, float]


def without_level(misfit: WeightedMisfit, fit: EffectFit, level: int) -> Unseen:
    """One step from the whole fit to the best one without a level's rows."""
    kept = ~_rows_of(misfit, level)
    change, rows, _ = _refitted(misfit, fit, kept)
    values = np.clip(fit.values + change, fit.lower, fit.upper)
    number = int(misfit.level_numbers[level])
    return Unseen(number, values, misfit.baseline_parameters(rows, kept))


def gap(misfit: WeightedMisfit, fit: EffectFit) -> float:
    """Root-mean-square misfit of all rows in units of noise."""
    return float(np.sqrt(misfit.chi_square(fit.rows) / misfit.n_rows))


def _rows_of(misfit: WeightedMisfit, level: int) -> Bool[np.ndarray, " row"]:
    levels = np.asarray(misfit.predictions.chosen.states.level)
    return np.asarray(levels[misfit.noise.state] == level)


def _refitted(
    misfit: WeightedMisfit, fit: EffectFit, kept: Bool[np.ndarray, " row"]
) -> tuple[
    Float[np.ndarray, " parameter"], Float[np.ndarray, " row"], Float[np.ndarray, "row any"]
]:
    """The change of a fit's parameters that some rows ask for, all rows after it, and its root.

    The root's columns are what independent unit errors of the change add to all rows.
    """
    slopes = fit.slopes
    if not slopes.shape[1]:
        return np.zeros(0), fit.rows, slopes
    lower = misfit.noise.of_rows(kept)
    size = np.linalg.norm(slopes, axis=0)
    size = np.where(size > 0, size, 1.0)
    scaled = slopes / size
    arms = solve_triangular(lower, scaled[kept], lower=True)
    matrix = arms.T @ arms
    left = solve_triangular(lower, fit.rows[kept], lower=True)
    change = -np.linalg.pinv(matrix, rcond=1e-12) @ (arms.T @ left)
    values, vectors = np.linalg.eigh(matrix)
    # What the kept rows do not see at all is open: as good as any size.
    root = vectors / np.sqrt(np.maximum(values, 1e-12))
    return change / size, fit.rows + scaled @ change, scaled @ root


def _foretold(
    misfit: WeightedMisfit, fit: EffectFit, out: Bool[np.ndarray, " row"]
) -> tuple[float, float]:
    """χ² of rows left out, with the fitted parameters taken as known and as uncertain.

    By one factor of the covariance with the rows left out last, where nothing large cancels.
    """
    _, rows, root = _refitted(misfit, fit, ~out)
    shared, n_out = misfit.noise.shared, int(out.sum())
    last = np.argsort(out, kind="stable")
    lower = np.linalg.cholesky(np.eye(len(shared)) + shared[last] @ shared[last].T)
    left, spread = (
        solve_triangular(lower, part[last], lower=True)[-n_out:] for part in (rows, root)
    )
    known = float(left @ left)
    uncertain = float(left @ np.linalg.solve(np.eye(n_out) + spread @ spread.T, left))
    return known, uncertain
