"""CONCERTO: natural frequency and loss factor from two frequencies of equal displacement.

At equal displacement amplitude a nonlinear structure has one equivalent stiffness and damping, so
that the two states of that amplitude, below and above resonance, belong to one linear mode,
α (λ − Ω²) = C with λ = ω̃²(1 + iη). Two receptances give λ = (α₂Ω₂² − α₁Ω₁²)/(α₂ − α₁), for any
complex modal constant C.

Reference: A. Carrella & D. J. Ewins, Mech. Syst. Signal Process. 25 (2011) 1011,
doi:10.1016/j.ymssp.2010.09.011.
"""

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.states import SteadyStates
from snrmjax.methods.one_sensor import SensorStates, sensor_states
from snrmjax.methods.result import MethodPoint, MethodResult, MethodStatus, method_result
from snrmjax.methods.steady.equal_amplitude import CONTROLLED, displacement_spread
from snrmjax.model.modes import LinearModes

_ROUNDING = 1e-9  # relative tolerance of equal displacement


def concerto(data: SteadyStates, modes: LinearModes) -> MethodResult:
    """Natural frequency and damping of every level at amplitudes reached on both sides.

    Every measured state with a partner of equal displacement on the other side of resonance gives
    a point; the partner's frequency and receptance are interpolated in amplitude. The phase
    separates the sides, so that up and down sweeps may be mixed. The force may vary in a level.

    Arguments: `data` with forces (or drive voltages) and phases; `modes` only names the sensor.
    Returns a `MethodResult`; damping ratio is η/2, velocity is ω̃ times the displacement.
    1σ from the stated errors of both states, to first order; it grows towards the peak, where the
    two states coincide. Levels without a pair are `ONE_SIDE`, those of controlled displacement
    `AMPLITUDE_CONTROLLED`.
    Raises `ValueError` where the data have neither forces nor drive voltages, or no phases.
    Validity: one mode, hysteretic damping (η is constant between the two frequencies), the
    displacement monotonic in frequency on each side.
    """
    states = sensor_states(data, modes, any_scale=True)
    points = [point for level, at_level in states.levels() for point in _pairs(level, at_level)]
    return method_result("concerto", points, len(states.level))


def _pairs(level: int, states: SensorStates) -> list[MethodPoint]:
    """The points of one level, one for each state with a partner."""
    if displacement_spread(states) <= CONTROLLED:
        return [MethodPoint(MethodStatus.AMPLITUDE_CONTROLLED, level)]
    amplitude = np.abs(states.displacement)
    below, above = (_rising(states, side) for side in (states.phase >= 0, states.phase < 0))
    points = []
    for side, other in ((below, above), (above, below)):
        if len(other) < 2:
            continue
        partners = amplitude[other]
        for k in side:
            if not partners[0] * (1 - _ROUNDING) <= amplitude[k] <= partners[-1] * (1 + _ROUNDING):
                continue
            upper = int(np.clip(np.searchsorted(partners, amplitude[k]), 1, len(other) - 1))
            two = other[[upper - 1, upper]]
            fraction = (amplitude[k] - amplitude[two[0]]) / (amplitude[two[1]] - amplitude[two[0]])
            points.append(_point(level, states, int(k), two, np.array([1 - fraction, fraction])))
    return points or [MethodPoint(MethodStatus.ONE_SIDE, level)]


def _rising(states: SensorStates, side: np.ndarray) -> np.ndarray:
    """States of one side by rising displacement, without duplicate displacements."""
    rows = np.flatnonzero(side)
    _, first = np.unique(np.abs(states.displacement)[rows], return_index=True)
    return rows[first]


def _point(
    level: int, states: SensorStates, k: int, two: np.ndarray, weight: np.ndarray
) -> MethodPoint:
    """The mode of one state and its interpolated partner."""
    alpha = states.receptance
    alpha_1, alpha_2 = alpha[k], complex(weight @ alpha[two])
    square_1, other = states.frequency[k] ** 2, float(weight @ states.frequency[two] ** 2)
    difference = alpha_2 - alpha_1
    eigenvalue = (alpha_2 * other - alpha_1 * square_1) / difference
    if not (eigenvalue.real > 0 and eigenvalue.imag > 0):
        return MethodPoint(MethodStatus.NOT_A_MODE, level)
    natural = float(np.sqrt(eigenvalue.real))
    loss = float(eigenvalue.imag / eigenvalue.real)
    # dλ = λ_α₁ dα₁ + λ_α₂ dα₂, λ_α₁ = α₂(Ω₂² − Ω₁²)/(α₂ − α₁)², λ_α₂ = −α₁(…): per relative error.
    gain = alpha_1 * alpha_2 * (other - square_1) / difference**2
    real, imag = _variance(gain, states, np.array([k]), np.ones(1)) + _variance(
        -gain, states, two, weight
    )
    return MethodPoint(
        MethodStatus.FOUND,
        level,
        natural * float(np.abs(states.displacement)[k]),
        natural,
        float(np.sqrt(real)) / (2 * natural),
        loss / 2,
        float(np.sqrt(imag + loss**2 * real)) / (2 * eigenvalue.real),
    )


def _variance(
    gain: Complex[np.ndarray, ""], states: SensorStates, rows: np.ndarray, weight: np.ndarray
) -> Float[np.ndarray, "2"]:
    """Variances of Re λ and Im λ from the relative amplitude error and the phase error of α."""
    amplitude = float(np.sum((weight * states.amplitude_std[rows]) ** 2))
    phase = float(np.sum((weight * states.phase_std[rows]) ** 2))
    parts = np.array([[gain.real**2, gain.imag**2], [gain.imag**2, gain.real**2]])
    return parts @ np.array([amplitude, phase])
