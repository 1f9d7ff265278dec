"""Forced responses by harmonic balance: whole curves with folds and resonances."""

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from snrmjax.model.moving_base import newtons
from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.blocks import mapped, on_one_core, taken
from snrmjax.numerics.compiled import compiled, on_numbers
from snrmjax.numerics.lanes import lanes_for
from snrmjax.numerics.newton import correct
from snrmjax.numerics.result import AbstractResult, quantity
from snrmjax.numerics.rules import InputError
from snrmjax.simulate.balance.given_numbers import frequency_range, positive
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, harmonic_balance
from snrmjax.simulate.continuation.continuation import CurveStatus, StepControl, TracedCurve
from snrmjax.simulate.continuation.curve_tracing import response_balances
from snrmjax.simulate.continuation.response_curve import (
    Branch,
    ResponseCurve,
    assembled,
    without_stable_response,
)
from snrmjax.simulate.solutions.branch_switching import add_branches
from snrmjax.simulate.solutions.from_rest import curves_from_rest, curves_where_sweeps_land
from snrmjax.simulate.solutions.subharmonics import subharmonic_orders, subharmonic_responses

DEFAULT_STEPS = StepControl()
_AT_FOLD = 1e-3  # relative distance in frequency of a fold and the last stable point
_WHOLE = (
    *(CurveStatus.UPPER_END, CurveStatus.LOWER_END),
    *(CurveStatus.CLOSED, CurveStatus.BRANCH_POINT),
)


class ResponseSettings(eqx.Module):
    """Settings of forced responses, as the keywords of `forced_response`."""

    harmonic_order: int = eqx.field(static=True, default=9)
    n_samples: int | None = eqx.field(static=True, default=None)  # over a period; None: as needed
    steps: StepControl = DEFAULT_STEPS
    stability: bool = eqx.field(static=True, default=True)  # Floquet multipliers and bifurcations


DEFAULT_SETTINGS = ResponseSettings()


@on_numbers(
    "Call it outside, and differentiate single motions of its curve: "
    "`sj.simulate.periodic_motion`, or `sj.simulate.TrackedMotion` where parameters move "
    "far."
)
@on_one_core
def forced_response(
    model: Structure,
    forces: float | Sequence[float] | Float[ArrayLike, " force"],
    from_frequency: float,
    to_frequency: float,
    *,
    harmonic_order: int = 9,
    n_samples: int | None = None,
    steps: StepControl = DEFAULT_STEPS,
    stability: bool = True,
    subharmonic: int | Sequence[int] = (),
) -> list[ResponseCurve]:
    """Trace the response to a cosine force through a frequency range, for one or more forces.

    Solves m q̈ + d q̇ + k q + ∂V/∂q + Σ f_nl = Φᵀb F Σ s_h cos hΩt by harmonic balance. Starts from
    the linear response at `from_frequency`, or if that fails from the response to a force raised
    from zero, and traces the curve around its folds by pseudo-arclength continuation until it
    leaves the range. Events are located between the steps and inserted with a name in `event`:
    folds ("fold"), peaks of the velocity fundamental at the first sensor ("peak"), phase
    resonances of the mode of interest ("phase_resonance") and, with `stability`, bifurcations
    ("branch_point", "period_doubling", "neimark_sacker").

    Arguments: `forces` in N, one or many; frequencies in rad/s; `n_samples` over a period, by
    default as many as the forces of the model need; `subharmonic` n, or several, also searches for
    motions that repeat after n periods of the force, for example 2 or 3.
    Returns one `ResponseCurve` for every force; its `status` is how it ended, and `not_located`
    names events that were detected but not located, and "branch" if one enters at `to_frequency`
    but has no start there. If the curve from the lower end does not reach the upper one, it is
    traced from the upper end instead, and if that does not reach the lower end either, both parts
    are returned, a part without a start being empty. If a resonance extends beyond
    `to_frequency`, the branch that enters there from the linear response is returned too, and so
    are those from further stable equilibria, from branch points at which a curve loses its
    stability, and where a sweep lands beyond a fold. For isolated branches see
    `isolated_responses`. Subharmonic motions follow as curves of their own with their
    `subharmonic`: those that leave at period doublings (order 2, 4, …) and isolated ones from the
    free oscillation of a mode at Ω/n, each without its copies that are delayed by periods of the
    force. Their `frequency` is that of the force, their coefficients and velocities are those of
    the harmonics of Ω/n, and their multipliers over n periods of the force. A search can miss one.
    Raises `ValueError` for a force that is not positive, for an empty or infinite frequency
    range and for a subharmonic that is no integer of 2 or more.
    Not differentiable: call it outside, and differentiate single motions of its curve:
    `snrmjax.simulate.periodic_motion`, or `snrmjax.simulate.TrackedMotion` where parameters move
    far.

    >>> from snrmjax.model import flat_beam
    >>> curve = forced_response(flat_beam(), [2e-4], 480.0, 520.0, harmonic_order=1)[0]
    >>> curve.status.name, curve.at_events("phase_resonance").size
    ('UPPER_END', 1)
    """
    loads = positive("forces", forces)
    ends = frequency_range(from_frequency, to_frequency)
    orders = subharmonic_orders(subharmonic)
    models = [simulated_structure(model)] * len(loads)
    settings = ResponseSettings(harmonic_order, n_samples, steps, stability)
    curves = _chunk_of_curves(models, loads, ends, settings, alone=len(loads) == 1)
    found: list[ResponseCurve] = []
    for parts in curves:
        found += parts
        for order in orders:
            found += subharmonic_responses(
                models[0], parts, order, ends, steps, n_samples=n_samples, stability=stability
            )
    return found


class ResponseBatch(AbstractResult):
    """Forced responses of many members; NaN if a member has no such point or stopped early."""

    curves: tuple[tuple[ResponseCurve, ...], ...]  # empty without `keep_curves`
    status: Int[np.ndarray, " member"] = quantity(
        "member", "", "how the curve ended", of=CurveStatus
    )
    n_points: Int[np.ndarray, " member"] = quantity("member", "1", "points of the curve")
    peak_frequency: Float[np.ndarray, " member"] = quantity("member", "Hz", "highest peak")
    # Fundamentals at the first sensor.
    peak_velocity: Float[np.ndarray, " member"] = quantity("member", "m/s", "highest peak")
    resonance_frequency: Float[np.ndarray, " member"] = quantity(
        "member", "Hz", "strongest phase resonance"
    )
    resonance_velocity: Float[np.ndarray, " member"] = quantity(
        "member", "m/s", "strongest phase resonance"
    )
    n_folds: Int[np.ndarray, " member"] = quantity("member", "1", "folds of all its curves")
    n_not_located: Int[np.ndarray, " member"] = quantity("member", "1", "events not located")


@on_numbers(
    "Call it outside, and differentiate single motions of its curve: "
    "`sj.simulate.periodic_motion`, or `sj.simulate.TrackedMotion` where parameters move "
    "far."
)
@on_one_core
def forced_response_batch(
    models: Structure | Sequence[Structure],
    forces: float | Sequence[float] | Float[ArrayLike, " member"],
    from_frequency: float,
    to_frequency: float,
    *,
    settings: ResponseSettings = DEFAULT_SETTINGS,
    keep_curves: bool = True,
    chunk: int = 256,
    progress: Callable[[int, int], None] | None = None,
) -> ResponseBatch:
    """Forced responses of many models, forces or both, over all cores or on an accelerator.

    Every member equals the result of `forced_response` to rounding and does not depend on the other
    members. Several members are traced in parallel, on every core. Other values, or more members,
    do not recompile. Memory is bounded by `chunk`, the number of members traced at a time, in
    addition to the curves that are kept.

    Arguments: `models` one or many, with the same modes, monomials and effects; `forces` in N,
    one or many; frequencies in rad/s; `progress` is called with the members done and their total.
    Returns a `ResponseBatch`. A member that fails has its status, and NaN values; the others are
    not affected. Raises `ValueError` when the numbers of models and forces disagree, for models of
    different kinds and for an empty or infinite frequency range.
    Not differentiable: call it outside, and differentiate single motions of its curve:
    `snrmjax.simulate.periodic_motion`, or `snrmjax.simulate.TrackedMotion` where parameters move
    far.
    """
    ends = frequency_range(from_frequency, to_frequency)
    members, loads = _paired(models, forces)
    # Repeated models are one object: each is expanded only once.
    expanded = {id(m): simulated_structure(m) for m in members}
    rows: list[tuple[ResponseCurve, ...]] = []
    summaries = []
    for begin in range(0, len(members), chunk):
        some = [expanded[id(m)] for m in members[begin : begin + chunk]]
        chunk_curves = _chunk_of_curves(some, loads[begin : begin + chunk], ends, settings)
        summaries += [_summary(parts) for parts in chunk_curves]
        rows += chunk_curves if keep_curves else []
        if progress is not None:
            progress(min(begin + chunk, len(members)), len(members))
    names = [field.name for field in dataclasses.fields(ResponseBatch)][1:]
    columns = {name: np.array([summary[name] for summary in summaries]) for name in names}
    return ResponseBatch(**columns, curves=tuple(rows))


def _paired(
    models: Structure | Sequence[Structure], forces: ArrayLike | Sequence[float]
) -> tuple[list[Structure], np.ndarray]:
    loads = np.atleast_1d(np.asarray(forces, dtype=np.float64))
    members = [models] if isinstance(models, Structure) else list(models)
    if len(members) == 1:
        members = members * len(loads)
    if len(loads) == 1:
        loads = np.repeat(loads, len(members))
    if len(members) != len(loads):
        raise InputError(
            f"`models` and `forces` must be as many, or one, but are {len(members)} and "
            f"{len(loads)}."
        )
    return members, loads


def _summary(parts: tuple[ResponseCurve, ...]) -> dict[str, float]:
    """The numbers of one member, as in `ResponseBatch`; NaN if a curve stopped early."""
    stopped = [part.status for part in parts if part.status not in _WHOLE]
    best = {"peak": (np.nan, np.nan), "phase_resonance": (np.nan, np.nan)}
    whole = () if stopped else parts
    for part in whole:
        for kind, (_, height) in list(best.items()):
            for k in part.at_events(kind):
                velocity = float(np.abs(part.velocity[k, 1, 0]))
                if not velocity <= height:
                    best[kind], height = (float(part.frequency[k]), velocity), velocity
    n_not_located = sum(len(part.not_located) for part in parts)
    if has_higher_point(whole, best["peak"][1]):
        best["peak"], n_not_located = (np.nan, np.nan), n_not_located + 1
    return {
        # A second branch that stopped early also makes the member fail.
        "status": int(stopped[0] if stopped else parts[0].status),
        "n_points": sum(len(part.frequency) for part in parts),
        "peak_frequency": best["peak"][0],
        "peak_velocity": best["peak"][1],
        "resonance_frequency": best["phase_resonance"][0],
        "resonance_velocity": best["phase_resonance"][1],
        "n_folds": sum(part.at_events("fold").size for part in whole),
        "n_not_located": n_not_located,
    }


def has_higher_point(parts: Sequence[ResponseCurve], peak: float) -> bool:
    """Whether the largest point of a curve is inside its range and higher than any located peak.

    Then a peak was not located. Arguments: `peak` is the highest located velocity (m/s), or NaN.
    """
    for part in parts:
        speed = np.abs(part.velocity[:, 1, 0])
        k = int(np.argmax(speed)) if len(speed) else 0
        inside = 0 < k < len(speed) - 1
        if inside and not speed[k] <= peak * (1 + 1e-6):
            return True
    return False


def _chunk_of_curves(
    models: list[Structure],
    forces: np.ndarray,
    ends: np.ndarray,
    settings: ResponseSettings,
    *,
    alone: bool = False,
) -> list[tuple[ResponseCurve, ...]]:
    leaves = {id(m): jax.tree.leaves(m) for m in models}
    finite = {k: all(np.all(np.isfinite(np.asarray(a))) for a in v) for k, v in leaves.items()}
    valid = np.isfinite(forces) & (forces > 0) & np.array([finite[id(m)] for m in models])
    good = np.flatnonzero(valid).tolist()
    results: list[list[ResponseCurve]] = [[] for _ in models]
    for k in np.flatnonzero(~valid).tolist():
        results[k].append(_no_curve(models[k], float(forces[k]), settings.harmonic_order))
    if not good:
        return [tuple(curves) for curves in results]
    some = [models[k] for k in good]
    balances = response_balances(
        some, forces[good], settings.harmonic_order, settings.n_samples, ends
    )
    lanes = 1 if alone else lanes_for(balances.size + 1)
    from_rest = curves_from_rest(some, balances, ends, settings.steps, lanes)
    owner = [k for k, one in enumerate(from_rest) for _ in one.curves]
    parts = [curve for one in from_rest for curve in one.curves]
    branches = [branch for one in from_rest for branch in one.branches]
    responses = assembled(
        taken(balances, np.array(owner)), parts, settings.steps, stability=settings.stability
    )
    for k, branch, response in zip(owner, branches, responses, strict=True):
        results[good[k]].append(dataclasses.replace(response, branch=branch))
    for i, (k, one) in enumerate(zip(good, from_rest, strict=True)):
        _add_where_sweeps_go(results[k], one.curves, balances, i, ends, settings.steps)
        if one.has_no_start:
            first = results[k][0]
            missed = (*first.not_located, "branch")
            results[k][0] = dataclasses.replace(first, not_located=missed)
    return [tuple(curves) for curves in results]


def _add_where_sweeps_go(
    curves: list[ResponseCurve],
    traced: Sequence[TracedCurve],
    balances: HarmonicBalance,
    member: int,
    ends: Float[np.ndarray, " end"],
    steps: StepControl,
) -> None:
    """Add curves on which a sweep goes on beyond branch points and folds of a member's curves."""

    known = [one.points for one in traced]
    add_branches(curves, known, balances, member, ends, steps)
    folds = _left_folds(curves, ends)
    new = curves_where_sweeps_land(balances, member, known, folds, ends, steps) if folds else []
    if new:
        own = taken(balances, np.full(len(new), member))
        landed = assembled(own, new, steps, branch=Branch.LANDING)
        curves.extend(curve for curve in landed if np.any(curve.is_stable))


def _left_folds(
    curves: Sequence[ResponseCurve], ends: Float[np.ndarray, " end"]
) -> list[tuple[float, float]]:
    """Folds next to a range without stable points, and the other end of that range (rad/s)."""
    at = np.concatenate([curve.frequency[curve.at_events("fold")] for curve in curves])
    return [
        (edge, other)
        for first, last in without_stable_response(curves, *ends)
        for edge, other in ((first, last), (last, first))
        if np.any(np.isclose(edge, at, rtol=_AT_FOLD))
    ]


def _no_curve(model: Structure, force: float, harmonic_order: int) -> ResponseCurve:
    sensors = model.modes.sensors
    return ResponseCurve(
        frequency=np.zeros(0),
        coefficients=np.zeros((0, 2 * harmonic_order + 1, model.n_modes)),
        velocity=np.zeros((0, harmonic_order + 1, len(sensors)), dtype=np.complex128),
        status=CurveStatus.INVALID,
        sensors=sensors,
        base=model.modes.base,
        unbalance=None if model.modes.unbalance is None else float(model.modes.unbalance),
        force=force,
        event=(),
    )


@on_one_core
def solve_at_frequency(
    model: Structure,
    force: float | Float[ArrayLike, "*state"],
    frequency: float | Float[ArrayLike, "*state"],
    start: Float[ArrayLike, "state coefficient mode"],
    *,
    n_samples: int | None = None,
) -> tuple[Float[Array, "state coefficient mode"], Bool[Array, " state"]]:
    """Solve for periodic motions at given forces (N) and frequencies (rad/s), from guesses.

    Arguments: `force` and `frequency` of each state, or one of all states; `start` the Fourier
    coefficients of the guesses in kg^1/2 m.
    Returns the Fourier coefficients (kg^1/2 m), NaN if Newton's method did not converge, and
    whether it did. For `jax.jit` and `jax.vmap`; differentiable in forward mode (`jax.jvp`) only:
    for `jax.grad` use `periodic_motion`.
    """
    guesses = jnp.asarray(start, dtype=jnp.float64)
    loads, speeds = (
        jnp.broadcast_to(jnp.asarray(part, dtype=jnp.float64), guesses.shape[:1])
        for part in (force, frequency)
    )
    coefficients, converged = _solve_batch(
        simulated_structure(model), loads, speeds, guesses, n_samples
    )
    return jnp.where(converged[:, None, None], coefficients, jnp.nan), converged


@compiled
def _solve_batch(
    model: Structure, force: Array, frequency: Array, start: Array, n_samples: int | None
) -> tuple:
    harmonic_order = (start.shape[1] - 1) // 2

    def solved(force: Array, frequency: Array, start: Array) -> tuple[Array, Array]:
        # With the static displacement the unknowns are of order one for a guess of zero too.
        static = newtons(model.modes.unbalance, frequency, force) * model.modes.participation
        squared = model.modes.natural_frequency**2
        static = jnp.where(squared > 0, static / jnp.where(squared > 0, squared, 1.0), 0.0)
        scale = jnp.maximum(jnp.max(jnp.abs(start)), jnp.max(jnp.abs(static)))
        balance = harmonic_balance(
            model, force, scale, harmonic_order=harmonic_order, n_samples=n_samples
        )
        guess = balance.point(start, frequency)
        fixed = jnp.zeros_like(guess).at[-1].set(1.0)
        end = correct(balance.linearised, guess, fixed)
        return balance.coefficients(end.point), end.converged

    return mapped(solved, force, frequency, start)
