"""Whether an answer predicts levels that it was not fitted to."""

from snrmjax.diagnose import priors
from snrmjax.diagnose.checks.cross_validation import HeldOutLevels
from snrmjax.diagnose.checks.doubts import Doubt
from snrmjax.diagnose.search.model_search import FoundEffects

_MISSED, _MISSED_BY_ONE = 0.05, 0.01  # by chance: beside a doubt, and beside other answers
_AS_NOISE, _FAR = 1.3, 2.0  # times the noise, that a level is missed


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
