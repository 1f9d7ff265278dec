"""A virtual phase-resonance test: steady states near resonance, with measurement errors."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from snrmjax.measure.states import SteadyStates
from snrmjax.model.structures import Structure
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.result import AbstractResult, Variable, setting
from snrmjax.numerics.rules import InputError
from snrmjax.simulate.balance.given_numbers import frequency_range, positive
from snrmjax.simulate.continuation.response_curve import ResponseCurve
from snrmjax.simulate.solutions.forced_response import ResponseSettings, forced_response_batch
from snrmjax.simulate.virtual_test.appropriation import (
    around,
    interpolated,
    mode_phase,
    phase_limits,
    spread_in_phase,
    states_near,
)
from snrmjax.simulate.virtual_test.recording import (
    EXACT,
    Recording,
    VisitedStates,
    check_recording,
    recorded_states,
)


class VirtualTest(AbstractResult):
    """Record of a virtual test."""

    coordinates: ClassVar[tuple[str, ...]] = SteadyStates.coordinates

    steady_states: SteadyStates
    jumps: tuple[tuple[int, float], ...]  # (level, frequency in rad/s) where a branch ended
    curves: tuple[ResponseCurve, ...]  # the exact responses behind the test
    # Planned states that the test did not reach or that did not converge.
    n_missing: int = setting(default=0)

    def variables(self) -> Mapping[str, Variable]:
        """The steady states, under the column names of their file."""
        return self.steady_states.variables()


@on_numbers("Differentiate the steady states of a model by `sj.simulate.periodic_motion`.")
def phase_resonance_test(
    model: Structure,
    forces: float | Sequence[float] | Float[ArrayLike, " level"],
    from_frequency: float,
    to_frequency: float,
    *,
    appropriation: tuple[float, float] = (0.5, 0.7),
    points_per_level: int = 5,
    recording: Recording = EXACT,
    harmonic_order: int = 9,
) -> VirtualTest:
    """Step the frequency towards resonance at rising force levels and record near, not at, it.

    At every level the frequency is stepped along the stable response, from both ends of the
    range; states whose appropriation indicator (Eq. 20, of the fundamental) lies inside
    `appropriation` are recorded, `points_per_level` of them, evenly spread in phase over the
    reachable part of both sides. Where a stable branch ends, the test jumps to the next one, noted
    in `jumps`, and records along that one in both directions; states in between are not reached.

    By harmonic balance it records exact steady states, at `order` from 0 to 1 in the order of the
    rows, through the measurement effects of the model; drift proceeds through the test. For
    transients see `stepped_sine_test` in a `Laboratory`.

    Arguments: `forces` in N, frequencies in rad/s; `recording` has the random errors and the
    harmonics recorded in addition to the fundamental; `harmonic_order` of the motion.
    Returns a `VirtualTest`; its steady states have the stated standard deviations, and
    `n_missing` counts planned states that could not be computed.
    Raises `ValueError` for an empty range of the indicator or one without stable states, and for
    invalid harmonics, errors or numbers of points.
    Not differentiable: differentiate the steady states of a model by
    `snrmjax.simulate.periodic_motion`.
    Reference: Kwarta & Allen, sections 1.2 and 3.1.
    """
    limits = phase_limits(appropriation)
    if points_per_level < 1:
        raise InputError(f"`points_per_level` must be 1 or more, but is {points_per_level}.")
    check_recording(recording, harmonic_order)
    loads = positive("forces", forces).tolist()
    low, high = frequency_range(from_frequency, to_frequency).tolist()
    visited = _along_curves(model, loads, (low, high), limits, points_per_level, harmonic_order)
    if not len(visited.states.level):
        raise InputError(
            "no stable state has an appropriation indicator in the range asked for; widen "
            "`appropriation` or the frequency range."
        )
    recorded = recorded_states(model, visited.states, recording)
    return VirtualTest(recorded, tuple(visited.jumps), visited.curves, visited.n_missing)


class _Visited(NamedTuple):
    """States that a test visits, its jumps, the exact curves and the number of missing states."""

    states: VisitedStates
    jumps: list[tuple[int, float]]
    curves: tuple[ResponseCurve, ...]
    n_missing: int


def _along_curves(
    model: Structure,
    forces: list[float],
    ends: tuple[float, float],
    limits: tuple[float, float],
    points_per_level: int,
    harmonic_order: int,
) -> _Visited:
    """States along the stable parts of the exact curves."""
    # A drifting structure at the middle of each level.
    middles = (np.arange(len(forces)) + 0.5) / max(len(forces), 1)
    models = [dataclasses.replace(model, test_order=jnp.asarray(middle)) for middle in middles]
    settings = ResponseSettings(harmonic_order=harmonic_order)
    batch = forced_response_batch(models, forces, *ends, settings=settings)
    rows: list[tuple] = []
    jumps: list[tuple[int, float]] = []
    for level, parts in enumerate(batch.curves, start=1):
        resonant = [curve for curve in parts if curve.at_events("phase_resonance").size]
        for curve in resonant or parts:
            reached, left = _swept(curve)
            jumps += [(level, f) for f in left]
            phase = mode_phase(model, curve.coefficients)
            near = reached & _around_resonance(curve, phase, limits[1])
            for position in spread_in_phase(phase, near, *limits, points_per_level):
                columns = (curve.frequency, curve.coefficients, phase)
                at = (interpolated(column, *position) for column in columns)
                rows.append((level, curve.force, *at))
    curves = tuple(curve for parts in batch.curves for curve in parts)
    if not rows:
        nothing = VisitedStates(*(np.zeros(0),) * 4, np.zeros((0, 2 * harmonic_order + 1, 1)))
        return _Visited(nothing, jumps, curves, 0)
    exact = states_near(model, rows)
    return _Visited(exact, jumps, curves, len(rows) - len(exact.level))


def _around_resonance(curve: ResponseCurve, phase: np.ndarray, largest: float) -> np.ndarray:
    """Points around the strongest phase resonance; without one all points."""
    resonances = curve.at_events("phase_resonance")
    if not resonances.size:
        return np.ones(len(phase), dtype=bool)
    centre = resonances[np.argmax(np.abs(curve.velocity[resonances, 1, 0]))]
    return around(phase, int(centre), largest)


def _swept(curve: ResponseCurve) -> tuple[np.ndarray, list[float]]:
    """Points that frequency steps up and down visit, and the frequencies of jumps.

    A sweep stays on a stable branch to its end, then continues with the next stable points of the
    same curve at that frequency or, beyond a window of period doubling, the next frequency. From
    where it lands it also sweeps back, since a resonance can lie in that direction.
    """
    n = len(curve.frequency)
    visited = np.zeros(n, dtype=bool)
    stays = curve.is_stable.copy()
    stays[curve.at_events("fold")] = False  # a multiplier is 1 to rounding there
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
