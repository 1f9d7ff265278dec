"""Restoring-force surface of one mode: elastic force over displacement, damping over velocity.

A mode obeys ẍ + s(x) + d(v) = |Φ_r Φᵀb| F. Acceleration and displacement follow from the measured
velocity, and two functions are fitted to the inertia force of every sample: an elastic force over
displacement and a damping force over velocity, both per unit of modal mass at the sensor. The
undamped motions, between two displacements of equal potential energy, then give the natural
frequency at each amplitude, and the power dissipated along them gives the damping.

References: S. F. Masri & T. K. Caughey, J. Appl. Mech. 46 (1979) 433, doi:10.1115/1.3424568;
G. Kerschen, K. Worden, A. F. Vakakis & J. C. Golinval, Mech. Syst. Signal Process. 20 (2006) 505,
doi:10.1016/j.ymssp.2005.04.008, section 6.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.methods.one_sensor import drive_point
from snrmjax.methods.records.resonant_decay import checked_record, velocity_extremes
from snrmjax.methods.result import MethodPoint, MethodResult, MethodStatus, method_result
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError

_POINTS = 25  # amplitudes at which the fitted surface is evaluated
_ANGLES = 128  # of half a cycle
_SPLINE = 5  # degree: velocity, its derivative and its integral from one curve
_ENDS = 2.0  # cycles at each end where the spline's derivative is not used
_MOST = 9
_SHIFTS = 4  # iterations for the displacement's zero and drift
_BISECTIONS = 60
_ROUNDS = 8  # iterations for the displacement of a given velocity
_FAR = 4.0  # times it: search range of the turning point on the other side


class RestoringForce(NamedTuple):
    """The two fitted forces, per unit of modal mass at the sensor (m/s²)."""

    elastic: Float[np.ndarray, " power"]  # s(x) = Σ k_i x^i, i = 1…, 1/(s² m^(i−1))
    damping: Float[np.ndarray, "3"]  # d(v) = c₁ v + c₂ v|v| + c₃ v³
    smallest: float  # m/s, velocity amplitude of the record's smallest cycle used
    largest: float
    misfit: float  # rms residual over the rms of the acceleration

    def damping_force(self, velocity: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """d(v) in m/s²."""
        return np.stack(_damping_terms(velocity), axis=-1) @ self.damping


def fit_restoring_force(
    time: Float[np.ndarray, " sample"],
    velocity: Float[np.ndarray, " sample"],
    force: Float[np.ndarray, " sample"] | None = None,
    modes: LinearModes | None = None,
    *,
    degree: int = 5,
    least_amplitude: float = 0.0,
    most_left: float = 0.5,
) -> RestoringForce:
    """Fit elastic and damping force to a record of one mode, free or forced.

    Arguments: `time` in s, evenly spaced; `velocity` in m/s; `force` in N, where one acts, with the
    `modes` that give its modal constant |Φ_r Φᵀb|; `degree` of the elastic force. A free decay is
    used down to `least_amplitude` (m/s); `most_left` is the largest residual as a fraction of the
    acceleration's power.
    Returns a `RestoringForce`. Raises `ValueError` for a record as in `resonant_decay`, for a force
    without modes, for a degree outside 1 to 9, and for a residual above `most_left`.
    Validity: one mode in the record (`isolate_decay` before), an elastic force of displacement
    alone and a damping force of velocity alone. Zero and drift of the integrated displacement are
    fitted, such that the elastic force is zero at rest.
    """
    from scipy.interpolate import make_interp_spline

    if not 1 <= degree <= _MOST:
        raise InputError(f"`degree` must be from 1 to {_MOST}, but is {degree}.")
    if force is not None and modes is None:
        raise InputError("`modes` are needed with a force: they give its modal constant.")
    times, speed = checked_record(time, velocity)
    curve = make_interp_spline(times, speed, k=_SPLINE)
    acceleration = curve.derivative()(times)
    displacement = curve.antiderivative()(times)
    displacement = displacement - np.polyval(np.polyfit(times, displacement, 1), times)
    if force is not None and modes is not None:
        acceleration = acceleration - drive_point(modes) * _of_length(force, len(times))
    at, peaks = velocity_extremes(times, speed)
    cycle = 2 * float(np.median(np.diff(at)))
    above = peaks >= least_amplitude
    end = at[-1] if above.all() else at[int(np.argmin(above))]
    inside = (times > times[0] + _ENDS * cycle) & (times < min(end, times[-1] - _ENDS * cycle))
    used = peaks[(at > times[0] + _ENDS * cycle) & (at < min(end, times[-1] - _ENDS * cycle))]
    moved, away = displacement[inside], (times[inside] - times[inside].mean()) / cycle
    for _ in range(_SHIFTS):
        terms = [moved**power for power in range(1, degree + 1)]
        shifts = [np.ones_like(moved), away]
        design = np.stack([*terms, *_damping_terms(speed[inside]), *shifts], axis=1)
        scale = np.sqrt(np.mean(design**2, axis=0))
        solved, *_ = np.linalg.lstsq(design / scale, -acceleration[inside], rcond=None)
        coefficients = solved / scale
        if not coefficients[0] > 0:
            break
        moved = moved + (coefficients[-2] + coefficients[-1] * away) / coefficients[0]
    left = design / scale @ solved + acceleration[inside]
    misfit = float(np.sqrt(np.mean(left**2) / np.mean(acceleration[inside] ** 2)))
    if misfit**2 > most_left:
        raise InputError(
            f"the residual of the two forces is {100 * misfit**2:.2g} % of the acceleration's "
            "power: the record has several modes (use `isolate_decay` before), or forces of "
            "another form."
        )
    return RestoringForce(
        coefficients[:degree],
        coefficients[degree : degree + 3],
        float(used.min()),
        float(used.max()),
        misfit,
    )


def restoring_force(
    time: Float[np.ndarray, " sample"],
    velocity: Float[np.ndarray, " sample"],
    force: Float[np.ndarray, " sample"] | None = None,
    modes: LinearModes | None = None,
    *,
    degree: int = 5,
    least_amplitude: float = 0.0,
    most_left: float = 0.5,
) -> MethodResult:
    """Natural frequency and damping that the fitted forces imply, over the record's amplitudes.

    An undamped motion has the period T = ∮ dx / v with ½v² = ∫ s dx between its ends, and the
    fundamental velocity V; 2ζ̃ω̃ = ∮ d(v) v dt / (½ V² T), the mean dissipated power.

    Arguments and errors as in `fit_restoring_force`. Returns a `MethodResult` of 25 amplitudes,
    without 1σ, which the method does not give; its note states the misfit.
    """
    fitted = fit_restoring_force(
        time,
        velocity,
        force,
        modes,
        degree=degree,
        least_amplitude=least_amplitude,
        most_left=most_left,
    )
    notes = (Fact("left_by_two_forces", misfit=fitted.misfit),)
    return method_result("restoring_force", _points(fitted), 0, notes)


def _of_length(force: Float[np.ndarray, " sample"], length: int) -> Float[np.ndarray, " sample"]:
    values = np.asarray(force, dtype=float)
    if values.shape != (length,) or not np.isfinite(values).all():
        raise InputError(
            f"`force` must be finite and have {length} samples, as `time` has, but it has shape "
            f"{values.shape}."
        )
    return values


def _damping_terms(velocity: np.ndarray) -> list[np.ndarray]:
    return [velocity, velocity * np.abs(velocity), velocity**3]


_ANGLE = np.pi * (np.arange(_ANGLES) + 0.5) / _ANGLES  # of half a cycle


class _Cycle(NamedTuple):
    """An undamped motion."""

    natural: float  # rad/s
    velocity: float  # m/s, fundamental
    dissipation: float  # 2ζ̃ω̃, 1/s


def _points(fitted: RestoringForce) -> list[MethodPoint]:
    """Points that span the amplitudes of the record."""
    rest = np.sqrt(max(fitted.elastic[0], np.finfo(float).tiny))
    points = []
    for wanted in np.linspace(fitted.smallest, fitted.largest, _POINTS):
        displacement, cycle = wanted / rest, None
        for _ in range(_ROUNDS):  # the fundamental velocity is nearly proportional to it
            cycle = _cycle(fitted, displacement)
            if cycle is None:
                break
            displacement *= wanted / cycle.velocity
        if cycle is None or not cycle.dissipation > 0:
            points.append(MethodPoint(MethodStatus.NOT_A_MODE, -1))
            continue
        points.append(
            MethodPoint(
                MethodStatus.FOUND,
                -1,
                velocity=cycle.velocity,
                natural_frequency=cycle.natural,
                damping_ratio=cycle.dissipation / (2 * cycle.natural),
            )
        )
    return points


def _energy(fitted: RestoringForce, displacement: np.ndarray) -> np.ndarray:
    """∫ s dx from rest, m²/s²."""
    powers = np.arange(2, len(fitted.elastic) + 2)
    return np.sum(fitted.elastic / powers * displacement[..., None] ** powers, axis=-1)


def _cycle(fitted: RestoringForce, displacement: float) -> _Cycle | None:
    """The motion that starts at a displacement; None where it has no second turning point."""
    top = _energy(fitted, np.array(displacement))
    grid = -displacement * np.linspace(0, _FAR, _ANGLES)
    above = _energy(fitted, grid) >= top
    if not above.any():
        return None
    k = int(np.argmax(above))
    low, high = grid[k], grid[k - 1]  # energies at and above, and below
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if _energy(fitted, middle) >= top else (low, middle)
    centre, radius = (displacement + low) / 2, (displacement - low) / 2
    x = centre + radius * np.cos(_ANGLE)
    square = 2 * (top - _energy(fitted, x))
    if not np.all(square > 0):
        return None
    speed = np.sqrt(square)
    # With x = centre + radius cos φ, dt/dφ is smooth, and its cosine series is integrated.
    by_angle = radius * np.sin(_ANGLE) / speed
    period = 2 * np.pi * float(by_angle.mean())
    order = np.arange(1, _ANGLES // 2)
    series = 2 * np.mean(by_angle[:, None] * np.cos(np.outer(_ANGLE, order)), axis=0)
    time = by_angle.mean() * _ANGLE + np.sin(np.outer(_ANGLE, order)) @ (series / order)
    natural = 2 * np.pi / period
    step = 2 * np.pi / period * by_angle  # dθ/dφ of half a cycle, whose mean over φ is 1
    fundamental = 2 * float(np.mean(speed * np.sin(natural * time) * step))
    power = float(np.mean(fitted.damping_force(speed) * speed * step))
    return _Cycle(natural, fundamental, 2 * power / fundamental**2)
