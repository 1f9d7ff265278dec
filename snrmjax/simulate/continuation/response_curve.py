"""One forced response as a curve, with its events, multipliers and how it ended."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from snrmjax.numerics.blocks import by_blocks, over_cores, taken
from snrmjax.numerics.compiled import compiled
from snrmjax.simulate.balance.harmonic_balance import HarmonicBalance, truncation_error
from snrmjax.simulate.continuation.continuation import CurveStatus, StepControl
from snrmjax.simulate.continuation.events import (
    Walked,
    with_bifurcations,
    with_events,
)
from snrmjax.simulate.continuation.stability import (
    StabilityLoss,
    floquet_multipliers,
    is_stable,
    stability_loss,
)


class ResponseCurve(NamedTuple):
    """One forced response in order along the curve, unstable parts included.

    `truncation` estimates the share of the velocity that the harmonics left out would have: a
    curve on which it exceeds a few per cent wants more harmonics. Without stability `stable` is
    False everywhere and `multipliers` and `truncation` are None.
    """

    force: float  # N
    frequency: Float[np.ndarray, " point"]  # rad/s
    coefficients: Float[np.ndarray, "point coefficient mode"]  # kg^1/2 m
    velocity: Complex[np.ndarray, "point harmonic sensor"]  # m/s, h = 0…H
    stable: Bool[np.ndarray, " point"]
    event: tuple[str, ...]  # "" or what happens at the point; see `forced_response`
    status: CurveStatus
    sensors: tuple[str, ...]
    multipliers: Complex[np.ndarray, "point multiplier"] | None = None  # None: not asked for
    n_solves: int = 0  # linear systems factorised to follow the curve
    branch: str = "main"  # "main", or how an isolated one was reached
    truncation: Float[np.ndarray, " point"] | None = None  # estimated, like `multipliers`

    def at_events(self, kind: str) -> np.ndarray:
        """Indices of the points at which an event of this kind was located."""
        return np.array([k for k, e in enumerate(self.event) if kind in e.split("+")], dtype=int)

    def point(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients (kg^1/2 m) and frequency (rad/s) of a point: a start for other solvers."""
        return self.coefficients[k], self.frequency[k]

    @property
    def stability_loss(self) -> tuple[StabilityLoss, ...]:
        """By which kind of multiplier each point is unstable.

        Raises `ValueError` when the curve was followed without stability.
        """
        if self.multipliers is None:
            raise ValueError("this curve was followed without stability: ask for it.")
        return stability_loss(self.multipliers)


class FollowedCurve(NamedTuple):
    """A curve as the continuation left it, trimmed, on the host."""

    points: Float[np.ndarray, "point unknown"]
    tangents: Float[np.ndarray, "point unknown"]
    status: CurveStatus
    n_solves: int

    def reversed(self) -> "FollowedCurve":
        """The same curve in the opposite order."""
        end = {
            CurveStatus.LOWER_END: CurveStatus.UPPER_END,
            CurveStatus.UPPER_END: CurveStatus.LOWER_END,
        }.get(self.status, self.status)
        return FollowedCurve(self.points[::-1], -self.tangents[::-1], end, self.n_solves)


def assembled(
    balances: HarmonicBalance,
    curves: Sequence[FollowedCurve],
    steps: StepControl,
    *,
    stability: bool = True,
    branch: str = "main",
) -> list[ResponseCurve]:
    """Curves with their events and bifurcations inserted, velocities and multipliers.

    Arguments: `balances` stacked, one for every curve; `steps` with which they were followed.
    """
    walked = [Walked(c.points, c.tangents, ("",) * len(c.points)) for c in curves]
    walked = with_events(balances, walked, steps)

    def finished(number: int) -> ResponseCurve:
        balance = taken(balances, number)
        curve, multipliers = walked[number], None
        if stability:
            multipliers = _multipliers(balance, curve)
            one = jax.tree.map(lambda a: np.asarray(a)[None] if eqx.is_array(a) else a, balance)
            curve, multipliers = with_bifurcations(one, curve, multipliers, steps)
        return _response(balance, curve, multipliers, curves[number], branch)

    return over_cores(finished, range(len(curves)))


def _multipliers(balance: HarmonicBalance, curve: Walked) -> Complex[np.ndarray, "point _"]:
    shape = (len(curve.points), balance.n_coefficients, balance.model.n_modes)
    x = curve.points[:, :-1].reshape(shape) * np.asarray(balance.displacement_scale)
    omega = curve.points[:, -1] * np.asarray(balance.frequency_scale)
    return floquet_multipliers(balance.model, x, omega)


def _response(
    balance: HarmonicBalance,
    curve: Walked,
    multipliers: np.ndarray | None,
    followed: FollowedCurve,
    branch: str,
) -> ResponseCurve:
    model, n = balance.model, len(curve.points)
    x = curve.points[:, :-1].reshape(n, balance.n_coefficients, model.n_modes)
    coefficients = x * np.asarray(balance.displacement_scale)
    frequency = curve.points[:, -1] * np.asarray(balance.frequency_scale)
    truncation = None
    if multipliers is not None:
        (truncation,) = by_blocks(
            lambda x, w: (_truncation(balance, x, w),), 128, coefficients, frequency
        )
    return ResponseCurve(
        force=float(balance.force),
        frequency=frequency,
        coefficients=coefficients,
        velocity=_velocity(coefficients, frequency, np.asarray(model.modes.mode_shape)),
        stable=np.zeros(len(frequency), bool) if multipliers is None else is_stable(multipliers),
        event=curve.labels,
        status=followed.status,
        sensors=model.modes.sensors,
        multipliers=multipliers,
        n_solves=followed.n_solves,
        branch=branch,
        truncation=truncation,
    )


def _velocity(
    coefficients: np.ndarray, frequency: np.ndarray, mode_shape: np.ndarray
) -> np.ndarray:
    """`velocity_phasors` on the host, where a curve is done before a program has its arguments."""
    mean, pairs = coefficients[:, :1] + 0j, coefficients[:, 1::2] - 1j * coefficients[:, 2::2]
    phasors = np.concatenate([mean, pairs], axis=1) @ mode_shape.T
    return 1j * np.arange(phasors.shape[1])[:, None] * frequency[:, None, None] * phasors


@compiled
def _truncation(balance: HarmonicBalance, coefficients: Array, frequency: Array) -> Array:
    return jax.vmap(lambda x, w: truncation_error(balance, x, w))(coefficients, frequency)
