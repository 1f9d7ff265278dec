"""One mode of a free decay, separated from interfering modes, hum, offset and noise.

1. The ridge of the model's mode in the spectrogram (`mode_ridge`) gives the initial carrier.
2. A mode-tracking filter (`local_fit`) reads amplitude, phase and their rates.
3. The slow flow of a single mode (`slow_flow`) is fitted to the reading. The deviation of the
   reading from it is other motion in the filter's band: where that has more than 1 % of the energy
   (beats of 10 % in amplitude) the mode does not dominate, and the decay is not evaluated.
4. Mains hum, a steady tone at 50 or 60 Hz or a multiple, is fitted to the residual and subtracted,
   and 2 and 3 are repeated.
5. Standard deviations: the residual's spectrum about each instant propagated through the least
   squares (inside the band, where the filter absorbs it, assumed white at the neighbouring level),
   or the scatter of the rates about the smooth decay where that is larger.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.ndimage import gaussian_filter1d

from snrmjax.measure.decays.decay_reading import (
    PER_CYCLE,
    POINTS,
    DecayReading,
    band_edge,
    noise_of,
    reading_of,
    wave_of,
)
from snrmjax.measure.decays.decay_record import (
    enough_cycles,
    even_record,
    require_cycles,
    require_samples,
)
from snrmjax.measure.decays.local_fit import ROUNDS, Carrier, local_fit
from snrmjax.measure.decays.mains_hum import mains_hum
from snrmjax.measure.decays.mode_ridge import ridge_of_mode, spectral_peaks
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

MAX_INTERFERING = 0.01  # largest fraction of the energy inside the band from other motion
UNDETERMINED = 1 / 1.96  # 1σ over the damping, above which its 95 % band contains zero
_SCATTER = 4.0  # σ of the filter, for the average of the scatter
_HARMONICS = (2, 3, 4, 5)
_COHERENT = 0.1  # largest incoherent fraction of the energy near a harmonic


class InterferingModes(NamedTuple):
    """Other motion in a decay, by energy of the velocity from the start of the record."""

    mode_fraction: float
    other_fraction: float  # modes and noise
    frequency: float  # rad/s, of the strongest other line
    line_fraction: float  # within 10 % of it
    hum: tuple[tuple[float, float], ...]  # frequency in Hz and amplitude in m/s


class IsolatedDecay(NamedTuple):
    """A mode's decay where it dominates: as a record, and as readings at some instants."""

    time: Float[np.ndarray, " sample"]  # s
    velocity: Float[np.ndarray, " sample"]  # m/s, the mode and its harmonics only
    at: Float[np.ndarray, " k"]  # s
    level: Complex[np.ndarray, " k"]  # ln amplitude (of m/s) + i phase, of the fundamental
    level_std: Float[np.ndarray, " k"]  # of ln amplitude
    rate: Complex[np.ndarray, " k"]  # its derivative, −decay + iω in 1/s
    rate_std: Complex[np.ndarray, " k"]  # of both parts
    excess: Complex[np.ndarray, " k"]  # ratio of both to the error by white noise of that density
    smooth_rate: Complex[np.ndarray, " k"]  # of the smooth decay
    smooth_bend: Complex[np.ndarray, " k"]  # its derivative, 1/s²
    noise_std: float  # m/s, 1σ of white noise of the density next to the band
    bias: Complex[np.ndarray, " k"]  # of the rate, by the filter; already subtracted
    begin: float  # s, from the first sample to where the mode dominates
    band: tuple[float, float]  # rad/s: the filter passes less than 1 % outside
    interfering: InterferingModes

    def notes(self) -> tuple[Fact, ...]:
        """Facts on the isolation and on other motion in the record."""
        low, high = (edge / HERTZ for edge in self.band)
        of = self.interfering
        omega = float(np.median(np.abs(self.bias.imag / self.rate.imag)))
        decay = float(np.median(np.abs(self.bias.real / self.smooth_rate.real)))
        about = {"low_hz": low, "high_hz": high, "begin": self.begin}
        return (
            Fact("mode_isolated", fraction=of.mode_fraction, **about),
            Fact(
                "interfering_modes_of_decay",
                fraction=of.other_fraction,
                frequency_hz=of.frequency / HERTZ,
                line_fraction=of.line_fraction,
            ),
            Fact("bias_of_mode_filter", frequency=omega, damping=decay),
            *(
                Fact("hum_taken_away", frequency_hz=hz, amplitude=amplitude)
                for hz, amplitude in of.hum
            ),
        )


def isolate_decay(
    time: Float[np.ndarray, " sample"],
    velocity: Float[np.ndarray, " sample"],
    frequency: float,
) -> IsolatedDecay:
    """The decay of the mode whose natural frequency at small amplitude is about `frequency`.

    Arguments: `time` in s, evenly spaced; `velocity` in m/s, from the removal of the force on;
    `frequency` in rad/s.
    Returns an `IsolatedDecay` of the longest stretch in which the mode has 99 % of the energy
    inside the filter's band, 0.18 of the mode's frequency to either side and tracking it. Raises
    `ValueError` for a record that is uneven, clipped, too short or too coarse, without a mode near
    `frequency`, and with another one inside its band.
    Validity: light damping, no excitation.
    """
    times, values = even_record(time, velocity)
    step = float(np.mean(np.diff(times)))
    times = times[0] + step * np.arange(len(times))
    require_cycles(values - values.mean(), frequency * float(np.ptp(times)) / HERTZ)
    require_samples(HERTZ / (frequency * step))
    ridge = ridge_of_mode(spectral_peaks(times, values, frequency), frequency)
    if ridge is None:
        raise InputError(
            f"no decaying mode stands out of the noise near {frequency / HERTZ:.4g} Hz."
        )
    require_samples(HERTZ / (float(ridge.frequency.max()) * step))
    signal = values - values.mean()
    reading = reading_of(times, signal, ridge, frequency)
    hum = mains_hum(times, signal, reading)
    if hum:
        for tone in hum:
            signal = signal - tone.wave
        reading = reading_of(times, signal, ridge, frequency)
    part = _usable(reading)
    return _isolated(times, signal, reading, part, [tone[:2] for tone in hum])


def _usable(reading: DecayReading) -> slice:
    """The longest stretch of instants in which the mode dominates inside the filter's band."""
    interfering = np.abs(reading.smooth.deviation) ** 2
    around = gaussian_filter1d(interfering, reading.sigma * PER_CYCLE, mode="nearest")
    good = np.concatenate([[False], around < MAX_INTERFERING, [False]])
    edges = np.flatnonzero(np.diff(good.astype(int)))
    runs = [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    longest = max(runs, key=lambda run: run.stop - run.start, default=slice(0, 0))
    level = reading.carrier.value[longest]
    if level.size > 1 and enough_cycles(
        float(np.ptp(level.imag)) / HERTZ + 0.5, float(level[0].real - level[-1].real)
    ):
        return longest
    raise InputError(_refusal(reading, slice(None)))


def _refusal(reading: DecayReading, part: slice) -> str:
    """Why the mode cannot be isolated."""
    off = reading.smooth.deviation[part]
    off = off * np.minimum(1.0, 1 / np.maximum(np.abs(off), 1e-300))
    low, high = (edge / HERTZ for edge in _band(reading, part))
    fraction = float(np.median(np.abs(off) ** 2))
    where = f"inside its band of {low:.4g} to {high:.4g} Hz"
    what = "noise"
    if fraction > 2 * float(np.median(2 * reading.noise[part] ** 2)):
        order = np.fft.fftfreq(len(off), 1 / PER_CYCLE)
        line = np.abs(np.fft.fft((off - off.mean()) * np.hanning(len(off))))
        away = 1 + float(order[np.argmax(line)])
        other = float(np.median(reading.rate.imag[part])) / HERTZ * away
        what = f"another motion near {other:.3g} Hz"
    return (
        f"the mode cannot be isolated: {where} {what} has about {100 * fraction:.2g} % of its "
        "energy, too much to evaluate the decay."
    )


def _band(reading: DecayReading, part: slice) -> tuple[float, float]:
    omega, edge = reading.rate.imag[part], band_edge(reading.sigma)
    return float(omega.min() * max(0.0, 1 - edge)), float(omega.max() * (1 + edge))


def _isolated(
    time: np.ndarray,
    signal: np.ndarray,
    reading: DecayReading,
    part: slice,
    hum: list[tuple[float, float]],
) -> IsolatedDecay:
    """The usable part with its standard deviations."""
    every = POINTS * PER_CYCLE
    rows = np.arange(part.start, part.stop, every)
    at, sigma = reading.carrier.time[rows], reading.sigma
    read = local_fit(time, signal, reading.before, at, sigma, rows=True)
    # Bias of the filter: the same filter applied to the identified mode alone.
    alone = wave_of(reading.carrier, time)
    again = reading.start
    for _ in range(ROUNDS):
        refound = local_fit(time, alone, again, reading.carrier.time, sigma)
        again = Carrier(reading.carrier.time, refound.level)
    bias = (refound.rate - reading.carrier.curve()(reading.carrier.time, 1))[rows]
    # The ends, where the filter has data on one side only, are cut from the record.
    one_sided = min(round(2 * sigma * PER_CYCLE), (part.stop - part.start) // 4)
    kept = slice(part.start + one_sided, part.stop - one_sided)
    mode = alone + _harmonics(time, signal - alone, reading, kept)
    residual = signal - mode
    level_std, noise, white_only, white = noise_of(residual, read, sigma, time[1] - time[0])
    off = (reading.rate - reading.smooth.rate)[part]
    excess = [
        _excess(one, np.exp(np.interp(reading.carrier.time[part], at, np.log(std))), sigma)[::every]
        for one, std in zip((off.real, off.imag), noise, strict=True)
    ]
    std = [
        np.hypot(one * np.maximum(1.0, times), part_of_bias)
        for one, times, part_of_bias in zip(noise, excess, (bias.real, bias.imag), strict=True)
    ]
    beyond = noise[0] * np.sqrt(np.maximum(excess[0] ** 2 - 1, 0.0))
    if np.median(np.abs(beyond / reading.smooth.rate.real[rows])) > UNDETERMINED:
        raise InputError(_refusal(reading, part))
    inside = slice(*np.searchsorted(time, reading.carrier.time[[kept.start, kept.stop - 1]]))
    return IsolatedDecay(
        time[inside],
        mode[inside],
        at,
        read.level,
        level_std,
        read.rate - bias,
        std[0] + 1j * std[1],
        std[0] / white_only[0] + 1j * std[1] / white_only[1],
        reading.smooth.rate[rows],
        reading.smooth.rate_derivative[rows],
        white,
        bias,
        float(at[0] - time[0]),
        _band(reading, part),
        _interfering_modes(time[: inside.stop], mode[: inside.stop], residual[: inside.stop], hum),
    )


def _excess(off: np.ndarray, std: np.ndarray, sigma: float) -> np.ndarray:
    """Scatter of readings about their smooth average over 4σ of the filter, in units of 1σ."""
    wide, weight = _SCATTER * sigma * PER_CYCLE, 1 / std**2

    def smooth(values: np.ndarray) -> np.ndarray:
        return gaussian_filter1d(values, wide, mode="nearest")

    swings = (off - smooth(weight * off) / smooth(weight)) / std
    return np.sqrt(smooth(swings**2))


def _harmonics(
    time: np.ndarray, residual: np.ndarray, reading: DecayReading, part: slice
) -> Float[np.ndarray, " sample"]:
    """Harmonics coherent with the mode, of amplitudes (c + d A²) A^h.

    Each is read by a filter as long as the mode's own, and omitted if interfering modes or noise
    have a tenth of the energy there.
    """
    carrier = reading.carrier
    at, phase = carrier.time, carrier.value.imag
    amplitude = np.exp(carrier.value.real - carrier.value.real[part].max())
    near = (time >= at[0]) & (time <= at[-1])
    level = carrier.curve()(time[near])
    of_time = np.exp(level.real - carrier.value.real[part].max())
    waves = np.zeros_like(time)
    for order in _HARMONICS:
        if order * float(np.max(np.diff(level.imag))) > np.pi:
            break
        harmonic = Carrier(at, 1j * order * phase)
        read = local_fit(time, residual, harmonic, at, order * reading.sigma).level
        measured = np.exp(read - harmonic.value)[part]
        design = np.stack([amplitude**order, amplitude ** (order + 2)], axis=1)[part]
        solved = np.linalg.lstsq(design, measured, rcond=None)[0]
        without, rest = (
            float(np.sum(np.abs(one) ** 2)) for one in (measured, measured - design @ solved)
        )
        if rest < _COHERENT * without:
            wave = (solved[0] + solved[1] * of_time**2) * np.exp(1j * order * level.imag)
            waves[near] += (wave * of_time**order).real * (of_time <= 1)
    return waves


def _interfering_modes(
    time: np.ndarray, mode: np.ndarray, residual: np.ndarray, hum: list[tuple[float, float]]
) -> InterferingModes:
    total = float(np.sum(mode**2) + np.sum(residual**2))
    fading = np.hanning(2 * len(residual))[
        len(residual) :
    ]  # weights the start, where other modes are strong
    power = np.abs(np.fft.rfft((residual - residual.mean()) * fading)) ** 2
    omega = HERTZ * np.fft.rfftfreq(len(residual), time[1] - time[0])
    power[0] = 0.0
    line = float(omega[np.argmax(power)])
    near = np.abs(omega / line - 1) < 0.1
    other = float(np.sum(residual**2)) / total
    fraction = float(power[near].sum() / max(power.sum(), 1e-300))
    return InterferingModes(
        float(np.sum(mode**2)) / total, other, line, other * fraction, tuple(hum)
    )
