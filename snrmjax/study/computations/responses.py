"""Forced responses of the members: peaks, resonances and folds, or whole curves."""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from snrmjax.numerics.units import HERTZ
from snrmjax.simulate.continuation.continuation import CurveStatus
from snrmjax.simulate.continuation.response_curve import ResponseCurve
from snrmjax.simulate.solutions.forced_response import (
    ResponseSettings,
    forced_response_batch,
    has_higher_point,
)
from snrmjax.study.computations.base import (
    COMPLETE,
    PEAK_SIDE,
    TEXT,
    AbstractComputation,
    Axis,
    Members,
    MemberStatus,
    OfForces,
    Output,
    of_forces,
)

GRID = "frequency_hz"


class ResponseRange(eqx.Module):
    """Frequency range in rad/s and settings of the responses."""

    from_frequency: float
    to_frequency: float
    harmonic_order: int = eqx.field(static=True, default=9)
    stability: bool = eqx.field(static=True, default=True)

    @property
    def ends(self) -> tuple[float, float]:
        """The frequencies in rad/s."""
        return self.from_frequency, self.to_frequency

    @property
    def settings(self) -> ResponseSettings:
        """The settings of `forced_response_batch`."""
        return ResponseSettings(harmonic_order=self.harmonic_order, stability=self.stability)


class AbstractResponses(AbstractComputation):
    """Forced responses of every member under every force."""

    within: eqx.AbstractVar[ResponseRange]
    forces: eqx.AbstractVar[OfForces]

    def outputs(self) -> dict[str, Output]:
        """Peak, resonance and folds of every response."""
        at = self.forces.dimensions
        return {
            "status": Output(at, TEXT, "", "how the curve ended"),
            "n_points": Output(at, "i4", "1", "points of the curve"),
            "peak_frequency_hz": Output(at, "f8", "Hz", "frequency of the highest peak", True),
            "peak_velocity_m_s": Output(at, "f8", "m/s", "velocity at the highest peak", True),
            "resonance_frequency_hz": Output(at, "f8", "Hz", "strongest phase resonance"),
            "resonance_velocity_m_s": Output(at, "f8", "m/s", "velocity at phase resonance", True),
            PEAK_SIDE: Output(at, "i1", "1", "peak above (1) or below (-1) the range", True),
            "n_folds": Output(at, "i4", "1", "folds of the curve"),
            "n_not_located": Output(at, "i4", "1", "events that are there but were not located"),
            "fold_frequency_hz": Output(("fold",), "f8", "Hz", "frequency of a fold"),
            "fold_velocity_m_s": Output(("fold",), "f8", "m/s", "velocity at a fold", True),
        }

    def axes(self) -> dict[str, Axis]:
        """The forces, where there are several."""
        return self.forces.axes()

    def traced(
        self, members: Members
    ) -> tuple[Sequence[tuple[ResponseCurve, ...]], dict[str, np.ndarray]]:
        """The curves of every member and force, and their rows of `outputs`."""
        loads, within = self.forces.of(members), self.within
        models = [m for m in members.models for _ in range(loads.shape[1])]
        batch = forced_response_batch(models, loads.ravel(), *within.ends, settings=within.settings)
        rows = {
            name: self.forces.shaped(np.asarray(one.values))
            for name, one in batch.variables().items()
        }
        ends = list(zip(batch.curves, rows["status"].ravel().tolist(), strict=True))
        whole = [parts if status in COMPLETE else () for parts, status in ends]
        folds = np.concatenate([_at_folds(parts) for parts in whole], axis=1)
        rows[PEAK_SIDE] = self.forces.shaped(np.array([peak_side(*e) for e in ends], dtype="i1"))
        return batch.curves, {**rows, "fold_frequency_hz": folds[0], "fold_velocity_m_s": folds[1]}


class Peaks(AbstractResponses):
    """Highest peak, strongest phase resonance and all folds of every forced response.

    A member whose response has no peak between the ends of the range has the status
    `no_peak_in_range`; one whose response is higher at an end than at its highest peak has
    `highest_at_range_end`: the resonance is outside, and a wider range would include it. Where the
    largest computed point is not a located peak, the status is `peak_not_located` and the peak is
    missing.

    `forces` in N; None: `force_n` varies. With `grid_points` also the highest and the lowest
    velocity of the response at that many frequencies, for the response bands of a report.
    """

    kind: ClassVar[str] = "peaks"
    members_a_chunk: ClassVar[int] = 128

    within: ResponseRange
    forces: OfForces = eqx.field(default=None, converter=of_forces)
    grid_points: int = eqx.field(static=True, default=0)

    def outputs(self) -> dict[str, Output]:
        """Outputs of responses, and bounds on the grid."""
        named = super().outputs()
        if self.grid_points:
            for name, which in (("upper", "highest"), ("lower", "lowest")):
                text = f"{which} velocity of the response at this frequency"
                dimensions = *self.forces.dimensions, GRID
                named[f"{name}_velocity_m_s"] = Output(dimensions, "f8", "m/s", text, True)
        return named

    def axes(self) -> dict[str, Axis]:
        """The forces and the grid."""
        axes = super().axes()
        if self.grid_points:
            axes[GRID] = Axis(self._grid / HERTZ, "Hz", "frequency of the force")
        return axes

    def rows(self, members: Members) -> dict[str, np.ndarray]:
        """See `AbstractComputation.rows`."""
        curves, rows = self.traced(members)
        batch_status = rows["status"].ravel().tolist()
        ends = zip(curves, batch_status, strict=True)
        rows["status"] = self.forces.shaped(np.array([peak_status(*end) for end in ends]))
        if self.grid_points:
            # A curve that stopped early is incomplete and gives no bounds.
            whole = zip(curves, batch_status, strict=True)
            bounds = np.array(
                [velocity_bounds(c if s in COMPLETE else (), self._grid) for c, s in whole]
            )
            rows["upper_velocity_m_s"] = self.forces.shaped(bounds[:, 1])
            rows["lower_velocity_m_s"] = self.forces.shaped(bounds[:, 0])
        return rows

    @property
    def _grid(self) -> Float[np.ndarray, " frequency"]:
        return np.linspace(*self.within.ends, self.grid_points)


class Curves(AbstractResponses):
    """Whole forced responses, unstable parts included, point by point.

    `forces` in N; None: `force_n` varies.
    """

    kind: ClassVar[str] = "curves"
    members_a_chunk: ClassVar[int] = 64

    within: ResponseRange
    forces: OfForces = eqx.field(default=None, converter=of_forces)

    def outputs(self) -> dict[str, Output]:
        """Outputs of responses, and their points."""
        at = ("point",)
        return {
            **super().outputs(),
            "point_frequency_hz": Output(at, "f8", "Hz", "frequency of the force"),
            **{
                f"point_velocity_{part}_m_s": Output(at, "f8", "m/s", f"velocity {which}", True)
                for part, which in (("re", "in phase with the force"), ("im", "90° ahead of it"))
            },
            "point_stability": Output(at, "i1", "1", "1 stable, 0 unstable, -1 not computed"),
            "point_branch": Output(at, "i1", "1", "number of the branch: a response may have two"),
        }

    def rows(self, members: Members) -> dict[str, np.ndarray]:
        """See `AbstractComputation.rows`."""
        curves, rows = self.traced(members)
        branches = [part for parts in curves for part in parts]
        number = [branch for parts in curves for branch in range(len(parts))]
        sizes = [len(part.frequency) for part in branches]
        velocity = np.concatenate([part.velocity[:, 1, 0] for part in branches])
        return {
            **rows,
            "point_frequency_hz": np.concatenate([part.frequency for part in branches]) / HERTZ,
            "point_velocity_re_m_s": velocity.real,
            "point_velocity_im_m_s": velocity.imag,
            "point_stability": np.concatenate([part.stability for part in branches]).astype("i1"),
            "point_branch": np.repeat(number, sizes).astype("i1"),
        }


def peak_status(curves: Sequence[ResponseCurve], status: str) -> str:
    """The status of a response with respect to its highest peak.

    Arguments: `status` of the continuation; it is kept for a curve that stopped early.
    """
    if status not in COMPLETE:
        return status
    speed = [np.abs(curve.velocity[:, 1, 0]) for curve in curves]
    peaks = [v[one.at_events("peak")] for v, one in zip(speed, curves, strict=True)]
    highest = max(np.concatenate(peaks), default=np.nan)
    missed = np.isnan(highest) and any("peak" in curve.not_located for curve in curves)
    if missed or has_higher_point(curves, highest):
        return MemberStatus.PEAK_NOT_LOCATED
    if np.isnan(highest):
        return MemberStatus.NO_PEAK
    open_ended = [v for v, c in zip(speed, curves, strict=True) if c.status != CurveStatus.CLOSED]
    at_ends = max((max(v[0], v[-1]) for v in open_ended), default=0.0)
    return MemberStatus.HIGHEST_AT_END if at_ends > highest else status


def peak_side(curves: Sequence[ResponseCurve], status: str) -> int:
    """Side of the range on which a response without a peak in it has its peak.

    The velocity of a structure under a bounded force falls to zero far from its resonances: where
    the highest branch still rises at an end of the range, there is a peak beyond that end. Returns
    1 for above, -1 for below; 0 for a peak in the range, for a curve that stopped early, and where
    the response rises at both ends or at neither.
    """
    if peak_status(curves, status) != MemberStatus.NO_PEAK:
        return 0
    highest = {-1: (-np.inf, False), 1: (-np.inf, False)}
    for curve in (one for one in curves if one.status != CurveStatus.CLOSED):
        speed = np.abs(curve.velocity[:, 1, 0])
        for end, inside in ((0, 1), (-1, -2)):
            side = 1 if curve.frequency[end] > curve.frequency[inside] else -1
            highest[side] = max(highest[side], (speed[end], bool(speed[end] > speed[inside])))
    return int(highest[1][1]) - int(highest[-1][1])


def velocity_bounds(
    curves: Sequence[ResponseCurve], frequencies: Float[np.ndarray, " frequency"]
) -> Float[np.ndarray, "bound frequency"]:
    """Lowest and highest velocity of a response at given frequencies (rad/s), NaN outside it."""
    if not curves:
        return np.full((2, len(frequencies)), np.nan)
    x = np.concatenate([curve.frequency for curve in curves])
    speed = np.concatenate([np.abs(curve.velocity[:, 1, 0]) for curve in curves])
    begins = np.concatenate([np.arange(len(curve.frequency)) == 0 for curve in curves])
    low, high = bounds_over(np.zeros(len(x), dtype=int), x, speed, frequencies, begins, 1)
    return np.concatenate([low, high])


def bounds_over(
    curve: Int[np.ndarray, " row"],
    x: Float[np.ndarray, " row"],
    y: Float[np.ndarray, " row"],
    at: Float[np.ndarray, " point"],
    begins: Bool[np.ndarray, " row"],
    n_curves: int,
) -> tuple[Float[np.ndarray, "curve point"], Float[np.ndarray, "curve point"]]:
    """Lowest and highest y of curves of polylines at rising abscissae `at`, NaN outside them.

    Arguments: `curve` is the number of the curve of every point, `begins` whether a point starts a
    polyline.
    """
    same = ~begins[1:]
    x0, x1, y0, y1 = (part[same] for part in (x[:-1], x[1:], y[:-1], y[1:]))
    first = np.searchsorted(at, np.minimum(x0, x1), side="left")
    count = np.searchsorted(at, np.maximum(x0, x1), side="right") - first
    segment = np.repeat(np.arange(len(x0)), count)
    index = np.arange(len(segment)) - np.repeat(np.cumsum(count) - count - first, count)
    width = np.where(x1 == x0, 1.0, x1 - x0)
    value = y0[segment] + (at[index] - x0[segment]) / width[segment] * (y1 - y0)[segment]
    of_curve = curve[1:][same][segment]
    low, high = np.full((n_curves, len(at)), np.inf), np.full((n_curves, len(at)), -np.inf)
    np.minimum.at(low, (of_curve, index), value)
    np.maximum.at(high, (of_curve, index), value)
    none = ~np.isfinite(high)
    return np.where(none, np.nan, low), np.where(none, np.nan, high)


def _at_folds(curves: Sequence[ResponseCurve]) -> Float[np.ndarray, "quantity fold"]:
    """Frequency in Hz and velocity in m/s of all folds of a response."""
    folds = [(curve, curve.at_events("fold")) for curve in curves]
    if not folds:
        return np.zeros((2, 0))
    frequency = np.concatenate([curve.frequency[at] for curve, at in folds]) / HERTZ
    return np.array([frequency, np.concatenate([np.abs(c.velocity[at, 1, 0]) for c, at in folds])])
