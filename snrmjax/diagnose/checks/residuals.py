"""What an answer leaves: levels that were left out of its fit, patterns, and the size of noise."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import fdtrc, ndtr

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.alternative_laws import Doubt
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.noise_model import (
    chi_square_p_value,
    shared_covariance,
    unit_columns,
)
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.diagnose.search.locating import hat_functions
from snrmjax.diagnose.search.model_search import FoundEffects
from snrmjax.numerics.facts import Fact


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
    kept = ~rows_of_level(misfit, level)
    before, after = (_refitted(misfit, one, kept)[1:] for one in (baseline, fit))
    return held_out_by(misfit, level, before, after, noise)


def held_out_by(
    misfit: WeightedMisfit,
    level: int,
    before: tuple[Float[np.ndarray, " row"], Float[np.ndarray, "row any"]],
    after: tuple[Float[np.ndarray, " row"], Float[np.ndarray, "row any"]],
    noise: float,
) -> HeldOut:
    """A level left out, by fits to the others: `before` and `after` any effect.

    Of each all rows, and the root of the covariance of the parameters' part of them.
    """
    out = rows_of_level(misfit, level)
    first, _ = _chi_square_of_level(misfit, *before, out)
    known, open_too = _chi_square_of_level(misfit, *after, out)
    n = int(out.sum())
    return HeldOut(
        int(misfit.level_numbers[level]),
        float(np.sqrt(first / n)),
        float(np.sqrt(known / n)),
        chi_square_p_value(known / noise, n),
        chi_square_p_value(open_too / noise, n),
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
    found = [held_out(misfit, baseline, fit, k, noise) for k in held_out_places(misfit)]
    return HeldOutLevels(*found) if found else None


def without_level(
    misfit: WeightedMisfit, fit: EffectFit, level: int
) -> tuple[Float[np.ndarray, " parameter"], dict[str, float]]:
    """A fit's parameters, and the baseline's: one step to the best fit without a level's rows."""
    kept = ~rows_of_level(misfit, level)
    change, rows, _ = _refitted(misfit, fit, kept)
    values = np.clip(fit.values + change, fit.lower, fit.upper)
    return values, misfit.baseline_parameters(rows, kept)


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
    scaled, size = unit_columns(fit.slopes)
    both = misfit.noise.decorrelated(np.column_stack([scaled, fit.rows]).T, kept)
    arms, left = both[:-1].T, both[-1]
    matrix = arms.T @ arms
    change = -np.linalg.pinv(matrix, rcond=1e-12) @ (arms.T @ left)
    values, vectors = np.linalg.eigh(matrix)
    # What the kept rows do not determine at all is open: it may have any size.
    root = vectors / np.sqrt(np.maximum(values, 1e-12))
    return change / size, fit.rows + scaled @ change, scaled @ root


def _chi_square_of_level(
    misfit: WeightedMisfit,
    rows: Float[np.ndarray, " row"],
    root: Float[np.ndarray, "row any"],
    out: Bool[np.ndarray, " row"],
) -> tuple[float, float]:
    """χ² of rows left out, given the others, with parameters taken as known and as uncertain."""
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
    refuting = [held for held in levels if held.uncertain_p_value < priors.REJECTED / 2][:1]
    chance = inner.uncertain_p_value if parts_missing else inner.p_value
    worse = inner.after > inner.before and chance < priors.REJECTED
    alike = doubted and (inner.p_value < priors.MISSED or inner.after > priors.AS_NOISE)
    if worse or alike or (unclear and inner.uncertain_p_value < priors.MISSED_BY_ONE):
        refuting.append(inner)
    if refuting:
        level = refuting[0].level
        reason = Fact("level_missed", level=level, misfit=refuting[0].after)
        return [Doubt(reason, Fact("measure_level_again", level=level), refutes=True)]
    if outer.after < priors.FAR_MISSED or outer.p_value >= priors.REJECTED:
        return []
    reason = Fact("top_level_missed", level=outer.level, misfit=outer.after)
    return [Doubt(reason, Fact("measure_beside_level", level=outer.level), identical=True)]


def pattern(misfit: WeightedMisfit, fit: EffectFit) -> Fact | None:
    """Why the misfit that is left cannot be noise of any one size; None where it can."""
    left = misfit.noise.without_shared(fit.rows)
    for search in (_by_level, _by_direction, _of_neighbours):
        reason = search(misfit, left)
        if reason is not None:
            return reason
    return left_curve(misfit, fit)


def left_curve(misfit: WeightedMisfit, fit: EffectFit) -> Fact | None:
    """Which free curve still explains a part of the misfit beside an answer; None if none does.

    Stiffness and damping are free functions of amplitude, and the stiffness one of the order of
    the test: a law that is nearly right, or a drift that is not linear, leaves little of χ² and
    all of it in such a curve. The answer's own parameters stay free. Fisher's ratio does not
    depend on the size of the noise.
    """
    chosen, noise = misfit.predictions.chosen, misfit.noise
    if chosen.phase_unknown.any():
        return None  # sizes are not linear in a curve
    amplitude = hat_functions(np.log(np.abs(np.asarray(chosen.states.velocity)[:, 0])), 6)
    of_test = hat_functions(np.argsort(np.argsort(chosen.rows)).astype(float), 8)
    curves = (("stiffness", 0, amplitude), ("damping", 1, amplitude), ("order", 0, of_test))
    left = noise.decorrelated(fit.rows)
    answer = _basis(noise.decorrelated(fit.slopes.T).T)
    found = []
    for name, part, hats in curves:
        arms = noise.decorrelated((misfit.by_linear[:, [part]] * hats[noise.state]).T).T
        basis = _basis(np.concatenate([answer, arms], axis=1))
        n_free, n_curve = misfit.n_rows - basis.shape[1], basis.shape[1] - answer.shape[1]
        explained = float(np.sum((left @ basis) ** 2))
        gain = max(explained - float(np.sum((left @ answer) ** 2)), 0.0)
        if n_curve > 0 and n_free > 0:
            ratio = gain / n_curve / ((float(left @ left) - explained) / n_free)
            found.append((float(fdtrc(n_curve, n_free, ratio)), name))
    chance, name = min(found, default=(1.0, ""))
    if chance * len(curves) >= priors.REJECTED:
        return None
    return Fact("curve_left", curve=name, chance=chance)


def _by_level(misfit: WeightedMisfit, left: Float[np.ndarray, " row"]) -> Fact | None:
    """Misfits of one level, of the force or the harmonics, that are larger than elsewhere."""
    level = np.asarray(misfit.predictions.chosen.states.level)[misfit.noise.state]
    of_force = misfit.noise.column < 2
    groups = [
        (k, force, (level == k) & (of_force == force))
        for k in np.unique(level)
        for force in (True, False)
    ]
    groups = [group for group in groups if group[2].any() and not group[2].all()]
    for k, force, rows in groups:
        ratio = np.mean(left[rows] ** 2) / np.mean(left[~rows] ** 2)
        if fdtrc(rows.sum(), (~rows).sum(), ratio) < priors.REJECTED / len(groups):
            number = int(misfit.level_numbers[int(k)])
            return Fact("level_worse", level=number, of_force=force, ratio=float(np.sqrt(ratio)))
    return None


def _by_direction(misfit: WeightedMisfit, left: Float[np.ndarray, " row"]) -> Fact | None:
    """Misfits of the force in the direction of a frequency change, larger than those across it.

    Noise of one size is the same in every direction of whitened parts; a natural frequency that
    differs from state to state, with temperature for example, has one direction.
    """
    noise = misfit.noise
    force = np.full((len(noise.known), 2), np.nan)
    unit = np.full_like(force, np.nan)
    rows = noise.column < 2
    force[noise.state[rows], noise.column[rows]] = left[rows]
    unit[noise.state[rows], noise.column[rows]] = misfit.by_linear[rows, 0]
    size = np.linalg.norm(unit, axis=1)
    whole = np.isfinite(force).all(axis=1) & (size > 0)
    if not whole.any() or misfit.predictions.chosen.phase_unknown.any():
        return None
    force, unit = force[whole], unit[whole] / size[whole, None]
    with_it = np.sum(force * unit, axis=1)
    across = force[:, 1] * unit[:, 0] - force[:, 0] * unit[:, 1]
    ratio = float(np.sum(with_it**2) / np.sum(across**2))
    if not fdtrc(len(with_it), len(with_it), ratio) < priors.REJECTED:
        return None
    return Fact("states_wander", ratio=float(np.sqrt(ratio)))


def _of_neighbours(misfit: WeightedMisfit, left: Float[np.ndarray, " row"]) -> Fact | None:
    """Misfits that are correlated between neighbouring states of a level."""
    for of_test in (True, False):
        parts = list(along(misfit, left, of_test=of_test))
        number = sum(max(len(some) - 1, 0) for some in parts)
        if not number:
            continue
        square = np.mean(np.concatenate(parts) ** 2)
        common = sum(float(some[:-1] @ some[1:]) for some in parts) / number / square
        if ndtr(-common * np.sqrt(number)) < priors.REJECTED / 2:
            return Fact("neighbours_alike", correlation=float(common), of_test=of_test)
    return None


def along(
    misfit: WeightedMisfit, rows: Float[np.ndarray, " row"], *, of_test: bool = False
) -> Iterator[Float[np.ndarray, " state"]]:
    """Rows of the force, level by level, along the resonance or in the order of the test.

    Along the resonance states are ordered by the phase of the velocity, which is monotonic even
    where a resonance bends over.
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


def _basis(columns: Float[np.ndarray, "row column"]) -> Float[np.ndarray, "row any"]:
    """Orthonormal columns with the same span."""
    if not columns.shape[1]:
        return columns
    left, values, _ = np.linalg.svd(unit_columns(columns)[0], full_matrices=False)
    return np.asarray(left[:, values > 1e-6 * values[0]])


def neighbour_noise(misfit: WeightedMisfit, fit: EffectFit) -> float:
    """Variance of the force's misfit, over the stated one, by second differences along levels.

    What varies smoothly from state to state, explained or not, does not enter; errors that states
    share are taken out first. Where phases are those of the fit, which may be wrong, the order of
    the test counts too: noise is smooth in neither.
    """
    left = misfit.noise.without_shared(fit.rows)
    found = []
    for of_test in (False, True) if misfit.predictions.chosen.phase_unknown.any() else (False,):
        parts = [some for some in along(misfit, left, of_test=of_test) if len(some) > 2]
        if not parts:
            return 1.0
        squares = [(some[:-2] - 2 * some[1:-1] + some[2:]) ** 2 / 6 for some in parts]
        differences = np.concatenate(squares)
        # Jumps and kinks are not noise: beyond four times the median's 1σ they are cut off.
        found.append(float(np.mean(np.minimum(differences, 16 * np.median(differences) / 0.4549))))
    return min(found)


def tolerated(noise: float) -> float:
    """Variance that counts as noise: stated a little too small it is no sign of further physics."""
    return float(np.clip(noise, 1.0, priors.TOLERATED_VARIANCE))
