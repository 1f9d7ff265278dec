"""The verdict on an answer: whether it leaves noise, and whether it foretells unseen levels.

Noise that is stated too small makes every misfit larger by one factor, everywhere and without
order. What grows with the level, or what neighbours along the resonance share, is physics.
"""

import numpy as np
from jaxtyping import Float
from scipy.special import chdtr

from snrmjax.diagnose.checks.cross_validation import HeldOut
from snrmjax.diagnose.checks.doubts import Doubt
from snrmjax.diagnose.checks.patterns import UNLIKELY, along, left_curve, pattern
from snrmjax.diagnose.misfit.effect_fit import EffectFit
from snrmjax.diagnose.misfit.noise_model import chi_square_p_value
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.diagnose.search.model_search import FoundEffects

_MISSED = 0.05  # probability of a held-out level below which an imitation is of no use
_MISSED_BY_ONE = 0.01  # and below which one of several that cannot be told apart is of none
_AS_NOISE = 1.3  # times the noise, by which an imitation may miss it at most
_FAR = 2.0  # times the noise, that the top level is missed by
_TOLERATED = 1.7  # variance over the stated one that neighbours show
_WRONG_NOISE = 4.0  # 1σ of the noise as neighbours show it
_LOUD = 2.0  # times the noise, that neighbours scatter, worth a word


def neighbour_noise(misfit: WeightedMisfit, fit: EffectFit) -> tuple[float, float]:
    """Variance of the force's misfit as second differences along every level show it, and 1σ.

    What varies smoothly from state to state, explained or not, does not enter; what baseline and
    levels may have in common is taken out first. Where phases are those of the fit, which may be
    wrong, the order of the test counts too: noise is smooth in neither.
    """
    left = misfit.noise.without_shared(fit.rows)
    unsure = misfit.predictions.chosen.phase_unknown.any()
    return min(_scatter(misfit, left, of_test=k) for k in ((False, True) if unsure else (False,)))


def _scatter(
    misfit: WeightedMisfit, left: Float[np.ndarray, " row"], *, of_test: bool
) -> tuple[float, float]:
    """Variance from second differences in an order of the states, and 1σ."""
    squares = [
        (some[:-2] - 2 * some[1:-1] + some[2:]) ** 2 / 6
        for some in along(misfit, left, of_test=of_test)
        if len(some) > 2
    ]
    if not squares:
        return 1.0, np.inf
    every = np.concatenate(squares)
    # Jumps and kinks are no noise: beyond four times the median's 1σ they are cut.
    limit = 16 * np.median(every) / 0.4549
    # Neighbouring differences share states: about half as many are independent.
    value = float(np.mean(np.minimum(every, limit)))
    return value, value * float(np.sqrt(2 / (0.51 * len(every))))


def judged(found: FoundEffects, noise: float, noise_std: float) -> tuple[str, list[str]]:
    """Verdict and reasons from the fit; `noise` and 1σ are as neighbours show it."""
    n = found.misfit.n_rows - len(found.fit.values)
    reduced = found.fit.chi_square / n
    too_good = float(chdtr(n, found.fit.chi_square))
    stated = found.misfit.predictions.chosen.noise_stated
    if stated and too_good < UNLIKELY:
        return "noise_rejected", [
            f"the misfit is {np.sqrt(reduced):.2g} times the stated noise: it is overstated, and "
            "smaller effects may be hidden by it."
        ]
    misfit = found.p_value < UNLIKELY
    structure = curve = None
    if misfit:
        structure = pattern(found.misfit, found.fit)
    elif found.fit.kinds and stated:  # else what is left counts as noise, whatever it is
        curve = left_curve(found.misfit, found.fit)
    loud = noise - 1 > (0.5 if misfit else 1.0) * _WRONG_NOISE * noise_std
    if stated and loud and structure is None:
        return "noise_rejected", [
            f"neighbouring states scatter {np.sqrt(noise):.2g} times as much as the stated noise "
            "allows: it is understated; state it rightly before an effect is named."
        ]
    if chi_square_p_value(found.fit.chi_square / tolerated(noise, structure), n) < UNLIKELY:
        reasons = ["no effect of the library explains what is left."]
        if structure is not None:
            reasons.append(structure)
        if noise > _LOUD**2:
            reasons.append(
                f"neighbouring states scatter {np.sqrt(noise):.2g} times as much as the noise "
                "that counts here: state what a repeated test shows, or no noise at all, and "
                "diagnose again."
            )
        return "unknown", reasons
    if curve is not None:
        return "unknown", [curve]
    if not found.fit.kinds:
        return "none", []
    unclear = any(len(group) > 1 for group in found.classes)
    return ("ambiguous" if unclear else "named"), []


def tolerated(noise: float, structure: str | None = None) -> float:
    """Variance that counts as noise: one stated a little too small is no sign of further physics.

    Not where what is left has a structure.
    """
    return float(np.clip(noise, 1.0, _TOLERATED)) if structure is None else 1.0


def not_foretold(
    inner: HeldOut,
    outer: HeldOut,
    *,
    doubted: bool,
    unclear: bool = False,
    parts_missing: bool = False,
) -> str | None:
    """Why held-out levels speak against an answer; None where they do not.

    Arguments: `inner` is a level between others, `outer` the top one; `doubted` says that the
    answer may be an imitation, which is then worth no more than what it foretells; `unclear` that
    several effects fit, any of which should foretell a level between those it was fitted to; with
    `parts_missing`, of forces of which the size alone is compared, fewer levels leave parameters
    open, and worse than nothing counts only beyond that.
    """
    for held in (inner, outer):
        if held.uncertain_p_value < UNLIKELY / 2:
            return (
                f"level {held.level}, left out, is missed by {held.after:.2g} times the noise, "
                "more than the uncertainty of the parameters allows: the law is another one."
            )
    chance = inner.uncertain_p_value if parts_missing else inner.p_value
    if inner.after > inner.before and chance < UNLIKELY:
        return (
            f"level {inner.level}, left out, is foretold worse than without the effects: "
            f"{inner.after:.2g} times the noise, {inner.before:.2g} before."
        )
    if doubted and (inner.p_value < _MISSED or inner.after > _AS_NOISE):
        return (
            f"the answer may be an imitation, and level {inner.level}, left out, is missed by "
            f"{inner.after:.2g} times the noise."
        )
    if unclear and inner.uncertain_p_value < _MISSED_BY_ONE:
        return (
            "several effects fit and may all be imitations: level "
            f"{inner.level}, left out, is missed by {inner.after:.2g} times the noise."
        )
    return None


def unproved(outer: HeldOut) -> Doubt | None:
    """The doubt that stays where the top level is not foretold for want of certain parameters.

    That it is not missed by more than they leave open refutes no answer, and proves none: beyond
    the levels that put the parameters the law may be another one, as that of a contact is which
    stiffens on after it has closed.
    """
    if outer.after < _FAR or outer.p_value >= UNLIKELY:
        return None
    return Doubt(
        f"level {outer.level}, left out, is missed by {outer.after:.2g} times the noise, which "
        "what the other levels leave open of the parameters allows: nothing proves the law there.",
        f"measure levels between level {outer.level} and the one below it, or above it",
        twin=True,
    )
