"""Curves of periodic motions as results: nonlinear modes, forced responses and their events."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from enum import StrEnum
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from snrmjax.model.moving_base import BaseMotion, drive_unit
from snrmjax.numerics.blocks import by_member, mapped, taken
from snrmjax.numerics.compiled import compiled
from snrmjax.numerics.result import AbstractResult, Variable, quantity, setting
from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, truncation_error
from snrmjax.simulate.balance.harmonics import velocity_phasors, with_sines
from snrmjax.simulate.balance.labelled import fundamental_variables
from snrmjax.simulate.continuation.bifurcations import with_bifurcations
from snrmjax.simulate.continuation.continuation import (
    CurveEvent,
    CurveStatus,
    StepControl,
    TracedCurve,
)
from snrmjax.simulate.continuation.events import with_events
from snrmjax.simulate.continuation.stability import (
    Stability,
    many_multipliers,
    stability_of,
)

_CHANGES_STABILITY = {
    *(CurveEvent.FOLD, CurveEvent.BRANCH_POINT),
    *(CurveEvent.PERIOD_DOUBLING, CurveEvent.NEIMARK_SACKER),
}
_NARROW = 1e-4  # relative width of a gap in stability that exceeds a step of the curve


class MotionCurve(AbstractResult):
    """Periodic motions in sequence along a curve."""

    coordinates: ClassVar[tuple[str, ...]] = ("sensor", "frequency_hz")

    coefficients: Float[np.ndarray, "point coefficient mode"]  # kg^1/2 m
    velocity: Complex[np.ndarray, "point harmonic sensor"]  # m/s, h = 0…H
    frequency: Float[np.ndarray, " point"] = quantity("point", "Hz", "frequency")
    status: CurveStatus = setting()
    sensors: tuple[str, ...] = quantity("sensor", "", "sensor", name="sensor", static=True)
    # With base excitation "forces" are its accelerations, and velocities are relative to it.
    base: BaseMotion | None = eqx.field(static=True, default=None, kw_only=True)
    # With an unbalance U (kg m) and the force c U Ω², "forces" are the factors c.
    unbalance: float | None = eqx.field(static=True, default=None, kw_only=True)
    # The motion repeats after this many periods of the force, and its harmonics h are those of
    # Ω/subharmonic; `frequency` is that of the force.
    subharmonic: int = eqx.field(static=True, default=1, kw_only=True)

    @property
    def force_unit(self) -> str:
        """Unit of the excitation: newtons, m/s² of a base, or a number of unbalances."""
        return drive_unit(self.base, self.unbalance)

    def variables(self) -> dict[str, Variable]:
        """The quantities of the curve, and its velocities under the column names of files."""
        return {**super().variables(), **fundamental_variables(self.velocity)}

    def point(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients (kg^1/2 m) and frequency (rad/s) of a point: a start for other solvers.

        The frequency is that of the first harmonic, for subharmonic motions a fraction of Ω.
        """
        return self.coefficients[k], self.frequency[k] / self.subharmonic


def motions_of(balance: HarmonicBalance, points: Float[np.ndarray, "point unknown"]) -> dict:
    """The fields of a `MotionCurve` from scaled points: frequency, coefficients, velocity, …"""
    coefficients, frequency = balance.motions(points)
    modes = balance.model.modes
    whole = with_sines(coefficients) if balance.cosine_only else coefficients
    velocity = velocity_phasors(whole, frequency, np.asarray(modes.mode_shape))
    n, unbalance = balance.subharmonic, modes.unbalance
    return {
        **{"frequency": n * frequency, "coefficients": coefficients, "velocity": velocity},
        **{"sensors": modes.sensors, "base": modes.base, "subharmonic": n},
        "unbalance": None if unbalance is None else float(unbalance),
    }


def velocity_at_sensors(
    curve: MotionCurve, force: float | Float[np.ndarray, " point"]
) -> Complex[np.ndarray, "point harmonic sensor"]:
    """Velocities as the sensors record them, m/s: plus that of the base where it is recorded.

    Arguments: `force` (N), or the acceleration of the base (m/s²), of the points.
    """
    if curve.base is None:
        return curve.velocity
    velocity = curve.velocity.copy()
    own = curve.base.own_velocity(curve.sensors, curve.frequency, force)
    velocity[:, curve.subharmonic] += own
    return velocity


class Branch(StrEnum):
    """How a response curve was reached."""

    MAIN = "main"  # from rest
    GIVEN_START = "isolated, from a given start"
    PHASE_RESONANCE = "isolated, from a phase resonance"
    EQUILIBRIUM = "from another equilibrium"
    BEYOND = "from beyond a resonance outside the range"
    LANDING = "where a sweep lands"
    BRANCH_POINT = "from a branch point"
    REST = "isolated, from a motion about rest"
    RANDOM_START = "isolated, from a random start"
    PERIOD_DOUBLING = "from a period doubling"
    FREE_OSCILLATION = "isolated, from the free oscillation of a mode"


class ResponseCurve(MotionCurve):
    """A forced response curve, unstable parts included.

    `truncation` estimates the relative velocity of the truncated harmonics: above a few per cent
    raise the harmonic order. Without stability `multipliers` and `truncation` are None, and the
    stability of every point is `NOT_COMPUTED`.
    """

    force: float = setting()  # N
    event: tuple[CurveEvent, ...] = quantity(  # see `forced_response`
        "point", "", "what happens there", static=True
    )
    multipliers: Complex[np.ndarray, "point multiplier"] | None = None  # None: not requested
    truncation: Float[np.ndarray, " point"] | None = None  # estimated, like `multipliers`
    # Kinds of events that were detected but not located.
    not_located: tuple[str, ...] = setting(default=())
    branch: Branch = setting(default=Branch.MAIN)
    n_solves: int = setting(default=0)  # linear systems factorised to trace the curve

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

    def at_events(self, kind: str) -> np.ndarray:
        """Indices of the points at which an event of this kind was located."""
        return np.array([k for k, e in enumerate(self.event) if e == kind], dtype=int)

    def summary(self) -> tuple[str, ...]:
        """Force, range, largest velocity, stability, events and status."""
        n = len(self.frequency)
        of = "" if self.branch is Branch.MAIN else f" ({self.branch})"
        lines = [f"forced response at {self.force:.4g} {self.force_unit}{of}: {n} points"]
        if n:
            height = np.abs(self.velocity[:, 1])
            k, r = np.unravel_index(np.argmax(height), height.shape)
            hertz = self.frequency / HERTZ
            events = _counted(filter(None, self.event))
            if self.subharmonic > 1:
                lines.append(f"repeats after {self.subharmonic} periods of the force")
            lines += [
                f"frequency {hertz.min():.4g} to {hertz.max():.4g} Hz",
                f"velocity fundamental up to {height[k, r]:.4g} m/s at"
                f" {hertz[k]:.5g} Hz, sensor {self.sensors[r]}",
                f"stability: {_counted(Stability(s).name.lower() for s in self.stability)}",
                f"events: {events or 'none'}",
            ]
        if self.not_located:
            names = {"branch": "branch that comes in at the upper end"}
            missed = _counted(names.get(kind, kind) for kind in self.not_located)
            lines.append(f"there, but not located: {missed}")
        return (*lines, f"status: {self.status.message}")

    def variables(self) -> dict[str, Variable]:
        """Those of the curve, stability and truncation."""
        at, named = ("point",), super().variables()
        named["stability"] = Variable(
            at, self.stability, "1", "1 stable, 0 unstable, -1 not computed"
        )
        if self.truncation is not None:
            text = "estimated relative velocity of the truncated harmonics"
            named["truncation"] = Variable(at, self.truncation, "1", text)
        return named


def _counted(kinds: Iterable[str]) -> str:
    """Counts of each kind as text: "2 fold, 1 peak"."""
    each = [(kind.replace("_", " "), n) for kind, n in Counter(kinds).items()]
    return ", ".join(f"{n} {kind}" for kind, n in each)


def assembled(
    balances: HarmonicBalance,
    curves: Sequence[TracedCurve],
    steps: StepControl,
    *,
    stability: bool = True,
    branch: Branch = Branch.MAIN,
) -> list[ResponseCurve]:
    """Response curves with events and bifurcations inserted, velocities and multipliers.

    Arguments: `balances` stacked, one for every curve; `steps` with which they were traced.
    """
    if not curves:
        return []
    labelled = with_events(
        balances, [c._replace(events=(CurveEvent.NONE,) * len(c.points)) for c in curves], steps
    )

    if stability:
        multipliers = _of_points(many_multipliers, balances, labelled)
        labelled = [
            c._replace(multipliers=rows) for c, rows in zip(labelled, multipliers, strict=True)
        ]
        labelled = with_bifurcations(balances, labelled, steps)
    truncations = _of_points(_truncation_errors, balances, labelled) if stability else None

    def finished(number: int) -> ResponseCurve:
        balance, curve = taken(balances, number), labelled[number]
        motions = motions_of(balance, curve.points)
        return ResponseCurve(
            **motions,
            force=float(balance.force),
            event=curve.events,
            status=curve.status,
            multipliers=curve.multipliers,
            truncation=None if truncations is None else truncations[number],
            not_located=curve.not_located,
            branch=branch,
            n_solves=curve.n_solves,
        )

    return [finished(number) for number in range(len(curves))]


def _of_points(
    numbers: Callable[[HarmonicBalance, np.ndarray, np.ndarray], np.ndarray],
    balances: HarmonicBalance,
    curves: list[TracedCurve],
) -> list[np.ndarray]:
    """Values at every point of many curves, computed in one call."""
    counts = [len(curve.points) for curve in curves]
    owner = np.repeat(np.arange(len(curves)), counts)
    rows = numbers(balances, owner, np.concatenate([curve.points for curve in curves]))
    return np.split(rows, np.cumsum(counts)[:-1])


@compiled
def _truncations(
    balances: HarmonicBalance,
    coefficients: Float[Array, "row point coefficient mode"],
    frequency: Float[Array, "row point"],
) -> Float[Array, "row point"]:
    return mapped(truncation_error, balances, coefficients, frequency)


def _truncation_errors(
    balances: HarmonicBalance, owner: np.ndarray, points: np.ndarray
) -> Float[np.ndarray, " point"]:
    """Estimated truncation errors of scaled points of several structures."""
    if not len(points):
        return np.zeros(0)
    coefficients, frequency = balances.motions(points, owner)
    return by_member(_truncations, balances, owner, coefficients, frequency)


def period_doublings(curves: Sequence[ResponseCurve]) -> list[float]:
    """Frequencies (rad/s) at which motions lose their stability to ones of twice the period.

    One for several curves that are mirror images of each other.
    """
    found: list[float] = []
    for curve in curves:
        for event in curve.frequency[curve.at_events(CurveEvent.PERIOD_DOUBLING)].tolist():
            if not np.any(np.abs(np.array(found) / event - 1) < _NARROW):
                found.append(event)
    return sorted(found)


def without_stable_response(
    curves: Sequence[ResponseCurve], from_frequency: float, to_frequency: float
) -> list[tuple[float, float]]:
    """Parts of a range (rad/s) in which no curve has a stable point.

    There a sweep settles on a response of no known curve, or on one that does not have the period
    of the force. Empty if the stability of any point is not known.
    """
    if any(np.any(curve.stability == int(Stability.NOT_COMPUTED)) for curve in curves):
        return []
    spans = []
    for curve in curves:
        # At a bifurcation or fold itself a motion counts as the stable ones next to it.
        changes = np.array([event in _CHANGES_STABILITY for event in curve.event], dtype=bool)
        stable = curve.stability == int(Stability.STABLE)
        both = (stable | changes)[1:] & (stable | changes)[:-1] & (stable[1:] | stable[:-1])
        pair = np.stack([curve.frequency[:-1], curve.frequency[1:]], axis=1)[both]
        spans += np.sort(pair, axis=1).tolist()
    gaps, reached = [], from_frequency
    for first, last in [*sorted(spans), [to_frequency, to_frequency]]:
        if first > reached * (1 + _NARROW):
            gaps.append((reached, first))
        reached = max(reached, last)
    return gaps
