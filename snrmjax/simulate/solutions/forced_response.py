"""Forced responses by harmonic balance: whole curves, folds and resonances included."""

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from snrmjax.model.modes import STILL
from snrmjax.model.moving_base import newtons
from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.blocks import mapped, taken
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.lanes import lanes_for
from snrmjax.numerics.result import AbstractResult, quantity
from snrmjax.simulate.balance.given_numbers import frequency_range, positive
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, harmonic_balance
from snrmjax.simulate.continuation.continuation import CurveStatus, StepControl, TracedCurve
from snrmjax.simulate.continuation.curve_tracing import response_balances, trace_from_rest
from snrmjax.simulate.continuation.newton import correct
from snrmjax.simulate.continuation.response_curve import ResponseCurve, assembled

DEFAULT_STEPS = StepControl()
_WHOLE = (CurveStatus.UPPER_END, CurveStatus.LOWER_END, CurveStatus.CLOSED)


class ResponseSettings(eqx.Module):
    """How forced responses are computed: as `forced_response` has them one by one."""

    harmonic_order: int = eqx.field(static=True, default=9)
    n_samples: int | None = eqx.field(static=True, default=None)  # over a period; None: as needed
    steps: StepControl = DEFAULT_STEPS
    stability: bool = eqx.field(static=True, default=True)  # Floquet multipliers and bifurcations


DEFAULT_SETTINGS = ResponseSettings()


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
) -> list[ResponseCurve]:
    """Trace the response to a cosine force through a frequency range, once for every force.

    Solves m q̈ + d q̇ + k q + ∂V/∂q + Σ effects = Φᵀb F Σ s_h cos hΩt by harmonic balance. Starts
    from the linear response at `from_frequency`, or where that leads nowhere from the
    response to a force that rises from zero, and traces the curve around its folds by
    pseudo-arclength continuation until it leaves the range. Located between the steps and
    inserted with a name in `event` are folds ("fold"), peaks of the velocity fundamental at the
    first sensor ("peak"), phase resonances of the mode of interest ("phase_resonance") and, with
    `stability`, bifurcations ("branch_point", "period_doubling", "neimark_sacker").

    Arguments: `forces` in N, one or many; frequencies in rad/s; `n_samples` over a period, by
    default as many as the forces of the model need.
    Returns one `ResponseCurve` for every force; its `status` says how it ended, and
    `not_located` names events that are there but were not located, and with "branch" one that
    comes in at `to_frequency` but has no start there. When the curve
    from the lower end does not reach the upper one, it is traced from the upper end instead,
    and when that does not reach the lower end either, both parts are returned, a part without a
    start being empty. Where a resonance reaches beyond `to_frequency`, the branch that comes in
    there from the linear response is returned too. Isolated branches and second wells:
    `isolated_responses`.
    Raises `ValueError` for a force that is not positive and for an empty or endless frequency
    range.

    >>> from snrmjax.model import flat_beam
    >>> curve = forced_response(flat_beam(), [2e-4], 480.0, 520.0, harmonic_order=1)[0]
    >>> curve.status.name, curve.at_events("phase_resonance").size
    ('UPPER_END', 1)
    """
    loads = positive("forces", forces)
    ends = frequency_range(from_frequency, to_frequency)
    models = [simulated_structure(model)] * len(loads)
    settings = ResponseSettings(harmonic_order, n_samples, steps, stability)
    found = _chunk_of_curves(models, loads, ends, settings, alone=len(loads) == 1)
    return [part for parts in found for part in parts]


class ResponseBatch(AbstractResult):
    """Forced responses of many members; NaN where a member has no such point."""

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
    n_folds: Int[np.ndarray, " member"] = quantity("member", "1", "folds")
    n_not_located: Int[np.ndarray, " member"] = quantity("member", "1", "events not located")


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

    Every member is what `forced_response` gives, to rounding; its digits do not depend on the other
    members. Several members are traced side by side, on every core. Other numbers, or more
    members, do not compile anew. Memory is bounded by `chunk`, the members at
    work at a time, beside the curves that are kept.

    Arguments: `models` one or many, with the same modes, monomials and effects; `forces` in N,
    one or many; frequencies in rad/s. `progress` is called with the members done and all of them.
    Returns a `ResponseBatch`. A member that fails has its status, and NaN in its values; the
    others are untouched. Raises `ValueError` when the numbers of models and forces disagree, for
    models of different kinds and for an empty or endless frequency range.
    """
    ends = frequency_range(from_frequency, to_frequency)
    members, loads = _paired(models, forces)
    # Which rows of one object are many times the same model is known before it is expanded.
    expanded = {id(m): simulated_structure(m) for m in members}
    rows: list[tuple[ResponseCurve, ...]] = []
    summaries = []
    for begin in range(0, len(members), chunk):
        some = [expanded[id(m)] for m in members[begin : begin + chunk]]
        found = _chunk_of_curves(some, loads[begin : begin + chunk], ends, settings)
        summaries += [_summary(parts) for parts in found]
        rows += found if keep_curves else []
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
        raise ValueError(
            f"`models` and `forces` must be as many, or one, but are {len(members)} and "
            f"{len(loads)}."
        )
    return members, loads


def _summary(parts: tuple[ResponseCurve, ...]) -> dict[str, float]:
    """The numbers of one member, named as in `ResponseBatch`."""
    best = {"peak": (np.nan, np.nan), "phase_resonance": (np.nan, np.nan)}
    for part in parts:
        for kind, (_, height) in list(best.items()):
            for k in part.at_events(kind):
                velocity = float(np.abs(part.velocity[k, 1, 0]))
                if not velocity <= height:
                    best[kind], height = (float(part.frequency[k]), velocity), velocity
    n_not_located = sum(len(part.not_located) for part in parts)
    if has_higher_point(parts, best["peak"][1]):
        best["peak"], n_not_located = (np.nan, np.nan), n_not_located + 1
    # A second branch that stopped early is the member's failure too.
    stopped = [part.status for part in parts if part.status not in _WHOLE]
    return {
        "status": int(stopped[0] if stopped else parts[0].status),
        "n_points": sum(len(part.frequency) for part in parts),
        "peak_frequency": best["peak"][0],
        "peak_velocity": best["peak"][1],
        "resonance_frequency": best["phase_resonance"][0],
        "resonance_velocity": best["phase_resonance"][1],
        "n_folds": sum(part.at_events("fold").size for part in parts),
        "n_not_located": n_not_located,
    }


def has_higher_point(parts: Sequence[ResponseCurve], peak: float) -> bool:
    """Whether curves are highest between their ends, and higher than the highest `peak` of them.

    That is the velocity (m/s), NaN where there is none. A peak is there then that was not located.
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
    balances = response_balances(
        [models[k] for k in good], forces[good], settings.harmonic_order, settings.n_samples, ends
    )
    walk = (ends, settings.steps, 1 if alone else lanes_for(balances.size + 1))
    upward = trace_from_rest(balances, np.arange(len(good)), *walk, downward=False)

    def ends_well(k: int) -> bool:
        curve = upward[k]
        reached = curve.status == CurveStatus.UPPER_END
        return reached and _ends_near_rest(balances, k, curve)

    # Below a strong softening the lower end has several solutions and the upper end has one; and
    # where a resonance reaches beyond the upper end, another branch comes in there.
    doubtful = [k for k in range(len(good)) if not ends_well(k)]
    found = trace_from_rest(balances, np.array(doubtful, dtype=int), *walk, downward=True)
    downward = dict(zip(doubtful, found, strict=True))
    # Beside a superharmonic resonance the linear response is no start: let the force rise.
    lost = [
        k
        for k, back in downward.items()
        if upward[k].status == CurveStatus.NO_START and back.status != CurveStatus.LOWER_END
    ]
    again = trace_from_rest(balances, np.array(lost, dtype=int), *walk, downward=False, ramp=True)
    for k, curve in zip(lost, again, strict=True):
        upward[k] = curve
        if ends_well(k):
            del downward[k]
    owner: list[int] = []
    without_branch: list[int] = []
    parts: list[TracedCurve] = []
    for k, curve in enumerate(upward):
        pieces = [curve]
        if k in downward:
            back = downward[k]
            if curve.status == CurveStatus.UPPER_END:
                started = len(back.points) > 0
                known = started and _same_point(back.points[0], curve.points[-1])
                pieces = [curve, back] if started and not known else [curve]
                without_branch += [] if started else [good[k]]
            else:
                whole = back.status == CurveStatus.LOWER_END
                pieces = [back.reversed()] if whole else [curve, back.reversed()]
        owner += [k] * len(pieces)
        parts += pieces
    responses = assembled(
        taken(balances, np.array(owner)), parts, settings.steps, stability=settings.stability
    )
    for k, response in zip(owner, responses, strict=True):
        results[good[k]].append(response)
    for k in without_branch:
        first = results[k][0]
        missed = (*first.not_located, "branch")
        results[k][0] = dataclasses.replace(first, not_located=missed)
    return [tuple(curves) for curves in results]


def _ends_near_rest(balances: HarmonicBalance, member: int, curve: TracedCurve) -> bool:
    """Whether a curve's last point is about the linear response there: then it is alone."""
    modes, j = balances.model.modes, balances.model.modes.mode_of_interest
    drive = np.asarray(modes.participation)[member]
    own = np.abs(drive[j]) > STILL * np.max(np.abs(drive))
    some = [j] if own else np.flatnonzero(drive)
    natural, damping = (
        np.asarray(part)[member, some] for part in (modes.natural_frequency, modes.damping_ratio)
    )
    omega = float(curve.points[-1, -1] * balances.frequency_scale[member])
    force = newtons(taken(modes, member).unbalance, omega, float(balances.force[member]))
    load = force * drive[some]
    linear = load / (natural**2 - omega**2 + 2j * damping * natural * omega)
    x = curve.points[-1, :-1].reshape(balances.n_coefficients, -1)[1:3, some]
    last = (x[0] - 1j * x[1]) * float(balances.displacement_scale[member])
    return bool(np.linalg.norm(last - linear) < 0.5 * np.linalg.norm(linear))


def _same_point(first: np.ndarray, second: np.ndarray) -> bool:
    return bool(np.max(np.abs(first - second)) < 1e-5)


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


def solve_at_frequency(
    model: Structure,
    force: float | Float[ArrayLike, "*state"],
    frequency: float | Float[ArrayLike, "*state"],
    start: Float[ArrayLike, "state coefficient mode"],
    *,
    n_samples: int | None = None,
) -> tuple[Float[Array, "state coefficient mode"], Bool[Array, " state"]]:
    """Periodic motions at given forces (N) and frequencies (rad/s), each from its own guess.

    Arguments: `force` and `frequency` of each state, or one of all states; `start` the Fourier
    coefficients of the guesses in kg^1/2 m.
    Returns the Fourier coefficients (kg^1/2 m), NaN where Newton's method did not converge, and
    whether it did.
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
        # A guess of zero is allowed: the static displacement keeps the unknowns of order one.
        static = newtons(model.modes.unbalance, frequency, force) * model.modes.participation
        squared = model.modes.natural_frequency**2
        static = jnp.where(squared > 0, static / jnp.where(squared > 0, squared, 1.0), 0.0)
        scale = jnp.maximum(jnp.max(jnp.abs(start)), jnp.max(jnp.abs(static)))
        balance = harmonic_balance(
            model, force, scale, harmonic_order=harmonic_order, n_samples=n_samples
        )
        guess = balance.point(start, frequency)
        fixed = jnp.zeros_like(guess).at[-1].set(1.0)
        found = correct(balance.linearised, guess, fixed, 1e-10, 30)
        return balance.coefficients(found.point), found.converged

    return mapped(solved, force, frequency, start)
