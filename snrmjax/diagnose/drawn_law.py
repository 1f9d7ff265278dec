"""A law that was drawn from data and stands in no library."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.model.effect_metadata import Argument
from snrmjax.numerics.facts import Fact


class LawOnset(NamedTuple):
    """From where on a force is seen, or changes its sign."""

    at: float  # m or m/s
    side: int  # 1 or −1 of a law that differs between positive and negative values, else 0
    adds: bool  # to stiffness or damping


class DrawnLaw(NamedTuple):
    """A law that was drawn from data, as an equivalent force at the reference sensor.

    `at` is the displacement (m) or the velocity (m/s) of that sensor, `force` (N) what a spring, a
    damper or a joint between the sensor's point and the ground would have to exert there beside
    the linear model, with its 1σ: of a mode of the shape φ at the sensor, x = φq, and φ times the
    force is the modal force. Of friction it is the first loading from rest, beside the stuck
    stiffness; of a damping that depends on the displacement the force at the velocity `passing`.
    """

    law: str  # "spring", "damper", "displacement_damping" or "slip"
    symmetries: tuple[str, ...]  # "odd", "even", where a law has them
    onsets: tuple[LawOnset, ...]
    argument: Argument  # displacement or velocity
    at: Float[np.ndarray, " knot"]
    force: Float[np.ndarray, " knot"]
    force_std: Float[np.ndarray, " knot"]
    largest: float  # of `at`, that was measured: what is beyond is extrapolated
    passing: float | None = None  # m/s

    @property
    def title(self) -> str:
        """Its class in words."""
        return str(Fact("law_class", law=self.law, symmetries=self.symmetries, onsets=()))

    @property
    def name(self) -> str:
        """Its class in words, and from where on it acts which way."""
        return str(Fact("law_class", law=self.law, symmetries=self.symmetries, onsets=self.onsets))
