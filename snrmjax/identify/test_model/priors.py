"""Priors of the model of a test, each with its unit and its reason.

Hyperparameters are 1σ. Those of levels and of the discrepancy have half-normal priors, given by
their scale; those of curves and noise have lognormal ones, given by their median.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

_LOG_ROOT = 0.5 * np.log(2 * np.pi)


class LogNormalPrior(NamedTuple):
    """A positive number whose logarithm is normal."""

    median: float
    spread: float  # 1σ of the logarithm


class HalfNormalPrior(NamedTuple):
    """A positive number: the absolute value of a normal one."""

    scale: float


class NormalPrior(NamedTuple):
    """A normal number of mean zero."""

    std: float


class LogUniformPrior(NamedTuple):
    """A positive number whose logarithm is uniform between two bounds."""

    low: float  # of the logarithm
    high: float


Density = LogNormalPrior | HalfNormalPrior | NormalPrior | LogUniformPrior


class JointDensity(NamedTuple):
    """Independent prior densities of a vector of hyperparameters, evaluated together."""

    normal: Int[np.ndarray, " normal"]  # indices of normal entries
    mean: Float[np.ndarray, " normal"]
    std: Float[np.ndarray, " normal"]
    half: Int[np.ndarray, " half"]  # indices of logarithms of half-normal numbers
    scale: Float[np.ndarray, " half"]  # their logarithms
    constant: float

    @classmethod
    def of(cls, densities: Sequence[Density | None]) -> "JointDensity":
        """From one density per entry; None: flat."""
        normal, half = [], []
        constant = 0.0
        for index, density in enumerate(densities):
            if isinstance(density, HalfNormalPrior):
                half.append((index, np.log(density.scale)))
                constant += np.log(2) - _LOG_ROOT
            elif isinstance(density, LogUniformPrior):
                constant -= np.log(density.high - density.low)
            elif density is not None:
                pair = (
                    (np.log(density.median), density.spread)
                    if isinstance(density, LogNormalPrior)
                    else (0.0, density.std)
                )
                normal.append((index, *pair))
                constant -= np.log(pair[1]) + _LOG_ROOT
        first, second = (np.array(rows).reshape(-1, k) for rows, k in ((normal, 3), (half, 2)))
        return cls(
            first[:, 0].astype(int),
            first[:, 1],
            first[:, 2],
            second[:, 0].astype(int),
            second[:, 1],
            float(constant),
        )

    def log_density(
        self, point: Float[np.ndarray, " number"]
    ) -> tuple[float, Float[np.ndarray, " number"]]:
        """ln p, and its gradient."""
        slopes = np.zeros(len(point))
        step = (point[self.normal] - self.mean) / self.std
        off = point[self.half] - self.scale
        square = np.exp(2 * off)
        slopes[self.normal], slopes[self.half] = -step / self.std, 1 - square
        value = -0.5 * float(step @ step) + float(off.sum() - 0.5 * square.sum())
        return value + self.constant, slopes


STATED_NOISE = LogNormalPrior(1.0, 0.1)
"""Noise over the stated noise: a standard deviation from ten readings is good to some 20 %, and a
laboratory states the mean of many."""

UNSTATED_NOISE = LogNormalPrior(0.004, 1.2)
"""Noise where none is stated, relative for velocities and rad for phases: analysers reach 0.05 %,
manual readings some 3 %."""

FORCE_TO_VELOCITY = 0.1
"""Unstated error of the force over that of the velocity: calibrated load cells."""

LEVEL_GAIN = HalfNormalPrior(0.05)
"""Relative: drift of conditioners and of a shaker's coupling between levels; published tests show
15 %."""

LEVEL_PHASE = HalfNormalPrior(0.02)
"""rad: 1.1°, drift of a filter or controller between levels; manually run tests show 3°."""

LEVEL_STIFFNESS = HalfNormalPrior(0.008)
"""Relative, of ω̃²: 0.4 % of frequency, as 20 K in metals or the reseating of a joint."""

LEVEL_DAMPING = HalfNormalPrior(0.05)
"""Relative: joints and clamps reopened between levels repeat to some 10 %."""

NEAR_LINEAR = (0.5, 1.5)
"""1σ of ln ω̃² and of ln δ at the smallest measured amplitude about the linear test's: friction and
stops change damping tenfold. Where all states of a sweep differ in amplitude, some smooth curve
fits with any modal mass; a mass a thousand times off has no resonance near the test."""

INSTRUMENT_PHASE = 0.1
"""rad: 6°, common to all records, where a phase error is a hypothesis."""

OFF_RESONANCE = (0.5, 1.0)
"""1σ of d ln(amplitude-dependent part of ω̃², and of 2ζ̃ω̃) / d ln Ω at equal amplitude, which a
curve of amplitude alone lacks. Damping: −1 for dry friction and hysteresis, 1 for v|v|, 2 for v³;
stiffness: 0 where harmonics are small, 0.75 on an arch, which its static and second harmonic
soften."""

LEVELS: tuple[HalfNormalPrior, ...] = (
    LEVEL_GAIN,
    LEVEL_PHASE,
    LEVEL_STIFFNESS,
    LEVEL_DAMPING,
)
"""In the order of `LEVEL_ERRORS`."""

ONE_FORCE = 0.1
"""Of the logarithm of levels' forces: closer levels are repeats of one another."""

ONE_PHASE = 0.03
"""rad about their mean, within which all states count as at one phase: 1.7°, as phase controllers
hold it. Such differences carry less on the modal mass than the phase errors themselves."""

NEAR_ONE_PHASE = 0.4
"""rad about their mean: half way to the half-power points. States within it may have been measured
under phase control."""

IN_ORDER = 0.01
"""p-value of a line of level errors over log force, below which they correlate with force: level
errors proper are independent of one another."""

LEVELS_DIFFER = 5.41
"""Of −2 ln p, from which levels differ significantly: 1 %, one-sided, as four kinds are tried."""

CURVE_CONSTANT = 1.0
"""1σ of the mean of both curves, over ω² and over the typical damping: uninformative."""

CURVE_SLOPES = 1.0
"""1σ of their terms in a²: changes as large as the curves themselves."""

CURVE_ROUGHNESS = LogNormalPrior(1e-3, 2.0)
"""1σ of the roughness at some twenty knots, over the same: from none to as large as the curve."""

NO_REMAINDER = 0.3
"""Prior probability that a family fits exactly: real structures seldom follow a library law."""

REMAINDER_BY_CHANCE = 0.05
"""Probability of no remainder, below which the remainder of a family is fitted."""

ROUGHNESS_VARIES = NormalPrior(1.0)
"""Of the logarithm of that 1σ along a curve: where joints open, roughness is thrice as large."""

ROUGHNESS_LENGTH = 2.0
"""Knots over which the 1σ of the roughness is correlated."""

DISCREPANCY = HalfNormalPrior(0.1)
"""Of Ωδ: misfit of a single-mode model off resonance. Measured beams show 1 to 5 %, slipping joints
some 20 %."""

DISCREPANCY_LENGTH = np.radians(30.0)
"""Correlation length of the discrepancy in phase."""

STUDENT_FREEDOM = 4.0
"""Student's t degrees of freedom of noise with outliers: one state in 20 lies beyond 3σ."""

STUDENT_STD = float(np.sqrt(STUDENT_FREEDOM / (STUDENT_FREEDOM - 2)))
"""Its 1σ over its scale."""

FALSE_OUTLIERS = 0.01
"""States expected to count as outliers in a test with normal noise: in one test of a hundred."""

STUDENT_INFORMATION = (STUDENT_FREEDOM + 2) / (STUDENT_FREEDOM + 4)
"""Fisher information of the bivariate distribution over that of the normal ones of its weights."""

LEAST_FRACTION = 0.1
"""Lower bound of the independent fraction of the states: while curves are far off it is too low."""
