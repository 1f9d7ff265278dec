"""Possible interpretations of recorded phasors, each fitted like the table itself."""

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
from snrmjax.numerics.rules import InputError

_DEGREES = 180 / np.pi

Phasors = Complex[np.ndarray, " state"]


class Meaning(NamedTuple):
    """An interpretation of phasors, with the name used in reports."""

    name: str
    change: Callable[[Phasors, Float[np.ndarray, " state"]], Phasors]  # of V and Ω
    kind: Kind | None  # None as recorded
    correction: ImportCorrection | None = None
    log_jacobian: float = 0.0  # from the recorded log phasor to the interpreted one
    lead: float = 0.0  # rad, phase lead of the misread quantity over velocity


_ACCELERATION: Kind = "acceleration_as_velocity"
_DISPLACEMENT: Kind = "displacement_as_velocity"
_PHASE: Kind = "conjugated_response"
_UNIT: Kind = "degrees_for_radians"
_BASE: Kind = "motion_of_base"


def _in_radians(lead: float) -> Meaning:
    """Phases in radians read as degrees, of a motion that leads the velocity by `lead`."""

    def converted(v: Phasors, _: Float[np.ndarray, " state"]) -> Phasors:
        stated = np.angle(v * np.exp(1j * lead))
        return np.abs(v) * np.exp(1j * (_DEGREES * stated - lead))

    correction = ImportCorrection(phase_unit="rad")
    log_scale = float(np.log(_DEGREES))
    return Meaning("radians_as_degrees", converted, _UNIT, correction, log_scale, lead)


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
    # The table has phases of velocities, the laboratory those of the recorded quantity.
    *(_in_radians(lead) for lead in (0.0, 0.5 * np.pi, -0.5 * np.pi)),
)
OF_SIZES = (
    Meaning("sizes_of_acceleration", lambda v, w: v / w, _ACCELERATION),
    Meaning("sizes_of_displacement", lambda v, w: v * w, _DISPLACEMENT),
)
"""Amplitudes of another quantity: κ is 1/Ω or Ω of the median state."""
IN_DEGREES = Meaning(
    "degrees_as_radians",
    lambda v, _: v,
    _UNIT,
    ImportCorrection(phase_unit="deg"),
    -float(np.log(_DEGREES)),
)


class Interpretation(NamedTuple):
    """A table under one interpretation."""

    meaning: Meaning
    as_modelled: FittedHypothesis | None  # with the model's modal mass, if there is a model
    scale: Scale | None  # with a free modal mass, if fitted

    @property
    def rescaled(self) -> bool:
        """Whether a modal mass other than the model's is clearly more likely."""
        if self.as_modelled is None or self.scale is None:
            return self.as_modelled is None
        return self.scale.fit.gain(self.as_modelled) > CLEARLY

    @property
    def evidence(self) -> float:
        """ln of the density of the recorded data under this interpretation."""
        return self.fit.evidence

    @property
    def fit(self) -> FittedHypothesis:
        """The more likely fit."""
        fit = self.scale.fit if self.rescaled and self.scale else self.as_modelled
        if fit is None:
            raise InputError("an interpretation that was not fitted has no fit.")
        return fit

    def of_any_mass(self, *, far: bool = False) -> "Interpretation":
        """With the most likely modal mass in addition, also `far` from the model's."""
        if self.scale is not None or self.as_modelled is None:
            return self
        jacobian = self.evidence - self.fit.posterior.log_evidence
        return self._replace(scale=any_mass(self.as_modelled.states, jacobian, far=far))


def best_interpretation(
    checked: CheckedStates, known_mass: bool
) -> tuple[Interpretation, Interpretation]:
    """The table as recorded and the interpretation that beats it, or itself twice.

    Arguments: `known_mass`: a model states the modal mass; it is tried first, another scale if that
    does not fit.
    """
    recorded = _interpreted(AS_RECORDED, checked.test, known_mass)
    near = checked.noise if np.isfinite(checked.noise) else 0.0
    enough = max(SCATTER, 3 * near)
    recorded = _rescaled(recorded, enough)
    sized = _of_sizes(checked, recorded) if known_mass else None
    if sized is not None:
        return recorded, sized
    # With a controlled response, steep curves can also fit the conjugates.
    well = recorded.fit.damped and recorded.fit.misfit < enough
    others = (*((CONJUGATED,) if well else OTHERS), *_of_base(checked))
    meant = [
        (other, checked.read(other.change(checked.recorded, checked.test.frequency)))
        for other in others
    ]
    # A motion that mostly feeds energy back to the force is excluded.
    tried = [
        _interpreted(one, states, known_mass)
        for one, states in meant
        if _possible(checked, one, states)
    ]
    if not well and not any(one.fit.fits for one in (recorded, *tried)):
        tried = [one.of_any_mass() for one in tried]
    if not any(one.fit.fits for one in (recorded, *tried)):
        tried += _in_degrees(checked, known_mass)
    damped = [one for one in tried if one.fit.damped]
    best = max(damped, key=lambda one: one.evidence, default=recorded)
    # The motion of a base is of known magnitude: the discrepancy of one mode cannot mimic it.
    if not best.fit.beats(recorded.fit, discrepancy=best.meaning.kind != _BASE):
        return recorded, recorded
    return recorded, _rescaled(best, SCATTER)


def _of_base(checked: CheckedStates) -> tuple[Meaning, ...]:
    """Base motion left in or subtracted twice, if the model's declaration were wrong."""
    if checked.base is None:
        return ()
    base_velocity, is_in = checked.base
    name = "base_left_in" if is_in else "base_taken_away_twice"
    sign = -1.0 if is_in else 1.0
    return (Meaning(name, lambda v, _: v + sign * base_velocity, _BASE),)


def _rescaled(one: Interpretation, enough: float) -> Interpretation:
    """With the most likely modal mass in addition, if the states contradict the model's."""
    first = one.fit
    content = abs(first.posterior.modal_mass[0] - 1) < MODAL_MASS
    return one if first.damped and first.misfit < enough and content else one.of_any_mass(far=True)


def _possible(checked: CheckedStates, meaning: Meaning, states: TestStates) -> bool:
    """Whether the force supplies energy in most states, and phases are within ±180°."""
    stated = np.angle(checked.recorded * np.exp(1j * meaning.lead))
    largest = np.max(np.abs(stated)) * np.exp(meaning.log_jacobian)
    unwrapped = meaning.log_jacobian == 0 or largest <= np.pi
    return bool(unwrapped and np.median(states.velocity.real) > 0)


def _interpreted(
    meaning: Meaning, states: TestStates, known_mass: bool, start: Interpretation | None = None
) -> Interpretation:
    jacobian = len(states.level) * meaning.log_jacobian
    if not known_mass:
        return Interpretation(meaning, None, any_mass(states, jacobian))
    begin = None if start is None else start.as_modelled
    return Interpretation(meaning, fit_hypothesis(states, jacobian, start=begin), None)


def _of_sizes(checked: CheckedStates, recorded: Interpretation) -> Interpretation | None:
    """Amplitudes of another quantity with phases of velocities, if κ is off by a factor Ω."""
    if recorded.scale is None or not recorded.rescaled:
        return None
    log_omega = float(np.log(np.median(checked.test.frequency)))
    for meaning, off in zip(OF_SIZES, (-log_omega, log_omega), strict=True):
        if abs(off) > 1.0 and abs(np.log(recorded.scale.mass) - off) < OTHER_SCALE:
            sized = _interpreted(
                meaning,
                checked.read(meaning.change(checked.recorded, checked.test.frequency)),
                True,
            )
            return sized if sized.fit.fits else None
    return None


def misread(recorded: FittedHypothesis, best: Interpretation, where: str) -> Finding:
    """Finding of a misread column of phasors."""
    meaning = best.meaning
    if meaning.kind is None:
        raise InputError("the table as recorded is not a misreading.")
    evidence = Fact(
        "misread",
        reading=meaning.name,
        misfit=best.fit.misfit,
        misfit_as_recorded=recorded.misfit if recorded.damped else None,
    )
    corrections = () if meaning.correction is None else (meaning.correction,)
    advice = Fact("advice_reading", reading=meaning.name)
    return Finding(meaning.kind, where, evidence, advice, corrections=corrections)


def _in_degrees(checked: CheckedStates, known_mass: bool) -> list[Interpretation]:
    """Phases in degrees read as radians: wrapped dozens of times, 6.3° apart.

    The amplitudes of a mode give the phase of each state to some degrees, the wrapped phase gives
    it exactly; the sign of the phase (below or above resonance) by trial.
    """
    recorded, speed = np.angle(checked.recorded) / _DEGREES, np.abs(checked.recorded)
    spacing = 2 * np.pi / _DEGREES

    def nearest(guess: np.ndarray, start: Interpretation | None) -> Interpretation:
        phase = recorded + spacing * np.round((guess - recorded) / spacing)
        states = checked.read(speed * np.exp(1j * phase))
        return _interpreted(IN_DEGREES, states, known_mass, start)

    tried = [nearest(guess, None) for guess in _phases_of_amplitudes(checked)]
    tried = sorted(tried, key=lambda one: one.evidence)[-2:]
    for k, best in enumerate(tried):
        for _ in range(8):
            # The phase of the fitted curves at these amplitudes and frequencies.
            fit = best.fit
            omega = fit.states.frequency
            stiffness = fit.stiffness - omega**2 + 1j * omega * fit.damping
            again = nearest(0.5 * np.pi - np.angle(stiffness), best)
            if again.evidence <= best.evidence:
                break
            tried[k] = best = again
    return tried


def _phases_of_amplitudes(checked: CheckedStates) -> list[Float[np.ndarray, " state"]]:
    """Phases from cos φ proportional to |V|/F, with possible choices of their sign.

    Positive below the frequency of each level's largest mobility; where a resonance moves by many
    bandwidths, a whole sweep lies on one side, or states alternate: then positive below the
    neighbours in amplitude.
    """
    states, mobility = checked.test, checked.mobility
    phase, top, alternating = (
        np.zeros(len(mobility)),
        np.zeros(len(mobility)),
        np.zeros(len(mobility)),
    )
    for k in range(states.n_levels):
        of_level = np.flatnonzero(states.level == k)
        if len(of_level) < 3:
            return []
        peak = of_level[np.argmax(mobility[of_level])]
        phase[of_level] = np.arccos(np.minimum(mobility[of_level] / (1.02 * mobility[peak]), 1.0))
        top[of_level] = np.sign(states.frequency[peak] - states.frequency[of_level])
        of_level = of_level[np.argsort(mobility[of_level])]
        omega = states.frequency[of_level]
        neighbours = np.interp(
            np.arange(len(of_level)) + 0.5,
            np.arange(len(of_level) - 1) + 0.5,
            0.5 * (omega[1:] + omega[:-1]),
        )
        alternating[of_level] = np.sign(neighbours - omega)
    return [top * phase, phase, -phase, alternating * phase]
