"""Responses not connected to the one from rest: isolated loops, motions in other wells."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from snrmjax.model.structures import Structure, equilibria, simulated_structure
from snrmjax.numerics.blocks import as_arrays, on_one_core, padded, taken
from snrmjax.numerics.compiled import on_numbers
from snrmjax.numerics.result import AbstractResult, Variable, setting
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.balance.given_numbers import frequency_range, positive
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, linear_coefficients
from snrmjax.simulate.continuation.continuation import CurveStatus
from snrmjax.simulate.continuation.curve_tracing import (
    lies_on,
    response_balances,
    trace_both_ways,
)
from snrmjax.simulate.continuation.response_curve import Branch, ResponseCurve, assembled
from snrmjax.simulate.solutions.branch_switching import add_branches
from snrmjax.simulate.solutions.controlled import phase_controlled
from snrmjax.simulate.solutions.forced_response import (
    DEFAULT_SETTINGS,
    ResponseSettings,
    forced_response_batch,
    solve_at_frequency,
)

Start = tuple[Float[np.ndarray, "coefficient mode"], float]


class IsolatedSearch(eqx.Module):
    """Starts of `isolated_responses` in addition to phase resonances and equilibria."""

    starts: Sequence[Start] = ()  # (coefficients in kg^1/2 m, frequency in rad/s)
    n_starts: int = 128  # random amplitudes and phases of the mode of interest
    seed: int = 0  # of the random starts


DEFAULT_SEARCH = IsolatedSearch()


class IsolatedResponses(AbstractResult):
    """Response curves apart from the one from rest, and the outcome of the starts.

    A sequence of the curves: it has a length, can be indexed and iterated.
    """

    curves: tuple[ResponseCurve, ...]
    force: float = setting()  # N
    n_starts: int = setting()
    n_failed: int = setting()  # starts from which Newton's method did not converge
    n_known: int = setting()  # motions outside the range, or on a known curve
    n_not_traced: int = setting()  # motions off known curves through which no curve could be traced
    # Of the force-appropriated backbone; UPPER_END when it is complete.
    backbone_status: CurveStatus = setting()

    def __len__(self) -> int:
        return len(self.curves)

    def __iter__(self) -> Iterator[ResponseCurve]:
        return iter(self.curves)

    def __getitem__(self, k: int) -> ResponseCurve:
        return self.curves[k]

    def variables(self) -> dict[str, Variable]:
        """One entry per curve: how it was found, its range and status."""
        rows = [
            (
                *(c.branch, c.status.name.lower(), len(c.frequency)),
                *(c.frequency.min() / HERTZ, c.frequency.max() / HERTZ),
                np.abs(c.velocity[:, 1, 0]).max(),
            )
            for c in self.curves
        ]
        columns = {
            "branch": ("", "how the curve was found", str),
            "status": ("", "how it ended", str),
            "n_points": ("1", "points", int),
            "lowest_frequency_hz": ("Hz", "lowest frequency", float),
            "highest_frequency_hz": ("Hz", "highest frequency", float),
            "velocity_m_s": ("m/s", "largest velocity, at the first sensor", float),
        }
        return {
            name: Variable(("curve",), np.array([row[k] for row in rows], dtype=kind), unit, text)
            for k, (name, (unit, text, kind)) in enumerate(columns.items())
        }


@on_numbers(
    "Call it outside, and differentiate single motions of its curve: "
    "`sj.simulate.periodic_motion`, or `sj.simulate.TrackedMotion` where parameters move "
    "far."
)
@on_one_core
def isolated_responses(
    model: Structure,
    force: float,
    from_frequency: float,
    to_frequency: float,
    *,
    known: Sequence[ResponseCurve] | None = None,
    search: IsolatedSearch = DEFAULT_SEARCH,
    settings: ResponseSettings = DEFAULT_SETTINGS,
) -> IsolatedResponses:
    """Search for response curves that are not connected to the one from rest, and trace them.

    Newton's method starts from the given motions, from every phase resonance of the force-
    appropriated backbone at this force (traced to twice the force; the tips of loops are among
    them), from vibrations about every stable equilibrium, and from random amplitudes and phases of
    the mode of interest across the frequency range. Through each motion that lies on no known
    curve a curve is traced in both directions, or around if it is closed.

    Arguments: `force` in N, frequencies in rad/s; `known` curves of this force, by default those of
    `forced_response`; `search` defines the starts; `settings` as in `forced_response_batch`.
    Returns `IsolatedResponses`: one `ResponseCurve` for every further curve, whose `branch` is how
    it was found and whose `status` is CLOSED for an isolated loop, and how many starts failed.
    The search is not a proof: further curves may exist that `n_starts` starts do not reach.
    Raises `ValueError` for a force that is not positive, an empty frequency range and starts of
    other harmonics than `harmonic_order`.
    Not differentiable: call it outside, and differentiate single motions of its curve:
    `snrmjax.simulate.periodic_motion`, or `snrmjax.simulate.TrackedMotion` where parameters move
    far.
    """
    model = simulated_structure(model)
    (load,) = positive("force", force).tolist()
    ends = frequency_range(from_frequency, to_frequency)
    if known is None:
        plain = dataclasses.replace(settings, stability=False)
        (known,) = forced_response_batch(model, load, *ends, settings=plain).curves
    balances = response_balances(
        [model], np.array([load]), settings.harmonic_order, settings.n_samples, ends
    )
    balance = as_arrays(taken(balances, 0))
    resonances, backbone_status = _phase_resonances(balance)
    named = _starts(balance, ends, search, resonances)
    solved = _solutions(balance, named, ends)
    curves = [_scaled(balance, curve) for curve in known if len(curve.frequency) > 1]
    isolated: list[ResponseCurve] = []
    n_known, n_not_traced = solved.n_outside, 0
    for point, origin in zip(solved.points, solved.origins, strict=True):
        if any(lies_on(point, curve) for curve in curves):
            n_known += 1
            continue
        traced = trace_both_ways(balances, point, ends, settings.steps)
        if len(traced.points) < 2:
            n_not_traced += 1
            continue
        curves.append(traced.points)
        stability = settings.stability
        isolated += assembled(
            balances, [traced], settings.steps, stability=stability, branch=origin
        )
    if settings.stability:
        add_branches(isolated, curves, balances, 0, ends, settings.steps)
    return IsolatedResponses(
        curves=tuple(isolated),
        force=load,
        n_starts=len(named),
        n_failed=solved.n_failed,
        n_known=n_known,
        n_not_traced=n_not_traced,
        backbone_status=backbone_status,
    )


def _starts(
    balance: HarmonicBalance, ends: np.ndarray, search: IsolatedSearch, resonances: list[Start]
) -> list[tuple[np.ndarray, float, Branch]]:
    """Coefficients, frequency and origin of every start."""
    model, n = balance.model, balance.n_coefficients
    rows: list[tuple[np.ndarray, float, Branch]] = []
    for coefficients, frequency in search.starts:
        x = np.asarray(coefficients, dtype=np.float64)
        if x.shape != (n, model.n_modes):
            raise InputError(
                f"every start must have coefficients of shape {(n, model.n_modes)}, but one has "
                f"{x.shape}."
            )
        rows.append((x, float(frequency), Branch.GIVEN_START))
    rows += [(x, w, Branch.PHASE_RESONANCE) for x, w in resonances]
    wells = [e for e in equilibria(model) if e.stable]
    rng = np.random.default_rng(search.seed)
    j, scale = model.modes.mode_of_interest, float(balance.displacement_scale)
    for frequency in np.linspace(ends[0], ends[1], 9)[1:-1]:
        for well in wells:
            x = np.zeros((n, model.n_modes))
            x[0] = well.displacement
            origin = Branch.EQUILIBRIUM if np.any(well.displacement) else Branch.REST
            rows.append((x.copy(), float(frequency), origin))
            linear = linear_coefficients(
                model, balance.force, jnp.asarray(frequency), balance.harmonic_order
            )
            rows.append((x + np.asarray(linear), float(frequency), origin))
    for k in range(search.n_starts):
        frequency = rng.uniform(ends[0], ends[1])
        amplitude = scale * 10 ** rng.uniform(-1.5, 0.5)
        # Isolated loops surround the backbone: half of the starts have the phase of resonance.
        angle = 0.5 * np.pi if k % 2 else rng.uniform(0, 2 * np.pi)
        x = np.zeros((n, model.n_modes))
        x[0] = wells[k % len(wells)].displacement if wells else 0.0
        x[1, j], x[2, j] = amplitude * np.cos(angle), amplitude * np.sin(angle)
        rows.append((x, float(frequency), Branch.RANDOM_START))
    return rows


def _phase_resonances(balance: HarmonicBalance) -> tuple[list[Start], CurveStatus]:
    """Points of the force-appropriated backbone at this force, and the status of the backbone."""
    if not balance.model.modes.driven()[balance.model.modes.mode_of_interest]:
        return [], CurveStatus.NO_START
    force = float(balance.force)
    backbone = phase_controlled(
        balance.model,
        2 * force,
        harmonic_order=balance.harmonic_order,
        n_samples=balance.n_samples,
    )
    beyond = backbone.force > force
    where = np.flatnonzero(beyond[1:] != beyond[:-1])
    fraction = (force - backbone.force[where]) / np.diff(backbone.force)[where]
    x, omega = backbone.coefficients, backbone.frequency
    between = x[where] + fraction[:, None, None] * np.diff(x, axis=0)[where]
    frequency = omega[where] + fraction * np.diff(omega)[where]
    return list(zip(between, frequency.tolist(), strict=True)), backbone.status


class _Solutions(NamedTuple):
    """Converged motions inside the range, and the numbers of the others."""

    points: list[np.ndarray]  # scaled
    origins: list[Branch]
    n_failed: int
    n_outside: int


def _solutions(
    balance: HarmonicBalance, named: list[tuple[np.ndarray, float, Branch]], ends: np.ndarray
) -> _Solutions:
    """Newton's method from every start."""
    count = len(named)
    starts = padded(np.stack([row[0] for row in named]))
    frequency = padded(np.array([row[1] for row in named]))
    force = np.full(len(frequency), float(balance.force))
    solutions, ok = solve_at_frequency(
        balance.model, force, frequency, starts, n_samples=balance.n_samples
    )
    inside = ((frequency >= ends[0]) & (frequency <= ends[1]))[:count]
    converged = np.asarray(ok)[:count]
    good = np.flatnonzero(converged & inside)
    x = np.asarray(solutions)[good].reshape(len(good), -1) / float(balance.displacement_scale)
    omega = frequency[good] / float(balance.frequency_scale)
    points = np.concatenate([x, omega[:, None]], axis=1)
    return _Solutions(
        points=list(points),
        origins=[named[k][2] for k in good],
        n_failed=int(np.sum(~converged)),
        n_outside=int(np.sum(converged & ~inside)),
    )


def _scaled(balance: HarmonicBalance, curve: ResponseCurve) -> np.ndarray:
    x = curve.coefficients.reshape(len(curve.frequency), -1) / float(balance.displacement_scale)
    omega = curve.frequency / float(balance.frequency_scale)
    return np.concatenate([x, omega[:, None]], axis=1)
