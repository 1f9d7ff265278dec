"""One forced response as a curve, with its events, multipliers and how it ended."""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from snrmjax.numerics.blocks import by_blocks, over_cores, taken
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.result import AbstractResult, Variable
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, truncation_error
from snrmjax.simulate.balance.harmonics import velocity_along
from snrmjax.simulate.balance.labelled import HERTZ, counted, motion_variables, range_text
from snrmjax.simulate.continuation.bifurcations import with_bifurcations
from snrmjax.simulate.continuation.continuation import CurveStatus, StepControl
from snrmjax.simulate.continuation.events import CurvePoints, with_events
from snrmjax.simulate.continuation.stability import (
    Stability,
    StabilityLoss,
    floquet_multipliers,
    stability_loss,
    stability_of,
)


class ResponseCurve(AbstractResult):
    """One forced response in order along the curve, unstable parts included.

    `truncation` estimates the share of the velocity that the harmonics left out would have: a
    curve on which it exceeds a few per cent wants more harmonics. Without stability
    `multipliers` and `truncation` are None, and the stability of every point is `NOT_COMPUTED`.
    """

    coordinates: ClassVar[tuple[str, ...]] = ("point", "sensor", "frequency_hz")

    force: float  # N
    frequency: Float[np.ndarray, " point"]  # rad/s
    coefficients: Float[np.ndarray, "point coefficient mode"]  # kg^1/2 m
    velocity: Complex[np.ndarray, "point harmonic sensor"]  # m/s, h = 0…H
    event: tuple[str, ...]  # "" or what happens at the point; see `forced_response`
    status: CurveStatus
    sensors: tuple[str, ...]
    multipliers: Complex[np.ndarray, "point multiplier"] | None = None  # None: not asked for
    truncation: Float[np.ndarray, " point"] | None = None  # estimated, like `multipliers`
    not_located: tuple[str, ...] = ()  # kinds of events that are there but were not located
    branch: str = "main"  # "main", or how an isolated one was reached
    n_solves: int = 0  # linear systems factorised to trace the curve

    @property
    def stability(self) -> Int[np.ndarray, " point"]:
        """A `Stability` of every point, from its Floquet multipliers."""
        if self.multipliers is None:
            return np.full(len(self.frequency), int(Stability.NOT_COMPUTED))
        return stability_of(self.multipliers)

    @property
    def is_stable(self) -> Bool[np.ndarray, " point"]:
        """Which points are known to be stable."""
        return self.stability == int(Stability.STABLE)

    @property
    def is_unstable(self) -> Bool[np.ndarray, " point"]:
        """Which points are known to be unstable."""
        return self.stability == int(Stability.UNSTABLE)

    @property
    def stability_loss(self) -> tuple[StabilityLoss, ...]:
        """By which kind of multiplier each point is unstable."""
        if self.multipliers is None:
            return (StabilityLoss.NOT_COMPUTED,) * len(self.frequency)
        return stability_loss(self.multipliers)

    def at_events(self, kind: str) -> np.ndarray:
        """Indices of the points at which an event of this kind was located."""
        return np.array([k for k, e in enumerate(self.event) if kind in e.split("+")], dtype=int)

    def point(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients (kg^1/2 m) and frequency (rad/s) of a point: a start for other solvers."""
        return self.coefficients[k], self.frequency[k]

    def summary(self) -> tuple[str, ...]:
        """Force, range, largest velocity, stability, events and status."""
        n = len(self.frequency)
        of = "" if self.branch == "main" else f" ({self.branch})"
        lines = [f"forced response at {self.force:.4g} N{of}: {n} points"]
        if n:
            height = np.abs(self.velocity[:, 1])
            k, r = np.unravel_index(np.argmax(height), height.shape)
            events = counted(kind for e in self.event for kind in e.split("+") if kind)
            lines += [
                f"frequency {range_text(self.frequency, 'Hz', HERTZ)}",
                f"velocity fundamental up to {height[k, r]:.4g} m/s at"
                f" {self.frequency[k] / HERTZ:.5g} Hz, sensor {self.sensors[r]}",
                f"stability: {_stability_text(self.stability)}",
                f"events: {events or 'none'}",
            ]
        if self.not_located:
            lines.append(f"not located: {counted(self.not_located)}")
        return (*lines, f"status: {self.status.message}")

    def variables(self) -> dict[str, Variable]:
        """Frequency, velocity, stability and events, by the names of `response.csv`."""
        at = ("point",)
        named = motion_variables(self.frequency, self.velocity, self.sensors)
        named["stability"] = Variable(
            at, self.stability, "1", "1 stable, 0 unstable, -1 not computed"
        )
        named["event"] = Variable(at, np.array(self.event, dtype=str), "", "what happens there")
        if self.truncation is not None:
            text = "estimated share of the velocity in harmonics left out"
            named["truncation"] = Variable(at, self.truncation, "1", text)
        return named

    def attributes(self) -> dict[str, str | float | int]:
        """Force, branch and status."""
        return {
            "force_n": self.force,
            "branch": self.branch,
            "status": self.status.name.lower(),
            "not_located": counted(self.not_located),
        }


def _stability_text(stability: Int[np.ndarray, " point"]) -> str:
    """How many points are stable, unstable and not computed."""
    counts = [(kind, int(np.sum(stability == int(kind)))) for kind in reversed(Stability)]
    return ", ".join(f"{n} {kind.name.lower().replace('_', ' ')}" for kind, n in counts if n)


class TracedCurve(NamedTuple):
    """A curve as the continuation left it, trimmed, on the host."""

    points: Float[np.ndarray, "point unknown"]
    tangents: Float[np.ndarray, "point unknown"]
    status: CurveStatus
    n_solves: int

    def reversed(self) -> "TracedCurve":
        """The same curve in the opposite order."""
        end = {
            CurveStatus.LOWER_END: CurveStatus.UPPER_END,
            CurveStatus.UPPER_END: CurveStatus.LOWER_END,
        }.get(self.status, self.status)
        return TracedCurve(self.points[::-1], -self.tangents[::-1], end, self.n_solves)


def assembled(
    balances: HarmonicBalance,
    curves: Sequence[TracedCurve],
    steps: StepControl,
    *,
    stability: bool = True,
    branch: str = "main",
) -> list[ResponseCurve]:
    """Curves with their events and bifurcations inserted, velocities and multipliers.

    Arguments: `balances` stacked, one for every curve; `steps` with which they were traced.
    """
    labelled = [CurvePoints(c.points, c.tangents, ("",) * len(c.points)) for c in curves]
    labelled = with_events(balances, labelled, steps)

    def finished(number: int) -> ResponseCurve:
        balance = taken(balances, number)
        curve = labelled[number]
        if stability:
            multipliers = _multipliers(balance, curve)
            one = jax.tree.map(lambda a: np.asarray(a)[None] if eqx.is_array(a) else a, balance)
            curve = with_bifurcations(one, curve, multipliers, steps)
        return _response(balance, curve, curves[number], branch)

    return over_cores(finished, range(len(curves)))


def _multipliers(balance: HarmonicBalance, curve: CurvePoints) -> Complex[np.ndarray, "point _"]:
    shape = (len(curve.points), balance.n_coefficients, balance.model.n_modes)
    x = curve.points[:, :-1].reshape(shape) * np.asarray(balance.displacement_scale)
    omega = curve.points[:, -1] * np.asarray(balance.frequency_scale)
    return floquet_multipliers(balance.model, x, omega)


def _response(
    balance: HarmonicBalance,
    curve: CurvePoints,
    traced: TracedCurve,
    branch: str,
) -> ResponseCurve:
    model, n = balance.model, len(curve.points)
    x = curve.points[:, :-1].reshape(n, balance.n_coefficients, model.n_modes)
    coefficients = x * np.asarray(balance.displacement_scale)
    frequency = curve.points[:, -1] * np.asarray(balance.frequency_scale)
    truncation = None
    if curve.multipliers is not None:
        (truncation,) = by_blocks(
            lambda x, w: (_truncation(balance, x, w),), 32, coefficients, frequency
        )
    return ResponseCurve(
        force=float(balance.force),
        frequency=frequency,
        coefficients=coefficients,
        velocity=velocity_along(coefficients, frequency, np.asarray(model.modes.mode_shape)),
        event=curve.labels,
        status=traced.status,
        sensors=model.modes.sensors,
        multipliers=curve.multipliers,
        truncation=truncation,
        not_located=curve.not_located,
        branch=branch,
        n_solves=traced.n_solves,
    )


_truncation = compiled(truncation_error)
