"""What an effect states about itself beside its equation: parameters, shape, confusions."""

import dataclasses
from collections.abc import Callable
from enum import StrEnum
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import Rule

VISIBLE_CHANGE = 0.05
"""Of the dynamic stiffness near resonance (or of a recorded size): what a first guess changes."""


class MotionScales(NamedTuple):
    """Typical sizes of the measured motions, from which fits take their starting values."""

    amplitude: float  # median amplitude Q of the mode of interest, kg^1/2 m
    largest: float  # largest Q, kg^1/2 m
    frequency: float  # natural frequency of the mode of interest, rad/s
    stiffness: float  # median |modal force|/Q, 1/s²
    receptance: float  # median |X/F| at the reference sensor, m/N
    smallest_force: float  # N
    damping_ratio: float

    @property
    def change(self) -> float:
        """A change of the dynamic stiffness that is plainly seen, 1/s²."""
        return VISIBLE_CHANGE * self.stiffness


class Prior(NamedTuple):
    """A flat prior: the values of a parameter that a fit considers.

    With `unit`, a quantity of the measured motions, the bounds are multiples of it.
    """

    lower: float = -np.inf
    upper: float = np.inf
    unit: Callable[[MotionScales], float] | None = None

    def bounds(self, scales: MotionScales) -> tuple[float, float]:
        """The bounds in the parameter's own unit."""
        size = 1.0 if self.unit is None else self.unit(scales)
        return self.lower * size, self.upper * size


ANY = Prior()
NOT_BELOW_ZERO = Prior(lower=0.0)
MORE_THAN_NOTHING = Prior(lower=-0.99)
"""Relative changes of what stays positive."""
FURTHER_DAMPING = Prior(1e-5, 0.2)
"""Damping ratios that a further mode may have."""


class Entries(StrEnum):
    """Whether a parameter is one number, or one for every knot of a law."""

    ONE = "one"
    KNOTS = "knots"  # where the knots are, rising: chosen, not fitted
    VALUES = "values"  # at the knots


@dataclasses.dataclass(frozen=True)
class Parameter:
    """One parameter of an effect: its unit, what it is, and which values it may have.

    `rules` are those of files and constructors; `prior` is what a fit considers. `typical` is the
    value from which a fit begins and which the parameter has while the effect has no strength.
    `exponent` names, for the coefficient c of a law c x^p, the parameter p: the coefficient is
    that at unit amplitude, and a fit steps in c R^(p − 1), at a typical amplitude R, instead.
    `entries` says of a law's parameters that they are a number for every knot. `start` gives the
    one value from which a fit to motions of some sizes begins.
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
    """A field of an effect that is one of its parameters; the arguments are `Parameter`'s.

    The first parameter is the effect's strength: at zero the effect does nothing.
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
    """Of a force f under reversal of the motion, f(−q, −q̇)."""

    ODD = "odd"  # −f
    EVEN = "even"  # f
    NEITHER = "neither"


class Argument(StrEnum):
    """What a force is a function of, against which it is drawn; others are drawn as loops."""

    DISPLACEMENT = "displacement"
    VELOCITY = "velocity"
    BOTH = "displacement and velocity"
    HISTORY = "the motion so far"


class Shape(NamedTuple):
    """How an effect depends on amplitude, to lowest order in its strength.

    A force with one power changes Δ(ω̃²), or ΩΔ(2ζ̃ω̃) where it damps, both in 1/s², by
    `factor` · strength · Q^`power` · Ω^`frequency_power`. `power` is None where there is no single
    one. `strength_order` is the power of the strength with which the fundamental changes: 2 where
    the effect acts on it through other harmonics only.
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
        """The lowest harmonic of the velocity, above the fundamental, in which the effect shows."""
        if self.symmetry is None:
            return None
        return 3 if self.symmetry is Symmetry.ODD else 2

    @property
    def fact(self) -> Fact:
        """What the effect changes and where it shows."""
        return Fact(
            "shape_of_effect", part=self.part, power=self.power, harmonic=self.lowest_harmonic
        )

    @property
    def grows(self) -> bool:
        """Whether it is a damping that grows with amplitude."""
        return self.part is Part.DAMPING and self.power is not None and self.power > 0


class Confounder(NamedTuple):
    """Effects that measured states may not tell apart, and the measurement that does.

    The effects are those whose classes name it among their `confounders`. With `by_itself` the
    measurement is asked for where one of them is in question beside any other effect. With
    `by_calibration` they do the same to every test of one mode: only a calibration tells them.
    """

    separated_by: str
    by_itself: bool = False
    by_calibration: bool = False
