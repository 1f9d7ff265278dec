"""A phase-resonance test in time: what stepping the frequency reaches, transients included."""

import numpy as np

from snrmjax.model.structures import Structure
from snrmjax.numerics.blocks import over_cores
from snrmjax.simulate.solutions.time_integration import IntegratedMotion, stepped_motions
from snrmjax.simulate.virtual_test.appropriation import around, mode_phase
from snrmjax.simulate.virtual_test.recording import VisitedStates

_SAME = 0.01  # rad: the same state on the way up and down


def stepped_states(
    model: Structure,
    forces: list[float],
    up: np.ndarray,
    limits: tuple[float, float],
    points_per_level: int,
    *,
    cycles_per_step: int,
    harmonic_order: int,
) -> tuple[VisitedStates, list[tuple[int, float]], int]:
    """Settled states near resonance of sweeps up and down at every force, and the jumps.

    The last number says how many steps had not settled when the next one came.

    Arguments: `up` the frequencies of a sweep in rad/s, `limits` of |phase| in rad.
    """
    steps = np.concatenate([up, up[::-1]])
    times = np.linspace(0.0, 1.0, len(forces) * len(steps)).reshape(len(forces), -1)

    def swept(level: int) -> IntegratedMotion:
        return stepped_motions(
            *(model, forces[level], steps),
            cycles_per_step=cycles_per_step,
            test_orders=times[level],
            harmonic_order=harmonic_order,
        )

    parts, jumps, n_unsettled = [], [], 0
    for level, motion in enumerate(over_cores(swept, range(len(forces)))):
        coefficients, good = np.asarray(motion.coefficients), np.asarray(motion.converged)
        n_unsettled += int(np.sum(~good))
        phase = np.where(good, mode_phase(model, coefficients), np.nan)
        height = np.where(good, np.linalg.norm(coefficients[:, 1:3], axis=(1, 2)), 0.0)
        rows: list[int] = []
        for sweep in (np.arange(len(up)), len(up) + np.arange(len(up))):
            settled = sweep[good[sweep]]
            if not settled.size:
                continue
            jumps += [(level + 1, float(steps[k])) for k in _jumps(model, steps, phase, settled)]
            near = around(phase[settled], int(np.argmax(height[settled])), limits[1])
            inside = (np.abs(phase[settled]) >= limits[0]) & (np.abs(phase[settled]) <= limits[1])
            rows += settled[near & inside].tolist()
        chosen = _spread(np.array(rows, dtype=int), steps, phase, points_per_level)
        n = len(chosen)
        parts.append(
            VisitedStates(
                level=np.full(n, level + 1),
                order=times[level, chosen],
                force=np.full(n, forces[level]),
                frequency=steps[chosen],
                coefficients=coefficients[chosen],
            )
        )
    return VisitedStates(*map(np.concatenate, zip(*parts, strict=True))), jumps, n_unsettled


def _jumps(model: Structure, steps: np.ndarray, phase: np.ndarray, settled: np.ndarray) -> list:
    """Steps after which the phase changes by more than a linear resonance would have it."""
    modes, j = model.modes, model.modes.mode_of_interest
    half_width = float(modes.damping_ratio[j] * modes.natural_frequency[j])
    change = np.abs(np.diff(phase[settled]))
    most = 0.3 + 3 * np.abs(np.diff(steps[settled])) / max(half_width, 1e-300)
    return settled[:-1][change > most].tolist()


def _spread(rows: np.ndarray, steps: np.ndarray, phase: np.ndarray, count: int) -> np.ndarray:
    """Up to `count` of the candidates, shared among the sides and evenly spread in phase."""
    distinct: list[int] = []
    for k in rows:
        again = [e for e in distinct if steps[e] == steps[k] and abs(phase[e] - phase[k]) < _SAME]
        if not again:
            distinct.append(int(k))
    candidates = np.array(distinct, dtype=int)
    sides = [candidates[sign * phase[candidates] > 0] for sign in (1, -1)]
    sides = [side for side in sides if side.size]
    chosen: list[int] = []
    for number, side in enumerate(sides):
        n = min(len(np.array_split(np.arange(count), len(sides))[number]), side.size)
        free = list(side)
        low, high = phase[side].min(), phase[side].max()
        for target in low + (high - low) * (np.arange(n) + 0.5) / max(n, 1):
            chosen.append(int(free.pop(int(np.argmin(np.abs(phase[free] - target))))))
    return np.sort(np.array(chosen, dtype=int))
