"""States at given phases of the mode of interest, at which a test near resonance records."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.blocks import padded
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.newton import correct
from snrmjax.numerics.rules import InputError
from snrmjax.simulate.balance.harmonic_balance import harmonic_balance
from snrmjax.simulate.virtual_test.recording import VisitedStates


def phase_limits(appropriation: tuple[float, float]) -> tuple[float, float]:
    """The smallest and the largest |phase| (rad) for a range of the indicator, cos² of the phase.

    Raises `ValueError` for an empty range. Reference: Kwarta & Allen, Eq. (20).
    """
    low, high = appropriation
    if not 0 <= low < high <= 1:
        raise InputError(f"`appropriation` must be a range inside 0…1, but is {appropriation}.")
    smallest, largest = np.arccos(np.sqrt([high, low])).tolist()
    return smallest, largest


def mode_phase(
    model: Structure, coefficients: Float[np.ndarray, "state coefficient mode"]
) -> Float[np.ndarray, " state"]:
    """Phase of the velocity fundamental of the mode of interest, 0 at phase resonance."""
    j = model.modes.mode_of_interest
    cosine, sine = coefficients[:, 1, j], coefficients[:, 2, j]
    return np.angle(1j * (cosine - 1j * sine) * np.sign(model.modes.participation.item(j)))


def around(phase: Float[np.ndarray, " point"], centre: int, largest: float) -> np.ndarray:
    """Points on either side of `centre` up to the largest |phase|.

    At a superharmonic resonance, far below, the phase may re-enter the range: a test of the mode
    does not record there.
    """
    # One point beyond the limit is kept on either side, since states are interpolated.
    far = np.flatnonzero(np.abs(phase) > largest)
    below, above = far[far < centre], far[far > centre]
    first = below[-1] if below.size else 0
    last = above[0] if above.size else len(phase) - 1
    index = np.arange(len(phase))
    return (index >= first) & (index <= last)


def spread_in_phase(
    phase: np.ndarray, reached: np.ndarray, smallest: float, largest: float, count: int
) -> list[tuple[int, float]]:
    """Positions (point, fraction of the step to the next) on a curve with |phase| in a range.

    `count` of them, divided between the sides of resonance and spread evenly in phase over the
    part of a side that is reached, so that none lies in a gap between two branches.
    """
    pair = np.flatnonzero(reached[:-1] & reached[1:] & (np.abs(np.diff(phase)) < 1.0))
    sides = []
    for sign in (1, -1):
        begin, end = (np.clip(sign * phase[pair + k], smallest, largest) for k in (0, 1))
        used = begin != end
        if used.any():
            sides.append((pair[used], sign * begin[used], sign * end[used]))
    positions: list[tuple[int, float]] = []
    for k, (here, begin, end) in enumerate(sides):
        n = len(np.array_split(np.arange(count), len(sides))[k])
        along = np.concatenate([[0.0], np.cumsum(np.abs(end - begin))])
        wanted = along[-1] * (np.arange(n) + 0.5) / n  # the middles of equal parts
        index = np.clip(np.searchsorted(along, wanted, side="right") - 1, 0, here.size - 1)
        target = begin[index] + np.sign(end - begin)[index] * (wanted - along[index])
        first, last = phase[here[index]], phase[here[index] + 1]
        positions += zip(
            here[index].tolist(), ((target - first) / (last - first)).tolist(), strict=True
        )
    return positions


def interpolated(values: np.ndarray, point: int, fraction: float) -> np.ndarray:
    """Linear interpolation between a point of a curve and the next one."""
    return values[point] + fraction * (values[point + 1] - values[point])


def states_near(
    model: Structure, rows: Sequence[tuple[int, float, float, np.ndarray, float]]
) -> VisitedStates:
    """The motions near given ones with exactly the requested phase of the mode of interest.

    Arguments: `rows` in the order of the test, which lasts from time 0 to 1: level, force (N),
    frequency (rad/s), coefficients (kg^1/2 m) and the requested phase (rad).
    Solves the harmonic balance for the motion and its frequency. A drifting structure is evaluated
    at the time of each state. States that do not converge are left out.
    """
    level, force, frequency, start, phase = (np.array(c) for c in zip(*rows, strict=True))
    order = np.linspace(0.0, 1.0, len(rows))
    columns = (jnp.asarray(padded(part, 64)) for part in (order, force, phase, frequency, start))
    solved = _at_phases(simulated_structure(model), *columns)
    frequency, coefficients, converged = (np.asarray(a)[: len(rows)] for a in solved)
    states = VisitedStates(level, order, force, frequency, coefficients)
    # Newton's method may have converged to another branch.
    amplitude, was = (np.linalg.norm(x[:, 1:3], axis=(1, 2)) for x in (coefficients, start))
    off = np.exp(1j * (mode_phase(model, coefficients) - phase))
    return states.only(converged & (np.abs(amplitude / was - 1) < 0.2) & (off.real > 0))


@compiled
def _at_phases(
    model: Structure, order: Array, force: Array, phase: Array, frequency: Array, start: Array
) -> tuple[Array, Array, Bool[Array, " state"]]:
    n, j = model.n_modes, model.modes.mode_of_interest
    harmonic_order = (start.shape[1] - 1) // 2

    def at_phase(row: tuple) -> tuple[Array, Array, Array]:
        order, force, phase, frequency, start = row
        now = eqx.tree_at(lambda m: m.test_order, model, order)
        scale = jnp.max(jnp.abs(start))
        balance = harmonic_balance(now, force, scale, harmonic_order=harmonic_order)
        guess = balance.point(start, frequency)
        # Velocity phasor ∝ i(a − ib) = b + ia: on the line at the phase φ.
        line = (
            jnp.zeros_like(guess).at[n + j].set(jnp.cos(phase)).at[2 * n + j].set(-jnp.sin(phase))
        )
        end = correct(balance.linearised, guess - (line @ guess) * line, line)
        omega = end.point[-1] * balance.frequency_scale
        return omega, balance.coefficients(end.point), end.converged

    return jax.lax.map(at_phase, (order, force, phase, frequency, start))
