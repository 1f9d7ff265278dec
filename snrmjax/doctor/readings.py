"""What recorded phasors may stand for, each reading judged as the table itself is."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.doctor.findings import Finding, ImportCorrection, Kind
from snrmjax.doctor.fitted_hypothesis import (
    CheckedStates,
    FittedHypothesis,
    Scale,
    any_mass,
    fit_hypothesis,
)
from snrmjax.doctor.priors import CLEARLY, MODAL_MASS, OTHER_SCALE, SCATTER
from snrmjax.identify.test_model.states import TestStates
from snrmjax.numerics.facts import Fact

_DEGREES = 180 / np.pi

Phasors = Complex[np.ndarray, " state"]


class Meaning(NamedTuple):
    """A reading of phasors, by a name that its sentences have."""

    name: str
    change: Callable[[Phasors, Float[np.ndarray, " state"]], Phasors]  # of V and Ω
    kind: Kind | None  # None as recorded
    correction: ImportCorrection | None = None
    log_jacobian: float = 0.0  # of a recorded phasor's logarithm to the one that is read
    lead: float = 0.0  # rad, by which the phases that were misread lead the velocity's


_ACCELERATION: Kind = "acceleration_as_velocity"
_DISPLACEMENT: Kind = "displacement_as_velocity"
_PHASE: Kind = "conjugated_response"
_UNIT: Kind = "degrees_for_radians"
_BASE: Kind = "motion_of_base"


def _in_radians(lead: float) -> Meaning:
    """Phases in radians that were read as degrees, of a motion that leads the velocity so."""

    def turned(v: Phasors, _: Float[np.ndarray, " state"]) -> Phasors:
        stated = np.angle(v * np.exp(1j * lead))
        return np.abs(v) * np.exp(1j * (_DEGREES * stated - lead))

    correction = ImportCorrection(phase_unit="rad")
    size = float(np.log(_DEGREES))
    return Meaning("radians_as_degrees", turned, _UNIT, correction, size, lead)


AS_RECORDED = Meaning("as_recorded", lambda v, _: v, None)
OPPOSITE = Meaning("opposite", lambda v, _: -v, "shape_not_mass_normalised")
CONJUGATED = Meaning("conjugated", lambda v, _: v.conj(), _PHASE, ImportCorrection(conjugate=True))
OTHERS = (
    OPPOSITE,
    CONJUGATED,
    Meaning("conjugated_opposite", lambda v, _: -v.conj(), _PHASE),
    Meaning(
        "acceleration",
        lambda v, w: v / (1j * w),
        _ACCELERATION,
        ImportCorrection(quantity="acceleration"),
    ),
    Meaning(
        "displacement",
        lambda v, w: v * 1j * w,
        _DISPLACEMENT,
        ImportCorrection(quantity="displacement"),
    ),
    # The table states phases of velocities, but a laboratory those of what was recorded.
    *(_in_radians(lead) for lead in (0.0, 0.5 * np.pi, -0.5 * np.pi)),
)
OF_SIZES = (
    Meaning("sizes_of_acceleration", lambda v, w: v / w, _ACCELERATION),
    Meaning("sizes_of_displacement", lambda v, w: v * w, _DISPLACEMENT),
)
"""Where κ is 1/Ω and Ω of the median state."""
IN_DEGREES = Meaning(
    "degrees_as_radians",
    lambda v, _: v,
    *(_UNIT, ImportCorrection(phase_unit="deg"), -float(np.log(_DEGREES))),
)


class Reading(NamedTuple):
    """A table as it may be meant."""

    meaning: Meaning
    as_modelled: FittedHypothesis | None  # with the model's modal mass, where there is a model
    scale: Scale | None  # with any, where that was looked at

    @property
    def rescaled(self) -> bool:
        """Whether another modal mass than the model's is clearly likelier."""
        if self.as_modelled is None or self.scale is None:
            return self.as_modelled is None
        return self.scale.judged.gain(self.as_modelled) > CLEARLY

    @property
    def evidence(self) -> float:
        """ln of the density of what was recorded, read so."""
        return self.judged.evidence

    @property
    def judged(self) -> FittedHypothesis:
        """The likelier fit."""
        found = self.scale.judged if self.rescaled and self.scale else self.as_modelled
        if found is None:
            raise ValueError("a reading that was not judged has no fit.")
        return found

    def of_any_mass(self, *, far: bool = False) -> "Reading":
        """With its likeliest modal mass, too, also `far` from the model's."""
        if self.scale is not None or self.as_modelled is None:
            return self
        jacobian = self.evidence - self.judged.posterior.log_evidence
        return self._replace(scale=any_mass(self.as_modelled.states, jacobian, far=far))


def best_reading(seen: CheckedStates, known_mass: bool) -> tuple[Reading, Reading]:
    """The table as recorded and the reading that beats it, or itself twice.

    Arguments: `known_mass` says whether a model states the modal mass: it is tried first, another
    scale where that does not fit.
    """
    recorded = _judged(AS_RECORDED, seen.test, known_mass)
    near = seen.noise if np.isfinite(seen.noise) else 0.0
    enough = max(SCATTER, 3 * near)
    recorded = _rescaled(recorded, enough)
    sized = _of_sizes(seen, recorded) if known_mass else None
    if sized is not None:
        return recorded, sized
    # Conjugates of a held response pass for curves as steep as their noise asks for.
    well = recorded.judged.damped and recorded.judged.misfit < enough
    others = (*((CONJUGATED,) if well else OTHERS), *_of_base(seen))
    meant = [
        (other, seen.read(other.change(seen.recorded, seen.test.frequency))) for other in others
    ]
    # A motion that mostly gains energy from its force has no odds.
    tried = [
        _judged(one, states, known_mass) for one, states in meant if _possible(seen, one, states)
    ]
    if not well and not any(one.judged.fits for one in (recorded, *tried)):
        tried = [one.of_any_mass() for one in tried]
    if not any(one.judged.fits for one in (recorded, *tried)):
        tried += _in_degrees(seen, known_mass)
    damped = [one for one in tried if one.judged.damped]
    best = max(damped, key=lambda one: one.evidence, default=recorded)
    # The motion of a base is of known size: nothing else that lies beside the mode has it.
    if not best.judged.beats(recorded.judged, beside=best.meaning.kind != _BASE):
        return recorded, recorded
    return recorded, _rescaled(best, SCATTER)


def _of_base(seen: CheckedStates) -> tuple[Meaning, ...]:
    """The motion of the base where the model says the other thing of it than the sensors record."""
    if seen.own is None:
        return ()
    own, is_in = seen.own
    name = "base_left_in" if is_in else "base_taken_away_twice"
    sign = -1.0 if is_in else 1.0
    return (Meaning(name, lambda v, _: v + sign * own, _BASE),)


def _rescaled(one: Reading, enough: float) -> Reading:
    """With its likeliest modal mass, too, where the model's is not what the states ask for."""
    first = one.judged
    content = abs(first.posterior.modal_mass[0] - 1) < MODAL_MASS
    return one if first.damped and first.misfit < enough and content else one.of_any_mass(far=True)


def _possible(seen: CheckedStates, meaning: Meaning, states: TestStates) -> bool:
    """Whether the force works on the motion in most states, and phases are less than a turn."""
    stated = np.angle(seen.recorded * np.exp(1j * meaning.lead))
    turned = np.max(np.abs(stated)) * np.exp(meaning.log_jacobian)
    whole = meaning.log_jacobian == 0 or turned <= np.pi
    return bool(whole and np.median(states.velocity.real) > 0)


def _judged(
    meaning: Meaning, states: TestStates, known_mass: bool, start: Reading | None = None
) -> Reading:
    jacobian = len(states.level) * meaning.log_jacobian
    if not known_mass:
        return Reading(meaning, None, any_mass(states, jacobian))
    begin = None if start is None else start.as_modelled
    return Reading(meaning, fit_hypothesis(states, jacobian, start=begin), None)


def _of_sizes(seen: CheckedStates, recorded: Reading) -> Reading | None:
    """Amplitudes of another quantity with phases of velocities, where these make κ off by Ω."""
    if recorded.scale is None or not recorded.rescaled:
        return None
    log_omega = float(np.log(np.median(seen.test.frequency)))
    for meaning, off in zip(OF_SIZES, (-log_omega, log_omega), strict=True):
        if abs(off) > 1.0 and abs(np.log(recorded.scale.mass) - off) < OTHER_SCALE:
            found = _judged(
                meaning, seen.read(meaning.change(seen.recorded, seen.test.frequency)), True
            )
            return found if found.judged.fits else None
    return None


def misread(recorded: FittedHypothesis, best: Reading, where: str) -> Finding:
    """That phasors are something else than what they are taken for."""
    meaning = best.meaning
    if meaning.kind is None:
        raise ValueError("the table as recorded is no misreading of itself.")
    evidence = Fact(
        "misread",
        reading=meaning.name,
        misfit=best.judged.misfit,
        misfit_as_recorded=recorded.misfit if recorded.damped else None,
    )
    corrections = () if meaning.correction is None else (meaning.correction,)
    advice = Fact("advice_reading", reading=meaning.name)
    return Finding(meaning.kind, where, evidence, advice, corrections=corrections)


def _in_degrees(seen: CheckedStates, known_mass: bool) -> list[Reading]:
    """Phases in degrees that were read as radians: wrapped dozens of times, 6.3° apart.

    A mode's amplitudes say to some degrees how far from resonance each state is, the wrapped phase
    says it exactly; which states lie below their resonance is tried.
    """
    recorded, size = np.angle(seen.recorded) / _DEGREES, np.abs(seen.recorded)
    spacing = 2 * np.pi / _DEGREES

    def nearest(guess: np.ndarray, start: Reading | None) -> Reading:
        phase = recorded + spacing * np.round((guess - recorded) / spacing)
        states = seen.read(size * np.exp(1j * phase))
        return _judged(IN_DEGREES, states, known_mass, start)

    tried = [nearest(guess, None) for guess in _phases_of_amplitudes(seen)]
    tried = sorted(tried, key=lambda one: one.evidence)[-2:]
    for k, found in enumerate(tried):
        for _ in range(8):
            # The phase that the curves have at these amplitudes and frequencies.
            judged = found.judged
            omega = judged.states.frequency
            stiffness = judged.stiffness - omega**2 + 1j * omega * judged.damping
            again = nearest(0.5 * np.pi - np.angle(stiffness), found)
            if again.evidence <= found.evidence:
                break
            tried[k] = found = again
    return tried


def _phases_of_amplitudes(seen: CheckedStates) -> list[Float[np.ndarray, " state"]]:
    """Phases by cos φ in proportion to |V|/F, with what may tell their sign.

    Below each level's largest they are positive; where a resonance moves by many bandwidths all of
    a sweep lies on one side, or on both by turns: then below the others of its amplitude.
    """
    states, mobility = seen.test, seen.mobility
    size, top, turns = np.zeros(len(mobility)), np.zeros(len(mobility)), np.zeros(len(mobility))
    for k in range(states.n_levels):
        of_level = np.flatnonzero(states.level == k)
        if len(of_level) < 3:
            return []
        peak = of_level[np.argmax(mobility[of_level])]
        size[of_level] = np.arccos(np.minimum(mobility[of_level] / (1.02 * mobility[peak]), 1.0))
        top[of_level] = np.sign(states.frequency[peak] - states.frequency[of_level])
        of_level = of_level[np.argsort(mobility[of_level])]
        omega = states.frequency[of_level]
        beside = np.interp(
            np.arange(len(of_level)) + 0.5,
            np.arange(len(of_level) - 1) + 0.5,
            0.5 * (omega[1:] + omega[:-1]),
        )
        turns[of_level] = np.sign(beside - omega)
    return [top * size, size, -size, turns * size]
