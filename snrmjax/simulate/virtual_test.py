"""A virtual phase-resonance test: steady states near resonance, with measurement errors."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from snrmjax.measure.steady_states import SteadyStates, steady_states
from snrmjax.model.structure import Structure
from snrmjax.simulate.forced_response import ResponseCurve, forced_response, solve_at_frequency
from snrmjax.simulate.harmonics import velocity_phasors


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
    `appropriation` are recorded, `points_per_level` of them, evenly spread in phase over the
    sides that a test can reach. Where a stable branch ends, the test jumps to the next one,
    which is noted in `jumps`; states between the two are not reached.

    Arguments: `forces` in N, frequencies in rad/s, `errors` 1σ, drawn from `seed`;
    `keep_harmonics` are recorded beside the fundamental.
    Returns a `VirtualTest`; its steady states carry the stated standard deviations.
    Raises `ValueError` for an empty range of the indicator.
    Reference: Kwarta & Allen, sections 1.2 and 3.1.
    """
    low, high = appropriation
    if not 0 <= low < high <= 1:
        raise ValueError(f"`appropriation` must be a range inside 0…1, but is {appropriation}.")
    curves = forced_response(
        model, forces, from_frequency, to_frequency, harmonic_order=harmonic_order
    )
    levels, frequency, force, starts = [], [], [], []
    jumps: list[tuple[int, float]] = []
    for curve in curves:
        level = 1 + list(forces).index(curve.force)
        reached, ends = _swept(curve)
        jumps += [(level, f) for f in ends]
        phase = _mode_phase(model, curve)
        indicator = np.cos(phase) ** 2  # Eq. (20) of the fundamental
        for wanted in _wanted_phases(phase, indicator, reached, low, high, points_per_level):
            nearest = int(np.argmin(np.where(reached, np.abs(phase - wanted), np.inf)))
            levels.append(level)
            force.append(curve.force)
            frequency.append(_frequency_at(curve, phase, nearest, wanted))
            starts.append(curve.coefficients[nearest])
    if not levels:
        raise ValueError(
            "no stable state has an appropriation indicator in the range asked for; widen "
            "`appropriation` or the frequency range."
        )
    exact, converged = solve_at_frequency(
        model, jnp.asarray(force), jnp.asarray(frequency), jnp.asarray(np.stack(starts))
    )
    keep = np.asarray(converged)
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


def _mode_phase(model: Structure, curve: ResponseCurve) -> np.ndarray:
    """Phase of the velocity fundamental of the mode of interest, 0 at phase resonance."""
    j = model.modes.mode_of_interest
    cosine, sine = curve.coefficients[:, 1, j], curve.coefficients[:, 2, j]
    return np.angle(1j * (cosine - 1j * sine) * np.sign(float(model.modes.participation[j])))


def _swept(curve: ResponseCurve) -> tuple[np.ndarray, list[float]]:
    """Points that stepping the frequency up and down visits, and where it jumps.

    A sweep follows a stable branch until it ends, then goes on with the next stable points of
    the same curve at that frequency or, beyond a window of period doubling, the next frequency.
    """
    n = len(curve.frequency)
    visited = np.zeros(n, dtype=bool)
    jumps: list[float] = []
    for direction in (1, -1):
        order = np.arange(n)[::direction]
        frequency, stable = direction * curve.frequency[order], curve.stable[order]
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


def _wanted_phases(
    phase: np.ndarray,
    indicator: np.ndarray,
    reached: np.ndarray,
    low: float,
    high: float,
    count: int,
) -> np.ndarray:
    """Phases to record at, evenly spread over the reachable ones inside the indicator's range."""
    good = reached & (indicator >= low) & (indicator <= high) & (np.abs(phase) < np.pi / 2)
    sides = [phase[good & (phase > 0)], phase[good & (phase < 0)]]
    sides = [side for side in sides if side.size]
    if not sides:
        return np.zeros(0)
    shares = np.array_split(np.arange(count), len(sides))
    return np.concatenate(
        [
            np.linspace(side.min(), side.max(), len(share)) if len(share) > 1 else [side.mean()]
            for side, share in zip(sides, shares, strict=True)
            if len(share)
        ]
    )


def _frequency_at(curve: ResponseCurve, phase: np.ndarray, nearest: int, wanted: float) -> float:
    """Frequency at a phase, interpolated between the nearest point and its better neighbour."""
    neighbours = [k for k in (nearest - 1, nearest + 1) if 0 <= k < len(phase)]
    across = [k for k in neighbours if (phase[k] - wanted) * (phase[nearest] - wanted) < 0]
    if not across:
        return float(curve.frequency[nearest])
    k = across[0]
    share = (wanted - phase[nearest]) / (phase[k] - phase[nearest])
    return float(curve.frequency[nearest] + share * (curve.frequency[k] - curve.frequency[nearest]))


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
        return np.asarray(jax.random.normal(key, shape))

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
