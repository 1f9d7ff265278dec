"""Responses that no curve from rest reaches: isolated loops and motions in other wells."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from snrmjax.model.structures import Structure, equilibria, simulated_structure
from snrmjax.numerics.blocks import as_arrays, padded, taken
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, linear_coefficients
from snrmjax.simulate.continuation.continuation import CurveStatus, StepControl, traced
from snrmjax.simulate.continuation.curve_tracing import follow_responses, response_balances
from snrmjax.simulate.continuation.response_curve import FollowedCurve, ResponseCurve, assembled
from snrmjax.simulate.solutions.controlled import phase_controlled
from snrmjax.simulate.solutions.forced_response import (
    DEFAULT_STEPS,
    forced_response,
    solve_at_frequency,
)

_NEAR = 5e-3  # distance in scaled unknowns below which a motion lies on a known curve
Start = tuple[Float[np.ndarray, "coefficient mode"], float]


def isolated_responses(
    model: Structure,
    force: float,
    from_frequency: float,
    to_frequency: float,
    *,
    known: Sequence[ResponseCurve] | None = None,
    starts: Sequence[Start] = (),
    n_starts: int = 128,
    seed: int = 0,
    harmonic_order: int = 9,
    steps: StepControl = DEFAULT_STEPS,
    max_points: int = 4000,
    n_samples: int | None = None,
    stability: bool = True,
) -> list[ResponseCurve]:
    """Search for response curves that are not connected to the one from rest, and follow them.

    Newton's method starts from the motions given (such as settled motions of a time integration,
    from other initial states), from every phase resonance that the force-appropriated backbone has
    at this force (followed to twice the force: the tips of loops are among them), from vibrations
    about every stable equilibrium, and from random amplitudes and phases of the mode of interest
    across the frequency range. Each motion that lies on no known curve is followed both ways,
    around if its curve is closed.

    Arguments: `force` in N, frequencies in rad/s; `known` curves of this force, `forced_response`
    if not given; `starts` as (coefficients in kg^1/2 m, frequency in rad/s).
    Returns one `ResponseCurve` for every further curve; `branch` says how it was found and
    `status` is CLOSED for an isolated loop. A search, not a proof: none found is none found by
    `n_starts` starts.
    Raises `ValueError` for starts of other harmonics than `harmonic_order`.
    """
    model = simulated_structure(model)
    if known is None:
        known = forced_response(
            model,
            [force],
            from_frequency,
            to_frequency,
            harmonic_order=harmonic_order,
            steps=steps,
            max_points=max_points,
            n_samples=n_samples,
            stability=False,
        )
    balances = response_balances([model], np.array([float(force)]), harmonic_order, n_samples)
    balance = as_arrays(taken(balances, 0))
    ends = np.array([from_frequency, to_frequency])
    named = _starts(balance, ends, starts, n_starts, seed)
    points, origins = _solutions(balance, named, ends)
    curves = [_scaled(balance, curve) for curve in known if len(curve.frequency) > 1]
    found = []
    for point, origin in zip(points, origins, strict=True):
        if any(_distance(point, curve) < _NEAR for curve in curves):
            continue
        followed = _both_ways(balances, point, ends, traced(steps), max_points)
        if len(followed.points) < 2:
            continue
        curves.append(followed.points)
        found += assembled(balances, [followed], traced(steps), stability=stability, branch=origin)
    return found


def _starts(
    balance: HarmonicBalance, ends: np.ndarray, given: Sequence[Start], n_starts: int, seed: int
) -> list[tuple[np.ndarray, float, str]]:
    """Coefficients, frequency and origin of every start."""
    model, n = balance.model, balance.n_coefficients
    rows: list[tuple[np.ndarray, float, str]] = []
    for coefficients, frequency in given:
        x = np.asarray(coefficients, dtype=np.float64)
        if x.shape != (n, model.n_modes):
            raise ValueError(
                f"every start must have coefficients of shape {(n, model.n_modes)}, but one has "
                f"{x.shape}."
            )
        rows.append((x, float(frequency), "isolated, from a given start"))
    rows += [(x, w, "isolated, from a phase resonance") for x, w in _phase_resonances(balance)]
    wells = [e for e in equilibria(model) if e.stable]
    rng = np.random.default_rng(seed)
    j, scale = model.modes.mode_of_interest, float(balance.displacement_scale)
    for frequency in np.linspace(ends[0], ends[1], 9)[1:-1]:
        for well in wells:
            x = np.zeros((n, model.n_modes))
            x[0] = well.displacement
            rows.append((x.copy(), float(frequency), "about another equilibrium"))
            linear = linear_coefficients(
                model, balance.force, jnp.asarray(frequency), balance.harmonic_order
            )
            rows.append((x + np.asarray(linear), float(frequency), "about another equilibrium"))
    for k in range(n_starts):
        frequency = rng.uniform(ends[0], ends[1])
        amplitude = scale * 10 ** rng.uniform(-1.5, 0.5)
        # Isolated loops surround the backbone: half of the starts are in phase resonance.
        angle = 0.5 * np.pi if k % 2 else rng.uniform(0, 2 * np.pi)
        x = np.zeros((n, model.n_modes))
        x[0] = wells[k % len(wells)].displacement if wells else 0.0
        x[1, j], x[2, j] = amplitude * np.cos(angle), amplitude * np.sin(angle)
        rows.append((x, float(frequency), "isolated, from a random start"))
    return rows


def _phase_resonances(balance: HarmonicBalance) -> list[Start]:
    """Where the force-appropriated backbone passes this force, however often it turns."""
    force = float(balance.force)
    backbone = phase_controlled(
        balance.model,
        2 * force,
        harmonic_order=balance.harmonic_order,
        n_samples=balance.n_samples,
    )
    beyond = backbone.force > force
    where = np.flatnonzero(beyond[1:] != beyond[:-1])
    share = (force - backbone.force[where]) / np.diff(backbone.force)[where]
    x, omega = backbone.coefficients, backbone.frequency
    between = x[where] + share[:, None, None] * np.diff(x, axis=0)[where]
    frequency = omega[where] + share * np.diff(omega)[where]
    return list(zip(between, frequency.tolist(), strict=True))


def _solutions(
    balance: HarmonicBalance, named: list[tuple[np.ndarray, float, str]], ends: np.ndarray
) -> tuple[list[np.ndarray], list[str]]:
    """Scaled points of the motions that Newton's method reaches inside the range."""
    count = len(named)
    starts = padded(np.stack([row[0] for row in named]))
    frequency = padded(np.array([row[1] for row in named]))
    force = np.full(len(frequency), float(balance.force))
    found, ok = solve_at_frequency(
        *(balance.model, jnp.asarray(force), jnp.asarray(frequency), jnp.asarray(starts)),
        n_samples=balance.n_samples,
    )
    inside = (frequency >= ends[0]) & (frequency <= ends[1])
    good = np.flatnonzero(np.asarray(ok)[:count] & inside[:count])
    x = np.asarray(found)[good].reshape(len(good), -1) / float(balance.displacement_scale)
    omega = frequency[good] / float(balance.frequency_scale)
    points = np.concatenate([x, omega[:, None]], axis=1)
    return list(points), [named[k][2] for k in good]


def _scaled(balance: HarmonicBalance, curve: ResponseCurve) -> np.ndarray:
    x = curve.coefficients.reshape(len(curve.frequency), -1) / float(balance.displacement_scale)
    omega = curve.frequency / float(balance.frequency_scale)
    return np.concatenate([x, omega[:, None]], axis=1)


def _distance(point: np.ndarray, curve: np.ndarray) -> float:
    """Distance of a point from the polyline through a curve's points."""
    begin, step = curve[:-1], np.diff(curve, axis=0)
    square = np.maximum(np.sum(step**2, axis=1), 1e-300)
    share = np.clip(np.sum((point - begin) * step, axis=1) / square, 0.0, 1.0)
    return float(np.min(np.linalg.norm(begin + share[:, None] * step - point, axis=1)))


def _both_ways(
    balances: HarmonicBalance,
    point: np.ndarray,
    ends: np.ndarray,
    steps: StepControl,
    max_points: int,
) -> FollowedCurve:
    """The curve through a point: once around, or from one end to the other."""
    start: Array = jnp.asarray(point)[None]
    ways = []
    for downward in (False, True):
        way = follow_responses(
            balances, jnp.asarray(ends), steps, max_points, downward=downward, starts=start
        )[0]
        ways.append(way)
        if way.status == CurveStatus.CLOSED:
            return way
    up, down = ways
    back = down.reversed()
    solves = up.n_solves + down.n_solves
    if not len(up.points) or not len(back.points):
        whole = up if len(up.points) else back
        return whole._replace(n_solves=solves)
    status = up.status if up.status != CurveStatus.UPPER_END else back.status
    return FollowedCurve(
        np.concatenate([back.points[:-1], up.points]),
        np.concatenate([back.tangents[:-1], up.tangents]),
        status,
        solves,
    )
