"""Which steady state to measure next: the one that makes a band narrowest."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from snrmjax.identify.inference.fitted_curves import values_at_displacement
from snrmjax.identify.inference.fitted_response import (
    FittedResponse,
    fitted_response,
    point_slopes,
)
from snrmjax.identify.joint.force_balance import (
    LEVEL_ERRORS,
    BalanceData,
    Spread,
    Unknowns,
    no_errors,
    weighing_at,
)
from snrmjax.identify.joint.free_unknowns import Restore
from snrmjax.identify.joint.joint_fit import JointFit
from snrmjax.identify.joint.residuals import whitened
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.compiled import compiled

Target = Literal["curves", "frequency", "damping", "resonance", "fold"]

_PER_FORCE = 96  # candidate states of one force
_TARGETS = 25  # amplitudes at which the band of a curve counts
_FROM_FOLD = 0.002  # relative frequency by which a state must keep away from a fold
_FARTHEST = np.radians(70.0)  # from resonance: beyond it other errors rule


class NextMeasurement(NamedTuple):
    """One advised steady state."""

    rank: int
    force: float  # N
    frequency: float  # rad/s
    velocity: float  # m/s, expected
    phase: float  # rad, expected of the velocity relative to the force
    expected_band_ratio: float  # mean band after this and the ones before it, over today's
    reason: str


def next_measurements(
    fit: JointFit,
    count: int,
    *,
    target: Target = "curves",
    target_force: float | None = None,
    forces: Sequence[float] | None = None,
    from_frequency: float = 0.0,
    to_frequency: float = np.inf,
) -> list[NextMeasurement]:
    """Rank steady states by how much they would narrow a band, each given the ones before it.

    Candidates are the stable states of the fitted responses within 70° of resonance; left out are
    isolated branches, which no sweep reaches, states within 0.2 % of a fold, where a test jumps
    off, and amplitudes that the fit has not seen. Every force counts as a level with its own
    errors. The expected information comes from the fit's balance, linearised at the state; bands
    are those of the families taken, without what the choice among families leaves open.

    Arguments: `target` is the band to narrow: of both curves (relative), of natural frequency or
    damping alone, or of the frequency of the resonance or upper fold under `target_force` (N).
    `forces` in N, by default twelve from the smallest to the largest measured; frequencies in
    rad/s.
    Returns at most `count` states, fewer when there are no more candidates.
    Raises `ValueError` when the target needs a force and has none, does not exist there, or when
    no state can be measured.
    Reference: the one-step rule of sequential design, Fedorov, Theory of Optimal Experiments
    (1972), for a mean of standard deviations.
    """
    measured = np.asarray(fit.motion().force)
    wanted = forces if forces is not None else np.geomspace(measured.min(), measured.max(), 12)
    ends = (from_frequency, to_frequency)
    states = _candidates(fit, [float(f) for f in wanted], ends)
    if states is None:
        raise ValueError("no stable state of the fitted responses can be measured in this range.")
    slopes, scale = _target(fit, target, target_force)
    rows = _information(fit, states)
    p, n_levels = fit.covariance.shape[0], rows.shape[2] - fit.covariance.shape[0]
    covariance = np.zeros((p + n_levels, p + n_levels))
    covariance[:p, :p] = fit.covariance
    covariance[p:, p:] = np.eye(n_levels)
    slopes = np.pad(slopes / scale[:, None], ((0, 0), (0, n_levels)))
    before = _mean_band(slopes, covariance)
    advice: list[NextMeasurement] = []
    open_states = np.ones(len(states.frequency), dtype=bool)
    for rank in range(1, count + 1):
        if not open_states.any():
            break
        best, variance = _best(slopes, covariance, rows, open_states)
        old = np.einsum("op,pq,oq->o", slopes, covariance, slopes)
        arm = rows[best] @ covariance
        covariance = covariance - arm.T @ np.linalg.solve(np.eye(2) + arm @ rows[best].T, arm)
        open_states[best] = False
        advice.append(
            NextMeasurement(
                rank=rank,
                force=float(states.force[best]),
                frequency=float(states.frequency[best]),
                velocity=float(abs(states.velocity[best])),
                phase=float(np.angle(states.velocity[best])),
                expected_band_ratio=float(_mean_band(slopes, covariance) / before),
                reason=_reason(target, states, best, old, variance),
            )
        )
    return advice


class _States(NamedTuple):
    level: np.ndarray
    force: np.ndarray
    frequency: np.ndarray
    velocity: Complex[np.ndarray, " state"]


def _candidates(fit: JointFit, forces: list[float], ends: tuple[float, float]) -> _States | None:
    rows = []
    for number, force in enumerate(forces):
        curves = fitted_response(fit, force, from_frequency=ends[0], to_frequency=ends[1])
        for curve in curves[:1]:
            keep = _measurable(curve)
            at = np.flatnonzero(keep)
            if at.size > _PER_FORCE:
                at = at[np.linspace(0, at.size - 1, _PER_FORCE).astype(int)]
            rows.append(
                (
                    *(np.full(at.size, number), np.full(at.size, force)),
                    *(curve.frequency[at], curve.velocity[at]),
                )
            )
    if not rows or not sum(len(row[0]) for row in rows):
        return None
    return _States(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def _measurable(curve: FittedResponse) -> np.ndarray:
    keep = curve.stable & ~curve.continued & (np.abs(np.angle(curve.velocity)) < _FARTHEST)
    for fold in curve.folds:
        keep &= np.abs(curve.frequency / fold.frequency - 1) > _FROM_FOLD
    return keep & np.isfinite(curve.frequency)


def _target(
    fit: JointFit, target: Target, force: float | None
) -> tuple[Float[np.ndarray, "output unknown"], Float[np.ndarray, " output"]]:
    """Slopes of what shall become better known, and the values that its bands are relative to."""
    if target in ("curves", "frequency", "damping"):
        measured = np.asarray(fit.motion().displacement)
        at = np.linspace(measured.min(), measured.max(), _TARGETS)
        values, slopes, _ = values_at_displacement(fit, at)
        parts = {"frequency": [0], "damping": [1]}.get(target, [0, 1])
        each = [slopes[:, k] / (2.0 if k == 0 else 1.0) for k in parts]
        return np.concatenate(each), np.concatenate([values[:, k] for k in parts])
    if force is None:
        raise ValueError(f"the target {target!r} needs `target_force`.")
    curves = fitted_response(fit, force)
    points = [p for c in curves for p in (c.resonances if target == "resonance" else c.folds)]
    if not points:
        raise ValueError(f"the fitted response to {force:g} N has no {target}.")
    best = max(points, key=lambda point: point.velocity)
    return point_slopes(fit, force, target, best)[:1], np.array([best.frequency])


def _information(fit: JointFit, states: _States) -> Float[np.ndarray, "state part unknown"]:
    """Whitened slopes of every candidate's balance, by the unknowns and by new levels' errors."""
    n, n_levels = len(states.force), int(states.level.max()) + 1
    std = np.median(np.asarray(fit.data.std), axis=0)
    gain = float(jnp.exp(fit.unknowns.log_force_gain))
    offset = float(fit.unknowns.force_offset) * float(jnp.min(fit.data.force))
    share = np.zeros((n, fit.data.share.shape[1]))
    share[:, fit.data.sensor] = 1.0
    data = BalanceData(
        level=jnp.asarray(states.level),
        frequency=jnp.asarray(states.frequency),
        force=jnp.asarray((states.force - offset) / gain),
        velocity=jnp.asarray(states.velocity * np.exp(1j * float(fit.unknowns.instrument_phase))),
        share=jnp.asarray(share),
        std=jnp.broadcast_to(jnp.asarray(std), (n, len(std))),
        weight=jnp.ones(n),
        correction=no_errors(n),
        n_levels=n_levels,
        sensor=fit.data.sensor,
    )
    vector, restore, own = fit.programmed()
    by_vector, by_level = _slopes(vector, restore, data, fit.modes, fit.spread)
    rows = np.zeros((n, 2, fit.covariance.shape[0] + n_levels * len(LEVEL_ERRORS)))
    rows[:, :, : fit.covariance.shape[0]] = np.asarray(by_vector)[:, :, own]
    for k in range(len(LEVEL_ERRORS)):
        place = fit.covariance.shape[0] + states.level * len(LEVEL_ERRORS) + k
        rows[np.arange(n)[:, None], np.arange(2), place[:, None]] = np.asarray(by_level)[:, :, k]
    return rows


@compiled
def _slopes(
    vector: Array, restore: Restore, data: BalanceData, modes: LinearModes, spread: Spread
) -> tuple[Array, Array]:
    new = jnp.zeros((data.n_levels, len(LEVEL_ERRORS)))

    def unknowns_of(vector: Array, level: Array) -> Unknowns:
        return eqx.tree_at(lambda u: u.level, restore(vector), level)

    weighing = weighing_at(unknowns_of(vector, new), data, modes, spread)

    def residuals(vector: Array, level: Array) -> Array:
        return whitened(unknowns_of(vector, level), data, modes, spread, weighing)

    # The levels of the fit have no part in a new one: their columns come out as zeros.
    by_vector = jax.jacfwd(residuals)(vector, new)
    kinds = new.shape[1]
    directions = jnp.broadcast_to(jnp.eye(kinds)[:, None, :], (kinds, *new.shape))
    by_level = jax.vmap(lambda d: jax.jvp(lambda b: residuals(vector, b), (new,), (d,))[1])
    return by_vector, jnp.moveaxis(by_level(directions), 0, 2)


def _mean_band(slopes: np.ndarray, covariance: np.ndarray) -> float:
    return float(np.mean(np.sqrt(np.einsum("op,pq,oq->o", slopes, covariance, slopes))))


def _best(
    slopes: np.ndarray, covariance: np.ndarray, rows: np.ndarray, wanted: np.ndarray
) -> tuple[int, np.ndarray]:
    """The candidate that leaves the smallest mean band, and the variances that it leaves."""
    index = np.flatnonzero(wanted)
    own = rows[index]
    through = own @ covariance  # (state, part, unknown)
    inner = np.eye(2) + through @ own.transpose(0, 2, 1)
    arms = through @ slopes.T  # (state, part, output)
    gain = np.einsum("sio,sio->so", arms, np.linalg.solve(inner, arms))
    variance = np.einsum("op,pq,oq->o", slopes, covariance, slopes)
    left = np.maximum(variance - gain, 0.0)
    best = int(np.argmin(np.mean(np.sqrt(left), axis=1)))
    return int(index[best]), left[best]


def _reason(
    target: Target, states: _States, best: int, before: np.ndarray, after: np.ndarray
) -> str:
    """Why this state, in words."""
    phase = np.degrees(np.angle(states.velocity[best]))
    side = "below" if phase > 0 else "above"
    place = "at resonance" if abs(phase) < 5 else f"{abs(phase):.0f}° {side} resonance"
    narrowed = 1 - np.sqrt(after / before)
    if target == "curves":
        half = len(before) // 2
        names = ("natural frequency", "damping")
        shares = [float(np.mean(narrowed[:half])), float(np.mean(narrowed[half:]))]
        which = names[int(np.argmax(shares))]
        gain = max(shares)
    else:
        which = {"frequency": "natural frequency"}.get(target, target)
        gain = float(np.mean(narrowed))
    return (
        f"{place}, near {abs(states.velocity[best]):.3g} m/s: narrows the band of {which} by "
        f"{100 * gain:.2g} %"
    )
