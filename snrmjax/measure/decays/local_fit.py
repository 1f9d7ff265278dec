"""Mode-tracking filter: local least squares of a decaying oscillation.

About each instant t_k the record is fitted, with Gaussian weights of σ cycles, by
Re[(a + b s) e^{L(t) − Re L(t_k)}] + harmonics + offset: L = ln amplitude + i·phase is the current
carrier, s the time from t_k, and a, b its correction. An exact carrier has a = e^{L(t_k)}, phase
included, and b = 0; three rounds of L ← L + ln(a/…) converge, because one round passes a
modulation of ν cycles per cycle by H(ν) = e^{−(2πσν)²/2} and n rounds by 1 − (1 − H)^n.
The filter has no phase shift, tracks the mode, and needs no truncation: near the ends of the
record the least squares have less data.

It is a local polynomial regression (J. Fan & I. Gijbels, Local Polynomial Modelling and Its
Applications, 1996, chapter 3) of the demodulated record (M. Feldman, Mech. Syst. Signal Process.
25 (2011) 735, doi:10.1016/j.ymssp.2010.07.018, section 4).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy.interpolate import CubicSpline

REACH = 3.5  # σ, at which the weights are truncated
ROUNDS = 3
_ORDERS = (2, 3)  # harmonics in addition to the fundamental
_CHUNK = 256  # instants per batch
_RIDGED = 1e-9  # ridge term, of the normal equations' diagonal


class Carrier(NamedTuple):
    """Logarithm of the mode's complex amplitude at some times, and its rate."""

    time: Float[np.ndarray, " k"]
    value: Complex[np.ndarray, " k"]  # ln(m/s) + i rad

    def curve(self) -> CubicSpline:
        """The carrier as a smooth function of time."""
        return CubicSpline(self.time, self.value)


class LocalFit(NamedTuple):
    """Local least squares at some instants."""

    time: Float[np.ndarray, " k"]
    first: Int[np.ndarray, " k"]  # sample at which each window begins
    level: Complex[np.ndarray, " k"]  # ln of the complex amplitude
    rate: Complex[np.ndarray, " k"]  # its derivative: −decay + iω
    level_rows: Complex[np.ndarray, "k window"]  # d ln a / d sample
    rate_rows: Complex[np.ndarray, "k window"]


def instants(carrier: Carrier, per_cycle: float) -> Float[np.ndarray, " k"]:
    """Times at equal steps of the carrier's phase, both ends included."""
    curve = carrier.curve()
    fine = np.linspace(carrier.time[0], carrier.time[-1], 8 * len(carrier.time) + 1)
    phase = np.maximum.accumulate(curve(fine).imag)
    count = max(8, round((phase[-1] - phase[0]) / (2 * np.pi) * per_cycle))
    wanted = np.linspace(phase[0], phase[-1], count + 1)
    rising = np.concatenate([[True], np.diff(phase) > 0])
    return np.interp(wanted, phase[rising], fine[rising])


def local_fit(
    time: Float[np.ndarray, " sample"],
    signal: Float[np.ndarray, " sample"],
    carrier: Carrier,
    at: Float[np.ndarray, " k"],
    sigma: float,
    *,
    rows: bool = False,
) -> LocalFit:
    """Fit the record about every instant `at`, with weights of `sigma` cycles.

    With `rows` also the sensitivities of level and rate to each sample, for error propagation.
    """
    curve = carrier.curve()
    whole, slope = curve(time), curve(at, 1)
    here = curve(at)
    step = float(time[1] - time[0])
    omega = np.abs(slope.imag)
    half = REACH * sigma * 2 * np.pi / omega  # s
    first = np.searchsorted(time, at - half)
    last = np.searchsorted(time, at + half, side="right")
    width = int((last - first).max())
    first = np.minimum(first, len(time) - width)
    columns = _ORDERS if np.max(omega) * max(_ORDERS) * step < np.pi else ()
    levels, rates = [], []
    kept: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for start in range(0, len(at), _CHUNK):
        part = slice(start, start + _CHUNK)
        index = first[part, None] + np.arange(width)
        away = time[index] - at[part, None]
        cycles = away * omega[part, None] / (2 * np.pi)
        weight = np.exp(-((cycles / sigma) ** 2) / 2) * (np.abs(cycles) <= REACH * sigma)
        relative = whole[index] - here[part, None]
        wave = np.exp(relative)
        design = [wave.real, -wave.imag, cycles * wave.real, -cycles * wave.imag]
        for order in columns:
            harmonic = np.exp(relative.real + 1j * order * relative.imag)
            design += [harmonic.real, -harmonic.imag]
        design.append(np.ones_like(cycles))
        matrix = np.stack(design, axis=1)  # instant, column, sample
        weighted = matrix * weight[:, None]
        normal = weighted @ matrix.transpose(0, 2, 1)
        diagonal = np.einsum("kii->ki", normal)
        diagonal += _RIDGED * diagonal.max(axis=1, keepdims=True)
        operator = np.linalg.solve(normal, weighted)[:, :4]
        solved = (operator @ signal[index][..., None])[..., 0]
        a, b = solved[:, 0] + 1j * solved[:, 1], solved[:, 2] + 1j * solved[:, 3]
        levels.append(a)
        rates.append(b / a * omega[part] / (2 * np.pi))
        if rows:
            of_a = (operator[:, 0] + 1j * operator[:, 1]) / a[:, None]
            of_b = (operator[:, 2] + 1j * operator[:, 3]) / a[:, None]
            kept[0].append(of_a)
            of_rate = of_b - (b / a)[:, None] * of_a
            kept[1].append(of_rate * (omega[part] / (2 * np.pi))[:, None])
    a, extra = np.concatenate(levels), np.concatenate(rates)
    # Correction of the carrier, with the phase unwrapped over the instants.
    ratio = a * np.exp(-here)
    correction = np.log(np.abs(ratio)) + 1j * np.unwrap(np.angle(ratio))
    none = np.zeros((len(at), 0), dtype=complex)
    return LocalFit(
        at,
        first,
        here + correction,
        slope + extra,
        np.concatenate(kept[0]) if rows else none,
        np.concatenate(kept[1]) if rows else none,
    )


def passed(nu: Float[np.ndarray, "..."], sigma: float) -> Float[np.ndarray, "..."]:
    """Gain of `ROUNDS` rounds for a modulation of `nu` cycles per cycle."""
    return 1 - (1 - np.exp(-((2 * np.pi * sigma * nu) ** 2) / 2)) ** ROUNDS
