"""Harmonic force surface: the force that a response needs, over frequency and amplitude.

Response-controlled levels give the complex force F(Ω, X) at each frequency and displacement. The
interpolated surface, cut at constant |F|, is the response to that constant force, including the
branch that a sweep would jump over.

Reference: T. Karaağaçlı & H. N. Özgüven, Vibration 3 (2020) 266,
doi:10.3390/vibration3030019.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.states import SteadyStates
from snrmjax.methods.one_sensor import drive_point, sensor_states
from snrmjax.methods.result import MethodPoint, MethodResult, MethodStatus, method_result
from snrmjax.methods.steady.equal_amplitude import AmplitudeSection, sections_of
from snrmjax.model.modes import LinearModes
from snrmjax.numerics.rules import InputError

_FEWEST_LEVELS, _FEWEST_STATES = 2, 3
_WITHIN = 2.0  # times the least force: range of the parabola fit
_FINE = 400  # interpolated amplitudes in which a cut is searched


class ForceSurface(NamedTuple):
    """The measured surface: complex forces by level of displacement and frequency."""

    amplitude: Float[np.ndarray, " level"]  # m, rising
    frequency: Float[np.ndarray, " frequency"]  # rad/s, common to all levels
    force: Complex[np.ndarray, "level frequency"]  # N, relative to the displacement

    def cut(self, force: float) -> tuple[Float[np.ndarray, " point"], Float[np.ndarray, " point"]]:
        """Frequencies (rad/s) and displacement amplitudes (m) under a constant force (N).

        Every amplitude at which |F| crosses the force is a point, so that up to three share a
        frequency. Sorted by frequency; empty where the force is outside the surface.
        """
        fine = np.linspace(self.amplitude[0], self.amplitude[-1], _FINE)
        crossings: list[tuple[float, float]] = []
        for k, omega in enumerate(self.frequency):
            column = self.force[:, k]
            real = np.interp(fine, self.amplitude, column.real)
            excess = np.abs(real + 1j * np.interp(fine, self.amplitude, column.imag)) - force
            for j in np.flatnonzero(np.sign(excess[:-1]) != np.sign(excess[1:])):
                fraction = excess[j] / (excess[j] - excess[j + 1])
                crossings.append(
                    (float(omega), float(fine[j] + fraction * (fine[j + 1] - fine[j])))
                )
        points = np.array(sorted(crossings)).reshape(-1, 2)
        return points[:, 0], points[:, 1]


def force_surface(data: SteadyStates, modes: LinearModes) -> ForceSurface:
    """The surface interpolated between levels, at the frequencies that all levels cover.

    Raises `ValueError` where fewer than two amplitudes have three states, or share no frequencies.
    """
    sections = _usable(data, modes)
    if len(sections) < _FEWEST_LEVELS:
        raise InputError(
            "two or more levels of controlled displacement with three states each are needed, but "
            f"the data have {len(sections)}."
        )
    low = max(section.frequency[0] for section in sections)
    high = min(section.frequency[-1] for section in sections)
    if not low < high:
        raise InputError("levels must share a range of frequencies.")
    frequencies = np.unique(np.concatenate([section.frequency for section in sections]))
    frequency = frequencies[(frequencies >= low) & (frequencies <= high)]
    rows = sorted(sections, key=lambda section: section.amplitude)
    forces = [row.amplitude * _interpolated(frequency, row) for row in rows]
    return ForceSurface(np.array([row.amplitude for row in rows]), frequency, np.array(forces))


def harmonic_force_surface(data: SteadyStates, modes: LinearModes) -> MethodResult:
    """Peak of the constant-force response, by level of displacement.

    At each amplitude the required force is least at the peak of the response to that force: a
    parabola through |F|² against Ω² near it gives its frequency, and the power balance,
    2ζ̃ω̃ = |Φ_r Φᵀb| |F| / |v|, its damping.

    Arguments: `data` with forces in N and phases; `modes` has the modal mass of the mode of
    interest. Returns a `MethodResult` with one point per amplitude, without 1σ, which the method
    does not give. Levels whose least force is at an end are `NO_RESONANCE`.
    Raises `ValueError` where the data have no forces or no phases.
    """
    sections = _usable(data, modes)
    points = [_peak(section, drive_point(modes)) for section in sections]
    if not points:
        points = [MethodPoint(MethodStatus.TOO_FEW_STATES, -1)]
    count = sum(len(section.frequency) for section in sections)
    return method_result("harmonic_force_surface", points, count)


def _usable(data: SteadyStates, modes: LinearModes) -> list[AmplitudeSection]:
    sections, _ = sections_of(sensor_states(data, modes))
    return [section for section in sections if len(section.frequency) >= _FEWEST_STATES]


def _interpolated(
    frequency: Float[np.ndarray, " k"], section: AmplitudeSection
) -> Complex[np.ndarray, " k"]:
    real = np.interp(frequency, section.frequency, section.stiffness.real)
    return real + 1j * np.interp(frequency, section.frequency, section.stiffness.imag)


def _peak(section: AmplitudeSection, per_force: float) -> MethodPoint:
    """Frequency of least force of one section.

    |F|² of a linear mode is a parabola in Ω², fitted with equal relative weights to the states of
    up to twice the least force, at least to the three states around it.
    """
    square = np.abs(section.stiffness) ** 2
    k = int(np.argmin(square))
    if k in (0, len(square) - 1):
        return MethodPoint(MethodStatus.NO_RESONANCE, section.level)
    near = square <= _WITHIN**2 * square[k]
    near[k - 1 : k + 2] = True
    center = section.frequency[k] ** 2
    away = section.frequency[near] ** 2 - center
    width = np.max(np.abs(away))
    curve = np.polyfit(away / width, square[near], 2, w=1 / square[near])
    lowest = -curve[1] / (2 * curve[0])
    least = float(np.polyval(curve, lowest))
    if not (curve[0] > 0 and least > 0 and center + width * lowest > 0):
        return MethodPoint(MethodStatus.NOT_A_MODE, section.level)
    omega = float(np.sqrt(center + width * lowest))
    damping = per_force * np.sqrt(least) / omega
    return MethodPoint(
        MethodStatus.FOUND,
        section.level,
        velocity=omega * section.amplitude,
        natural_frequency=omega,
        damping_ratio=float(damping / (2 * omega)),
    )
