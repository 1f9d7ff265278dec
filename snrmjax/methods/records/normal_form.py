"""The motion on a two-dimensional spectral submanifold in its polynomial normal form.

In normal-form coordinates z = ρ e^{iθ} a decaying mode obeys ρ̇ = ρ α(ρ²), θ̇ = ω(ρ²), and a
sensor's signal is a polynomial of z and its conjugate. Near-identity changes of z that keep the
form leave one free choice: here ρ is the fundamental amplitude at the sensor,
v = ρ cos θ + Σ_h Re[(c_h + d_h ρ²) ρ^h e^{ihθ}] + offset + e ρ². Where the elastic force has even
terms (an arch, a one-sided stop) the mean of the motion changes as it decays: that is e.

References: S. Jain & G. Haller, Nonlinear Dyn. 107 (2022) 1417, doi:10.1007/s11071-021-06957-4
(polar normal form); T. Breunung & G. Haller, Proc. R. Soc. A 474 (2018) 20180083,
doi:10.1098/rspa.2018.0083 (backbone from it).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from numpy.polynomial import chebyshev
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from snrmjax.numerics.units import HERTZ

_LARGEST = 4.0  # (ρ/scale)² that a trial step may reach
_TOLERANCE = 1e-9
_NODES_A_CYCLE = 1.0  # of the slow flow, between which it is interpolated
_MOST_NODES = 2000


class NormalForm(NamedTuple):
    """Amplitude and phase dynamics, and the harmonics of the sensor's signal."""

    decay: Float[np.ndarray, " term"]  # α = Σ decay_k T_k(2(ρ/scale)² − 1), Chebyshev's T, 1/s
    frequency: Float[np.ndarray, " term"]  # ω likewise, rad/s
    harmonics: Complex[np.ndarray, "harmonic 2"]  # c and d of each order, m/s at ρ = scale
    orders: tuple[int, ...]
    middle: Float[np.ndarray, "2"]  # m/s: offset, and e at ρ = scale
    scale: float  # m/s
    start: Float[np.ndarray, "2"]  # ln(ρ/scale) and phase (rad) at the record's first sample

    def decay_rate(self, amplitude: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """α in 1/s at fundamental velocity amplitudes in m/s; negative where the motion decays."""
        return chebyshev.chebval(2 * (amplitude / self.scale) ** 2 - 1, self.decay)

    def angular_frequency(self, amplitude: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """ω of the decaying motion in rad/s."""
        return chebyshev.chebval(2 * (amplitude / self.scale) ** 2 - 1, self.frequency)

    def modal_damping(self, amplitude: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Dissipated power over ½ m V² (1/s), as at phase resonance: 2ζ̃ω̃.

        The energy of a conservative motion changes by its frequency times the change of its
        action, dE = ω dJ with J = m V² (1 + h)/(2ω), h the power of the harmonics over that of
        the fundamental; so 2ζ̃ω̃ = −(ω/V²) d/dt [V² (1 + h)/ω].
        """
        ratio = amplitude / self.scale
        alpha, omega = self.decay_rate(amplitude), self.angular_frequency(amplitude)
        slope_of = chebyshev.chebder(self.frequency)  # by 2(ρ/scale)²: d/d ln ρ is 4(ρ/scale)²
        frequency_slope = 4 * ratio**2 * chebyshev.chebval(2 * ratio**2 - 1, slope_of) / omega
        power, slope = np.zeros_like(ratio), np.zeros_like(ratio)
        for order, (first, second) in zip(self.orders, self.harmonics, strict=True):
            harmonic = (first + second * ratio**2) * ratio ** (order - 1) / self.scale
            rise = (order - 1) * harmonic + 2 * second * ratio ** (order + 1) / self.scale
            power += np.abs(harmonic) ** 2
            slope += 2 * np.real(np.conj(harmonic) * rise)
        return -2 * alpha * ((1 + power) * (1 - frequency_slope / 2) + slope / 2)


class SensorSignal(NamedTuple):
    """The sensor's signal of a normal form, and its sensitivities to the unknowns."""

    signal: Float[np.ndarray, " sample"]
    jacobian: Float[np.ndarray, "sample unknown"]
    amplitude: Float[np.ndarray, " sample"]  # ρ, m/s
    phase: Float[np.ndarray, " sample"]  # rad


def unknowns_of(form: NormalForm) -> Float[np.ndarray, " unknown"]:
    """Start, decay, frequency, harmonics (real and imaginary parts) and middle as one vector."""
    parts = form.harmonics.ravel()
    return np.concatenate(
        [form.start, form.decay, form.frequency, parts.real, parts.imag, form.middle]
    )


def form_of(
    unknowns: Float[np.ndarray, " unknown"], terms: int, orders: Sequence[int], scale: float
) -> NormalForm:
    """A normal form from its unknowns, in the order of `unknowns_of`."""
    start, decay, frequency, rest = np.split(unknowns, [2, 2 + terms, 2 + 2 * terms])
    parts = rest[:-2].reshape(2, len(orders), 2)
    harmonics = parts[0] + 1j * parts[1]
    return NormalForm(decay, frequency, harmonics, tuple(orders), rest[-2:], scale, np.array(start))


def sensor_signal(form: NormalForm, time: Float[np.ndarray, " sample"]) -> SensorSignal:
    """The sensor's signal of the decaying motion, and its sensitivities.

    Amplitude and phase, and their derivatives with respect to start and coefficients, are one
    slow system of ordinary differential equations. Raises `ArithmeticError` where it cannot be
    integrated.
    """
    terms = len(form.decay)
    slow = _slow_flow(form, time)
    log_ratio, phase = slow[0], slow[1]
    ratio = np.exp(np.minimum(log_ratio, 0.5 * np.log(_LARGEST)))
    phasor = np.exp(1j * phase)
    amplitude = form.scale * ratio
    middle = form.middle[1] * ratio**2
    signal = amplitude * phasor.real + form.middle[0] + middle
    # Derivatives of the signal with respect to ln ρ and θ, harmonics included.
    by_amplitude, by_phase = amplitude * phasor.real + 2 * middle, -amplitude * phasor.imag
    linear: list[list[np.ndarray]] = [[], []]
    for order, pair in zip(form.orders, form.harmonics, strict=True):
        rotating = phasor**order
        for extra, coefficient in zip((0, 2), pair, strict=True):
            wave = ratio ** (order + extra) * rotating
            part = coefficient * wave
            signal = signal + part.real
            by_amplitude = by_amplitude + (order + extra) * part.real
            by_phase = by_phase - order * part.imag
            linear[0].append(wave.real)
            linear[1].append(-wave.imag)
    # Rows 2…: ∂ln ρ and ∂θ with respect to ln ρ(0) and each decay; ∂θ for each frequency.
    amplitude_rows = slow[2 : 3 + terms]
    phase_rows = slow[3 + terms : 4 + 2 * terms]
    both = by_amplitude * amplitude_rows + by_phase * phase_rows
    of_frequency = by_phase * slow[4 + 2 * terms :]
    columns = [both[0], by_phase, *both[1:], *of_frequency, *linear[0], *linear[1]]
    jacobian = np.stack([*columns, np.ones_like(signal), ratio**2], axis=1)
    return SensorSignal(signal, jacobian, amplitude, phase)


def _slow_flow(
    form: NormalForm, time: Float[np.ndarray, " sample"]
) -> Float[np.ndarray, "row sample"]:
    """ln ρ, θ and their sensitivities to start and coefficients, at the record's times."""
    terms = len(form.decay)
    # Values of the polynomials T_k(2r − 1), r = (ρ/scale)², and 4r times their derivatives:
    # d/d ln ρ = 2r d/dr.
    values = np.eye(terms)
    roughness = chebyshev.chebder(values, axis=0)

    def rate(_: float, state: np.ndarray) -> np.ndarray:
        square = np.exp(2 * min(state[0], 0.5 * np.log(_LARGEST)))
        polynomials = chebyshev.chebval(2 * square - 1, values)
        log_slopes = 4 * square * chebyshev.chebval(2 * square - 1, roughness) * (square < _LARGEST)
        sensitivity = state[2 : 3 + terms]
        d_amplitude, d_phase = (
            (form.decay @ log_slopes) * sensitivity,
            (form.frequency @ log_slopes) * sensitivity,
        )
        d_amplitude[1:] += polynomials
        rates = [form.decay @ polynomials, form.frequency @ polynomials]
        return np.concatenate([rates, d_amplitude, d_phase, polynomials])

    initial = np.zeros(4 + 3 * terms)
    initial[:2], initial[2] = form.start, 1.0
    span = time[-1] - time[0]
    cycles = span * abs(form.frequency[0]) / HERTZ
    nodes = np.linspace(0, span, int(np.clip(cycles * _NODES_A_CYCLE, 50, _MOST_NODES)))
    solution = solve_ivp(
        rate, (0, span), initial, "DOP853", t_eval=nodes, rtol=_TOLERANCE, atol=_TOLERANCE
    )
    if not solution.success or not np.isfinite(solution.y).all():
        raise ArithmeticError("the amplitude of the normal form cannot be integrated.")
    slopes_at = np.stack([rate(0.0, column) for column in solution.y.T], axis=1)
    return CubicHermiteSpline(nodes, solution.y, slopes_at, axis=1)(time - time[0])
