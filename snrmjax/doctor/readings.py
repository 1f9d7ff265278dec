"""What recorded phasors may stand for, each reading judged as the table itself is."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.doctor.checked_states import CheckedStates
from snrmjax.doctor.findings import Finding, Kind, Repair, percent
from snrmjax.doctor.judgement import Judged, Scale, best_scale, guessed_mass, judge, with_mass
from snrmjax.doctor.priors import OTHER_SCALE, SCATTER, WILD
from snrmjax.identify.test_model.states import TestStates

_DEGREES = 180 / np.pi
_LATTICE_TURNS = 4

Phasors = Complex[np.ndarray, " state"]


class Meaning(NamedTuple):
    """A reading of phasors, and what is said of it."""

    change: Callable[[Phasors, Float[np.ndarray, " state"]], Phasors]  # of V and Ω
    kind: Kind | None  # None as recorded
    said: str = ""
    mend: str = ""
    repair: Repair | None = None
    log_jacobian: float = 0.0  # of a recorded phasor's logarithm to the one that is read


_SIGN = "import again with the other phase sign, or negate `velocity_im_m_s`."
AS_RECORDED = Meaning(lambda v, _: v, None)
OPPOSITE = Meaning(
    lambda v, _: -v,
    "shape_not_mass_normalised",
    "of turned sign: the shape, the sensor or the force has the other one",
    "negate this sensor's entry of `shape` in the model, or both velocity columns.",
)
CONJUGATED = Meaning(
    lambda v, _: v.conj(),
    "conjugated_response",
    "complex conjugates",
    _SIGN,
    Repair(conjugate=True),
)
CONJUGATED_OPPOSITE = Meaning(
    lambda v, _: -v.conj(),
    "conjugated_response",
    "complex conjugates of turned sign",
    "negate `velocity_re_m_s`; or import again with the other phase sign, and turn the sensor's.",
)
OTHERS = (
    Meaning(
        lambda v, w: v / (1j * w),
        "acceleration_as_velocity",
        "accelerations (m/s²)",
        "divide by iΩ: import again as accelerations.",
        Repair(quantity="acceleration"),
    ),
    Meaning(
        lambda v, w: v * 1j * w,
        "displacement_as_velocity",
        "displacements (m)",
        "multiply by iΩ: import again as displacements.",
        Repair(quantity="displacement"),
    ),
    Meaning(
        lambda v, _: np.abs(v) * np.exp(1j * _DEGREES * np.angle(v)),
        "degrees_for_radians",
        "phases in radians that were read as degrees",
        "import again with phases in radians.",
        Repair(phase_unit="rad"),
        log_jacobian=float(np.log(_DEGREES)),
    ),
)
OF_SIZES = (
    Meaning(
        lambda v, w: v / w,
        "acceleration_as_velocity",
        "amplitudes of accelerations (m/s²) with the phases of velocities",
        "divide the amplitudes by Ω = 2πf, not the phases, in the laboratory's file.",
    ),
    Meaning(
        lambda v, w: v * w,
        "displacement_as_velocity",
        "amplitudes of displacements (m) with the phases of velocities",
        "multiply the amplitudes by Ω = 2πf, not the phases, in the laboratory's file.",
    ),
)
"""Where κ is 1/Ω and Ω of the median state."""
IN_DEGREES = Meaning(
    lambda v, _: v,
    "degrees_for_radians",
    "phases in degrees that were read as radians",
    "import again with phases in degrees.",
    Repair(phase_unit="deg"),
    log_jacobian=-float(np.log(_DEGREES)),
)


class Reading(NamedTuple):
    """A table as it may be meant."""

    meaning: Meaning
    states: TestStates
    judged: Judged
    mass: float  # κ with which it fits: 1 where the model's does

    @property
    def log_jacobian(self) -> float:
        """Of all states."""
        return len(self.states.level) * self.meaning.log_jacobian

    def best_scale(self) -> Scale:
        """The likeliest modal mass about the one that fits."""
        return best_scale(self.states, self.mass, self.judged, self.log_jacobian)


def best_reading(seen: CheckedStates, known_mass: bool) -> tuple[Reading, Reading]:
    """The table as recorded and the reading that beats it, or itself twice.

    Arguments: `known_mass` says whether a model states the modal mass: it is tried first, another
    scale where that does not fit.
    """
    mass = guessed_mass(seen.test)
    recorded = _read(seen, AS_RECORDED, known_mass, mass)
    sized = _of_sizes(seen, recorded) if known_mass else None
    if sized is not None:
        return recorded, sized
    near = seen.noise if np.isfinite(seen.noise) else 0.0
    if recorded.judged.damped and recorded.judged.misfit < max(SCATTER, 3 * near):
        return recorded, recorded
    turned = (CONJUGATED, OPPOSITE, CONJUGATED_OPPOSITE)
    tried = [recorded, *(_read(seen, one, known_mass, mass) for one in turned)]
    tried += [_read(seen, one, known_mass, None) for one in OTHERS]
    if not any(one.judged.fits for one in tried):
        lattice = _in_degrees(seen, known_mass)
        tried += [] if lattice is None else [lattice]
    best = max((one for one in tried if one.judged.damped), key=_evidence, default=recorded)
    return recorded, best if best.judged.beats(recorded.judged) else recorded


def _of_sizes(seen: CheckedStates, recorded: Reading) -> Reading | None:
    """Amplitudes of another quantity with phases of velocities, where these make κ off by Ω."""
    log_omega = float(np.log(np.median(seen.test.frequency)))
    for meaning, off in zip(OF_SIZES, (-log_omega, log_omega), strict=True):
        if abs(off) > 1.0 and abs(np.log(recorded.mass) - off) < OTHER_SCALE:
            found = _read(seen, meaning, True, 1.0)
            return found if found.judged.fits else None
    return None


def _evidence(one: Reading) -> float:
    return one.judged.evidence


def misread(recorded: Judged, best: Reading, where: str) -> Finding:
    """That phasors are something else than what they are taken for."""
    meaning = best.meaning
    if meaning.kind is None:
        raise ValueError("the table as recorded is no misreading of itself.")
    as_they_are = f"{percent(recorded.misfit)} as recorded"
    if not recorded.damped:
        as_they_are = "as recorded the mode would gain energy"
    return Finding(
        *(meaning.kind, "error", where),
        f"the responses are {meaning.said}: so read one mode misses a state by "
        f"{percent(best.judged.misfit)}, {as_they_are}.",
        meaning.mend,
        repairs=() if meaning.repair is None else (meaning.repair,),
    )


def _read(seen: CheckedStates, meaning: Meaning, known_mass: bool, mass: float | None) -> Reading:
    states = seen.read(meaning.change(seen.recorded, seen.test.frequency))
    return _fitted(meaning, states, known_mass, mass)


def _fitted(
    meaning: Meaning, states: TestStates, known_mass: bool, mass: float | None = None
) -> Reading:
    """With the model's modal mass, or with the guessed one where that has more evidence."""
    jacobian = len(states.level) * meaning.log_jacobian
    first = Reading(meaning, states, judge(states, jacobian), 1.0) if known_mass else None
    if first is not None and meaning is not AS_RECORDED and first.judged.fits:
        return first
    mass = guessed_mass(states) if mass is None else mass
    size = abs(mass) if np.isfinite(mass) else 1.0
    if first is not None and abs(np.log(size)) < OTHER_SCALE:
        return first
    other = Reading(meaning, states, judge(with_mass(states, size), jacobian), size)
    if first is None or (other.judged.damped and other.judged.gain(first.judged) > 0):
        return other
    return first


def _in_degrees(seen: CheckedStates, known_mass: bool) -> Reading | None:
    """Phases in degrees that were read as radians: wrapped dozens of times, 6.3° apart.

    A mode's amplitudes say where each phase lies to some degrees; the wrapped one says it exactly.
    """
    recorded = np.angle(seen.recorded)
    guess = _phases_of_amplitudes(seen)
    if guess is None:
        return None
    spacing = 2 * np.pi / _DEGREES
    found = None
    for _ in range(_LATTICE_TURNS):
        nearest = np.round((guess - recorded / _DEGREES) / spacing)
        phase = recorded / _DEGREES + spacing * nearest
        states = seen.read(np.abs(seen.recorded) * np.exp(1j * phase))
        if found is not None and np.allclose(states.velocity, found.states.velocity):
            break
        found = _fitted(IN_DEGREES, states, known_mass)
        # The phase that the curves have at this amplitude and frequency.
        omega, judged = states.frequency, found.judged
        stiffness = judged.stiffness - omega**2 + 1j * omega * judged.damping
        guess = np.pi / 2 - np.angle(stiffness)
    return found


def _phases_of_amplitudes(seen: CheckedStates) -> Float[np.ndarray, " state"] | None:
    """Phases by cos φ in proportion to |V|/F, positive below each level's largest."""
    states, mobility = seen.test, seen.mobility
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


def wild_phases(seen: CheckedStates) -> Finding | None:
    """Phases that jump at random from state to state where the amplitudes are smooth."""
    states = seen.test
    turns, steps = [np.zeros(0)], [np.zeros(0)]
    for k in range(states.n_levels):
        mine = np.flatnonzero(states.level == k)
        mine = mine[np.argsort(states.frequency[mine])]
        turns.append(np.exp(1j * np.diff(np.angle(states.velocity[mine]))))
        steps.append(np.abs(np.diff(np.log(seen.mobility[mine]))))
    turn, step = np.concatenate(turns), np.concatenate(steps)
    if len(turn) < 8 or abs(turn.mean()) > WILD or np.median(step) > WILD:
        return None
    return Finding(
        *("degrees_for_radians", "error", ""),
        f"phases jump at random from state to state (mean of e^iΔφ {abs(turn.mean()):.2f}) where "
        "amplitudes are smooth, as phases in degrees do that were read as radians.",
        IN_DEGREES.mend,
        repairs=(Repair(phase_unit="deg"),),
    )
