"""Metadata of an effect in addition to its equation: parameters and shape."""

import dataclasses
from collections.abc import Callable
from enum import StrEnum
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import Rule

VISIBLE_CHANGE = 0.05
"""Change by a starting value, relative to the dynamic stiffness near resonance or an amplitude."""


class MotionScales(NamedTuple):
    """Typical magnitudes of the measured motions, for starting values and bounds of fits."""

    amplitude: float  # median amplitude Q of the mode of interest, kg^1/2 m
    largest: float  # largest Q, kg^1/2 m
    frequency: float  # natural frequency of the mode of interest, rad/s
    stiffness: float  # median |modal force|/Q, 1/s²
    receptance: float  # median |X/F| at the reference sensor, m/N
    smallest_force: float  # N
    damping_ratio: float

    @property
    def change(self) -> float:
        """A clearly visible change of the dynamic stiffness, 1/s²."""
        return VISIBLE_CHANGE * self.stiffness


class Prior(NamedTuple):
    """A uniform prior: the bounds of a parameter in a fit.

    With `unit`, a scale of the measured motions, the bounds are multiples of it.
    """

    lower: float = -np.inf
    upper: float = np.inf
    unit: Callable[[MotionScales], float] | None = None

    def bounds(self, scales: MotionScales) -> tuple[float, float]:
        """The bounds in the parameter's own unit."""
        scale = 1.0 if self.unit is None else self.unit(scales)
        return self.lower * scale, self.upper * scale


ANY = Prior()
NON_NEGATIVE = Prior(lower=0.0)
POSITIVE_FACTOR = Prior(lower=-0.99)
"""Relative changes of a positive quantity."""
ADDED_MODE_DAMPING = Prior(1e-5, 0.2)
"""Damping ratio of an added mode."""


class Entries(StrEnum):
    """Whether a parameter is a scalar, or has one entry for every knot of a law."""

    ONE = "one"
    KNOTS = "knots"  # ascending positions of the knots: chosen, not fitted
    VALUES = "values"  # at the knots


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One parameter of an effect: its unit, meaning and permitted values.

    `rules` are those of files and constructors; `prior` has the bounds of a fit. `typical` is the
    default starting value, and the value while the effect has zero strength.
    `exponent` names, for the coefficient c of a law c x^p, the parameter p: the coefficient is
    that at unit amplitude, and a fit uses c R^(p − 1), at a typical amplitude R, instead.
    `entries` marks parameters of a law with one number for every knot. `start` gives the starting
    value of a fit to motions of given magnitudes.
    """

    unit: str = ""
    meaning: str = ""
    rules: tuple[Rule, ...] = ()
    prior: Prior = ANY
    typical: float = 1.0
    exponent: str | None = None
    entries: Entries = Entries.ONE
    start: Callable[[MotionScales], float] | None = None


def parameter(unit: str, meaning: str = "", **stated: Any) -> Any:
    """Declare a field of an effect as one of its parameters; arguments as of `Parameter`.

    The first parameter is the effect's strength: at zero the effect vanishes.
    """
    return eqx.field(metadata={"parameter": Parameter(unit, meaning, **stated)})


class Part(StrEnum):
    """The part of the force balance that an effect changes."""

    STIFFNESS = "stiffness"
    DAMPING = "damping"
    STIFFNESS_AND_DAMPING = "stiffness and damping"
    HARMONICS = "harmonics"
    INSTRUMENTS = "instruments"
    TIME = "not a function of amplitude"


class Symmetry(StrEnum):
    """Symmetry of a force f under reversal of the motion: f(−q, −q̇)."""

    ODD = "odd"  # −f
    EVEN = "even"  # f
    NEITHER = "neither"


class Argument(StrEnum):
    """The variable a force depends on, the abscissa of its plot; others are plotted as loops."""

    DISPLACEMENT = "displacement"
    VELOCITY = "velocity"
    BOTH = "displacement and velocity"
    HISTORY = "the motion so far"


class Shape(NamedTuple):
    """How an effect depends on amplitude, to lowest order in its strength.

    A force with a single power changes Δ(ω̃²), or ΩΔ(2ζ̃ω̃) if it is dissipative, both in 1/s², by
    `factor` · strength · Q^`power` · Ω^`frequency_power`. `power` is None if there is no single
    one. `strength_order` is the order in the strength of the change of the fundamental: 2 if the
    effect acts on it only through other harmonics.
    """

    part: Part
    symmetry: Symmetry | None = None
    argument: Argument | None = None
    power: float | None = None
    factor: float | None = None
    frequency_power: int = 0
    strength_order: int = 1

    @property
    def lowest_harmonic(self) -> int | None:
        """The lowest harmonic of the velocity, above the fundamental, that the effect generates."""
        if self.symmetry is None:
            return None
        return 3 if self.symmetry is Symmetry.ODD else 2

    @property
    def fact(self) -> Fact:
        """The part the effect changes and its signature."""
        return Fact(
            "shape_of_effect", part=self.part, power=self.power, harmonic=self.lowest_harmonic
        )

    @property
    def grows(self) -> bool:
        """Whether it is damping that increases with amplitude."""
        return self.part is Part.DAMPING and self.power is not None and self.power > 0
