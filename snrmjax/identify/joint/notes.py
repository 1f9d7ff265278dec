"""Notes of a joint fit on its data: noise, levels, modal mass, and coverage of the states."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.special import chdtri, ndtri

from snrmjax.identify.checks.residual_autocorrelation import states_of_levels
from snrmjax.identify.curves.splines import WithRemainder
from snrmjax.identify.joint.force_balance import BalanceProblem, Motion, Unknowns
from snrmjax.identify.test_model.posterior import farthest_by_chance
from snrmjax.identify.test_model.states import LEVEL_ERRORS
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

_OFF_RESONANCE = np.radians(5.0)  # from resonance: all states beyond it are on one side
_ONE_AMPLITUDE = 1.1  # ratio of levels' amplitudes, below which they are the same
_TREND = 4  # levels: fewer are monotonic by chance too often
_SIGNIFICANT = 2.0  # standard deviations that are worth a note
_CHANCE = 1e-3  # false-alarm probability for stated level errors


class NoiseEstimate(eqx.Module):
    """Random errors of the states, and level errors that the states of a level share."""

    scale: float  # residuals over the stated noise; the noise itself where none is stated
    scale_std: float
    level_std: Float[np.ndarray, " error"]  # of `LEVEL_ERRORS`, stated or estimated
    stated: bool = eqx.field(static=True)
    # Of successive residuals, 0 if not significant.
    autocorrelation: Float[np.ndarray, " part"] = eqx.field(default_factory=lambda: np.zeros(2))

    @property
    def exceeded(self) -> bool:
        """Whether the residuals significantly exceed a stated noise."""
        return self.stated and self.scale - 3 * self.scale_std > 1

    @property
    def overstated(self) -> bool:
        """Whether the residuals are significantly below it."""
        return self.stated and self.scale + 3 * self.scale_std < 1


def notes_on_noise(
    noise: NoiseEstimate,
    frequency_jitter_std: float,
    given: Float[np.ndarray, " error"],
    taken: Float[np.ndarray, " error"],
    n_levels: int,
) -> list[Fact]:
    """Where noise and level-to-level variance differ from what is stated.

    Arguments: `frequency_jitter_std` 1σ of the natural frequency from state to state, relative;
    `given` the stated 1σ of level errors, `taken` those included in the bands.
    """
    notes = []
    scale = {"scale": noise.scale, "scale_std": noise.scale_std}
    if noise.exceeded:
        notes.append(Fact("noise_exceeded", **scale))
    if noise.overstated:
        notes.append(Fact("noise_overstated", **scale))
    if frequency_jitter_std > 0:
        notes.append(Fact("frequency_wanders", std=frequency_jitter_std, noise_stated=noise.stated))
    shared = np.where(given > 0, 0.0, noise.level_std)
    if np.any(shared > 0):
        beyond = bool(noise.stated or np.any(given > 0))
        notes.append(Fact("levels_differ", std=tuple(shared.tolist()), beyond_stated=beyond))
    if n_levels < 3:
        assumed = tuple(np.where(given > 0, 0.0, taken).tolist())
        notes.append(Fact("few_levels", n_levels=n_levels, assumed=assumed))
    return notes


def notes_on_stated_errors(
    deviation: Float[np.ndarray, "level error"], stated: Float[np.ndarray, " error"]
) -> list[Fact]:
    """Where level errors exceed their stated 1σ, or all have one sign.

    Arguments: `deviation` of every level in units of its 1σ (`LEVEL_ERRORS`); `stated` 1σ, zero
    where none is.
    """
    notes, n_levels = [], len(deviation)
    for errors, std, name in zip(deviation.T, stated.tolist(), LEVEL_ERRORS, strict=True):
        if std == 0 or float(errors @ errors) <= chdtri(n_levels, _CHANCE):
            continue
        mean = float(np.mean(errors))
        alike = n_levels > 1 and abs(mean) * np.sqrt(n_levels) > -ndtri(_CHANCE / 2)
        deviations = {
            "rms": float(np.sqrt(np.mean(errors**2))),
            "largest": float(np.max(np.abs(errors))),
        }
        common = mean if alike else None
        notes.append(Fact("level_beyond_stated", error=name, stated=std, **deviations, mean=common))
    return notes


def notes_on_modal_mass(
    unknowns: Unknowns, problem: BalanceProblem, covariance: Float[np.ndarray, "unknown unknown"]
) -> list[Fact]:
    """Where the fitted modal mass, which the damping is relative to, differs from the model's."""
    prior = problem.prior.linear.item(-1)
    model = 1 / abs(float(problem.modal_constant))
    mass = float(problem.modal_mass_of(unknowns))
    std = mass * prior * float(np.sqrt(covariance[-1, -1]))
    away = abs(mass / model - 1)
    if prior == 0 or away <= _SIGNIFICANT * min(prior, std / model):
        return []
    masses = {"found_kg": mass, "std_kg": std, "model_kg": model, "model_std": prior}
    stated, beyond = problem.modes.modal_mass_std is not None, bool(away > _SIGNIFICANT * prior)
    return [Fact("modal_mass_moved", **masses, std_stated=stated, beyond_std=beyond)]


def notes_on_families(unknowns: Unknowns) -> list[Fact]:
    """Which families leave a remainder that noise does not explain."""
    curves = {"natural frequency": unknowns.squared_frequency, "damping": unknowns.modal_damping}
    return [
        Fact(
            "family_leaves",
            curve=name,
            family=curve.family.words,
            # A relative change of ω̃² is half of it in frequency.
            largest=curve.largest_remainder * (0.5 if name == "natural frequency" else 1.0),
        )
        for name, curve in curves.items()
        if isinstance(curve, WithRemainder)
    ]


def notes_on_autocorrelation(correlation: Float[np.ndarray, " part"]) -> list[Fact]:
    """Whether the residuals of neighbouring states are correlated."""
    if not np.any(correlation > 0):
        return []
    in_phase, quadrature = correlation.tolist()
    as_one = float(np.max((1 + correlation) / (1 - correlation)))
    return [
        Fact("residuals_correlated", in_phase=in_phase, quadrature=quadrature, states_as_one=as_one)
    ]


def notes_on_level_errors(
    errors: Float[np.ndarray, "level error"],
    numbers: Sequence[int],
    force: Float[np.ndarray, " level"],
    *,
    of_force: bool = False,
) -> list[Fact]:
    """By how much the fit scaled each level's velocities and shifted their phases.

    With `of_force` the level gain scales the force, and the velocities are as measured.

    Arguments: `errors` of every level (`LEVEL_ERRORS`), zero for a kind that the fit does not
    estimate; `numbers` the levels' own numbers; `force` of every level, or its drive voltage.
    """
    changes = {
        "forces" if of_force else "velocities": np.expm1(
            errors[:, 0] if of_force else -errors[:, 0]
        ),
        "phases": -errors[:, 1],
    }
    levels, order = tuple(numbers), np.argsort(force)
    return [
        Fact(
            "levels_corrected",
            of=of,
            levels=levels,
            change=tuple(change.tolist()),
            trend=_trend(change, order),
        )
        for of, change in changes.items()
        if len(numbers) > 1 and np.any(change != 0)
    ]


def _trend(change: Float[np.ndarray, " level"], order: np.ndarray) -> int:
    """1 or −1 if four or more changes of one sign grow or fall monotonically with force, else 0."""
    steps = np.diff(np.abs(change)[order])
    one_sign = np.all(change > 0) or np.all(change < 0)
    if len(change) < _TREND or not one_sign:
        return 0
    return int(np.all(steps > 0)) - int(np.all(steps < 0))


def notes_on_reach(motion: Motion, level: np.ndarray) -> list[Fact]:
    """Where all states are on one side of resonance, or at one amplitude."""
    notes = []
    phase = np.angle(np.asarray(motion.velocity))
    if np.min(phase) > _OFF_RESONANCE or np.max(phase) < -_OFF_RESONANCE:
        near, far = np.degrees(np.sort(np.abs([phase.min(), phase.max()]))).tolist()
        notes.append(
            Fact("one_side_of_resonance", near_deg=near, far_deg=far, below=bool(phase.min() > 0))
        )
    amplitude = np.asarray(motion.displacement)
    peaks = np.array([amplitude[level == k].max() for k in np.unique(level)])
    if len(peaks) > 1 and peaks.max() < _ONE_AMPLITUDE * peaks.min():
        notes.append(Fact("levels_of_one_amplitude", apart=float(peaks.max() / peaks.min() - 1)))
    return notes


_NEIGHBOURS = 2  # states on each side, in the order of frequency within a level
_MEDIAN_OF_FOUR = 1.2  # variance of that median, times that of the mean


def unweighted_residuals(fit: Any) -> np.ndarray:
    """Residuals in units of the noise, whatever the weights of the states."""
    weight = np.asarray(fit.data.weight)[:, None]
    return np.nan_to_num(np.asarray(fit.residuals)[:, :2] / np.sqrt(weight))


def outlying_states(fit: Any) -> np.ndarray:
    """Indices of outlying states, which noise does not explain.

    Their residual exceeds `farthest_by_chance`. The difference from the neighbours' median must
    exceed it too: a curve that misses a whole stretch of states makes no outlier.
    """
    residuals = unweighted_residuals(fit)
    level, frequency = np.asarray(fit.data.level), np.asarray(fit.data.frequency)
    robust = bool(np.any(np.asarray(fit.data.weight) != 1))
    beyond = farthest_by_chance(len(residuals), robust=robust)
    alone = np.zeros_like(residuals)
    for rows in states_of_levels(level, frequency):
        for k, row in enumerate(rows):
            near = np.r_[rows[max(0, k - _NEIGHBOURS) : k], rows[k + 1 : k + 1 + _NEIGHBOURS]]
            if near.size > 1:
                spread = np.sqrt(1 + _MEDIAN_OF_FOUR / near.size)
                alone[row] = (residuals[row] - np.median(residuals[near], axis=0)) / spread
    far = (np.hypot(*residuals.T) > beyond) & (np.hypot(*alone.T) > beyond)
    return np.flatnonzero(far)


def note_on_outlying(fit: Any) -> tuple[Fact, ...]:
    """A note that lists the outlying states, the largest residual first."""
    rows = outlying_states(fit)
    if not rows.size:
        return ()
    distance = np.hypot(*unweighted_residuals(fit)[rows].T)
    rows = rows[np.argsort(-distance)]
    data = fit.data
    states = tuple(
        (fit.level_numbers[int(data.level[k])], float(data.frequency[k]) / HERTZ)
        for k in rows.tolist()
    )
    robust = bool(np.any(np.asarray(data.weight) != 1))
    return (Fact("states_outlying", states=states, farthest=float(distance.max()), robust=robust),)
