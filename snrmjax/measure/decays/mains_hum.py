"""Mains hum in a decay: steady tones in addition to the decaying mode."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.decays.decay_reading import DecayReading, wave_of
from snrmjax.measure.decays.local_fit import Carrier
from snrmjax.numerics.units import HERTZ

_MAINS = (50.0, 60.0)
_MAINS_OFF = 0.2  # Hz, tolerance of the mains frequency
_MAINS_NEAR = 3.0  # largest ratio to the mode's frequency, or its inverse
_SURE = 4.0  # least signal-to-noise ratio of a hum line
_NEIGHBOURS = np.arange(2, 9)  # spectral lines on either side, for the noise level
_APART = 2.0  # least cycles of phase difference between hum and mode over the record
_SMOOTH_ERROR = 0.05  # of the mode's amplitude: error of the smooth decay
_MEDIAN_OF_POWER = float(np.log(2))  # over the mean, of a spectrum's bins


def _white(signal: np.ndarray) -> float:
    """1σ of white noise from the median of the spectrum."""
    from scipy.signal import welch

    density = welch(signal, nperseg=min(len(signal), 4096))[1]
    return float(np.sqrt(np.median(density) / _MEDIAN_OF_POWER / 2))


class MainsTone(NamedTuple):
    """A tone of the mains over a whole record."""

    hertz: float
    amplitude: float
    unit: Complex[np.ndarray, " sample"]  # of amplitude one
    wave: Float[np.ndarray, " sample"]


def mains_hum(time: np.ndarray, signal: np.ndarray, reading: DecayReading) -> list[MainsTone]:
    """Steady mains tones in the residual of the smooth decay.

    A line that decays like a harmonic of the mode is not counted as hum.
    """
    carrier = Carrier(reading.carrier.time, reading.smooth.level)
    inside = (time >= carrier.time[0]) & (time <= carrier.time[-1])
    at = time[inside]
    residual = (signal - wave_of(carrier, time))[inside]
    amplitude = np.exp(np.interp(at, carrier.time, carrier.value.real))
    weight = 1 / np.hypot(_white(residual), _SMOOTH_ERROR * amplitude)
    omega = reading.rate.imag
    low, high = omega.min() / HERTZ / _MAINS_NEAR, omega.max() / HERTZ * _MAINS_NEAR
    tones = []
    for mains in _MAINS:
        for hertz in np.arange(mains, high, mains):
            cycles = np.abs(np.ptp(carrier.value.imag / HERTZ - hertz * carrier.time))
            if hertz < low or cycles < _APART:
                continue
            tone = _steady_tone(time, inside, residual, weight, hertz)
            own = _explained(residual, weight, _own_harmonic(carrier, at, hertz))
            if tone is not None and _explained(residual, weight, tone.unit[inside]) > own:
                tones.append(tone)
                residual = residual - tone.wave[inside]
    return tones


def _steady_tone(
    time: np.ndarray, inside: np.ndarray, residual: np.ndarray, weight: np.ndarray, hertz: float
) -> MainsTone | None:
    """The largest tone within 0.2 Hz, if it exceeds the neighbouring spectrum."""
    at = time[inside]
    span = float(np.ptp(at))

    def line(of: np.ndarray) -> np.ndarray:
        phases = np.exp(-2j * np.pi * of[:, None] * at)
        return 2 * (phases @ (weight**2 * residual)) / np.sum(weight**2)

    near = hertz + np.linspace(-_MAINS_OFF, _MAINS_OFF, 21)
    lines = line(near)
    best = int(np.argmax(np.abs(lines)))
    away = _NEIGHBOURS / span
    neighbours = np.abs(line(hertz + np.concatenate([-away, away])))
    if np.abs(lines[best]) < _SURE * np.median(neighbours) / np.sqrt(2 * np.log(2)):
        return None
    unit = np.exp(2j * np.pi * near[best] * time)
    wave = (lines[best] * unit).real
    return MainsTone(float(near[best]), float(np.abs(lines[best])), unit, wave)


def _own_harmonic(carrier: Carrier, at: np.ndarray, hertz: float) -> np.ndarray:
    """The harmonic of the decaying mode that is nearest to a frequency on average."""
    value = carrier.curve()(at)
    order = max(1.0, np.round(hertz * HERTZ * np.ptp(at) / np.ptp(value.imag)))
    return np.exp(order * (value - value.real.max()))


def _explained(signal: np.ndarray, weight: np.ndarray, wave: np.ndarray) -> float:
    """Weighted sum of squares that a wave of any amplitude and phase explains."""
    product = np.abs(np.sum(weight**2 * signal * wave.conj())) ** 2
    return float(2 * product / np.sum(weight**2 * np.abs(wave) ** 2))
