"""Residuals of an answer: cross-validation on withheld levels, and the noise level."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.noise_model import unit_columns
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit


class WithheldLevel(NamedTuple):
    """Root-mean-square misfit of one level in units of its predicted scatter."""

    level: int
    before: float
    after: float


def withheld_level(
    misfit: WeightedMisfit, baseline: EffectFit, fit: EffectFit, level: int
) -> WithheldLevel:
    """Fit to the other levels alone, and compare with the withheld one.

    The misfit is conditional on the other levels: errors that it shares with them through the
    baseline's stated uncertainty are predicted; its own gain and phase are not.
    """
    withheld = rows_of_level(misfit, level)
    given, n = misfit.noise.covariance.given_rows(~withheld), int(withheld.sum())
    left = [given.decorrelated(_refitted(misfit, one, ~withheld)[1]) for one in (baseline, fit)]
    before, after = (float(np.sqrt(rows @ rows / n)) for rows in left)
    return WithheldLevel(int(misfit.level_numbers[level]), before, after)


def withheld_level_indices(misfit: WeightedMisfit) -> tuple[int, ...]:
    """Indices of the levels to withhold: the middle and the top one by velocity.

    Empty for fewer than three levels.
    """
    chosen = misfit.predictions.chosen
    if chosen.n_levels < 3:
        return ()
    level = np.asarray(chosen.states.level)
    speed = np.abs(np.asarray(chosen.states.velocity)[:, 0])
    order = np.argsort([speed[level == k].max() for k in range(chosen.n_levels)])
    return int(order[chosen.n_levels // 2]), int(order[-1])


def withheld_levels(
    misfit: WeightedMisfit, baseline: EffectFit, fit: EffectFit
) -> list[WithheldLevel]:
    """Cross-validation on the level in the middle and the top one; none below three levels."""
    return [withheld_level(misfit, baseline, fit, k) for k in withheld_level_indices(misfit)]


def without_level(
    misfit: WeightedMisfit, fit: EffectFit, level: int
) -> tuple[Float[np.ndarray, " parameter"], dict[str, float]]:
    """A fit's parameters, and the baseline's, after one refit step without a level's rows."""
    kept = ~rows_of_level(misfit, level)
    change, rows = _refitted(misfit, fit, kept)
    values = np.clip(fit.values + change, fit.lower, fit.upper)
    return values, misfit.baseline_parameters(rows, kept)


def rms_misfit(misfit: WeightedMisfit, fit: EffectFit) -> float:
    """Root-mean-square misfit of all rows in units of noise."""
    return float(np.sqrt(misfit.chi_square(fit.rows) / misfit.n_rows))


def rows_of_level(misfit: WeightedMisfit, level: int) -> Bool[np.ndarray, " row"]:
    """Mask of the rows of a level, by its index."""
    levels = np.asarray(misfit.predictions.chosen.states.level)
    return np.asarray(levels[misfit.noise.state] == level)


def _refitted(
    misfit: WeightedMisfit, fit: EffectFit, kept: Bool[np.ndarray, " row"]
) -> tuple[Float[np.ndarray, " parameter"], Float[np.ndarray, " row"]]:
    """Refit to some rows, to first order: the change of the parameters, and all rows after it."""
    scaled, norm = unit_columns(fit.slopes)
    both = misfit.noise.decorrelated(np.column_stack([scaled, fit.rows]).T, kept)
    sensitivities, left = both[:-1].T, both[-1]
    change = -np.linalg.pinv(sensitivities.T @ sensitivities, rcond=1e-12) @ (
        sensitivities.T @ left
    )
    return change / norm, fit.rows + scaled @ change


def along(
    misfit: WeightedMisfit, rows: Float[np.ndarray, " row"], *, of_test: bool = False
) -> Iterator[Float[np.ndarray, " state"]]:
    """Rows of the force, level by level, along the resonance or in the order of the test.

    Along the resonance states are ordered by the phase of the velocity, which is monotonic even
    on a folded resonance curve.
    """
    noise, chosen = misfit.noise, misfit.predictions.chosen
    level = np.asarray(chosen.states.level)
    phase = np.angle(np.asarray(chosen.states.velocity)[:, 0])
    for column in range(2):
        of_column = noise.column == column
        values, states = rows[of_column], noise.state[of_column]
        for number in range(chosen.n_levels):
            some: Int[np.ndarray, " state"] = np.flatnonzero(level[states] == number)
            keys: Sequence[float] = chosen.rows[states[some]] if of_test else phase[states[some]]
            yield values[some[np.argsort(keys, kind="stable")]]


def neighbour_noise(misfit: WeightedMisfit, fit: EffectFit) -> float:
    """Variance of the force misfit over the stated one, from second differences along levels.

    Smooth variation from state to state, explained or not, cancels; shared errors are removed
    first. Where phases come from the fit, which may be wrong, the states are also taken in the
    order of the test and the smaller variance counts: noise is rough in both orders.
    """
    left = misfit.noise.without_shared(fit.rows)
    variances = []
    for of_test in (False, True) if misfit.predictions.chosen.phase_unknown.any() else (False,):
        parts = [some for some in along(misfit, left, of_test=of_test) if len(some) > 2]
        if not parts:
            return 1.0
        squares = [(some[:-2] - 2 * some[1:-1] + some[2:]) ** 2 / 6 for some in parts]
        differences = np.concatenate(squares)
        # Jumps are not noise: squares are clipped at (4σ)², σ² = median/0.4549 (median of χ²₁).
        variances.append(
            float(np.mean(np.minimum(differences, 16 * np.median(differences) / 0.4549)))
        )
    return min(variances)


def scatter_of_levels(misfit: WeightedMisfit, fit: EffectFit) -> Float[np.ndarray, " part"]:
    """1σ of each part of the force over the stated one, level by level.

    From second differences along the resonance; 1 where no level has three states.
    """
    left = misfit.noise.without_shared(fit.rows)
    parts = [some for some in along(misfit, left) if len(some) > 2]
    squares = [np.mean((p[:-2] - 2 * p[1:-1] + p[2:]) ** 2) / 6 for p in parts]
    return np.sqrt(squares) if parts else np.ones(1)
