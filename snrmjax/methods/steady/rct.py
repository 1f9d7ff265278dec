"""Response-controlled stepped sine: a linear mode fitted at each controlled amplitude.

At constant displacement amplitude a nonlinear mode responds linearly, so that standard modal
analysis of each level gives natural frequency and damping at its amplitude. Here a straight line
is fitted to the inverse receptance, F/X = (λ − Ω²)/C, by least squares.

Reference: T. Karaağaçlı & H. N. Özgüven, Vibration 3 (2020) 266,
doi:10.3390/vibration3030019; for the line, D. J. Ewins, Modal Testing (2000), section 4.2.
"""

import numpy as np

from snrmjax.measure.states import SteadyStates
from snrmjax.methods.one_sensor import sensor_states
from snrmjax.methods.result import MethodPoint, MethodResult, MethodStatus, method_result
from snrmjax.methods.steady.equal_amplitude import CONTROLLED, AmplitudeSection, sections_of
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.facts import Fact

_UNKNOWNS = 2  # complex: 1/C and λ/C
_NEAR = 3.0  # half-power bandwidths on each side of resonance in the second fit


def rct(data: SteadyStates, modes: LinearModes) -> MethodResult:
    """Natural frequency and damping at each controlled displacement amplitude.

    Levels whose displacement stays within ±10 % are fitted directly. Where there are none (tests
    of constant force) the levels are interpolated at common amplitudes on both sides of resonance.

    Arguments: `data` with forces (or drive voltages) and phases; `modes` only names the sensor.
    Returns a `MethodResult` with one point per amplitude; 1σ from the scatter about the line.
    Sections of fewer than three states are `TOO_FEW_STATES`.
    Raises `ValueError` where the data have neither forces nor drive voltages, or no phases.
    Validity: one mode near resonance with hysteretic damping; a response level that varies within
    ±10 % is averaged.
    """
    states = sensor_states(data, modes, any_scale=True)
    sections, controlled = sections_of(states)
    notes = () if controlled else (Fact("sections_between_levels", spread=CONTROLLED),)
    points = [_mode_of(section) for section in sections]
    if not points:
        points = [MethodPoint(MethodStatus.ONE_SIDE, level) for level, _ in states.levels()]
    return method_result("rct", points, len(states.level), notes)


def _mode_of(section: AmplitudeSection) -> MethodPoint:
    """The linear mode of one section, by weighted least squares, repeated near resonance."""
    if len(section.frequency) <= _UNKNOWNS:
        return MethodPoint(MethodStatus.TOO_FEW_STATES, section.level)
    eigenvalue, variance = _line(section.frequency, section.stiffness)
    if eigenvalue.real > 0 and eigenvalue.imag > 0:
        natural = np.sqrt(eigenvalue.real)
        width = eigenvalue.imag / natural  # η ω̃: between half-power points
        near = np.abs(section.frequency - natural) < _NEAR * width
        if near.sum() > _UNKNOWNS:
            eigenvalue, variance = _line(section.frequency[near], section.stiffness[near])
    if not (eigenvalue.real > 0 and eigenvalue.imag > 0):
        return MethodPoint(MethodStatus.NOT_A_MODE, section.level)
    natural = float(np.sqrt(eigenvalue.real))
    loss = float(eigenvalue.imag / eigenvalue.real)
    std = float(np.sqrt(variance))  # of Re λ and of Im λ
    return MethodPoint(
        MethodStatus.FOUND,
        section.level,
        natural * section.amplitude,
        natural,
        std / (2 * natural),
        loss / 2,
        float(np.hypot(1.0, loss)) * std / (2 * eigenvalue.real),
    )


def _line(frequency: np.ndarray, stiffness: np.ndarray) -> tuple[complex, float]:
    """λ of F/X = (λ − Ω²)/C, and the variance of its real and of its imaginary part."""
    center = float(np.mean(frequency**2))
    # Equal relative weights; subtracting the mean of Ω² avoids cancellation.
    magnitude = np.abs(stiffness)
    design = (
        np.stack([np.ones_like(frequency), -(frequency**2 - center)], axis=1) / magnitude[:, None]
    )
    scale = np.linalg.norm(design, axis=0)
    solved, *_ = np.linalg.lstsq(design / scale, stiffness / magnitude, rcond=None)
    numerator, inverse = solved / scale  # (λ − center)/C and 1/C
    eigenvalue = complex(center + numerator / inverse)
    residual = stiffness / magnitude - design @ np.array([numerator, inverse])
    degrees_of_freedom = len(frequency) - _UNKNOWNS
    noise = (
        float(np.sum(np.abs(residual) ** 2) / (2 * degrees_of_freedom))
        if degrees_of_freedom
        else np.nan
    )
    covariance = np.linalg.inv(design.T @ design) * noise
    slope = np.array([1.0, -(eigenvalue - center)]) / inverse
    return eigenvalue, float(np.real(slope.conj() @ covariance @ slope))
