"""What a joint fit says in words of its data: families, noise, levels, and where the states lie."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from snrmjax.identify.joint.force_balance import LEVEL_ERRORS, Motion
from snrmjax.identify.joint.ranking import FamilyCandidate
from snrmjax.identify.joint.selection import SelectionStatus
from snrmjax.identify.joint.variance_components import VarianceComponents

_BESIDE = 5.0  # degrees from resonance, with every state farther on the same side
_ALIKE = 1.1  # ratio of levels' amplitudes below which they are one
_COUNTS = 0.03  # weight of a family that could widen a band


def notes_on_families(
    status: SelectionStatus, candidates: Sequence[FamilyCandidate]
) -> tuple[str, ...]:
    """Where the choice of families did not settle, or rests on fits that had not converged."""
    notes = []
    if status == SelectionStatus.NOT_SETTLED:
        notes.append(
            "the choice of families and the level-to-level variance still changed one another in "
            "the last round: other families may fit as well; name one to be sure of the choice."
        )
    unfinished = [one for one in candidates if not one.converged]
    told = [one for one in unfinished if one.chosen or one.weight > _COUNTS]
    if told:
        listed = ", ".join(f"{one.family}@{one.argument} of the {one.curve}" for one in told)
        notes.append(
            f"{len(told)} of {len(candidates)} families were compared by fits that had not "
            f"converged ({listed}): their scores in cross-validation are lower bounds."
        )
    return tuple(notes)


def notes_on_noise(
    components: VarianceComponents,
    jitter: float,
    given: Float[np.ndarray, " error"],
    n_levels: int,
    *,
    stated: bool,
    alike: bool,
) -> tuple[str, ...]:
    """Where the noise and the level-to-level variance are not as stated.

    Arguments: `jitter` 1σ of relative stiffness from state to state, in units of the noise where
    none is stated; `given` the stated 1σ of levels' errors; `alike` whether the residuals of
    neighbouring states are correlated.
    """
    notes = []
    size = f"{components.noise:.2g} ± {components.noise_std:.1g}"
    if stated and components.contradicts_upward:
        notes.append(
            f"residuals are {size} times the stated noise: the noise is understated or the "
            "model is wrong; the bands are widened accordingly."
        )
    if stated and components.contradicts_downward:
        more = "" if alike else ", and the bands are wider than need be"
        notes.append(f"residuals are only {size} times the stated noise: it is overstated{more}.")
    found_only = np.where(given > 0, 0.0, components.level)
    if jitter > 0:
        jitter = 0.5 * jitter * (1.0 if stated else components.noise)
        notes.append(
            f"the natural frequency varies by {100 * jitter:.2g} % from state to state (1σ), which "
            "the stated noise does not explain; the bands include it."
        )
    shared = in_words(found_only)
    if shared:
        notes.append(
            f"levels differ from one another by {shared} (1σ, estimated), which no stated error "
            "explains; the bands include this level-to-level variance."
        )
    if components.unbounded:
        names = " and ".join(LEVEL_ERRORS[kind] for kind in components.unbounded)
        notes.append(
            f"by how much levels differ in {names} cannot be told from these data: it would "
            "have to be larger than levels of one test can differ. The bands do not include it; "
            "state it in the model's [measurement] if you know it."
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


def notes_on_autocorrelation(correlation: Float[np.ndarray, " part"]) -> tuple[str, ...]:
    """That the residuals of neighbouring states are correlated."""
    if not np.any(correlation > 0):
        return ()
    found = " and ".join(f"{value:.2g}" for value in correlation if value > 0)
    worth = float(np.max((1 + correlation) / (1 - correlation)))
    return (
        f"residuals of neighbouring states along a resonance are correlated ({found}), which "
        "random noise is not: the curves do not follow the data there, or the motion was not "
        f"steady. About {worth:.0f} states carry the information of one, and the bands are widened "
        "accordingly.",
    )


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
        notes.append(
            f"the levels' largest amplitudes lie within {100 * (peaks.max() / peaks.min() - 1):.2g}"
            " % of each other: how the mode changes with amplitude rests on the smaller states of "
            "the same levels alone."
        )
    return tuple(notes)
