"""Subharmonic responses: motions that repeat after several periods of the force.

They are solutions of the harmonic balance with the fundamental Ω/n, whose harmonic n the force
drives. One is reached where a response doubles its period; one that is isolated is found from the
free oscillation of a mode at Ω/n, locked in phase with the force. A motion delayed by a period of
the force is a solution too: of these n copies one is returned.
"""

import dataclasses
from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.blocks import as_arrays, taken
from snrmjax.numerics.rules import InputError
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance
from snrmjax.simulate.continuation.continuation import CurveEvent, StepControl, TracedCurve
from snrmjax.simulate.continuation.curve_tracing import (
    lies_on,
    response_balances,
    trace_both_ways,
)
from snrmjax.simulate.continuation.response_curve import Branch, ResponseCurve, assembled
from snrmjax.simulate.solutions.branch_switching import (
    corrected,
    from_branch_points,
    with_named_ends,
)
from snrmjax.simulate.solutions.normal_modes import free_oscillations

_FREQUENCIES, _PHASES = 12, 4  # of the starts from a mode's free oscillation
_REACH = 2.0  # ratio of frequencies to which the free oscillation of a mode is followed
_SUBHARMONIC = 1e-3  # least fraction of a motion in the harmonics that are not those of the force


def subharmonic_orders(given: int | Sequence[int]) -> tuple[int, ...]:
    """The different numbers of periods, each once; `ValueError` for what is none."""
    several = np.atleast_1d(np.asarray(given, dtype=float)).tolist()
    for order in several:
        if order != int(order) or order < 2:
            raise InputError(f"`subharmonic` must be an integer of 2 or more, but is {order:g}.")
    return tuple(dict.fromkeys(int(order) for order in several))


def subharmonic_responses(
    model: Structure,
    known: Sequence[ResponseCurve],
    order: int,
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
    *,
    n_samples: int | None = None,
    stability: bool = True,
) -> list[ResponseCurve]:
    """Responses to one force that repeat after `order` periods of it, in a range of frequencies.

    For an even order the branches that leave at the period doublings of responses with half the
    period; for every order those through motions on which Newton's method converges from the free
    oscillation of a mode at Ω/n, superposed on the known response at Ω, with 4 phases at each of 12
    frequencies. The search is not a proof that there are no others.

    Arguments: `known` responses with the period of the force, of `forced_response`; `ends` in
    rad/s.
    """
    known = [curve for curve in known if len(curve.frequency) > 1]
    if not known:
        return []
    model, harmonics = simulated_structure(model), (known[0].coefficients.shape[1] - 1) // 2
    (load,) = {curve.force for curve in known}
    samples = None if n_samples is None else order * n_samples
    balances = response_balances([model], np.array([load]), order * harmonics, samples, ends)
    balances = dataclasses.replace(
        balances, subharmonic=order, frequency_scale=balances.frequency_scale / order
    )
    half: Sequence[ResponseCurve] = known if order == 2 else ()
    if order > 2 and order % 2 == 0:
        half = subharmonic_responses(
            model, known, order // 2, ends, steps, n_samples=n_samples, stability=stability
        )
    found = _doubled(balances, half, ends / order, steps)
    starts = list(_starts(model, known, order, ends))
    if starts:
        scale = max(np.max(np.abs(coefficients)) for coefficients, _ in starts)
        balances = dataclasses.replace(balances, displacement_scale=jnp.array([scale]))
    traced = _isolated(balances, starts, found, ends / order, steps)
    return found + assembled(
        taken(balances, np.zeros(len(traced), dtype=int)),
        traced,
        steps,
        stability=stability,
        branch=Branch.FREE_OSCILLATION,
    )


def _doubled(
    balances: HarmonicBalance,
    curves: Sequence[ResponseCurve],
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
) -> list[ResponseCurve]:
    """Branches of twice the period from the period doublings of curves.

    In the balance with twice the period a period doubling is a branch point.
    """
    balance: HarmonicBalance = as_arrays(taken(balances, 0))
    found: list[TracedCurve] = []
    known = [_points(balance, curve) for curve in curves]
    for curve in curves:
        at_doublings = dataclasses.replace(
            curve,
            coefficients=_repeated(curve.coefficients, 2),
            subharmonic=2 * curve.subharmonic,
            event=tuple(
                CurveEvent.BRANCH_POINT if event == CurveEvent.PERIOD_DOUBLING else CurveEvent.NONE
                for event in curve.event
            ),
        )
        for piece in from_branch_points(
            balances, 0, at_doublings, known, ends, steps, unstable_too=True
        ):
            middle = piece.points[len(piece.points) // 2]
            if not any(_is_copy(balance, middle, points) for points in known):
                known.append(piece.points)
                found.append(piece)
    own = taken(balances, np.zeros(len(found), dtype=int))
    branches = assembled(own, found, steps, branch=Branch.PERIOD_DOUBLING)
    ends = ends * balance.subharmonic
    return [with_named_ends(one, ends, CurveEvent.PERIOD_DOUBLING) for one in branches]


def _starts(
    model: Structure,
    known: Sequence[ResponseCurve],
    order: int,
    ends: Float[np.ndarray, " end"],
) -> Iterator[tuple[Float[np.ndarray, "coefficient mode"], float]]:
    """Coefficients and frequencies (rad/s) of the force: free oscillations on known motions."""
    natural, (lower, upper) = np.asarray(model.modes.natural_frequency), ends / order
    harmonics = (known[0].coefficients.shape[1] - 1) // 2
    near = (natural > lower / _REACH) & (natural < upper * _REACH)
    for mode in np.flatnonzero(near).tolist():
        omega = float(natural[mode])
        within = min(lower, omega / _REACH), max(upper, omega * _REACH)
        motions, frequency = free_oscillations(model, mode, within, harmonics)
        begin, end = max(lower, frequency.min()), min(upper, frequency.max())
        if not begin < end:
            continue
        for own in np.linspace(begin, end, _FREQUENCIES + 2)[1:-1].tolist():
            free = [_widened(x, order) for x in _at_frequency(motions, frequency, own)]
            forced = [
                _repeated(x, order)
                for curve in known
                for x in _at_frequency(curve.coefficients, curve.frequency, order * own)
            ]
            angles = 2 * np.pi / (order * _PHASES) * np.arange(_PHASES)
            for one in free:
                for other in forced:
                    for angle in angles.tolist():
                        yield _shifted(one, angle) + other, order * own


def _isolated(
    balances: HarmonicBalance,
    starts: Sequence[tuple[np.ndarray, float]],
    found: Sequence[ResponseCurve],
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
) -> list[TracedCurve]:
    """Curves through the subharmonic motions on which Newton's method converges from the starts."""
    balance: HarmonicBalance = as_arrays(taken(balances, 0))
    curves: list[TracedCurve] = []
    known = [_points(balance, curve) for curve in found]
    at_frequency = np.append(np.zeros(balance.size), 1.0)
    for coefficients, frequency in starts:
        own = jnp.asarray(frequency / balance.subharmonic)
        start = np.asarray(balance.point(jnp.asarray(coefficients), own))
        trial = corrected(balance, start, at_frequency)
        point = np.asarray(trial.point)
        if not trial.converged or not _is_subharmonic(balance, point):
            continue
        if any(_is_copy(balance, point, points) for points in known):
            continue
        curve = trace_both_ways(balances, point, ends, steps)
        if len(curve.points) > 1:
            known.append(curve.points)
            curves.append(curve)
    return curves


def _is_subharmonic(balance: HarmonicBalance, point: Float[np.ndarray, " unknown"]) -> bool:
    """Whether a scaled motion has no shorter period than that of its balance."""
    n = balance.subharmonic
    power = np.sum(point[:-1].reshape(balance.n_coefficients, -1) ** 2, axis=1)
    orders = np.repeat(np.arange(balance.harmonic_order + 1), 2)[1:]
    shorter = [p for p in range(2, n + 1) if n % p == 0]
    least = min(np.sum(power[orders % p != 0]) for p in shorter)
    return bool(least > _SUBHARMONIC**2 * np.sum(power))


def _is_copy(
    balance: HarmonicBalance,
    point: Float[np.ndarray, " unknown"],
    curve: Float[np.ndarray, "point unknown"],
) -> bool:
    """Whether a scaled motion is on a curve, perhaps delayed by periods of the force."""
    rows = point[:-1].reshape(balance.n_coefficients, -1)
    angles = 2 * np.pi / balance.subharmonic * np.arange(balance.subharmonic)
    return any(
        lies_on(np.append(_shifted(rows, angle).ravel(), point[-1]), curve)
        for angle in angles.tolist()
    )


def _points(balance: HarmonicBalance, curve: ResponseCurve) -> Float[np.ndarray, "point unknown"]:
    """Scaled points of a curve in a balance over as many periods, or over a multiple of them."""
    n = balance.subharmonic
    rows = _repeated(curve.coefficients, n // curve.subharmonic).reshape(len(curve.frequency), -1)
    omega = curve.frequency / (n * float(balance.frequency_scale))
    return np.column_stack([rows / float(balance.displacement_scale), omega])


def _at_frequency(
    motions: Float[np.ndarray, "point coefficient mode"],
    frequency: Float[np.ndarray, " point"],
    value: float,
) -> list[Float[np.ndarray, "coefficient mode"]]:
    """The motions where a curve crosses a frequency, interpolated."""
    beyond = frequency > value
    k = np.flatnonzero(beyond[1:] != beyond[:-1])
    fraction = (value - frequency[k]) / (frequency[k + 1] - frequency[k])
    return list(motions[k] + fraction[:, None, None] * (motions[k + 1] - motions[k]))


def _repeated(
    coefficients: Float[np.ndarray, "*point coefficient mode"], times: int
) -> Float[np.ndarray, "*point wide mode"]:
    """Coefficients of a motion over several of its periods: harmonic h becomes times·h."""
    wide = _widened(np.zeros_like(coefficients), times)
    wide[..., 0, :] = coefficients[..., 0, :]
    for part in (-1, 0):
        wide[..., 2 * times + part :: 2 * times, :] = coefficients[..., 2 + part :: 2, :]
    return wide


def _widened(
    coefficients: Float[np.ndarray, "*point coefficient mode"], times: int
) -> Float[np.ndarray, "*point wide mode"]:
    """Coefficients with zeros for as many times more harmonics."""
    missing = (times - 1) * (coefficients.shape[-2] - 1)
    return np.concatenate(
        [coefficients, np.zeros((*coefficients.shape[:-2], missing, coefficients.shape[-1]))],
        axis=-2,
    )


def _shifted(
    coefficients: Float[np.ndarray, "coefficient mode"], angle: float
) -> Float[np.ndarray, "coefficient mode"]:
    """Coefficients of q(τ + angle)."""
    cosines, sines = coefficients[1::2], coefficients[2::2]
    turns = angle * np.arange(1, len(cosines) + 1)[:, None]
    shifted = coefficients.copy()
    shifted[1::2] = np.cos(turns) * cosines + np.sin(turns) * sines
    shifted[2::2] = np.cos(turns) * sines - np.sin(turns) * cosines
    return shifted
