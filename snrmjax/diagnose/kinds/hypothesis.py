"""What a diagnosis states about a kind of effect, apart from its physics."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex

from snrmjax.model.effect_metadata import MotionScales

Start = tuple[float, ...]
"""Starting values of a fit: parameters in the order of the constructor."""


class Confounder(NamedTuple):
    """Effects that measured states may not distinguish, and the measurement that does.

    The effects are those whose hypotheses name it. With `by_itself` the measurement is proposed
    where one of them competes with any other effect. With `by_calibration` they are equivalent in
    every test of one mode: only a calibration separates them.
    """

    separated_by: str
    by_itself: bool = False
    by_calibration: bool = False


class Hypothesis(NamedTuple):
    """How a kind of effect is looked for in measured states: its row of `HYPOTHESES`.

    The first-order `change` of the dynamic stiffness, over ω₀², is a function of the readings and
    of the shape parameters, whose values are on the grid `axes`; the last shape parameter may be
    one of `choices`, which are not refined. `higher` gives the change of one recorded harmonic of
    the force, `parameters` those of the effect's class, in modal units, from the readings, the
    strength and the shape. A force of a user's own needs none of these: they are computed.

    `starts`, from the magnitudes of the motions, and `steps` (a clearly visible change), from the
    magnitudes of a start, are for fits by harmonic balance; `idle` gives the parameters at zero
    strength, from the natural frequency (rad/s) and the damping ratio. Without them they follow
    from the class (see `starts_of` and `without_strength`).
    """

    change: Callable[..., Complex[np.ndarray, " state"]] | None = None
    higher: Callable[..., Complex[np.ndarray, " state"]] | None = None
    axes: tuple[np.ndarray, ...] = ()
    choices: tuple[float, ...] = ()
    sign: int = 0  # of the strength; 0: either
    std: float | None = None  # 1σ of the strength; None: over `priors.STRENGTHS`
    unit: float | None = None  # shape at strength 1, where the change depends on the strength
    odds: float = 1.0  # prior odds over a law of the library
    of_instrument: bool = False  # a measurement error, no property of the structure
    parameters: Callable[..., tuple[float, ...]] | None = None
    starts: Callable[[MotionScales], list[Start]] | None = None
    steps: Callable[[Start], Start] | None = None
    idle: Callable[[float, float], Start] | None = None
    confounders: tuple[Confounder, ...] = ()
    like_force_gain: bool = False  # equivalent to a gain of all forces
    # Adds a linear response to the force: the whole response, if the force gain is unknown.
    follows_force: bool = False
    only_phase: bool = False  # does not change amplitudes
    searched: bool = True  # otherwise only as an alternative to another effect
