"""What an answer leaves: levels that were left out of its fit, patterns, and the size of noise."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from snrmjax.diagnose import priors
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.noise_model import (
    chi_square_p_value,
    unit_columns,
)
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit


class HeldOut(NamedTuple):
    """Root-mean-square misfit of one level in units of its predicted scatter."""

    level: int
    before: float
    after: float
    p_value: float  # of `after`, by noise alone


def held_out(
    misfit: WeightedMisfit, baseline: EffectFit, fit: EffectFit, level: int, noise: float = 1.0
) -> HeldOut:
    """Fit to the other levels alone, and compare with the one left out.

    The misfit is that of the level given the others: errors that it shares with them through the
    baseline's stated uncertainty are predicted too; its own gain and phase are not. `noise` is
    the variance over the stated one for which probabilities are given.
    """
    out = rows_of_level(misfit, level)
    given, n = misfit.noise.covariance.given_rows(~out), int(out.sum())
    left = [given.decorrelated(_refitted(misfit, one, ~out)[1]) for one in (baseline, fit)]
    before, after = (float(rows @ rows) for rows in left)
    return HeldOut(
        int(misfit.level_numbers[level]),
        float(np.sqrt(before / n)),
        float(np.sqrt(after / n)),
        chi_square_p_value(after / noise, n),
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
    change, rows = _refitted(misfit, fit, kept)
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
) -> tuple[Float[np.ndarray, " parameter"], Float[np.ndarray, " row"]]:
    """The refit of a fit's parameters to some rows, to first order: their change, and all rows
    after it.
    """
    scaled, size = unit_columns(fit.slopes)
    both = misfit.noise.decorrelated(np.column_stack([scaled, fit.rows]).T, kept)
    sensitivities, left = both[:-1].T, both[-1]
    change = -np.linalg.pinv(sensitivities.T @ sensitivities, rcond=1e-12) @ (
        sensitivities.T @ left
    )
    return change / size, fit.rows + scaled @ change


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


def scatter_of_levels(misfit: WeightedMisfit, fit: EffectFit) -> Float[np.ndarray, " part"]:
    """1σ of both parts of the force over the stated one, level by level.

    By second differences along the resonance; 1 where no level has three states.
    """
    left = misfit.noise.without_shared(fit.rows)
    parts = [some for some in along(misfit, left) if len(some) > 2]
    squares = [np.mean((p[:-2] - 2 * p[1:-1] + p[2:]) ** 2) / 6 for p in parts]
    return np.sqrt(squares) if parts else np.ones(1)


def tolerated(noise: float) -> float:
    """Variance that counts as noise: stated a little too small it is no sign of further physics."""
    return float(np.clip(noise, 1.0, priors.TOLERATED_VARIANCE))
