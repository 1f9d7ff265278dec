"""What predictions have to tell: how sure a resonance is, trends of levels, negative damping."""

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtr

from snrmjax.identify.pointwise.backbone import BackboneValues
from snrmjax.identify.prediction.new_level import LevelTrend
from snrmjax.identify.prediction.resonance_distribution import ResonanceDistribution
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

_SURE = 0.975  # probability of a resonance that needs no word
_WORTH = 0.025  # probability of negative damping that needs one


def where_in_words(distribution: ResonanceDistribution) -> Fact:
    """Whether a further level has the resonance, and its 95 % ranges."""
    low, high = (distribution.frequency[[0, -1]] / HERTZ).tolist()
    slow, fast = distribution.velocity[[0, -1]].tolist()
    return Fact(
        "resonance_of_a_level",
        probability=distribution.probability,
        sure=distribution.probability >= _SURE,
        ratio=distribution.largest_amplitude_ratio,
        frequency_hz=(low, high),
        velocity=(slow, fast),
        another_day=distribution.another_day,
    )


def notes_on_resonance(distribution: ResonanceDistribution, load: Fact) -> list[Fact]:
    """Which curves were left out."""
    if not distribution.negative_damping > _WORTH:
        return []
    return [Fact("negative_damping_left_out", load=load, share=distribution.negative_damping)]


def notes_on_trends(trends: Sequence[LevelTrend], load: Fact) -> list[Fact]:
    """Which errors of levels change steadily with their force, and what that comes to."""
    return [
        Fact(
            "levels_follow_force",
            error=trend.kind,
            change=trend.last - trend.first,
            there=trend.there,
            p_value=trend.p_value,
            load=load,
        )
        for trend in trends
    ]


def notes_on_negative_damping(values: BackboneValues) -> list[Fact]:
    """Where a curve of damping, or its band, is below zero."""
    ratio, std = np.asarray(values.damping_ratio), np.asarray(values.damping_ratio_std)
    known = np.isfinite(ratio) & np.isfinite(std) & (std > 0)
    below = np.where(known, ndtr(-ratio / np.where(known, std, 1.0)), ratio < 0)
    k = int(np.argmax(below))
    if not below[k] > _WORTH:
        return []
    at = {"velocity": float(values.velocity[k]), "ratio": float(ratio[k])}
    return [Fact("damping_below_zero", **at, ratio_std=float(std[k]), probability=float(below[k]))]
