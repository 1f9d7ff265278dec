"""Mains hum in a decay: steady tones beside the mode, told from it as the decay goes on."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.measure.decays.decay_reading import DecayReading, wave_of
from snrmjax.measure.decays.local_fit import Carrier
from snrmjax.numerics.units import HERTZ

_MAINS = (50.0, 60.0)
_MAINS_OFF = 0.2  # Hz, that mains may be off
_MAINS_NEAR = 3.0  # times the mode's frequency, or one over it
_SURE = 4.0  # standard deviations by which hum stands out
_NEIGHBOURS = np.arange(2, 9)  # lines on either side of which these are taken
_APART = 2.0  # turns by which hum and mode must part to be told apart
_SMOOTH_ERROR = 0.05  # of the mode's amplitude, that the smooth decay may be off
_MEDIAN_OF_POWER = float(np.log(2))  # over the mean, of a spectrum's bins


def _white(signal: np.ndarray) -> float:
    """1σ of white noise by the median of the spectrum."""
    from scipy.signal import welch

    density = welch(signal, nperseg=min(len(signal), 4096))[1]
    return float(np.sqrt(np.median(density) / _MEDIAN_OF_POWER / 2))


class MainsTone(NamedTuple):
    """A tone of the mains over a whole record."""

    hertz: float
    amplitude: float
    wave: Float[np.ndarray, " sample"]


def mains_hum(time: np.ndarray, signal: np.ndarray, reading: DecayReading) -> list[MainsTone]:
    """Steady tones of the mains in what the smooth decay leaves."""
    carrier = Carrier(reading.carrier.time, reading.smooth.level)
    inside = (time >= carrier.time[0]) & (time <= carrier.time[-1])
    at = time[inside]
    left = (signal - wave_of(carrier, time))[inside]
    size = np.exp(np.interp(at, carrier.time, carrier.value.real))
    weight = 1 / np.hypot(_white(left), _SMOOTH_ERROR * size)
    omega = reading.rate.imag
    low, high = omega.min() / HERTZ / _MAINS_NEAR, omega.max() / HERTZ * _MAINS_NEAR
    found = []
    for mains in _MAINS:
        for hertz in np.arange(mains, high, mains):
            turns = np.abs(np.ptp(carrier.value.imag / HERTZ - hertz * carrier.time))
            if hertz < low or turns < _APART:
                continue
            tone = _steady_tone(time, inside, left, weight, hertz)
            if tone is not None:
                found.append(tone)
                left = left - tone.wave[inside]
    return found


def _steady_tone(
    time: np.ndarray, inside: np.ndarray, left: np.ndarray, weight: np.ndarray, hertz: float
) -> MainsTone | None:
    """The tone within 0.2 Hz that is largest, if it stands out of the spectrum beside it."""
    at = time[inside]
    span = float(np.ptp(at))

    def line(of: np.ndarray) -> np.ndarray:
        turns = np.exp(-2j * np.pi * of[:, None] * at)
        return 2 * (turns @ (weight**2 * left)) / np.sum(weight**2)

    near = hertz + np.linspace(-_MAINS_OFF, _MAINS_OFF, 21)
    lines = line(near)
    best = int(np.argmax(np.abs(lines)))
    away = _NEIGHBOURS / span
    beside = np.abs(line(hertz + np.concatenate([-away, away])))
    if np.abs(lines[best]) < _SURE * np.median(beside) / np.sqrt(2 * np.log(2)):
        return None
    wave = (lines[best] * np.exp(2j * np.pi * near[best] * time)).real
    return MainsTone(float(near[best]), float(np.abs(lines[best])), wave)
