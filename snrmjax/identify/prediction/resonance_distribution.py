"""Distribution of the resonance under a force that was not measured."""

from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float
from scipy.special import ndtr

from snrmjax.identify.pointwise.backbone import BackboneValues
from snrmjax.identify.pointwise.prediction import LARGEST_AMPLITUDE_RATIO
from snrmjax.identify.pointwise.snrm import participation_of, sensed_mode
from snrmjax.identify.prediction.new_level import LevelTrend, NewLevel
from snrmjax.model.modes import LinearModes, residual_velocity
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting
from snrmjax.numerics.units import HERTZ

QUANTILES = (0.025, 0.16, 0.5, 0.84, 0.975)
_DRAWS = 4000
_POINTS = 201  # amplitudes of each sampled curve
# One draw in so many has constant damping beyond the largest measured amplitude: prior 5 %.
_CONSTANT_BEYOND = 20
_FEWEST = 40  # draws with a resonance, below which no quantiles are reported


class ResonanceDistribution(AbstractResult):
    """Probability and distribution of a new level's phase resonance within an amplitude range.

    Frequency and velocity are quantiles of the draws with a resonance in the range. The other draws
    reach the end of the range at less than this force: their resonance lies beyond it.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("quantile",)

    force: float = setting()  # N
    drive: float | None  # its record, where requested
    largest_amplitude_ratio: float = (
        setting()
    )  # end of the range over the largest measured amplitude
    probability: float = setting()  # that the resonance lies within the range
    frequency: Float[np.ndarray, " quantile"] = quantity("quantile", "Hz", "frequency")
    # As the level would be recorded.
    velocity: Float[np.ndarray, " quantile"] = quantity("quantile", "m/s", "velocity")
    negative_damping: float = setting()  # fraction of draws rejected as not passive
    another_day: bool  # whether day-to-day variation is included

    @property
    def frequency_std(self) -> float:
        """1σ of the frequency (rad/s): half of the 68 % interval."""
        return float(self.frequency[3] - self.frequency[1]) / 2

    @property
    def velocity_std(self) -> float:
        """1σ of the velocity (m/s): half of the 68 % interval."""
        return float(self.velocity[3] - self.velocity[1]) / 2

    @property
    def holds(self) -> Fact:
        """Which errors the quantiles include."""
        return Fact("errors_of_a_level", another_day=self.another_day)

    def variables(self) -> dict[str, Variable]:
        """Frequency and velocity at `QUANTILES`."""
        quantile = Variable(("quantile",), np.array(QUANTILES), "1", "cumulative probability")
        return {"quantile": quantile, **super().variables()}

    def attributes(self) -> dict[str, str | float | int]:
        """The force, the range, probabilities, and which errors the quantiles include."""
        return {**super().attributes(), "holds": str(self.holds)}


class KnownCurves(NamedTuple):
    """Both curves at amplitudes, with their derivatives by independent unit-variance errors."""

    values: Float[np.ndarray, "point curve"]  # ω̃² and 2ζ̃ω̃
    errors: Float[np.ndarray, "point curve error"]
    load: float | Float[np.ndarray, " point"]  # |A|F, m/s²
    load_errors: Float[np.ndarray, " error"]  # of its logarithm


def amplitudes_to(largest: float, ratio: float) -> Float[np.ndarray, " point"]:
    """Amplitudes of sampled curves, denser at small amplitudes."""
    return ratio * largest * np.linspace(0.0, 1.0, _POINTS)[1:] ** 2


def resonance_distribution(
    force: float,
    amplitude: Float[np.ndarray, " point"],
    curves: KnownCurves,
    new: NewLevel,
    other: Callable[[Float[np.ndarray, " draw"]], Complex[np.ndarray, " draw"]],
    *,
    ratio: float = LARGEST_AMPLITUDE_RATIO,
    gain_of_force: bool = False,
    self_excited: bool = False,
) -> ResonanceDistribution:
    """Sample curves and a new level's errors, and solve each sample for its resonance.

    A level with phase error ψ records its resonance where tan ψ = (Ω² − ω̃²)/(Ωδ), which requires
    X Ω δ/cos ψ = |A|F; the smallest such amplitude is used. The damping of a passive structure
    stays positive beyond the data: samples that become negative before their resonance are
    rejected; in one of twenty the damping is constant beyond the data.

    Arguments: `force` in N; `amplitude` up to `ratio` times the largest measured one; `other`
    is the velocity of the other modes, in phase with the mode's own; with `gain_of_force` the level
    gain scales its recorded force, else its velocity.
    """
    rng, edge = np.random.default_rng(0), int(np.searchsorted(amplitude, amplitude[-1] / ratio))
    gain, phase, stiffness, loss = (new.std * rng.normal(size=(_DRAWS, len(new.std)))).T
    error = rng.normal(size=(_DRAWS, curves.errors.shape[-1]))
    squared, damping = (curves.values.T[k] + error @ curves.errors[:, k].T for k in range(2))
    damping[::_CONSTANT_BEYOND, edge:] = damping[::_CONSTANT_BEYOND, edge, None]
    of_force = gain if gain_of_force and new.drive is not None else 0 * gain
    load = np.exp(error @ curves.load_errors + of_force) * np.cos(phase)
    squared, damping = squared * np.exp(stiffness)[:, None], damping * np.exp(loss)[:, None]
    with np.errstate(invalid="ignore"):
        natural = np.sqrt(squared)
    omega = natural + 0.5 * damping * np.tan(phase)[:, None]
    speed = amplitude * omega
    root = _Root.of(speed * damping / (load[:, None] * curves.load))
    kept = root.reached | ~np.any(damping[:, edge:] <= 0, axis=1) | self_excited
    at, of_mode = root.at(omega), root.at(speed, at_rest=0.0)
    recorded = np.exp(0 * gain if gain_of_force else gain)
    known = np.isfinite(at)
    quantiles = np.full((2, len(QUANTILES)), np.nan)
    if known.sum() >= _FEWEST:
        total = recorded * np.abs(of_mode + other(np.where(known, at, np.nanmedian(at))))
        quantiles = np.quantile([at[known], total[known]], QUANTILES, axis=1).T
    return ResonanceDistribution(
        force=force,
        drive=new.drive,
        largest_amplitude_ratio=ratio,
        probability=float(known.sum() / max(kept.sum(), 1)),
        frequency=quantiles[0],
        velocity=quantiles[1],
        negative_damping=float(1 - kept.mean()),
        another_day=new.another_day,
    )


class _Root(NamedTuple):
    """First crossing of one by rows that start at zero, by linear interpolation."""

    position: np.ndarray  # first amplitude beyond the crossing
    fraction: np.ndarray  # distance back from there, over the step
    reached: np.ndarray

    @classmethod
    def of(cls, needed: Float[np.ndarray, "draw point"]) -> "_Root":
        rows, position = np.arange(len(needed)), np.argmax(needed >= 1, axis=1)
        here = needed[rows, position] - 1
        before = np.where(position > 0, needed[rows, position - 1], 0.0) - 1
        return cls(position, here / (here - before), here >= 0)

    def at(
        self, values: Float[np.ndarray, "draw point"], at_rest: float | None = None
    ) -> Float[np.ndarray, " draw"]:
        rows = np.arange(len(values))
        here, before = values[rows, self.position], values[rows, np.maximum(self.position - 1, 0)]
        if at_rest is not None:
            before = np.where(self.position > 0, before, at_rest)
        return np.where(self.reached, here + self.fraction * (before - here), np.nan)


def other_modes(
    modes: LinearModes, sensor: int, force: float
) -> Callable[[Float[np.ndarray, " draw"]], Complex[np.ndarray, " draw"]]:
    """Velocity of the other modes at frequencies, in phase with the mode's own motion."""
    shape = modes.mode_shape[sensor, modes.mode_of_interest]
    sign = np.sign(float(shape * participation_of(modes)))

    def velocity(frequency: np.ndarray) -> np.ndarray:
        load = jnp.full(frequency.shape, force)
        others = np.asarray(residual_velocity(modes, jnp.asarray(frequency), load))[:, sensor]
        return sign * others * np.asarray(sensed_mode(modes, frequency).to_mode(sensor))

    return velocity


def covariance_root(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """R with RRᵀ = covariance, which may be singular."""
    eigenvalues, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(eigenvalues, 0.0))


_CERTAIN = 0.975  # probability of a resonance that needs no note
_WORTH = 0.025  # probability of negative damping that needs a note


def where_in_words(distribution: ResonanceDistribution) -> Fact:
    """Probability of the new level's resonance in range, and its 95 % intervals."""
    low, high = (distribution.frequency[[0, -1]] / HERTZ).tolist()
    slow, fast = distribution.velocity[[0, -1]].tolist()
    return Fact(
        "resonance_of_a_level",
        probability=distribution.probability,
        sure=distribution.probability >= _CERTAIN,
        ratio=distribution.largest_amplitude_ratio,
        frequency_hz=(low, high),
        velocity=(slow, fast),
        another_day=distribution.another_day,
    )


def notes_on_resonance(distribution: ResonanceDistribution, load: Fact) -> list[Fact]:
    """Which fraction of the sampled curves was rejected as not passive."""
    if not distribution.negative_damping > _WORTH:
        return []
    return [Fact("negative_damping_left_out", load=load, fraction=distribution.negative_damping)]


def notes_on_trends(trends: Sequence[LevelTrend], load: Fact) -> list[Fact]:
    """Level errors with a significant trend in force, and their value at this one."""
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
    """Where the damping curve or its band is negative."""
    ratio, std = np.asarray(values.damping_ratio), np.asarray(values.damping_ratio_std)
    known = np.isfinite(ratio) & np.isfinite(std) & (std > 0)
    below = np.where(known, ndtr(-ratio / np.where(known, std, 1.0)), ratio < 0)
    k = int(np.argmax(below))
    if not below[k] > _WORTH:
        return []
    at = {"velocity": float(values.velocity[k]), "ratio": float(ratio[k])}
    return [Fact("damping_below_zero", **at, ratio_std=float(std[k]), probability=float(below[k]))]
