"""What a joint fit says in words of its data: families, noise, levels, and where the states lie."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.special import chdtri, ndtri

from snrmjax.identify.joint.force_balance import (
    BalanceProblem,
    Motion,
    Unknowns,
)
from snrmjax.identify.test_model.states import LEVEL_ERRORS

_BESIDE = 5.0  # degrees from resonance, with every state farther on the same side
_ALIKE = 1.1  # ratio of levels' amplitudes below which they are one
_LISTED = 8  # levels by name
_TREND = 4  # levels: fewer are in order by chance too often
_BREACH = 2.0  # standard deviations that are worth a word
_CHANCE = 1e-3  # of stated errors that are right to be called too small

_COMMON = {
    "gain": "all velocities share an error, or the force or the modal mass has one",
    "phase": "the instruments turn all phases alike (free `instrument_phase`)",
    "stiffness": "the natural frequency differs between this test and the others",
    "damping": "the force or the modal mass has an error",
}
"""What an error that all levels share may be."""


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
    noise: NoiseEstimate, wandering: float, given: Float[np.ndarray, " error"], n_levels: int
) -> tuple[str, ...]:
    """Where the noise and the level-to-level variance are not as stated.

    Arguments: `wandering` 1σ of the natural frequency from state to state, relative; `given` the
    stated 1σ of levels' errors.
    """
    notes = []
    size = f"{noise.scale:.2g} ± {noise.scale_std:.1g}"
    if noise.exceeded:
        notes.append(
            f"the fit misses the data by {size} times the stated noise: either that noise is too "
            f"small or the model is wrong; the bands are {noise.scale:.2g} times wider for it."
        )
    if noise.overstated:
        notes.append(
            f"states scatter about the curves by only {size} times the stated noise, errors of "
            "whole levels apart: it is overstated."
        )
    found_only = np.where(given > 0, 0.0, noise.level_std)
    if wandering > 0:
        more = "which the stated noise does not explain"
        if not noise.stated:
            more = "more than random noise of force and velocity explains (no noise is stated)"
        notes.append(
            f"the natural frequency varies by {100 * wandering:.2g} % from state to state (1σ), "
            f"{more}; the bands include it."
        )
    shared = in_words(found_only)
    if shared:
        notes.append(
            f"levels differ from one another by {shared} (1σ, estimated)"
            + (", which no stated error explains" if noise.stated or np.any(given > 0) else "")
            + "; the bands include this level-to-level variance."
        )
    if n_levels == 1:
        notes.append(
            "1 level only: the level-to-level variance cannot be estimated, and the bands do not "
            "include it."
        )
    if n_levels == 2:
        notes.append(
            "2 levels only: the level-to-level variance rests on a single difference, if the "
            "levels share amplitudes at all, and the bands may be too narrow."
        )
    return tuple(notes)


def in_words(level_std: Float[np.ndarray, " error"]) -> str:
    """By how much levels differ, and in what; nothing where they do not."""
    units = {
        "gain": (100, " % in gain"),
        "phase": (180 / np.pi, "° in phase"),
        "stiffness": (50, " % in natural frequency"),
        "damping": (100, " % in damping"),
    }
    pairs = [(units[k], one) for k, one in zip(LEVEL_ERRORS, level_std, strict=True) if one > 0]
    return ", ".join(f"{factor * one:.2g}{name}" for (factor, name), one in pairs)


def notes_on_stated_errors(
    deviation: Float[np.ndarray, "level error"], stated: Float[np.ndarray, " error"]
) -> tuple[str, ...]:
    """Where levels deviate by more than their stated errors allow, or all in one direction.

    Arguments: `deviation` of every level in units of its 1σ (`LEVEL_ERRORS`); `stated` 1σ, zero
    where none is.
    """
    notes, n_levels = [], len(deviation)
    for kind, name in enumerate(LEVEL_ERRORS):
        own = deviation[:, kind]
        if stated[kind] == 0 or float(own @ own) <= chdtri(n_levels, _CHANCE):
            continue
        size = in_words(np.where(np.arange(len(stated)) == kind, stated, 0.0))
        needed = float(np.sqrt(np.mean(own**2)))
        wanted = in_words(np.where(np.arange(len(stated)) == kind, needed * stated, 0.0))
        shift = float(np.mean(own)) * np.sqrt(n_levels)
        alike = ""
        if abs(shift) > -ndtri(_CHANCE / 2) and n_levels > 1 and name in _COMMON:
            alike = f"; their mean is {float(np.mean(own)):+.2g} of it: {_COMMON[name]}"
        notes.append(
            f"levels deviate by {needed:.2g} times the stated 1σ of {size} (root mean square; "
            f"largest {np.max(np.abs(own)):.2g} times): the data ask for at least {wanted}, "
            f"and the bands are too narrow if that is what levels vary by{alike}."
        )
    return tuple(notes)


def notes_on_modal_mass(
    unknowns: Unknowns,
    problem: BalanceProblem,
    covariance: Float[np.ndarray, "unknown unknown"],
) -> tuple[str, ...]:
    """Which modal mass the damping is relative to: the model's, or one that the data ask for."""
    prior = float(problem.prior.linear[-1])
    model = 1 / abs(float(problem.modal_constant))
    if prior == 0:
        return ()
    found = float(problem.modal_mass_of(unknowns))
    std = found * prior * float(np.sqrt(covariance[-1, -1]))
    away = abs(found / model - 1)
    source = "assumed" if problem.modes.modal_mass_std is None else "stated"
    if away > _BREACH * prior:
        return (
            f"the states away from resonance ask for a modal mass of {found:.4g} ± {std:.2g} kg, "
            f"{100 * (found / model - 1):+.2g} % from the model's {model:.4g} kg and beyond its "
            f"{source} 1σ of {100 * prior:.2g} %: check the linear test, the force calibration and "
            "the mode shape at the sensor.",
        )
    if away > _BREACH * std / model:
        return (
            f"the states away from resonance ask for a modal mass of {found:.4g} ± {std:.2g} kg; "
            f"the model has {model:.4g} kg (1σ {source}: {100 * prior:.2g} %). Damping ratios are "
            f"relative to {found:.4g} kg: relative to the model's they are {100 * away:.2g} % "
            f"{'larger' if found > model else 'smaller'}.",
        )
    return ()


def notes_on_autocorrelation(correlation: Float[np.ndarray, " part"]) -> tuple[str, ...]:
    """That the residuals of neighbouring states are correlated."""
    if not np.any(correlation > 0):
        return ()
    parts = ("for the part in phase with the force", "for the part in quadrature with it")
    found = ", ".join(
        f"{value:.2g} {part}" for value, part in zip(correlation, parts, strict=True) if value > 0
    )
    worth = float(np.max((1 + correlation) / (1 - correlation)))
    return (
        f"neighbouring points miss the curve in the same direction (correlation {found}): a "
        "systematic error, not noise; the curves do not follow the data there, or the motion was "
        f"not steady. About {worth:.0f} points count as one in the bands.",
    )


def notes_on_level_errors(
    found: Float[np.ndarray, "level error"],
    numbers: Sequence[int],
    force: Float[np.ndarray, " level"],
    *,
    of_force: bool = False,
) -> tuple[str, ...]:
    """By how much the fit scaled each level's velocities and turned their phases.

    With `of_force` a level's gain is the force's, and the velocities are as measured.

    Arguments: `found` the errors of every level (`LEVEL_ERRORS`), zero where a kind of error is
    none of the fit's unknowns; `numbers` the levels' own numbers; `force` of every level, or its
    drive voltage.
    """
    notes = []
    scaled = ("scaled the velocities", 100 * np.expm1(-found[:, 0]), " %")
    if of_force:
        scaled = ("scaled the forces", 100 * np.expm1(found[:, 0]), " %")
    changes = (
        scaled,
        ("turned the phases of the velocity", -np.degrees(found[:, 1]), "°"),
    )
    for done, change, unit in changes:
        if len(numbers) < 2 or not np.any(change != 0):
            continue
        notes.append(
            f"the fit {done} of {_by_level(change, numbers, unit)}, so that all levels lie on one "
            f"pair of curves{_trend(change, np.argsort(force))}."
        )
    return tuple(notes)


def _by_level(change: Float[np.ndarray, " level"], numbers: Sequence[int], unit: str) -> str:
    """Every level's change, or of many levels the extremes."""
    if len(numbers) > _LISTED:
        low, high = int(np.argmin(change)), int(np.argmax(change))
        return (
            f"{len(numbers)} levels by {change[low]:+.2g}{unit} (level {numbers[low]}) to "
            f"{change[high]:+.2g}{unit} (level {numbers[high]})"
        )
    run = list(numbers) == list(range(numbers[0], numbers[0] + len(numbers)))
    named = f"{numbers[0]} to {numbers[-1]}" if run and len(numbers) > 2 else _and(numbers)
    return f"levels {named} by {_and([f'{one:+.2g}' for one in change])}{unit}"


def _and(items: Sequence[object]) -> str:
    texts = [str(one) for one in items]
    return f"{', '.join(texts[:-1])} and {texts[-1]}"


def _trend(change: Float[np.ndarray, " level"], order: np.ndarray) -> str:
    """That four or more changes have one sign and grow or fall with the levels' force."""
    size = np.abs(change)[order]
    one_sign = np.all(change > 0) or np.all(change < 0)
    if len(size) < _TREND or not one_sign:
        return ""
    for verb, steps in (("grow", np.diff(size)), ("fall", -np.diff(size))):
        if np.all(steps > 0):
            return f"; they {verb} with the force of the level, so they are probably not random"
    return ""


def notes_on_reach(motion: Motion, level: np.ndarray) -> tuple[str, ...]:
    """What states on one side of resonance, or of one amplitude, leave open."""
    notes = []
    phase = np.degrees(np.angle(np.asarray(motion.velocity)))
    if phase.min() > _BESIDE or phase.max() < -_BESIDE:
        near, far = sorted((abs(phase.min()), abs(phase.max())))
        side = "below" if phase.min() > 0 else "above"
        notes.append(
            f"all states lie on one side of resonance ({near:.0f}° to {far:.0f}° {side} it): a "
            "phase error that they share looks like a change of natural frequency and damping, and "
            "the bands include it only if it is stated."
        )
    size = np.asarray(motion.displacement)
    peaks = np.array([size[level == k].max() for k in np.unique(level)])
    if len(peaks) > 1 and peaks.max() < _ALIKE * peaks.min():
        apart = 100 * (peaks.max() / peaks.min() - 1)
        notes.append(
            f"the levels' largest amplitudes lie within {max(apart, 0.1):.2g}"
            " % of each other: how the mode changes with amplitude rests on the smaller states of "
            "the same levels alone."
        )
    return tuple(notes)
