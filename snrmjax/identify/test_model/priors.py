"""What is taken for likely before a test is seen: every prior with its unit and its reason.

Sizes are 1σ. Those of levels and of the discrepancy are the scale of a half-normal distribution
of the size itself; those of curves and noise are medians of lognormal ones.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

_LOG_ROOT = 0.5 * np.log(2 * np.pi)


class LogNormalSize(NamedTuple):
    """A positive number whose logarithm is normal."""

    median: float
    spread: float  # 1σ of the logarithm


class HalfNormalSize(NamedTuple):
    """A positive number: a normal one without its sign."""

    scale: float


class NormalNumber(NamedTuple):
    """Any number about zero."""

    std: float


class FlatSize(NamedTuple):
    """A positive number whose logarithm is anywhere between two ends."""

    low: float  # of the logarithm
    high: float


Density = LogNormalSize | HalfNormalSize | NormalNumber | FlatSize


class JointDensity(NamedTuple):
    """Independent densities of the numbers of a point, all at once."""

    normal: Int[np.ndarray, " normal"]  # places of logarithms and numbers that are normal
    mean: Float[np.ndarray, " normal"]
    std: Float[np.ndarray, " normal"]
    half: Int[np.ndarray, " half"]  # places of logarithms of half-normal sizes
    scale: Float[np.ndarray, " half"]  # their logarithms
    constant: float

    @classmethod
    def of(cls, densities: Sequence[Density | None]) -> "JointDensity":
        """Of one density a number; None says nothing."""
        normal, half = [], []
        constant = 0.0
        for place, density in enumerate(densities):
            if isinstance(density, HalfNormalSize):
                half.append((place, np.log(density.scale)))
                constant += np.log(2) - _LOG_ROOT
            elif isinstance(density, FlatSize):
                constant -= np.log(density.high - density.low)
            elif density is not None:
                pair = (
                    (np.log(density.median), density.spread)
                    if isinstance(density, LogNormalSize)
                    else (0.0, density.std)
                )
                normal.append((place, *pair))
                constant -= np.log(pair[1]) + _LOG_ROOT
        first, second = (np.array(rows).reshape(-1, k) for rows, k in ((normal, 3), (half, 2)))
        return cls(
            *(first[:, 0].astype(int), first[:, 1], first[:, 2]),
            *(second[:, 0].astype(int), second[:, 1], float(constant)),
        )

    def log_density(
        self, point: Float[np.ndarray, " number"]
    ) -> tuple[float, Float[np.ndarray, " number"]]:
        """ln p, and its slopes."""
        slopes = np.zeros(len(point))
        step = (point[self.normal] - self.mean) / self.std
        off = point[self.half] - self.scale
        square = np.exp(2 * off)
        slopes[self.normal], slopes[self.half] = -step / self.std, 1 - square
        value = -0.5 * float(step @ step) + float(np.sum(off) - 0.5 * np.sum(square))
        return value + self.constant, slopes


STATED_NOISE = LogNormalSize(1.0, 0.1)
"""Noise over the stated one: standard deviations from ten readings are good to some 20 %, and a
laboratory states the mean of many."""

UNSTATED_NOISE = LogNormalSize(0.004, 1.2)
"""Relative noise of velocities, rad of phases, where none is stated: analysers reach 0.05 %, hand
evaluation some 3 %."""

FORCE_TO_VELOCITY = 0.1
"""Error of a force of which none is stated, over that of the velocity: calibrated load cells."""

LEVEL_GAIN = HalfNormalSize(0.05)
"""Relative: drift of conditioners and of a shaker's coupling between levels; published tests show
15 %."""

LEVEL_PHASE = HalfNormalSize(0.02)
"""rad: 1.1°, a filter's or a controller's between levels; hand-made tests show 3°."""

LEVEL_STIFFNESS = HalfNormalSize(0.008)
"""Relative, of ω̃²: 0.4 % of frequency, some 20 K of temperature in metals, or a joint's seat."""

LEVEL_DAMPING = HalfNormalSize(0.05)
"""Relative: joints and clamps that are opened between levels repeat to some 10 %."""

NEAR_LINEAR = (0.5, 1.5)
"""1σ of ln ω̃² and of ln δ at the smallest measured amplitude about the linear test's: friction and
stops change damping tenfold. Where amplitude tells all states of a sweep apart, some smooth curves
fit with any modal mass; one a thousand times off has no resonance near the test."""

INSTRUMENT_PHASE = 0.1
"""rad: 6°, of all records together, where a hypothesis may be that there is one."""

OFF_RESONANCE = (0.5, 1.0)
"""1σ of d ln(what the motion adds to ω̃², and of 2ζ̃ω̃) / d ln Ω at equal amplitude, of which a
curve of amplitude knows nothing. Damping: −1 for dry friction and hysteresis, 1 for v|v|, 2 for v³;
stiffness: 0 where harmonics are small, 0.75 on an arch, whose static and second harmonic soften
it."""

LEVELS: tuple[HalfNormalSize, ...] = (
    LEVEL_GAIN,
    LEVEL_PHASE,
    LEVEL_STIFFNESS,
    LEVEL_DAMPING,
)
"""In the order of `LEVEL_ERRORS`."""

ONE_FORCE = 0.1
"""Of the logarithm of levels' forces: closer levels repeat one another."""

ONE_PHASE = 0.03
"""rad, from their mean, up to which states count as all of one phase: 1.7°, as phase controllers
keep it. Steps of that size say less on a modal mass than phases' own errors."""

NEAR_ONE_PHASE = 0.4
"""rad, from their mean: half of the way to the half-power points. States that stay within it may
have had their phase controlled."""

IN_ORDER = 0.01
"""Probability by chance of a line over the levels' forces, below which their errors run with it:
they are then no errors of levels, which know nothing of one another."""

LEVELS_DIFFER = 5.41
"""Of −2 ln p, from which on levels are said to differ: 1 %, one-sided, as four kinds are tried."""

CURVE_CONSTANT = 1.0
"""Of the mean of both curves, over ω² and over the typical damping: nothing is assumed."""

CURVE_SLOPES = 1.0
"""Of their terms in a²: changes as large as the curves themselves."""

CURVE_ROUGHNESS = LogNormalSize(1e-3, 2.0)
"""Size of the bends at some twenty knots, over the same: nothing to as much as the curve."""

NO_REMAINDER = 0.3
"""Probability that a family of curves leaves nothing: real structures are hardly in a library."""

REMAINDER_BY_CHANCE = 0.05
"""Probability that a family leaves nothing, below which its remainder is drawn."""

ROUGHNESS_VARIES = NormalNumber(1.0)
"""Of the logarithm of that size along a curve: where joints open a curve bends thrice as much."""

SIZES_ALIKE = 2.0
"""Bends, over which they are of one size."""

DISCREPANCY = HalfNormalSize(0.1)
"""Of Ωδ: what a single mode leaves off resonance. Measured beams show 1 to 5 %, joints that slip
some 20 %."""

DISCREPANCY_LENGTH = np.radians(30.0)
"""Phase over which a discrepancy changes."""

STUDENT_FREEDOM = 4.0
"""Degrees of freedom of noise with outliers, on request: one state in 20 beyond three times 1σ."""

LEAST_FRACTION = 0.1
"""Of states that tell something of their own: from curves that are far off fewer seem to."""
