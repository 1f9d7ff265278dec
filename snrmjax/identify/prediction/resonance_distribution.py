"""A resonance under a force that was not measured, as a distribution: whether, and where."""

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
_POINTS = 201  # amplitudes of each drawn curve
# One law in so many ends with the data: damping stays what it was at the largest amplitude.
_HELD = 20
_FEWEST = 40  # draws with a resonance, of which quantiles are told


class ResonanceDistribution(AbstractResult):
    """Whether a further level has a phase resonance within a range of amplitudes, and where.

    Frequency and velocity are quantiles of those draws that have one. The others reach the end of
    the range and ask for more force still: their resonance lies beyond, and is not denied.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("quantile",)

    force: float = setting()  # N
    drive: float | None  # what the test records of it, where that was asked for
    largest_amplitude_ratio: float = setting()  # the range, in largest measured amplitudes
    probability: float = setting()  # that the resonance lies within the range
    frequency: Float[np.ndarray, " quantile"] = quantity("quantile", "Hz", "frequency")
    # As the level would record it.
    velocity: Float[np.ndarray, " quantile"] = quantity("quantile", "m/s", "velocity")
    negative_damping: float = setting()  # share of the curves left out: none is passive
    another_day: bool  # whether the errors are another day's too

    @property
    def frequency_std(self) -> float:
        """1σ of the frequency (rad/s) of those draws: half of the range that holds 68 %."""
        return float(self.frequency[3] - self.frequency[1]) / 2

    @property
    def velocity_std(self) -> float:
        """The same of the velocity, m/s."""
        return float(self.velocity[3] - self.velocity[1]) / 2

    @property
    def holds(self) -> Fact:
        """Which errors the quantiles hold."""
        return Fact("errors_of_a_level", another_day=self.another_day)

    def variables(self) -> dict[str, Variable]:
        """Frequency and velocity at `QUANTILES`."""
        quantile = Variable(("quantile",), np.array(QUANTILES), "1", "share below")
        return {"quantile": quantile, **super().variables()}

    def attributes(self) -> dict[str, str | float | int]:
        """The force, the range, probabilities, and which errors the quantiles hold."""
        return {**super().attributes(), "holds": str(self.holds)}


class KnownCurves(NamedTuple):
    """Both curves along amplitudes, with independent errors of 1σ each."""

    values: Float[np.ndarray, "point curve"]  # ω̃² and 2ζ̃ω̃
    errors: Float[np.ndarray, "point curve error"]
    load: float | Float[np.ndarray, " point"]  # |A|F, m/s²
    load_errors: Float[np.ndarray, " error"]  # of its logarithm


def amplitudes_to(largest: float, ratio: float) -> Float[np.ndarray, " point"]:
    """Amplitudes of drawn curves, closer to one another the smaller they are."""
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
    """Draw curves, a further level's errors with them, and look where each has its resonance.

    A level whose phase errs by ψ records its resonance where tan ψ = (Ω² − ω̃²)/(Ωδ), and then
    needs X Ω δ/cos ψ = |A|F; the smallest such amplitude is taken. Beyond the data the damping of a
    passive structure stays positive: draws that fall below zero before they have a resonance are
    left out; one law in twenty ends with the data, and damping stays as it is there.

    Arguments: `force` in N; `amplitude` up to `ratio` times the largest measured one; `other`
    is the velocity of the other modes in units of the mode's own direction; with `gain_of_force` a
    level's gain is that of its recorded force, else of its velocity.
    """
    rng, edge = np.random.default_rng(0), int(np.searchsorted(amplitude, amplitude[-1] / ratio))
    gain, phase, stiffness, loss = (new.std * rng.normal(size=(_DRAWS, len(new.std)))).T
    error = rng.normal(size=(_DRAWS, curves.errors.shape[-1]))
    squared, damping = (curves.values.T[k] + error @ curves.errors[:, k].T for k in range(2))
    damping[::_HELD, edge:] = damping[::_HELD, edge, None]
    of_force = gain if gain_of_force and new.drive is not None else 0 * gain
    load = np.exp(error @ curves.load_errors + of_force) * np.cos(phase)
    squared, damping = squared * np.exp(stiffness)[:, None], damping * np.exp(loss)[:, None]
    with np.errstate(invalid="ignore"):
        natural = np.sqrt(squared)
    omega = natural + 0.5 * damping * np.tan(phase)[:, None]
    speed = amplitude * omega
    root = _Root.of(speed * damping / (load[:, None] * curves.load))
    kept = root.found | ~np.any(damping[:, edge:] <= 0, axis=1) | self_excited
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
    """Where rows that start at zero first reach one, between two amplitudes."""

    place: np.ndarray  # of the first amplitude beyond
    fraction: np.ndarray  # of the way back from there
    found: np.ndarray

    @classmethod
    def of(cls, needed: Float[np.ndarray, "draw point"]) -> "_Root":
        rows, place = np.arange(len(needed)), np.argmax(needed >= 1, axis=1)
        here = needed[rows, place] - 1
        before = np.where(place > 0, needed[rows, place - 1], 0.0) - 1
        return cls(place, here / (here - before), here >= 0)

    def at(
        self, values: Float[np.ndarray, "draw point"], at_rest: float | None = None
    ) -> Float[np.ndarray, " draw"]:
        rows = np.arange(len(values))
        here, before = values[rows, self.place], values[rows, np.maximum(self.place - 1, 0)]
        if at_rest is not None:
            before = np.where(self.place > 0, before, at_rest)
        return np.where(self.found, here + self.fraction * (before - here), np.nan)


def other_modes(
    modes: LinearModes, sensor: int, force: float
) -> Callable[[Float[np.ndarray, " draw"]], Complex[np.ndarray, " draw"]]:
    """Velocity of the other modes at frequencies, in the direction of the mode's own motion."""
    shape = modes.mode_shape[sensor, modes.mode_of_interest]
    sign = np.sign(float(shape * participation_of(modes)))

    def velocity(frequency: np.ndarray) -> np.ndarray:
        load = jnp.full(frequency.shape, force)
        beside = np.asarray(residual_velocity(modes, jnp.asarray(frequency), load))[:, sensor]
        return sign * beside * np.asarray(sensed_mode(modes, frequency).to_mode(sensor))

    return velocity


def covariance_root(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """A matrix R with RRᵀ the covariance, which may be singular."""
    size, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(size, 0.0))


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
    return [Fact("negative_damping_left_out", load=load, fraction=distribution.negative_damping)]


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
