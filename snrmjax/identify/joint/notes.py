"""What a joint fit says in words of its data: noise, levels, and where the states lie."""

import numpy as np
from jaxtyping import Float

from snrmjax.identify.joint.force_balance import LEVEL_ERRORS, Motion
from snrmjax.identify.joint.variance_components import Scatter

_BESIDE = 5.0  # degrees from resonance, with every state farther on the same side
_ALIKE = 1.1  # ratio of levels' amplitudes below which they are one


def notes_on_noise(
    scatter: Scatter,
    jitter: float,
    given: Float[np.ndarray, " error"],
    n_levels: int,
    *,
    stated: bool,
    alike: bool,
) -> tuple[str, ...]:
    """Where noise and levels are not as stated.

    Arguments: `jitter` 1σ of relative stiffness from state to state, in units of the noise where
    none is stated; `given` the stated 1σ of levels' errors; `alike` whether neighbouring states
    have misfits in common.
    """
    notes = []
    if stated and scatter.contradicts_upward:
        notes.append(
            f"residuals are {scatter.noise:.2g} ± {scatter.noise_std:.1g} times the stated noise: "
            "the noise is understated or the model is wrong; the bands are widened accordingly."
        )
    if stated and scatter.contradicts_downward:
        more = "" if alike else ", and the bands are wider than need be"
        notes.append(
            f"residuals are only {scatter.noise:.2g} ± {scatter.noise_std:.1g} times the stated "
            f"noise: it is overstated{more}."
        )
    found_only = np.where(given > 0, 0.0, scatter.level)
    if jitter > 0:
        jitter = 0.5 * jitter * (1.0 if stated else scatter.noise)
        notes.append(
            f"natural frequency wanders by {100 * jitter:.2g} % from state to state (1σ), which "
            "no stated noise explains."
        )
    shared = in_words(found_only)
    if shared:
        notes.append(
            f"levels differ from one another by {shared} (1σ), which no stated error "
            "explains; the bands include it."
        )
    if scatter.unbounded:
        names = " and ".join(LEVEL_ERRORS[kind] for kind in scatter.unbounded)
        notes.append(
            f"how far levels differ in {names} cannot be told from these data: it would be by more "
            "than levels of one test can; the bands do not include it: state it if you know."
        )
    if n_levels == 1:
        notes.append(
            "1 level only: nothing says how far levels differ from one another, and the bands do "
            "not include it."
        )
    if n_levels == 2:
        notes.append(
            "2 levels only: a single difference says how far levels differ from one another, if "
            "they share amplitudes, and the bands may be too narrow."
        )
    return tuple(notes)


def in_words(level_std: Float[np.ndarray, " error"]) -> str:
    """By how much levels differ in what; nothing where they do not."""
    units = {
        "gain": (100, " % in gain"),
        "phase": (180 / np.pi, "° in phase"),
        "stiffness": (50, " % in natural frequency"),
        "damping": (100, " % in damping"),
    }
    pairs = [(units[k], one) for k, one in zip(LEVEL_ERRORS, level_std, strict=True) if one > 0]
    return ", ".join(f"{factor * one:.2g}{name}" for (factor, name), one in pairs)


def notes_on_neighbours(correlation: Float[np.ndarray, " part"]) -> tuple[str, ...]:
    """That states are left with misfits that their neighbours share."""
    if not np.any(correlation > 0):
        return ()
    found = " and ".join(f"{value:.2g}" for value in correlation if value > 0)
    worth = float(np.max((1 + correlation) / (1 - correlation)))
    return (
        f"neighbours along a resonance are left with like misfits (correlation {found}): noise has "
        "none, so that the curves are not followed there, or the motion was not steady. About "
        f"{worth:.0f} states tell as much as one, and the bands are widened accordingly.",
    )


def notes_on_reach(motion: Motion, level: np.ndarray) -> tuple[str, ...]:
    """What states on one side of resonance, or of one amplitude, leave open."""
    notes = []
    phase = np.degrees(np.angle(np.asarray(motion.velocity)))
    if phase.min() > _BESIDE or phase.max() < -_BESIDE:
        near, far = sorted((abs(phase.min()), abs(phase.max())))
        side = "below" if phase.min() > 0 else "above"
        notes.append(
            f"all states lie on one side of resonance ({near:.0f}° to {far:.0f}° {side} it): an "
            "error of phase that they share passes for a change of natural frequency and damping, "
            "and no band contains it unless it is stated."
        )
    size = np.asarray(motion.displacement)
    peaks = np.array([size[level == k].max() for k in np.unique(level)])
    if len(peaks) > 1 and peaks.max() < _ALIKE * peaks.min():
        notes.append(
            f"the levels' largest amplitudes lie within {100 * (peaks.max() / peaks.min() - 1):.2g}"
            " % of each other: no level tells more than another of how the mode changes with "
            "amplitude, and only smaller states of the same levels do."
        )
    return tuple(notes)
