"""Cross-validation: whether an answer predicts levels that it was not fitted to."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.doubts import Doubt
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.noise_model import chi_square_p_value, shared_covariance
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.diagnose.search.model_search import FoundEffects

_MISSED, _MISSED_BY_ONE = 0.05, 0.01  # by chance: beside a doubt, and beside other answers
_AS_NOISE, _FAR = 1.3, 2.0  # times the noise, that a level is missed


class HeldOut(NamedTuple):
    """Root-mean-square misfit of one level in units of its predicted scatter."""

    level: int
    before: float
    after: float
    p_value: float  # of `after`, by noise alone
    uncertain_p_value: float  # by noise and the uncertainty of parameters from the other levels


def held_out(
    misfit: WeightedMisfit, baseline: EffectFit, fit: EffectFit, level: int, noise: float = 1.0
) -> HeldOut:
    """Fit to the other levels alone, and compare with the one left out.

    The misfit is that of the level given the others: errors that it shares with them through the
    baseline's stated uncertainty are predicted too; its own gain and phase are not. `noise` is
    the variance over the stated one for which probabilities are given.
    """
    out = rows_of_level(misfit, level)
    before, _ = _chi_square_of(misfit, baseline, out)
    return held_out_by(misfit, level, before, _chi_square_of(misfit, fit, out), noise)


def held_out_by(
    misfit: WeightedMisfit, level: int, before: float, after: tuple[float, float], noise: float
) -> HeldOut:
    """A level left out of a fit by its χ²: `before` and `after` any effect.

    `after` is what `chi_square_of_level` returns.
    """
    n_out = int(rows_of_level(misfit, level).sum())
    known, open_too = after
    return HeldOut(
        int(misfit.level_numbers[level]),
        float(np.sqrt(before / n_out)),
        float(np.sqrt(known / n_out)),
        chi_square_p_value(known / noise, n_out),
        chi_square_p_value(open_too / noise, n_out),
    )


class HeldOutLevels(NamedTuple):
    """A level between others, and the top one."""

    inner: HeldOut
    outer: HeldOut


def held_out_places(misfit: WeightedMisfit) -> tuple[int, ...]:
    """Which levels are left out: that in the middle and the top one by velocity.

    None for fewer than three levels.
    """
    chosen = misfit.predictions.chosen
    if chosen.n_levels < 3:
        return ()
    level = np.asarray(chosen.states.level)
    speed = np.abs(np.asarray(chosen.states.velocity)[:, 0])
    order = np.argsort([speed[level == k].max() for k in range(chosen.n_levels)])
    return int(order[chosen.n_levels // 2]), int(order[-1])


def held_out_levels(
    misfit: WeightedMisfit, baseline: EffectFit, fit: EffectFit, noise: float = 1.0
) -> HeldOutLevels | None:
    """Cross-validation on the level in the middle and the top one; None below three levels."""
    places = held_out_places(misfit)
    if not places:
        return None
    return HeldOutLevels(*(held_out(misfit, baseline, fit, place, noise) for place in places))


class FitWithoutLevel(NamedTuple):
    """A fit's parameters, and the baseline's, by all levels but one."""

    level: int
    values: Float[np.ndarray, " parameter"]
    baseline: dict[str, float]


def without_level(misfit: WeightedMisfit, fit: EffectFit, level: int) -> FitWithoutLevel:
    """One step from the whole fit to the best one without a level's rows."""
    kept = ~rows_of_level(misfit, level)
    change, rows, _ = _refitted(misfit, fit, kept)
    values = np.clip(fit.values + change, fit.lower, fit.upper)
    number = int(misfit.level_numbers[level])
    return FitWithoutLevel(number, values, misfit.baseline_parameters(rows, kept))


def rms_misfit(misfit: WeightedMisfit, fit: EffectFit) -> float:
    """Root-mean-square misfit of all rows in units of noise."""
    return float(np.sqrt(misfit.chi_square(fit.rows) / misfit.n_rows))


def rows_of_level(misfit: WeightedMisfit, level: int) -> Bool[np.ndarray, " row"]:
    """Which rows are those of a level, by its place."""
    levels = np.asarray(misfit.predictions.chosen.states.level)
    return np.asarray(levels[misfit.noise.state] == level)


def _refitted(
    misfit: WeightedMisfit, fit: EffectFit, kept: Bool[np.ndarray, " row"]
) -> tuple[
    Float[np.ndarray, " parameter"], Float[np.ndarray, " row"], Float[np.ndarray, "row any"]
]:
    """The refit of a fit's parameters to some rows, to first order.

    Returns the change of the parameters, all rows after it, and the root of its covariance: what
    independent unit errors of the change add to all rows.
    """
    slopes = fit.slopes
    if not slopes.shape[1]:
        return np.zeros(0), fit.rows, slopes
    size = np.linalg.norm(slopes, axis=0)
    size = np.where(size > 0, size, 1.0)
    scaled = slopes / size
    both = misfit.noise.decorrelated(np.column_stack([scaled, fit.rows]).T, kept)
    arms, left = both[:-1].T, both[-1]
    matrix = arms.T @ arms
    change = -np.linalg.pinv(matrix, rcond=1e-12) @ (arms.T @ left)
    values, vectors = np.linalg.eigh(matrix)
    # What the kept rows do not determine at all is open: it may have any size.
    root = vectors / np.sqrt(np.maximum(values, 1e-12))
    return change / size, fit.rows + scaled @ change, scaled @ root


def _chi_square_of(
    misfit: WeightedMisfit, fit: EffectFit, out: Bool[np.ndarray, " row"]
) -> tuple[float, float]:
    """χ² of rows left out, with the fitted parameters taken as known and as uncertain."""
    _, rows, root = _refitted(misfit, fit, ~out)
    return chi_square_of_level(misfit, rows, root, out)


def chi_square_of_level(
    misfit: WeightedMisfit,
    rows: Float[np.ndarray, " row"],
    root: Float[np.ndarray, "row any"],
    out: Bool[np.ndarray, " row"],
) -> tuple[float, float]:
    """χ² of rows left out, given the others, with parameters taken as known and as uncertain.

    Arguments: `rows` of a fit to the others; `root` of the covariance of the parameters' part of
    the rows.
    """
    given = misfit.noise.covariance.given_rows(~out)
    left, spread = given.decorrelated(rows), given.decorrelated(root.T).T
    known = float(left @ left)
    uncertain = float(np.sum(shared_covariance(spread).decorrelated(left) ** 2))
    return known, uncertain


def missed_levels(
    levels: HeldOutLevels | None, found: FoundEffects, *, doubted: bool
) -> list[Doubt]:
    """What levels that were left out of the fit say against an answer.

    They refute it where a level is missed by more than the uncertainty of the parameters allows,
    or predicted worse than without the effects; and where it is missed although a law that was not
    tried may act alike (`doubted`), or although several effects fit. A top level that is missed
    within that uncertainty proves nothing, and leaves a question open.
    """
    if levels is None:
        return []
    inner, outer = levels
    unclear = any(len(group) > 1 for group in found.classes)
    parts_missing = bool(found.misfit.predictions.chosen.phase_unknown[:, 0].any())
    for held in levels:
        if held.uncertain_p_value < priors.REJECTED / 2:
            return [_refuting(held.level, held.after)]
    chance = inner.uncertain_p_value if parts_missing else inner.p_value
    worse = inner.after > inner.before and chance < priors.REJECTED
    alike = doubted and (inner.p_value < _MISSED or inner.after > _AS_NOISE)
    if worse or alike or (unclear and inner.uncertain_p_value < _MISSED_BY_ONE):
        return [_refuting(inner.level, inner.after)]
    if outer.after < _FAR or outer.p_value >= priors.REJECTED:
        return []
    return [
        Doubt(
            f"level {outer.level}, left out of the fit, is missed by {outer.after:.2g} times the "
            "noise, within the uncertainty of the parameters: nothing proves the law there.",
            f"measure levels between level {outer.level} and the one below it, or above it",
            identical=True,
        )
    ]


def _refuting(level: int, missed: float) -> Doubt:
    return Doubt(
        f"level {level}, left out of the fit, is missed by {missed:.2g} times the noise: the law "
        "is not the true one.",
        f"measure level {level} again, and further levels around it",
        refutes=True,
    )
