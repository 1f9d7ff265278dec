"""Restoring-force surface of one mode: what force a motion meets, over displacement and velocity.

A mode obeys ẍ + s(x) + d(v) = |Φ_r Φᵀb| F. Acceleration and displacement follow from the measured
velocity, and two polynomials are fitted to what is left of every sample: an elastic force over
displacement and a damping force over velocity, both per unit of modal mass at the sensor. Harmonic
balance of one term then gives natural frequency and damping at each amplitude.

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

_POINTS = 25  # amplitudes at which the fitted surface is asked
_ANGLES = 128  # of a cycle
_SPLINE = 5  # degree: velocity, its derivative and its integral from one curve
_ENDS = 2.0  # cycles at each end that the curve's derivative is not trusted in
_MOST = 9


class RestoringForce(NamedTuple):
    """The two fitted forces, per unit of modal mass at the sensor (m/s²)."""

    elastic: Float[np.ndarray, " power"]  # s(x) = Σ k_i x^i, i = 1…, 1/(s² m^(i−1))
    damping: Float[np.ndarray, "3"]  # d(v) = c₁ v + c₂ v|v| + c₃ v³
    smallest: float  # m/s, velocity amplitude of the record's smallest cycle used
    largest: float
    misfit: float  # rms of what the two forces leave, over the rms of the acceleration

    def elastic_force(self, displacement: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """s(x) in m/s²."""
        powers = np.arange(1, len(self.elastic) + 1)
        return np.sum(self.elastic * displacement[..., None] ** powers, axis=-1)

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
) -> RestoringForce:
    """Fit elastic and damping force to a record of one mode, free or forced.

    Arguments: `time` in s, evenly spaced; `velocity` in m/s; `force` in N, where one acts, with the
    `modes` that say what it does to the mode of interest (|Φ_r Φᵀb|); `degree` of the elastic
    force. A free decay is read down to `least_amplitude` (m/s).
    Returns a `RestoringForce`. Raises `ValueError` for a record as in `resonant_decay`, for a force
    without modes and for a degree outside 1 to 9.
    Validity: one mode in the record (filter others out before), an elastic force of displacement
    alone and a damping force of velocity alone, no offset of the displacement: it is integrated.
    """
    from scipy.interpolate import make_interp_spline

    if not 1 <= degree <= _MOST:
        raise ValueError(f"`degree` must be from 1 to {_MOST}, but is {degree}.")
    if force is not None and modes is None:
        raise ValueError("restoring_force needs `modes` with a force: they say what it drives.")
    times, speed = checked_record(time, velocity, "restoring_force")
    curve = make_interp_spline(times, speed, k=_SPLINE)
    acceleration = curve.derivative()(times)
    displacement = curve.antiderivative()(times)
    displacement = displacement - np.polyval(np.polyfit(times, displacement, 1), times)
    if force is not None and modes is not None:
        acceleration = acceleration - drive_point(modes) * _of_length(force, len(times))
    at, size = velocity_extremes(times, speed)
    cycle = 2 * float(np.median(np.diff(at)))
    above = size >= least_amplitude
    end = at[-1] if above.all() else at[int(np.argmin(above))]
    inside = (times > times[0] + _ENDS * cycle) & (times < min(end, times[-1] - _ENDS * cycle))
    used = size[(at > times[0] + _ENDS * cycle) & (at < min(end, times[-1] - _ENDS * cycle))]
    terms = [displacement[inside] ** power for power in range(1, degree + 1)]
    design = np.stack([*terms, *_damping_terms(speed[inside])], axis=1)
    scale = np.sqrt(np.mean(design**2, axis=0))
    solved, *_ = np.linalg.lstsq(design / scale, -acceleration[inside], rcond=None)
    left = design / scale @ solved + acceleration[inside]
    misfit = float(np.sqrt(np.mean(left**2) / np.mean(acceleration[inside] ** 2)))
    found = solved / scale
    return RestoringForce(
        found[:degree], found[degree:], float(used.min()), float(used.max()), misfit
    )


def restoring_force(
    time: Float[np.ndarray, " sample"],
    velocity: Float[np.ndarray, " sample"],
    force: Float[np.ndarray, " sample"] | None = None,
    modes: LinearModes | None = None,
    *,
    degree: int = 5,
    least_amplitude: float = 0.0,
) -> MethodResult:
    """Natural frequency and damping that the fitted forces imply, over the record's amplitudes.

    Of a motion x = X cos θ: ω̃² = ∮ s(x) cos θ dθ / (πX), and 2ζ̃ω̃ = ∮ d(v) sin θ dθ / (πV) with
    v = V sin θ, the mean power of one term of harmonic balance.

    Arguments and errors as in `fit_restoring_force`. Returns a `MethodResult` of 25 amplitudes,
    without 1σ, which the method does not give; its note has the misfit.
    """
    fitted = fit_restoring_force(
        time, velocity, force, modes, degree=degree, least_amplitude=least_amplitude
    )
    points = [_point(fitted, size) for size in _displacements(fitted)]
    note = f"the two forces leave {100 * fitted.misfit:.2g} % of the acceleration (rms)"
    return method_result("restoring_force", points, 0, (note,))


def _of_length(force: Float[np.ndarray, " sample"], length: int) -> Float[np.ndarray, " sample"]:
    values = np.asarray(force, dtype=float)
    if values.shape != (length,) or not np.isfinite(values).all():
        raise ValueError(
            f"restoring_force needs a finite `force` of {length} samples, as `time` has, but it "
            f"has shape {values.shape}."
        )
    return values


def _damping_terms(velocity: np.ndarray) -> list[np.ndarray]:
    return [velocity, velocity * np.abs(velocity), velocity**3]


_ANGLE = 2 * np.pi * np.arange(_ANGLES) / _ANGLES


def _square(fitted: RestoringForce, size: float) -> float:
    """ω̃² at a displacement amplitude."""
    pulled = fitted.elastic_force(size * np.cos(_ANGLE))
    return float(2 * np.mean(pulled * np.cos(_ANGLE)) / size)


def _displacements(fitted: RestoringForce) -> Float[np.ndarray, " k"]:
    """Displacement amplitudes that span the record's velocity amplitudes."""
    ends = []
    for velocity in (fitted.smallest, fitted.largest):
        size = velocity / np.sqrt(max(fitted.elastic[0], np.finfo(float).tiny))
        for _ in range(50):  # x = v / ω̃(x): ω̃ changes little with amplitude
            square = _square(fitted, size)
            if not square > 0:
                break
            size = velocity / np.sqrt(square)
        ends.append(size)
    low, high = ends
    return np.linspace(low, high, _POINTS)


def _point(fitted: RestoringForce, size: float) -> MethodPoint:
    square = _square(fitted, size)
    if not square > 0:
        return MethodPoint(MethodStatus.NOT_A_MODE, -1)
    natural = float(np.sqrt(square))
    speed = natural * size
    lost = fitted.damping_force(speed * np.sin(_ANGLE))
    damping = float(2 * np.mean(lost * np.sin(_ANGLE)) / speed)
    if not damping > 0:
        return MethodPoint(MethodStatus.NOT_A_MODE, -1)
    return MethodPoint(
        MethodStatus.FOUND,
        -1,
        velocity=speed,
        natural_frequency=natural,
        damping_ratio=damping / (2 * natural),
    )
