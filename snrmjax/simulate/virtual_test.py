"""A virtual phase-resonance test: steady states near resonance, with measurement errors."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from snrmjax.measure.steady_states import SteadyStates, steady_states
from snrmjax.model.structure import Structure
from snrmjax.simulate.blocks import padded
from snrmjax.simulate.forced_response import forced_response, solve_at_frequency
from snrmjax.simulate.harmonics import velocity_phasors
from snrmjax.simulate.response_curve import ResponseCurve


class MeasurementErrors(NamedTuple):
    """Random errors of a test, 1σ; what a level shares is drawn once for each level."""

    amplitude: float = 0.0  # relative, of the velocity
    phase: float = 0.0  # rad
    force: float = 0.0  # relative
    level_gain: float = 0.0  # relative, shared by a level
    level_phase: float = 0.0  # rad, shared by a level
    harmonic: float = 0.0  # m/s, rms of the complex error of every higher harmonic


class VirtualTest(NamedTuple):
    """What a virtual test recorded."""

    steady_states: SteadyStates
    jumps: tuple[tuple[int, float], ...]  # (level, frequency in rad/s) where a branch ended
    curves: tuple[ResponseCurve, ...]  # the exact responses behind the test


NO_ERRORS = MeasurementErrors()
_BLOCK = 4096


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
) -> VirtualTest:
    """Step the frequency towards resonance at rising force levels and record near, not at, it.

    At every level the frequency is stepped along the stable response, from both ends of the
    range; states whose appropriation indicator (Eq. 20, of the fundamental) lies inside
    `appropriation` are recorded, `points_per_level` of them, evenly spread in phase over what a
    test can reach of both sides. Where a stable branch ends, the test jumps to the next one,
    which is noted in `jumps`; states between the two are not reached.

    Arguments: `forces` in N, frequencies in rad/s, `errors` 1σ, drawn from `seed`;
    `keep_harmonics` are recorded beside the fundamental.
    Returns a `VirtualTest`; its steady states carry the stated standard deviations.
    Raises `ValueError` for an empty range of the indicator, for one that no stable state falls
    into, and for harmonics or errors that make no sense.
    Reference: Kwarta & Allen, sections 1.2 and 3.1.
    """
    low, high = appropriation
    if not 0 <= low < high <= 1:
        raise ValueError(f"`appropriation` must be a range inside 0…1, but is {appropriation}.")
    if points_per_level < 1:
        raise ValueError(f"`points_per_level` must be 1 or more, but is {points_per_level}.")
    if not all(2 <= h <= harmonic_order for h in keep_harmonics):
        raise ValueError(
            f"`keep_harmonics` must lie between 2 and `harmonic_order` = {harmonic_order}, "
            f"but is {keep_harmonics}."
        )
    for name, value in errors._asdict().items():
        if not 0 <= value < np.inf:
            raise ValueError(f"the error `{name}` must be zero or positive, but is {value}.")
    smallest, largest = np.arccos(np.sqrt([high, low])).tolist()  # Eq. (20): cos² of the phase
    curves = forced_response(
        model, forces, from_frequency, to_frequency, harmonic_order=harmonic_order
    )
    levels, frequency, force, starts, phases = [], [], [], [], []
    jumps: list[tuple[int, float]] = []
    for curve in curves:
        level = 1 + list(forces).index(curve.force)
        reached, ends = _swept(curve)
        jumps += [(level, f) for f in ends]
        phase = _mode_phase(model, curve.coefficients)
        near = reached & _around_resonance(curve, phase, largest)
        for k, share in _spread_in_phase(phase, near, smallest, largest, points_per_level):
            levels.append(level)
            force.append(curve.force)
            frequency.append(_between(curve.frequency, k, share))
            starts.append(_between(curve.coefficients, k, share))
            phases.append(_between(phase, k, share))
    if not levels:
        raise ValueError(
            "no stable state has an appropriation indicator in the range asked for; widen "
            "`appropriation` or the frequency range."
        )
    asked = (np.array(force), np.array(frequency), np.stack(starts))
    solved = solve_at_frequency(model, *(jnp.asarray(padded(one, 64)) for one in asked))
    exact, converged = (one[: len(force)] for one in solved)
    # Beside a fold, Newton's method at fixed frequency may leave for the other branch.
    found = _mode_phase(model, np.asarray(exact))
    keep = np.asarray(converged) & (np.abs(found - np.array(phases)) < 0.05)
    velocity = velocity_phasors(exact, jnp.asarray(frequency), model.modes.mode_shape)
    recorded = _with_errors(
        np.asarray(levels)[keep],
        np.asarray(frequency)[keep],
        np.asarray(force)[keep],
        np.asarray(velocity)[keep],
        model.modes.sensors,
        keep_harmonics,
        errors,
        seed,
    )
    return VirtualTest(recorded, tuple(jumps), tuple(curves))


def _mode_phase(model: Structure, coefficients: np.ndarray) -> np.ndarray:
    """Phase of the velocity fundamental of the mode of interest, 0 at phase resonance."""
    j = model.modes.mode_of_interest
    cosine, sine = coefficients[:, 1, j], coefficients[:, 2, j]
    return np.angle(1j * (cosine - 1j * sine) * np.sign(float(model.modes.participation[j])))


def _around_resonance(curve: ResponseCurve, phase: np.ndarray, largest: float) -> np.ndarray:
    """Points from the strongest phase resonance on, either way, until the phase is too far off.

    At a superharmonic resonance, far below, the phase may come back into the range: no test for
    the mode would look there. Without a phase resonance in the curve every point counts.
    """
    n = len(phase)
    resonances = curve.at_events("phase_resonance")
    if not resonances.size:
        return np.ones(n, dtype=bool)
    centre = resonances[np.argmax(np.abs(curve.velocity[resonances, 1, 0]))]
    # One point beyond the limit is kept on either side: states lie between points.
    far = np.flatnonzero(np.abs(phase) > largest)
    below, above = far[far < centre], far[far > centre]
    first = below[-1] if below.size else 0
    last = above[0] if above.size else n - 1
    index = np.arange(n)
    return (index >= first) & (index <= last)


def _swept(curve: ResponseCurve) -> tuple[np.ndarray, list[float]]:
    """Points that stepping the frequency up and down visits, and where it jumps.

    A sweep follows a stable branch until it ends, then goes on with the next stable points of
    the same curve at that frequency or, beyond a window of period doubling, the next frequency.
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
    return visited, jumps


def _spread_in_phase(
    phase: np.ndarray, reached: np.ndarray, smallest: float, largest: float, count: int
) -> list[tuple[int, float]]:
    """Places (point, share of the way to the next) on a curve with |phase| inside a range.

    `count` of them, shared among the sides of resonance and spread evenly in phase over what is
    reached of a side, so that none lies in a gap between two branches.
    """
    pair = np.flatnonzero(reached[:-1] & reached[1:] & (np.abs(np.diff(phase)) < 1.0))
    sides = []
    for sign in (1, -1):
        begin, end = (np.clip(sign * phase[pair + k], smallest, largest) for k in (0, 1))
        used = begin != end
        if used.any():
            sides.append((pair[used], sign * begin[used], sign * end[used]))
    places: list[tuple[int, float]] = []
    for k, (here, begin, end) in enumerate(sides):
        n = len(np.array_split(np.arange(count), len(sides))[k])
        along = np.concatenate([[0.0], np.cumsum(np.abs(end - begin))])
        wanted = along[-1] * (np.arange(n) + 0.5) / n  # the middles of equal parts
        index = np.clip(np.searchsorted(along, wanted, side="right") - 1, 0, here.size - 1)
        target = begin[index] + np.sign(end - begin)[index] * (wanted - along[index])
        first, last = phase[here[index]], phase[here[index] + 1]
        places += zip(
            here[index].tolist(), ((target - first) / (last - first)).tolist(), strict=True
        )
    return places


def _between(values: np.ndarray, point: int, share: float) -> np.ndarray:
    """Linear interpolation between a point of a curve and the next."""
    return values[point] + share * (values[point + 1] - values[point])


def _with_errors(
    level: np.ndarray,
    frequency: np.ndarray,
    force: np.ndarray,
    velocity: np.ndarray,
    sensors: tuple[str, ...],
    keep_harmonics: tuple[int, ...],
    errors: MeasurementErrors,
    seed: int,
) -> SteadyStates:
    """Measured values: the exact ones with errors drawn from a seeded key."""
    n, n_sensors = len(level), velocity.shape[2]
    keys = jax.random.split(jax.random.key(seed), 6)

    def normal(key: jax.Array, *shape: int) -> np.ndarray:
        # Drawn in blocks of one length, which compiles once.
        size = int(np.prod(shape))
        blocks = jax.random.normal(key, (-(-size // _BLOCK) * _BLOCK,))
        return np.asarray(blocks)[:size].reshape(shape)

    groups, group = np.unique(level, return_inverse=True)
    gain = errors.level_gain * normal(keys[3], len(groups))[group]
    turn = errors.level_phase * normal(keys[4], len(groups))[group]
    shared = (1 + gain) * np.exp(1j * turn)
    own = (1 + errors.amplitude * normal(keys[0], n, n_sensors)) * np.exp(
        1j * errors.phase * normal(keys[1], n, n_sensors)
    )
    factor = shared[:, None] * own
    exact = velocity[:, 1]
    harmonics = (
        np.stack([velocity[:, h] * factor for h in keep_harmonics], axis=2)
        if keep_harmonics
        else None
    )
    if harmonics is not None:
        parts = normal(keys[5], 2, *harmonics.shape) / np.sqrt(2)
        harmonics = harmonics + errors.harmonic * (parts[0] + 1j * parts[1])
    measured = exact * factor

    def stated(value: float, scale: np.ndarray) -> np.ndarray | None:
        return value * scale if value > 0 else None

    return steady_states(
        level,
        frequency,
        force * (1 + errors.force * normal(keys[2], n)),
        measured,
        sensors=sensors,
        velocity_std=stated(errors.amplitude, np.abs(measured)),
        phase_std=stated(errors.phase, np.ones((n, n_sensors))),
        force_std=stated(errors.force, force),
        harmonics=harmonics,
        harmonic_order=keep_harmonics,
        harmonic_std=stated(errors.harmonic, np.ones((n, n_sensors))),
    )
