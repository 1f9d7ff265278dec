"""A virtual test under a controller of the phase: a phase-locked loop that has settled."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from snrmjax.model.structures import Structure
from snrmjax.simulate.balance.given_numbers import positive
from snrmjax.simulate.solutions.controlled import ControlledCurve, phase_controlled
from snrmjax.simulate.virtual_test.appropriation import between, states_near
from snrmjax.simulate.virtual_test.phase_resonance_test import VirtualTest
from snrmjax.simulate.virtual_test.recording import (
    EXACT,
    Recording,
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
    states = states_near(model, rows)
    missing = len(loads) * len(angles) - len(states.level)
    return VirtualTest(recorded_states(model, states, recording), (), curves, missing)


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
