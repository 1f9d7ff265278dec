"""A virtual phase-resonance test: steady states near resonance, with measurement errors."""

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import jax.numpy as jnp
import numpy as np

from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure
from snrmjax.simulate.continuation.response_curve import ResponseCurve
from snrmjax.simulate.solutions.controlled import ControlledCurve
from snrmjax.simulate.solutions.forced_response import forced_response_batch
from snrmjax.simulate.virtual_test.appropriation import (
    around,
    between,
    mode_phase,
    phase_limits,
    spread_in_phase,
    states_at_phases,
)
from snrmjax.simulate.virtual_test.integrated_test import stepped_states
from snrmjax.simulate.virtual_test.recording import (
    NO_ERRORS,
    MeasurementErrors,
    VisitedStates,
    check_recording,
    recorded_states,
)

__all__ = ["NO_ERRORS", "MeasurementErrors", "VirtualTest", "phase_resonance_test"]

Means = Literal["harmonic_balance", "time_integration"]


class VirtualTest(NamedTuple):
    """What a virtual test recorded."""

    steady_states: SteadyStates
    jumps: tuple[tuple[int, float], ...]  # (level, frequency in rad/s) where a branch ended
    curves: tuple[ResponseCurve | ControlledCurve, ...]  # the exact responses behind the test


def phase_resonance_test(
    model: Structure,
    forces: Sequence[float],
    from_frequency: float,
    to_frequency: float,
    *,
    appropriation: tuple[float, float] = (0.5, 0.7),
    points_per_level: int = 5,
    errors: MeasurementErrors = NO_ERRORS,
    seed: int = 0,
    harmonic_order: int = 9,
    keep_harmonics: tuple[int, ...] = (),
    by: Means = "harmonic_balance",
    steps_per_sweep: int = 100,
    cycles_per_step: int = 200,
) -> VirtualTest:
    """Step the frequency towards resonance at rising force levels and record near, not at, it.

    At every level the frequency is stepped along the stable response, from both ends of the
    range; states whose appropriation indicator (Eq. 20, of the fundamental) lies inside
    `appropriation` are recorded, `points_per_level` of them, evenly spread in phase over what a
    test can reach of both sides. Where a stable branch ends, the test jumps to the next one,
    which is noted in `jumps`, and follows that one both ways; states between the two are not
    reached.

    `by="harmonic_balance"` steps infinitely slowly and records exact states, at `order` from 0
    to 1 in the order of the rows. `by="time_integration"` is `stepped_sine`: each level starts
    from rest, goes up in `steps_per_sweep` equal steps of at most `cycles_per_step` cycles and
    down again, jumps where a step's transient throws it off, and records of its own steps the
    settled ones, at their time in the test; fewer than `points_per_level` where a coarse
    sweep has no more, and no curves. Both record through the measurement effects of the model,
    and drift makes its way through the test.

    Arguments: `forces` in N, frequencies in rad/s, `errors` 1σ, drawn from `seed`;
    `keep_harmonics` are recorded beside the fundamental.
    Returns a `VirtualTest`; its steady states carry the stated standard deviations.
    Raises `ValueError` for an empty range of the indicator, for one that no stable state falls
    into, and for harmonics, errors or steps that make no sense.
    Reference: Kwarta & Allen, sections 1.2 and 3.1.
    """
    limits = phase_limits(appropriation)
    if points_per_level < 1:
        raise ValueError(f"`points_per_level` must be 1 or more, but is {points_per_level}.")
    check_recording(errors, keep_harmonics, harmonic_order)
    if by not in get_args(Means):
        raise ValueError(f"`by` must be one of {get_args(Means)}, but is {by!r}.")
    if steps_per_sweep < 2:
        raise ValueError(f"`steps_per_sweep` must be 2 or more, but is {steps_per_sweep}.")
    forces = list(forces)
    for force in forces:
        if not force > 0 or not np.isfinite(force):
            raise ValueError(f"every force must be positive, but one is {force!r} N.")
    if not 0 < from_frequency < to_frequency < np.inf:
        raise ValueError(
            "`from_frequency` must be positive and below a finite `to_frequency`, but they are "
            f"{from_frequency:g} and {to_frequency:g} rad/s."
        )
    ends = (from_frequency, to_frequency)
    curves: tuple[ResponseCurve, ...] = ()
    if by == "harmonic_balance":
        found = _along_curves(model, forces, ends, limits, points_per_level, harmonic_order)
        states, jumps, curves = found
    else:
        up = np.linspace(*ends, steps_per_sweep)
        states, jumps = stepped_states(
            *(model, forces, up, limits, points_per_level),
            cycles_per_step=cycles_per_step,
            harmonic_order=harmonic_order,
        )
    if not len(states.level):
        raise ValueError(
            "no stable state has an appropriation indicator in the range asked for; widen "
            "`appropriation` or the frequency range, or take more steps."
        )
    recorded = recorded_states(model, states, errors, seed, keep_harmonics)
    return VirtualTest(recorded, tuple(jumps), curves)


def _along_curves(
    model: Structure,
    forces: list[float],
    ends: tuple[float, float],
    limits: tuple[float, float],
    points_per_level: int,
    harmonic_order: int,
) -> tuple[VisitedStates, list[tuple[int, float]], tuple[ResponseCurve, ...]]:
    """States along the stable parts of the exact curves, jumps and the curves."""
    # A drifting structure as it is in the middle of each level.
    middles = (np.arange(len(forces)) + 0.5) / max(len(forces), 1)
    models = [dataclasses.replace(model, test_order=jnp.asarray(middle)) for middle in middles]
    batch = forced_response_batch(models, forces, *ends, harmonic_order=harmonic_order)
    rows: list[tuple] = []
    jumps: list[tuple[int, float]] = []
    for level, parts in enumerate(batch.curves, start=1):
        for curve in parts:
            reached, left = _swept(curve)
            jumps += [(level, f) for f in left]
            phase = mode_phase(model, curve.coefficients)
            near = reached & _around_resonance(curve, phase, limits[1])
            for place in spread_in_phase(phase, near, *limits, points_per_level):
                columns = (curve.frequency, curve.coefficients, phase)
                at = (between(column, *place) for column in columns)
                rows.append((level, curve.force, *at))
    curves = tuple(curve for parts in batch.curves for curve in parts)
    if not rows:
        nothing = VisitedStates(*(np.zeros(0),) * 4, np.zeros((0, 2 * harmonic_order + 1, 1)))
        return nothing, jumps, curves
    number, load, frequency, motion, wanted = (np.array(c) for c in zip(*rows, strict=True))
    order = np.linspace(0.0, 1.0, len(rows))
    states = VisitedStates(number, order, load, frequency, motion)
    return states_at_phases(model, states, wanted), jumps, curves


def _around_resonance(curve: ResponseCurve, phase: np.ndarray, largest: float) -> np.ndarray:
    """Points around the strongest phase resonance; without one every point counts."""
    resonances = curve.at_events("phase_resonance")
    if not resonances.size:
        return np.ones(len(phase), dtype=bool)
    centre = resonances[np.argmax(np.abs(curve.velocity[resonances, 1, 0]))]
    return around(phase, int(centre), largest)


def _swept(curve: ResponseCurve) -> tuple[np.ndarray, list[float]]:
    """Points that stepping the frequency up and down visits, and where it jumps.

    A sweep follows a stable branch until it ends, then goes on with the next stable points of
    the same curve at that frequency or, beyond a window of period doubling, the next frequency.
    From where it lands it is also turned round: a resonance can lie behind it.
    """
    n = len(curve.frequency)
    visited = np.zeros(n, dtype=bool)
    stays = curve.stable.copy()
    stays[curve.at_events("fold")] = False  # there a multiplier is 1, give or take a rounding
    jumps: list[float] = []
    for direction in (1, -1):
        order = np.arange(n)[::direction]
        frequency, stable = direction * curve.frequency[order], stays[order]
        stable_points = np.flatnonzero(stable)
        k = int(stable_points[0]) if stable_points.size else n
        while k < n:
            visited[order[k]] = True
            if k + 1 < n and stable[k + 1] and frequency[k + 1] > frequency[k]:
                k += 1
                continue
            beyond = np.flatnonzero(stable[k + 1 :] & (frequency[k + 1 :] >= frequency[k]))
            if not beyond.size:
                break
            jumps.append(float(curve.frequency[order[k]]))
            k += 1 + int(beyond[0])
            back = k - 1
            while back >= 0 and stable[back]:
                visited[order[back]] = True
                back -= 1
    return visited, jumps
