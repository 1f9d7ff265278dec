"""What predictions say in words: how sure a resonance is, trends of levels, negative damping."""

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtr

from snrmjax.identify.joint.notes import in_words
from snrmjax.identify.pointwise.backbone import BackboneValues
from snrmjax.identify.prediction.new_level import LevelTrend
from snrmjax.identify.prediction.resonance_distribution import ResonanceDistribution
from snrmjax.identify.test_model.states import LEVEL_ERRORS

_HERTZ = 2 * np.pi
_SURE = 0.975  # probability of a resonance that needs no word
_WORTH = 0.025  # probability of negative damping that needs one


def where_in_words(one: ResonanceDistribution) -> str:
    """Whether a further level has the resonance, and its 95 % ranges."""
    words = []
    if one.probability < _SURE:
        words = [
            f"within {one.largest_amplitude_ratio:g} times the largest measured amplitude with "
            f"probability {one.probability:.2g}, else beyond (`--extrapolate` looks farther)"
        ]
    if np.all(np.isfinite(one.frequency)):
        low, high = one.frequency[[0, -1]] / _HERTZ
        slow, fast = one.velocity[[0, -1]]
        band = f"{low:.6g} to {high:.6g} Hz, {slow:.3g} to {fast:.3g} m/s"
        words.append(f"95 % {band} ({one.holds})")
    return "; ".join(words)


def notes_on_resonance(one: ResonanceDistribution, load: str) -> list[str]:
    """Which curves were left out."""
    if not one.negative_damping > _WORTH:
        return []
    return [
        f"damping extrapolated to nothing at {load}: {100 * one.negative_damping:.2g} % of the "
        "curves have none left before a resonance. No passive structure is so: they are left out "
        "(`--self-excited` keeps them)."
    ]


def notes_on_trends(trends: Sequence[LevelTrend], load: str) -> list[str]:
    """Which errors of levels change steadily with their force, and what that comes to."""
    notes = []
    for one in trends:
        place = LEVEL_ERRORS.index(one.kind)

        def said(size: float, place: int = place) -> str:
            sizes = np.where(np.arange(len(LEVEL_ERRORS)) == place, abs(size), 0.0)
            return f"{'-' if size < 0 else '+'}{in_words(sizes)}"

        notes.append(
            f"levels differ steadily with their force, by {said(one.last - one.first)} from the "
            f"smallest to the largest (p = {one.p_value:.1g}): a law that the curves lack, or a "
            f"drive that is not linear. Its line has {said(one.there)} at {load}: bands there are "
            "as much wider (1σ)."
        )
    return notes


def notes_on_negative_damping(values: BackboneValues) -> list[str]:
    """Where a curve of damping, or its band, is below zero."""
    ratio, std = np.asarray(values.damping_ratio), np.asarray(values.damping_ratio_std)
    known = np.isfinite(ratio) & np.isfinite(std) & (std > 0)
    below = np.where(known, ndtr(-ratio / np.where(known, std, 1.0)), ratio < 0)
    k = int(np.argmax(below))
    if not below[k] > _WORTH:
        return []
    return [
        f"damping at {float(values.velocity[k]):.3g} m/s is {100 * ratio[k]:.2g} ± "
        f"{100 * std[k]:.2g} % of critical, below zero with probability {below[k]:.2g}: a passive "
        "structure's is not, so read the band upwards of zero."
    ]
