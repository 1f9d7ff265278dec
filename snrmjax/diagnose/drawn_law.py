"""A force law estimated from data as a free curve, for lack of a library law."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.model.effect_metadata import Argument
from snrmjax.numerics.facts import Fact


class LawOnset(NamedTuple):
    """Where a force sets in, or changes its sign."""

    at: float  # m or m/s
    side: int  # 1 or −1 of a law that differs between positive and negative values, else 0
    adds: bool  # whether it increases stiffness or damping


class DrawnLaw(NamedTuple):
    """A law estimated from data, as an equivalent force at the reference sensor.

    `at` is the displacement (m) or velocity (m/s) of that sensor; `force` (N), with its 1σ, is that
    of a spring, damper or joint between the sensor's point and the ground, in addition to the
    linear model. With the mode shape φ at the sensor x = φq, and φ times the force is the modal
    force. For friction it is the initial loading curve, in addition to the stuck stiffness; for
    displacement-dependent damping it is the force at the velocity `passing`.
    """

    law: str  # "spring", "damper", "displacement_damping" or "slip"
    symmetries: tuple[str, ...]  # "odd", "even", where a law has them
    onsets: tuple[LawOnset, ...]
    argument: Argument  # displacement or velocity
    at: Float[np.ndarray, " knot"]
    force: Float[np.ndarray, " knot"]
    force_std: Float[np.ndarray, " knot"]
    largest: float  # measured value of `at`; beyond it the law is extrapolated
    passing: float | None = None  # m/s

    @property
    def title(self) -> str:
        """Its class in words."""
        return str(Fact("law_class", law=self.law, symmetries=self.symmetries, onsets=()))

    @property
    def name(self) -> str:
        """Its class and its onsets in words."""
        return str(Fact("law_class", law=self.law, symmetries=self.symmetries, onsets=self.onsets))
