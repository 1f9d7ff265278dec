"""Events of forced responses continued in a second parameter: folds, peaks, bifurcations."""

from typing import get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from snrmjax.model.parameters import checked_names, parameter_unit, parameter_value
from snrmjax.model.structures import Structure, simulated_structure
from snrmjax.numerics.blocks import on_one_core
from snrmjax.numerics.compiled import compiled, on_numbers
from snrmjax.numerics.result import Variable, quantity, setting
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.status import Status
from snrmjax.numerics.units import HERTZ, unit_in_print
from snrmjax.simulate.balance.given_numbers import positive
from snrmjax.simulate.balance.harmonic_balance import harmonic_balance, resonance_displacement
from snrmjax.simulate.continuation.continuation import (
    Curve,
    CurveRange,
    CurveStatus,
    StepControl,
    TracedCurve,
    on_host,
    trace_curve,
)
from snrmjax.simulate.continuation.event_equations import (
    FORCE,
    EventEquations,
    EventKind,
)
from snrmjax.simulate.continuation.response_curve import MotionCurve, motions_of
from snrmjax.simulate.continuation.stability import floquet_multipliers
from snrmjax.simulate.continuation.turning_points import with_turning_points

DEFAULT_STEPS = StepControl(max_points=2000)
_SAME = 1e-10  # distance in scaled unknowns below which two points coincide
_ROUNDING = 1e-12  # relative, of a parameter's value
_SHOWN = 6  # turning points that a summary lists
_RESONANT = 1e-2  # ratio of second to first frequency below which a stopped curve has ended
Start = tuple[Float[np.ndarray, "coefficient mode"], float]


class EventCurveEnd(Status):
    """Where a curve of events ended."""

    UPPER_END = 0, "the upper end of the range"
    LOWER_END = 1, "the lower end of the range"
    POINT_LIMIT = 2, "the largest number of points (in Python: raise `max_points`)"
    STEP_TOO_SMALL = 3, "where Newton's method fails at the smallest step; use more harmonics"
    NO_START = 4, "its start, where there is no such event; start at a point with this event"
    CLOSED = 6, "where it started: a closed curve"
    STRONG_RESONANCE = 8, "a strong resonance: the second frequency is zero or half the first"


class EventCurve(MotionCurve):
    """Curve of one kind of event of forced responses over a parameter.

    `event` names the turning points of the parameter. On a curve of folds these are a "cusp", where
    two folds meet and vanish; an "isola_birth", where an isolated response begins as a point; and
    an "isola_merging", where it joins another response. On other curves they are a "turn".
    """

    kind: EventKind = setting()
    parameter: str = setting()  # "force" or a name of `parameter_names`
    unit: str = setting()  # of the parameter
    value: Float[np.ndarray, " point"]  # of the parameter
    force: Float[np.ndarray, " point"] = quantity("point", "N", "force amplitude")
    event: tuple[str, ...] = quantity("point", "", "what happens there", static=True)
    ends: tuple[
        EventCurveEnd, EventCurveEnd
    ]  # where the curve ends, before its first and after its last point
    # Of a Neimark-Sacker point, rad/s: second frequency of the bifurcating motion; else None.
    second_frequency: Float[np.ndarray, " point"] | None = None
    n_not_located: int = setting(default=0)  # turning points that were detected but not located
    n_solves: int = setting(default=0)  # linear systems factorised to trace the curve

    @property
    def amplitude(self) -> Float[np.ndarray, " point"]:
        """|velocity fundamental| at the first sensor, in m/s."""
        return np.abs(self.velocity[:, 1, 0])

    def at_events(self, kind: str) -> np.ndarray:
        """Indices of the turning points of this kind."""
        return np.array([k for k, e in enumerate(self.event) if e == kind], dtype=int)

    def summary(self) -> tuple[str, ...]:
        """Kind, parameter, ranges, turning points and ends."""
        n, kind = len(self.frequency), self.kind.replace("_", " ")
        lines = [f"{kind} over {self.parameter}: {n} points"]
        if n:
            hertz, unit = self.frequency / HERTZ, f" {unit_in_print(self.unit)}".rstrip()
            lines += [
                f"{self.parameter} {self.value.min():.6g} to {self.value.max():.6g}{unit}",
                f"frequency {hertz.min():.6g} to {hertz.max():.6g} Hz",
                f"velocity fundamental up to {self.amplitude.max():.4g} m/s,"
                f" sensor {self.sensors[0]}",
            ]
            lines += [
                f"{name.replace('_', ' ')} at {self.value[k]:.6g}{unit}, {hertz[k]:.6g} Hz"
                for k, name in enumerate(self.event)
                if name
            ][:_SHOWN]
        if self.n_not_located:
            lines.append(f"turning points not located: {self.n_not_located}")
        return (*lines, f"from {self.ends[0].message}", f"to {self.ends[1].message}")

    def variables(self) -> dict[str, Variable]:
        """Those of the curve, the parameter and the second frequency of Neimark-Sacker points."""
        named = dict(super().variables())
        named["parameter"] = Variable(("point",), self.value, self.unit, self.parameter)
        if self.second_frequency is not None:
            text = "frequency of the second motion"
            named["second_frequency_hz"] = Variable(
                ("point",), self.second_frequency / HERTZ, "Hz", text
            )
        return named

    def near(self, value: float) -> list[Start]:
        """Points at which the curve crosses a value of its parameter, by linear interpolation.

        They are starts for `periodic_motion`, which solves for the motions.
        """
        off = self.value - value
        off = np.where(np.abs(off) <= _ROUNDING * abs(value), 0.0, off)
        # At points of the curve, and between two points on either side.
        at = np.flatnonzero(off == 0)
        between = np.flatnonzero(off[1:] * off[:-1] < 0)
        x, omega = self.coefficients, self.frequency
        crossings = [(int(k), x[k], float(omega[k])) for k in at]
        for k in between.tolist():
            fraction = off[k] / (off[k] - off[k + 1])
            motion = x[k] + fraction * (x[k + 1] - x[k])
            crossings.append((k, motion, float(omega[k] + fraction * (omega[k + 1] - omega[k]))))
        return [
            (motion, frequency)
            for _, motion, frequency in sorted(crossings, key=lambda row: row[0])
        ]


@on_numbers(
    "Call it outside, and differentiate single motions of its curve: "
    "`sj.simulate.periodic_motion`, or `sj.simulate.TrackedMotion` where parameters move "
    "far."
)
@on_one_core
def follow_event(
    model: Structure,
    force: float,
    start: tuple[Float[ArrayLike, "coefficient mode"], float | Float[ArrayLike, ""]],
    *,
    kind: EventKind,
    to: tuple[float, float],
    parameter: str = FORCE,
    n_samples: int | None = None,
    steps: StepControl = DEFAULT_STEPS,
) -> EventCurve:
    """Trace an event of a forced response as the force or a parameter of the model changes.

    Solves the harmonic balance together with the event's condition, with the parameter as a further
    unknown, and traces the curve in both directions from `start` through turning points of the
    parameter and of the frequency: to the ends of the range, or around a closed curve.
    A "fold", "peak", "period_doubling" or "neimark_sacker" is where a bordered matrix is
    singular; the last two by Hill's method, with as many harmonics as the motion. Curves of a
    "phase_resonance" over the force are damped backbones, as `phase_controlled` traces them.

    Arguments: `force` in N; `start` coefficients in kg^1/2 m and frequency in rad/s of the event
    at this force, such as `curve.point(curve.at_events("fold")[0])` of a `ResponseCurve`; `to`
    the range of the parameter, in N or in the unit of the model; `parameter` "force" or a name of
    `snrmjax.model.parameters.parameter_names`, an effect's among them.
    Returns an `EventCurve` in the direction in which the parameter rises at `start`; its `ends`
    are how it ended on either side, its `status` the worse of them. A curve of Neimark-Sacker
    points ends where its pair of multipliers meets at +1 or -1.
    Raises `ValueError` for an unknown kind or parameter, for a range that does not contain the
    parameter's value, for a start without a pair of multipliers to follow, and for a
    Neimark-Sacker point with friction, which Hill's method does not linearise.
    Not differentiable: call it outside, and differentiate single motions of its curve:
    `snrmjax.simulate.periodic_motion`, or `snrmjax.simulate.TrackedMotion` where parameters move
    far.
    Reference: Detroux, Renson, Masset & Kerschen, Comput. Methods Appl. Mech. Eng. 296 (2015) 18,
    doi:10.1016/j.cma.2015.07.017.

    >>> from snrmjax import forced_response
    >>> from snrmjax.model import flat_beam
    >>> beam = flat_beam()
    >>> curve = forced_response(beam, [0.01], 480.0, 660.0, harmonic_order=1)[0]
    >>> start = curve.point(curve.at_events("fold")[0])
    >>> folds = follow_event(beam, 0.01, start, kind="fold", to=(1e-3, 0.01))
    >>> [name for name in folds.event if name]
    ['cusp']
    """
    equations, point = _problem(model, force, start, kind, to, parameter, n_samples)
    scale = float(equations.parameter_scale)
    lower, upper = (end / scale for end in to)
    ways = [
        on_host(trace_events(equations, point, np.array([lower, upper]), steps, np.array(up)))
        for up in (1.0, -1.0)
    ]
    if kind == "neimark_sacker":
        ways = [_before_resonance(way) for way in ways]
    curve = _joined(*ways)
    closed = curve.status == CurveStatus.CLOSED
    sides = (ways[0], ways[0]) if closed else (ways[1], ways[0])
    points, events, missed = with_turning_points(equations, curve, steps)
    balance = equations.balance
    value, second = points[:, -1] * scale, None
    if kind == "neimark_sacker":
        second = np.sqrt(points[:, -2]) * float(balance.frequency_scale)
    return EventCurve(
        **motions_of(balance, points[:, : balance.size + 1]),
        status=curve.status,
        kind=kind,
        parameter=parameter,
        unit=model.modes.force_unit if parameter == FORCE else parameter_unit(model, parameter),
        value=value,
        force=value if parameter == FORCE else np.full(len(value), float(force)),
        event=tuple(events),
        ends=(_end_of(sides[0], kind), _end_of(sides[1], kind)),
        second_frequency=second,
        n_not_located=missed,
        n_solves=curve.n_solves,
    )


def _problem(
    model: Structure,
    force: float,
    start: tuple[ArrayLike, float | ArrayLike],
    kind: EventKind,
    to: tuple[float, float],
    parameter: str,
    n_samples: int | None,
) -> tuple[EventEquations, Float[Array, " unknown"]]:
    """The equations of an event and its starting point. Raises as `follow_event` does."""
    if kind not in get_args(EventKind):
        raise InputError(f"`kind` must be one of {get_args(EventKind)}, but is {kind!r}.")
    (load,) = positive("force", force).tolist()
    lower, upper = (float(end) for end in to)
    begin = load
    if parameter != FORCE:
        checked_names(model, [parameter], "parameter")
        begin = float(parameter_value(model, parameter))
    if not (np.isfinite([lower, upper]).all() and lower < upper):
        raise InputError(f"`to` must be two numbers that rise, but is {lower:g} to {upper:g}.")
    if not lower <= begin <= upper:
        raise InputError(
            f"`to` must hold {parameter}, which is {begin:g}, but goes from {lower:g} to {upper:g}."
        )
    if parameter == FORCE and lower <= 0:
        raise InputError(f"`to` must be positive for the force, but begins at {lower:g} N.")
    expanded = simulated_structure(model)
    if kind == "neimark_sacker" and expanded.hysteretic:
        names = ", ".join(effect.kind for effect in expanded.hysteretic)
        raise InputError(f"a Neimark-Sacker point is not followed with friction ({names}).")
    coefficients = np.asarray(start[0], dtype=np.float64)
    frequency = float(np.asarray(start[1]))
    largest = max(load, upper) if parameter == FORCE else load
    scale = max(resonance_displacement(expanded, largest), float(np.abs(coefficients).max()))
    balance = harmonic_balance(
        expanded,
        load,
        scale,
        harmonic_order=(len(coefficients) - 1) // 2,
        n_samples=n_samples,
    )
    equations = EventEquations(
        model=model,
        balance=balance,
        parameter_scale=jnp.asarray(max(abs(lower), abs(upper))),
        kind=kind,
        parameter=parameter,
    )
    motion = balance.point(jnp.asarray(coefficients), jnp.asarray(frequency))
    further = []
    if kind == "neimark_sacker":
        second = _second_frequency(expanded, coefficients, frequency)
        further = [(second / float(balance.frequency_scale)) ** 2]
    further.append(begin / float(equations.parameter_scale))
    return equations, jnp.concatenate([motion, jnp.asarray(further)])


def _second_frequency(model: Structure, coefficients: np.ndarray, frequency: float) -> float:
    """Frequency (rad/s) of the pair of multipliers nearest to the unit circle."""
    row = floquet_multipliers(model, coefficients[None], np.array([frequency]))[0]
    pairs = row[row.imag > 1e-6 * np.abs(row)]
    if not pairs.size:
        raise InputError("the motion at `start` has no pair of complex multipliers to follow.")
    nearest = pairs[np.argmin(np.abs(np.abs(pairs) - 1.0))]
    return float(np.angle(nearest)) / (2 * np.pi) * frequency


@compiled
def trace_events(
    equations: EventEquations, start: Array, ends: Array, steps: StepControl, up: Array
) -> Curve:
    """Trace from a start in one direction, `up` being 1 for a rising parameter and -1 else."""
    direction = jnp.zeros_like(start).at[-1].set(up)
    return trace_curve(equations.linearised, start, direction, CurveRange(ends[0], ends[1]), steps)


def _before_resonance(way: TracedCurve) -> TracedCurve:
    """The part with the second frequency below half the first, where the pair meets at −1.

    Beyond it the same motions recur with the complementary second frequency.
    """
    beyond = np.flatnonzero(np.sqrt(way.points[:, -2]) > 0.5 * way.points[:, -3])
    last = int(beyond[0]) if beyond.size else len(way.points)
    return way._replace(points=way.points[:last], tangents=way.tangents[:last])


def _end_of(way: TracedCurve, kind: EventKind) -> EventCurveEnd:
    """How the curve ended in one direction from the start."""
    if kind == "neimark_sacker" and len(way.points) > 1:
        before, last = np.sqrt(way.points[-2:, -2]) / way.points[-2:, -3]
        near_half = last + abs(last - before) > 0.5
        stopped = way.status == CurveStatus.STEP_TOO_SMALL
        if near_half or (stopped and last < _RESONANT):
            return EventCurveEnd.STRONG_RESONANCE
    return EventCurveEnd(int(way.status))


def _joined(up: TracedCurve, down: TracedCurve) -> TracedCurve:
    """Both directions joined to one curve, with the parameter rising at the start."""
    if up.status == CurveStatus.CLOSED or not len(down.points):
        return up
    solves = up.n_solves + down.n_solves
    points = np.concatenate([down.points[::-1], up.points[1:]])
    tangents = np.concatenate([-down.tangents[::-1], up.tangents[1:]])
    # A start at an end of the range would be repeated as that end.
    fresh = np.linalg.norm(np.diff(points, axis=0), axis=1) > _SAME
    keep = np.concatenate([[True], fresh])
    ends = (CurveStatus.UPPER_END, CurveStatus.LOWER_END)
    stopped = [way.status for way in (up, down) if way.status not in ends]
    return TracedCurve(points[keep], tangents[keep], (*stopped, up.status)[0], solves)
