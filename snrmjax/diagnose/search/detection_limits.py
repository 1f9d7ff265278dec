"""How large an effect would have to be to be detected in the data at hand."""

from collections.abc import Collection

import numpy as np

from snrmjax.diagnose.misfit.candidates import EffectCandidate, candidate
from snrmjax.diagnose.misfit.effect_fit import EffectFit, unfitted
from snrmjax.diagnose.misfit.weighted_misfit import WeightedMisfit
from snrmjax.diagnose.search.model_search import DETECTED
from snrmjax.model.effect_base import AbstractEffect
from snrmjax.model.effect_metadata import VISIBLE_CHANGE, MotionScales
from snrmjax.model.effect_shape import shape_of, starts_of
from snrmjax.model.effects import EFFECTS, effect_parameters

_TRIALS = 4  # of a limit
_BEYOND = 10.0  # times all that was measured: effects that must be larger cannot be detected


def detection_limits(
    misfit: WeightedMisfit, fit: EffectFit, scales: MotionScales, excluded: Collection[str]
) -> dict[str, float]:
    """The least strength of every further effect that would have been detected.

    By parameter, in its own unit. Not given for the effects of the answer, for those `excluded`
    from the search, and for what the data do not show at all.
    """
    limits = {}
    for kind in EFFECTS:
        if kind in excluded or kind in fit.kinds or not EFFECTS[kind].searched:
            continue
        tried = candidate(kind, scales)
        change = misfit.first_change(tried)
        square = misfit.chi_square(change)
        if not square > 0:
            continue
        need = DETECTED + len(tried.unit) * np.log(misfit.n_rows)
        power = 2 if misfit.predictions.chosen.orders else 2 * tried.strength_order
        name = f"{kind}.{effect_parameters(kind)[0]}"
        limit = float(abs(tried.starts[0][0]) * (need / square) ** (1 / power))
        limits[name] = _corrected(misfit, tried, limit, need)
    return limits


def _corrected(misfit: WeightedMisfit, one: EffectCandidate, limit: float, need: float) -> float:
    """A limit corrected by trials at it where sizes are compared: they are not linear in it."""
    if not misfit.predictions.sizes.alone.any():
        return limit
    first, *shape = one.starts[0]
    for _ in range(_TRIALS):
        start = (float(np.copysign(limit, first)), *shape)
        rows = unfitted(misfit, one._replace(starts=(start,))).rows
        square = misfit.chi_square(rows - misfit.base)
        if not 0 < square < np.inf:
            break
        # χ² grows with a power between the second and the fourth.
        limit *= float(np.clip(need / square, 0.01, 100.0)) ** (1 / 3)
    return limit


def beyond_data(effect: type[AbstractEffect], limit: float, scales: MotionScales | None) -> bool:
    """Whether an effect at its detection limit would exceed all that was measured ten times.

    Arguments: `limit` of its strength, in its own unit; `scales` of the measured motions, without
    which relative strengths alone are judged.
    """
    unit = next(iter(effect.parameters().values())).unit
    if not np.isfinite(limit) or (unit == "1" and limit > _BEYOND):
        return True
    starts = [] if scales is None else starts_of(effect, scales)
    if not starts or not starts[0][0]:
        return False
    shape = shape_of(effect)
    order = 1 if shape is None else shape.strength_order
    return bool(VISIBLE_CHANGE * (limit / abs(starts[0][0])) ** order > _BEYOND)
