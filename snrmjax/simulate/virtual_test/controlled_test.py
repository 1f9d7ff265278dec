"""Virtual tests under a controller: of the phase (a phase-locked loop) or of the response."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from snrmjax.model.structures import Structure
from snrmjax.simulate.balance.given_numbers import positive
from snrmjax.simulate.solutions.controlled import (
    ControlledCurve,
    phase_controlled,
    response_controlled,
)
from snrmjax.simulate.virtual_test.appropriation import (
    around,
    between,
    mode_phase,
    phase_limits,
    spread_in_phase,
    states_at_phases,
)
from snrmjax.simulate.virtual_test.phase_resonance_test import VirtualTest
from snrmjax.simulate.virtual_test.recording import (
    EXACT,
    Recording,
    VisitedStates,
    check_recording,
    recorded_states,
)


def phase_controlled_test(
    model: Structure,
    forces: float | Sequence[float] | Float[ArrayLike, " level"],
    phases: float | Sequence[float] | Float[ArrayLike, " phase"],
    *,
    harmonic_order: int = 9,
    recording: Recording = EXACT,
) -> VirtualTest:
    """Hold the phase of the mode of interest by a phase-locked loop and raise the force.

    At each force level the states at all `phases` are recorded, those that are unstable without
    the controller included: there are no jumps. Where a curve of one phase turns back before it
    reaches a force, that state is missing, which `n_missing` counts.

    Arguments: `forces` in N, `phases` of the velocity relative to the force in rad, 0 for phase
    resonance, positive below it; the others as in `phase_resonance_test`. Assumes a controller
    that settles and removes the phase error of the mode of interest altogether.
    Returns a `VirtualTest` with one `ControlledCurve` for each phase.
    Raises `ValueError` as `phase_resonance_test` does, for a phase beyond ±π/2 and when no
    state at all is reached.
    Reference: Peter & Leine, Mech. Syst. Signal Process. 96 (2017) 139,
    doi:10.1016/j.ymssp.2017.04.011.
    """
    check_recording(recording, harmonic_order)
    loads = positive("forces", forces).tolist()
    angles = np.atleast_1d(np.asarray(phases, dtype=np.float64)).tolist()
    if not angles:
        raise ValueError("`phases` must name at least one phase, but is empty.")
    middle = dataclasses.replace(model, test_order=jnp.asarray(0.5))
    curves = tuple(
        phase_controlled(middle, 1.02 * max(loads), phase=angle, harmonic_order=harmonic_order)
        for angle in angles
    )
    rows = []
    for level, force in enumerate(loads, start=1):
        for phase, curve in zip(angles, curves, strict=True):
            near = _at_force(curve, force)
            if near is not None:
                rows.append((level, force, *near, phase))
    if not rows:
        raise ValueError("no state was reached at any of the phases; lower the forces.")
    number, load, frequency, motion, wanted = (np.array(c) for c in zip(*rows, strict=True))
    order = np.linspace(0.0, 1.0, len(rows))
    states = VisitedStates(number, order, load, frequency, motion)
    found = states_at_phases(model, states, wanted)
    return _recorded(model, found, curves, recording, aimed=len(loads) * len(angles))


def response_controlled_test(
    model: Structure,
    velocities: float | Sequence[float] | Float[ArrayLike, " level"],
    from_frequency: float,
    to_frequency: float,
    *,
    appropriation: tuple[float, float] = (0.5, 1.0),
    points_per_level: int = 5,
    harmonic_order: int = 9,
    recording: Recording = EXACT,
) -> VirtualTest:
    """Hold the velocity amplitude at the first sensor and step the frequency through resonance.

    The level of a state is that of its velocity, the force is whatever holds it. The curves
    have no folds in the frequency where stiffness and damping depend on the amplitude alone, so
    that states unstable under a constant force are recorded as well. `points_per_level` states
    are evenly spread in phase over where the indicator lies inside `appropriation`.

    Arguments: `velocities` in m/s, peak amplitude of the fundamental of the flexible modes;
    frequencies in rad/s; the others as in `phase_resonance_test`.
    Returns a `VirtualTest` with one `ControlledCurve` for each velocity; a level whose curve has no
    start (its `status` says so) has no states.
    Raises `ValueError` as `phase_resonance_test` does.
    Reference: Karaağaçlı & Özgüven, Mech. Syst. Signal Process. 144 (2020) 107023,
    doi:10.1016/j.ymssp.2020.107023.
    """
    limits = phase_limits(appropriation)
    if points_per_level < 1:
        raise ValueError(f"`points_per_level` must be 1 or more, but is {points_per_level}.")
    check_recording(recording, harmonic_order)
    speeds = positive("velocities", velocities).tolist()
    rows: list[tuple] = []
    curves = []
    for level, velocity in enumerate(speeds, start=1):
        # A drifting structure as it is in the middle of the level.
        order = jnp.asarray((level - 0.5) / len(speeds))
        now = dataclasses.replace(model, test_order=order)
        ends = (from_frequency, to_frequency)
        curve = response_controlled(now, velocity, *ends, harmonic_order=harmonic_order)
        curves.append(curve)
        if not len(curve.frequency):
            continue
        phase = mode_phase(model, curve.coefficients)
        near = around(phase, int(np.argmin(np.abs(phase))), limits[1])
        for place in spread_in_phase(phase, near, *limits, points_per_level):
            columns = (curve.force, curve.frequency, curve.coefficients, phase)
            rows.append((level, velocity, *(between(column, *place) for column in columns)))
    if not rows:
        raise ValueError(
            "no state has an appropriation indicator in the range asked for; widen "
            "`appropriation` or the frequency range."
        )
    number, speed, load, frequency, motion, wanted = (np.array(c) for c in zip(*rows, strict=True))
    states = VisitedStates(number, np.linspace(0.0, 1.0, len(rows)), load, frequency, motion)
    found = states_at_phases(model, states, wanted, speed)
    aimed = points_per_level * len(speeds)
    return _recorded(model, found, tuple(curves), recording, aimed=aimed)


def _at_force(curve: ControlledCurve, force: float) -> tuple[float, np.ndarray] | None:
    """Frequency and coefficients where a rising force first reaches a value."""
    if not len(curve.force):
        return None
    if force <= curve.force[0]:
        return float(curve.frequency[0]), curve.coefficients[0] * (force / curve.force[0])
    passed = np.flatnonzero((curve.force[:-1] < force) & (curve.force[1:] >= force))
    # A loop whose force turned back has left the way that a rising force takes.
    turned = np.flatnonzero(np.diff(curve.force) <= 0)
    if not passed.size or (turned.size and turned[0] < passed[0]):
        return None
    k = int(passed[0])
    share = (force - curve.force[k]) / (curve.force[k + 1] - curve.force[k])
    return float(between(curve.frequency, k, share)), between(curve.coefficients, k, share)


def _recorded(
    model: Structure,
    states: VisitedStates,
    curves: tuple[ControlledCurve, ...],
    recording: Recording,
    *,
    aimed: int,
) -> VirtualTest:
    """The states found, of so many aimed at, as the instruments record them."""
    recorded = recorded_states(model, states, recording)
    return VirtualTest(recorded, (), curves, aimed - len(states.level))
