"""What the recorded phasors may stand for: the reading with which a single mode fits best."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.doctor.balance_fit import (
    BalanceFit,
    Corrected,
    ModeStates,
    as_recorded,
    best_balance,
)

_DEGREES = 180 / np.pi
_CLEARLY = 15.0  # of the criterion, by which another reading must be better than the recorded one
_FAR_FREQUENCY = 0.3  # 1σ, relative, of ω̃² at small amplitude about the model's
_RIGHT = 0.12  # relative misfit of phasors that need no other reading
_FAR_MASS = 8.0  # ratio of modal masses, from which on other readings are tried
_SIGNS = 4.0  # 1σ, beyond which the sign of the inertia or of the damping counts
_LATTICE_TURNS = 4
_BY_FREQUENCY = 0.15  # logarithm of κ over Ω or 1/Ω: amplitudes of another quantity
_WILD, _SMOOTH = 0.5, 3.0  # mean resultant of steps of phase; how much smoother amplitudes are


class Reading(NamedTuple):
    """A way to read the phasors, what the data are then, and how well they agree with a mode."""

    name: str
    corrected: Corrected
    fit: BalanceFit
    criterion: float


def best_reading(states: ModeStates, natural_frequency: float | None) -> tuple[Reading, Reading]:
    """The phasors as recorded, and the reading with which they agree best with a single mode.

    Readings: `as_recorded`, `conjugated`, `opposite` (180°), `conjugated_opposite`,
    `acceleration`, `displacement`, `radians_read_as_degrees`, `degrees_read_as_radians`.
    The signs of inertia and damping tell the first four from one another. `acceleration_size` and
    `displacement_size`, amplitudes of these with the phases of a velocity, are tried where the
    modal mass is off by Ω: over a wide band a constant factor in its place leaves a misfit.
    """
    recorded = _read(states, "as_recorded", lambda v, _: v, natural_frequency)
    if agrees(recorded.fit, natural_frequency):
        return recorded, recorded
    found = [
        recorded,
        _read(states, "acceleration", lambda v, w: v / (1j * w), natural_frequency),
        _read(states, "displacement", lambda v, w: v * 1j * w, natural_frequency),
        _read(states, "radians_read_as_degrees", _with_phase(_DEGREES), natural_frequency),
    ]
    unwrapped = _read_lattice(states, natural_frequency)
    found += [] if unwrapped is None else [unwrapped]
    found += [
        _read(states, name, change, natural_frequency) for name, change in _turned(found[0].fit)
    ]
    best = min(found, key=lambda one: one.criterion)
    if recorded.criterion - best.criterion < _CLEARLY:
        best = recorded
    sizes = [
        _read(states, name, change, natural_frequency)
        for name, change in _sized(states, recorded.fit, natural_frequency)
    ]
    return recorded, min([best, *sizes], key=lambda one: one.criterion)


def agrees(fit: BalanceFit, natural_frequency: float | None) -> bool:
    """Whether the phasors as recorded are beyond doubt those of a velocity."""
    used = fit.used
    if fit.misfit > _RIGHT or fit.mass < _SIGNS * fit.mass_std or np.any(fit.damping[used] <= 0):
        return False
    return _implausible(fit, natural_frequency) < 1 and 1 / _FAR_MASS < fit.mass < _FAR_MASS


Change = Callable[[np.ndarray, np.ndarray], np.ndarray]


def _with_phase(factor: float) -> Change:
    return lambda v, _: np.abs(v) * np.exp(1j * factor * np.angle(v))


def _turned(fit: BalanceFit) -> list[tuple[str, Change]]:
    """The reading that gives inertia and damping the right signs, where these are clear."""
    if abs(fit.mass) < _SIGNS * fit.mass_std:
        return []
    damped = np.median(fit.damping[fit.used] * fit.mass) > 0
    if fit.mass > 0:
        return [] if damped else [("conjugated_opposite", lambda v, _: -v.conj())]
    if damped:
        return [("conjugated", lambda v, _: v.conj())]
    return [("opposite", lambda v, _: -v)]


def off_by_frequency(mass: float, frequency: float) -> str:
    """The quantity, acceleration or displacement, whose size makes the modal mass κ wrong by Ω.

    None of them ("") within a factor of 4.5 of 1 rad/s, where Ω is no telling factor.
    """
    log_omega = float(np.log(frequency))
    if not mass > 0 or abs(log_omega) < 10 * _BY_FREQUENCY:
        return ""
    if abs(np.log(mass) + log_omega) < _BY_FREQUENCY:
        return "acceleration"
    return "displacement" if abs(np.log(mass) - log_omega) < _BY_FREQUENCY else ""


def _sized(
    states: ModeStates, fit: BalanceFit, natural_frequency: float | None
) -> list[tuple[str, Change]]:
    """The reading of amplitudes alone that makes the modal mass that of the model."""
    if natural_frequency is None:
        return []
    quantity = off_by_frequency(fit.mass, float(np.median(states.frequency)))
    if not quantity:
        return []
    power = -1.0 if quantity == "acceleration" else 1.0
    return [(f"{quantity}_size", lambda v, w: v * w**power)]


def _read(
    states: ModeStates, name: str, change: Change, natural_frequency: float | None
) -> Reading:
    changed = change(states.velocity, states.frequency) - states.beside
    corrected = as_recorded(states)._replace(velocity=changed)
    fit = best_balance(states, corrected)
    return Reading(name, corrected, fit, fit.criterion + _implausible(fit, natural_frequency))


def _implausible(fit: BalanceFit, natural_frequency: float | None) -> float:
    """What speaks against a fit beside its residuals: signs and the model's frequency."""
    used = fit.used
    square = 0.0
    if fit.mass_std > 0:
        square += min(fit.mass / fit.mass_std, 0.0) ** 2
    damping = fit.damping[used] * np.sign(fit.mass)
    square += 4 * np.sum(damping < 0)
    if natural_frequency is not None and fit.mass != 0:
        ratio = np.median(fit.stiffness[used]) / natural_frequency**2 - 1
        square += (ratio / _FAR_FREQUENCY) ** 2
    return float(min(square, 1e6))


def _read_lattice(states: ModeStates, natural_frequency: float | None) -> Reading | None:
    """Phases in degrees that were read as radians: wrapped dozens of times, 6.3° apart.

    A mode's amplitudes say where each phase lies to some degrees; the wrapped one says it exactly.
    """
    recorded = np.angle(states.velocity)
    guess = _phases_of_amplitudes(states)
    if guess is None:
        return None
    spacing = 2 * np.pi / _DEGREES
    corrected = as_recorded(states)
    fit = None
    for _ in range(_LATTICE_TURNS):
        nearest = np.round((guess - recorded / _DEGREES) / spacing)
        phase = recorded / _DEGREES + spacing * nearest
        velocity = np.abs(states.velocity) * np.exp(1j * phase) - states.beside
        corrected = as_recorded(states)._replace(velocity=velocity, parameters=0)
        fit = best_balance(states, corrected)
        # The phase that the curves have at this amplitude and frequency.
        guess = -np.angle(fit.predicted / (1j * states.frequency)) if fit.mass > 0 else guess
    if fit is None:
        return None
    criterion = fit.criterion + _implausible(fit, natural_frequency)
    # A phase on the lattice was chosen for each state: a density of one in the spacing.
    criterion += 2 * len(states.level) * np.log(spacing / (2 * np.pi)) * -1.0
    return Reading("degrees_read_as_radians", corrected, fit, float(criterion))


def _phases_of_amplitudes(states: ModeStates) -> Float[np.ndarray, " state"] | None:
    """Phases by cos φ in proportion to |V|/F, positive below each level's largest."""
    mobility = np.abs(states.velocity) / states.force
    phase = np.zeros(len(mobility))
    for k in range(states.n_levels):
        mine = np.flatnonzero(states.level == k)
        if len(mine) < 3:
            return None
        top = mine[np.argmax(mobility[mine])]
        cosine = np.minimum(mobility[mine] / (1.02 * mobility[top]), 1.0)
        side = np.sign(states.frequency[top] - states.frequency[mine])
        phase[mine] = side * np.arccos(cosine)
    return phase


def wild_phases(states: ModeStates) -> bool:
    """Whether phases jump at random from state to state where the amplitudes are smooth.

    By neighbours in frequency on a level.
    """
    turns, steps = [], []
    for k in range(states.n_levels):
        mine = np.flatnonzero(states.level == k)
        mine = mine[np.argsort(states.frequency[mine])]
        if len(mine) < 4:
            continue
        v = states.velocity[mine]
        turns.append(np.exp(1j * np.diff(np.angle(v))))
        steps.append(np.abs(np.diff(np.log(np.abs(v / states.force[mine])))))
    if not turns:
        return False
    turn, step = np.concatenate(turns), np.concatenate(steps)
    scattered = abs(turn.mean()) < max(_WILD, _SMOOTH / np.sqrt(len(turn)) * 0.5)
    return bool(len(turn) >= 8 and scattered and np.median(step) < 0.4)
