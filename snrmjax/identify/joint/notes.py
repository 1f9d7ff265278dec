"""What a joint fit has to tell of its data: noise, levels, modal mass, and where the states lie."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.special import chdtri, ndtri

from snrmjax.identify.checks.residual_autocorrelation import states_of_levels
from snrmjax.identify.curves.splines import WithRemainder
from snrmjax.identify.joint.force_balance import BalanceProblem, Motion, Unknowns
from snrmjax.identify.test_model.states import LEVEL_ERRORS
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

_BESIDE = np.radians(5.0)  # from resonance, with every state farther on the same side
_ONE_AMPLITUDE = 1.1  # ratio of levels' amplitudes below which they are one
_TREND = 4  # levels: fewer are in order by chance too often
_BREACH = 2.0  # standard deviations that are worth a word
_CHANCE = 1e-3  # of stated errors that are right to be called too small


class NoiseEstimate(eqx.Module):
    """The random errors of the states and the errors that the states of a level share."""

    scale: float  # by which residuals exceed the stated noise; the noise where none is stated
    scale_std: float
    level_std: Float[np.ndarray, " error"]  # of `LEVEL_ERRORS`, stated or found
    stated: bool = eqx.field(static=True)
    # Of successive residuals, 0 if it may be chance.
    autocorrelation: Float[np.ndarray, " part"] = eqx.field(default_factory=lambda: np.zeros(2))

    @property
    def exceeded(self) -> bool:
        """Whether the residuals are too large for a stated noise."""
        return self.stated and self.scale - 3 * self.scale_std > 1

    @property
    def overstated(self) -> bool:
        """Whether they are too small for it."""
        return self.stated and self.scale + 3 * self.scale_std < 1


def notes_on_noise(
    noise: NoiseEstimate,
    frequency_jitter_std: float,
    given: Float[np.ndarray, " error"],
    taken: Float[np.ndarray, " error"],
    n_levels: int,
) -> list[Fact]:
    """Where the noise and the level-to-level variance are not as stated.

    Arguments: `frequency_jitter_std` 1σ of the natural frequency from state to state, relative;
    `given` the stated 1σ of levels' errors, `taken` those that the bands hold.
    """
    notes = []
    size = {"scale": noise.scale, "scale_std": noise.scale_std}
    if noise.exceeded:
        notes.append(Fact("noise_exceeded", **size))
    if noise.overstated:
        notes.append(Fact("noise_overstated", **size))
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
    """Where levels deviate by more than their stated errors allow, or all in one direction.

    Arguments: `deviation` of every level in units of its 1σ (`LEVEL_ERRORS`); `stated` 1σ, zero
    where none is.
    """
    notes, n_levels = [], len(deviation)
    for off, std, name in zip(deviation.T, stated.tolist(), LEVEL_ERRORS, strict=True):
        if std == 0 or float(off @ off) <= chdtri(n_levels, _CHANCE):
            continue
        mean = float(np.mean(off))
        alike = n_levels > 1 and abs(mean) * np.sqrt(n_levels) > -ndtri(_CHANCE / 2)
        size = {"rms": float(np.sqrt(np.mean(off**2))), "largest": float(np.max(np.abs(off)))}
        common = mean if alike else None
        notes.append(Fact("level_beyond_stated", error=name, stated=std, **size, mean=common))
    return notes


def notes_on_modal_mass(
    unknowns: Unknowns, problem: BalanceProblem, covariance: Float[np.ndarray, "unknown unknown"]
) -> list[Fact]:
    """Which modal mass the damping is relative to: the model's, or one that the data ask for."""
    prior = problem.prior.linear.item(-1)
    model = 1 / abs(float(problem.modal_constant))
    mass = float(problem.modal_mass_of(unknowns))
    std = mass * prior * float(np.sqrt(covariance[-1, -1]))
    away = abs(mass / model - 1)
    if prior == 0 or away <= _BREACH * min(prior, std / model):
        return []
    masses = {"found_kg": mass, "std_kg": std, "model_kg": model, "model_std": prior}
    stated, beyond = problem.modes.modal_mass_std is not None, bool(away > _BREACH * prior)
    return [Fact("modal_mass_moved", **masses, std_stated=stated, beyond_std=beyond)]


def notes_on_families(unknowns: Unknowns) -> list[Fact]:
    """Which families leave more of a curve than noise explains."""
    curves = {"natural frequency": unknowns.squared_frequency, "damping": unknowns.modal_damping}
    return [
        Fact(
            "family_leaves",
            curve=name,
            family=curve.family.words,
            # Of ω̃², of which a frequency has half.
            largest=curve.largest_remainder * (0.5 if name == "natural frequency" else 1.0),
        )
        for name, curve in curves.items()
        if isinstance(curve, WithRemainder)
    ]


def notes_on_autocorrelation(correlation: Float[np.ndarray, " part"]) -> list[Fact]:
    """That the residuals of neighbouring states are correlated."""
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
    """By how much the fit scaled each level's velocities and turned their phases.

    With `of_force` a level's gain is the force's, and the velocities are as measured.

    Arguments: `found` the errors of every level (`LEVEL_ERRORS`), zero where a kind of error is
    none of the fit's unknowns; `numbers` the levels' own numbers; `force` of every level, or its
    drive voltage.
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
    """1 or −1 if four or more changes have one sign and grow or fall with the levels' force."""
    steps = np.diff(np.abs(change)[order])
    one_sign = np.all(change > 0) or np.all(change < 0)
    if len(change) < _TREND or not one_sign:
        return 0
    return int(np.all(steps > 0)) - int(np.all(steps < 0))


def notes_on_reach(motion: Motion, level: np.ndarray) -> list[Fact]:
    """What states on one side of resonance, or of one amplitude, leave open."""
    notes = []
    phase = np.angle(np.asarray(motion.velocity))
    if np.min(phase) > _BESIDE or np.max(phase) < -_BESIDE:
        near, far = np.degrees(np.sort(np.abs([phase.min(), phase.max()]))).tolist()
        notes.append(
            Fact("one_side_of_resonance", near_deg=near, far_deg=far, below=bool(phase.min() > 0))
        )
    size = np.asarray(motion.displacement)
    peaks = np.array([size[level == k].max() for k in np.unique(level)])
    if len(peaks) > 1 and peaks.max() < _ONE_AMPLITUDE * peaks.min():
        notes.append(Fact("levels_of_one_amplitude", apart=float(peaks.max() / peaks.min() - 1)))
    return notes


_ONE_TEST_IN = 100  # has a state by chance that is called so
_NEIGHBOURS = 2  # states on each side, in the order of frequency within a level
_MEDIAN_OF_FOUR = 1.2  # variance of that median, times that of the mean


def outlying_states(fit: Any) -> np.ndarray:
    """Numbers of the states that lie farther from the curves than noise puts any of a test's.

    The two residuals of n states are those of a normal distribution: the largest of all is beyond
    √(−2 ln(p/n)) in the share p of tests, here one in a hundred (Bonferroni). So must be what a
    state differs by from its neighbours' median: curves that miss a stretch of states alike miss
    no single one.
    """
    residuals = np.nan_to_num(np.asarray(fit.residuals)[:, :2])
    level, frequency = np.asarray(fit.data.level), np.asarray(fit.data.frequency)
    beyond = np.sqrt(2 * np.log(_ONE_TEST_IN * max(1, len(residuals))))
    alone = np.zeros_like(residuals)
    for rows in states_of_levels(level, frequency):
        for k, row in enumerate(rows):
            near = np.r_[rows[max(0, k - _NEIGHBOURS) : k], rows[k + 1 : k + 1 + _NEIGHBOURS]]
            if near.size > 1:
                spread = np.sqrt(1 + _MEDIAN_OF_FOUR / near.size)
                alone[row] = (residuals[row] - np.median(residuals[near], axis=0)) / spread
    far = (np.hypot(*residuals.T) > beyond) & (np.hypot(*alone.T) > beyond)
    return np.flatnonzero(far)


def note_on_outlying(fit: Any, *, robust: bool) -> tuple[Fact, ...]:
    """A note that names these states, the farthest first."""
    rows = outlying_states(fit)
    if not rows.size:
        return ()
    size = np.hypot(*np.asarray(fit.residuals)[rows, :2].T)
    rows = rows[np.argsort(-size)]
    data = fit.data
    states = tuple(
        (fit.level_numbers[int(data.level[k])], float(data.frequency[k]) / HERTZ)
        for k in rows.tolist()
    )
    return (Fact("states_outlying", states=states, farthest=float(size.max()), robust=robust),)
