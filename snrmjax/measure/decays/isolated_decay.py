"""One mode of a free decay apart from its company: other modes, hum, an offset, noise.

1. The ridge of the model's mode in the spectrogram (`mode_ridge`) starts a carrier.
2. A filter that moves with the mode (`local_fit`) reads amplitude, phase and their rates.
3. What one mode can do (`slow_flow`) is fitted to the reading. How far the reading is off it is
   what else lies inside the filter: where that holds more than 1 % of the energy (beats then swing
   the amplitude by 10 %) the mode does not dominate, and the decay is not read.
4. Mains hum, a steady tone at 50 or 60 Hz or a multiple, is fitted to what is left and taken away,
   and 2 and 3 are done again.
5. Standard deviations: what the least squares make of the residual's spectrum about each instant
   (white inside the band, where the filter took it up, as beside it), or the scatter of the rates
   about the smooth decay where that is larger.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.ndimage import gaussian_filter1d

from snrmjax.measure.decays.decay_record import (
    QUARTER,
    enough_cycles,
    even_record,
    require_cycles,
    require_samples,
)
from snrmjax.measure.decays.local_fit import (
    ROUNDS,
    Carrier,
    LocalFit,
    instants,
    local_fit,
    passed,
)
from snrmjax.measure.decays.mode_ridge import FRAME_CYCLES, Ridge, ridge_of_mode, spectral_peaks
from snrmjax.measure.decays.slow_flow import SlowFlow, slow_flow
from snrmjax.numerics.facts import Fact
from snrmjax.numerics.units import HERTZ

PER_CYCLE = 2  # instants
POINTS = 4  # cycles from one reading to the next
MOST_COMPANY = 0.01  # largest share of the energy inside the band that is not the mode's
NOT_KNOWN = 1 / 1.96  # 1σ over the damping, from where on its 95 % band holds zero
_SIGMA = (1.0, 3.0)  # cycles of the filter's weights
_CYCLES_A_SIGMA = 8 / 3  # of a fall to a quarter, in which one line would be drawn
_BAND = 0.25  # of the mode's frequency: what the filter passes, one side
_BESIDE = 0.6  # of it, one side, from where the density inside is taken
_MAINS = (50.0, 60.0)
_MAINS_OFF = 0.2  # Hz, that mains may be off
_MAINS_NEAR = 3.0  # times the mode's frequency, or one over it
_SURE = 4.0  # standard deviations by which hum stands out
_NEIGHBOURS = np.arange(2, 9)  # lines on either side of which these are taken
_APART = 2.0  # turns by which hum and mode must part to be told apart
_SMOOTH_ERROR = 0.05  # of the mode's amplitude, that the smooth decay may be off
_SCATTER = 4.0  # σ of the filter, over which scatter is averaged
_HARMONICS = (2, 3, 4, 5)
_COHERENT = 0.1  # of what lies near a harmonic, that may not turn with the mode
_MEDIAN_OF_POWER = float(np.log(2))  # over the mean, of a spectrum's bins


class Company(NamedTuple):
    """What else lies in a decay, by energy of the velocity from the record's begin on."""

    mode_share: float
    other_share: float  # modes and noise
    frequency: float  # rad/s, of the strongest other line
    line_share: float  # within 10 % of it
    hum: tuple[tuple[float, float], ...]  # frequency in Hz and amplitude in m/s


class IsolatedDecay(NamedTuple):
    """A mode's decay where it dominates: as a record, and read at some instants."""

    time: Float[np.ndarray, " sample"]  # s
    velocity: Float[np.ndarray, " sample"]  # m/s, the mode with its harmonics alone
    at: Float[np.ndarray, " k"]  # s
    level: Complex[np.ndarray, " k"]  # ln amplitude (of m/s) + i phase, of the fundamental
    level_std: Float[np.ndarray, " k"]  # of ln amplitude
    rate: Complex[np.ndarray, " k"]  # its derivative, −decay + iω in 1/s
    rate_std: Complex[np.ndarray, " k"]  # of both parts
    excess: Complex[np.ndarray, " k"]  # of both over what white noise of that density makes
    smooth_rate: Complex[np.ndarray, " k"]  # of the smooth decay
    smooth_bend: Complex[np.ndarray, " k"]  # its derivative, 1/s²
    noise_std: float  # m/s, 1σ of white noise of the density that the record has beside the band
    bias: Complex[np.ndarray, " k"]  # of the rate, by the filter; it is taken away
    begin: float  # s from the record's first sample to where the mode dominates
    band: tuple[float, float]  # rad/s: beyond, the filter passes less than 1 %
    company: Company

    def notes(self) -> tuple[Fact, ...]:
        """What was done and what else lies in the record."""
        low, high = (edge / HERTZ for edge in self.band)
        of = self.company
        omega = float(np.median(np.abs(self.bias.imag / self.rate.imag)))
        decay = float(np.median(np.abs(self.bias.real / self.smooth_rate.real)))
        about = {"low_hz": low, "high_hz": high, "begin": self.begin}
        return (
            Fact("mode_isolated", share=of.mode_share, **about),
            Fact(
                "company_of_decay",
                share=of.other_share,
                frequency_hz=of.frequency / HERTZ,
                line_share=of.line_share,
            ),
            Fact("bias_of_mode_filter", frequency=omega, damping=decay),
            *(Fact("hum_taken_away", frequency_hz=hz, amplitude=size) for hz, size in of.hum),
        )


class _Reading(NamedTuple):
    """A carrier read at half cycles, and the smooth decay through it."""

    start: Carrier
    before: Carrier  # of the last round but one
    carrier: Carrier
    rate: Complex[np.ndarray, " k"]
    smooth: SlowFlow
    noise: Float[np.ndarray, " k"]  # 1σ of ln A that the residual's spectrum makes
    sigma: float


def isolate_decay(
    time: Float[np.ndarray, " sample"],
    velocity: Float[np.ndarray, " sample"],
    frequency: float,
) -> IsolatedDecay:
    """The decay of the mode whose natural frequency at small amplitude is about `frequency`.

    Arguments: `time` in s, evenly spaced; `velocity` in m/s, from the moment on at which the force
    was gone; `frequency` in rad/s.
    Returns an `IsolatedDecay` of the longest stretch in which the mode holds 99 % of the energy
    inside the filter's band, which reaches 0.18 of the mode's frequency to either side and moves
    with it. Raises `ValueError` for a record that is uneven, clipped, too short or too coarse,
    where no mode is near `frequency`, and where another one inside its band keeps the mode from
    being isolated.
    Validity: light damping, nothing driving.
    """
    times, values = even_record(time, velocity)
    step = float(np.mean(np.diff(times)))
    times = times[0] + step * np.arange(len(times))
    require_cycles(values - values.mean(), frequency * float(np.ptp(times)) / HERTZ)
    require_samples(HERTZ / (frequency * step))
    ridge = ridge_of_mode(spectral_peaks(times, values, frequency), frequency)
    if ridge is None:
        raise ValueError(
            f"no mode that rings stands out of the noise near {frequency / HERTZ:.4g} Hz."
        )
    require_samples(HERTZ / (float(ridge.frequency.max()) * step))
    start, sigma = _extended(ridge, times, frequency), _width(ridge)
    signal = values - values.mean()
    reading = _read(times, signal, start, sigma)
    hum = _hum(times, signal, reading)
    if hum:
        for tone in hum:
            signal = signal - tone.wave
        reading = _read(times, signal, start, sigma)
    part = _usable(reading)
    return _isolated(times, signal, reading, part, [tone[:2] for tone in hum])


def _extended(ridge: Ridge, time: np.ndarray, frequency: float) -> Carrier:
    """A carrier of the ridge, and on to the ends of the record where these are a frame away."""
    at = ridge.time
    reach = FRAME_CYCLES * HERTZ / frequency
    begin = time[0] if at[0] - time[0] < reach else at[0]
    end = time[-1] if time[-1] - at[-1] < reach else at[-1]
    times = np.concatenate([[begin], at[(at > begin) & (at < end)], [end]])
    inside = np.clip(times, at[0], at[-1])
    few = min(4, len(at))

    def along(values: np.ndarray) -> np.ndarray:
        ends = [
            np.polyfit(at[rows], values[rows], 1)[0] if few > 1 else 0.0
            for rows in (slice(0, few), slice(-few, None))
        ]
        slope = np.where(times < at[0], *ends)
        return np.interp(inside, at, values) + slope * (times - inside)

    omega = np.maximum(along(ridge.frequency), ridge.frequency.min() / 2)
    phase = np.concatenate([[0.0], np.cumsum(np.diff(times) * (omega[1:] + omega[:-1]) / 2)])
    return Carrier(times, along(np.log(ridge.amplitude)) + 1j * phase)


def _width(ridge: Ridge) -> float:
    """σ of the weights in cycles: 3, or less where the motion falls to a quarter in few cycles."""
    cycles = float(np.sum(np.diff(ridge.time) * ridge.frequency[1:])) / HERTZ
    fall = float(np.log(ridge.amplitude[0] / ridge.amplitude[-1]))
    quarter = QUARTER * cycles / fall if fall > 0 else np.inf
    return float(np.clip(quarter / _CYCLES_A_SIGMA, *_SIGMA))


def _read(time: np.ndarray, signal: np.ndarray, start: Carrier, sigma: float) -> _Reading:
    """Read from the ridge on, then from the smooth decay on, which is right up to the ends."""
    at = instants(start, PER_CYCLE)
    first = _read_from(time, signal, start, sigma, at)
    return _read_from(time, signal, Carrier(at, first.smooth.level), sigma, at)


def _read_from(
    time: np.ndarray, signal: np.ndarray, start: Carrier, sigma: float, at: np.ndarray
) -> _Reading:
    before, carrier, rate = start, start, start.value
    for _ in range(ROUNDS):
        before = carrier
        local = local_fit(time, signal, carrier, at, sigma)
        carrier, rate = Carrier(at, local.level), local.rate
    rows = np.unique([*range(0, len(at), POINTS * PER_CYCLE), len(at) - 1])
    read = local_fit(time, signal, before, at[rows], sigma, rows=True)
    left = signal - _wave(carrier, time)
    noise = np.interp(at, at[rows], _noise_of(left, read, sigma, time[1] - time[0])[0])
    independent = _independent(carrier.value.imag, sigma)
    weight = 1 / np.hypot(noise, _SMOOTH_ERROR * 0.1)
    smooth = slow_flow(at, carrier.value, weight, independent)
    return _Reading(start, before, carrier, rate, smooth, noise, sigma)


def _independent(phase: np.ndarray, sigma: float) -> float:
    """How many independent readings a phase holds, by the width of the filter."""
    nu = np.linspace(0, 1 / sigma, 400)
    return float(np.ptp(phase)) / HERTZ * 2 * float(np.sum(passed(nu, sigma) ** 2)) * nu[1]


def _wave(carrier: Carrier, time: np.ndarray) -> np.ndarray:
    """The carrier's motion; zero where there is none."""
    inside = (time >= carrier.time[0]) & (time <= carrier.time[-1])
    wave = np.zeros_like(time)
    wave[inside] = np.exp(carrier.curve()(time[inside])).real
    return wave


def _white(signal: np.ndarray) -> float:
    """1σ of white noise by the median of the spectrum."""
    from scipy.signal import welch

    density = welch(signal, nperseg=min(len(signal), 4096))[1]
    return float(np.sqrt(np.median(density) / _MEDIAN_OF_POWER / 2))


class _Tone(NamedTuple):
    hertz: float
    amplitude: float
    wave: Float[np.ndarray, " sample"]


def _hum(time: np.ndarray, signal: np.ndarray, reading: _Reading) -> list[_Tone]:
    """Steady tones of the mains in what the smooth decay leaves."""
    carrier = Carrier(reading.carrier.time, reading.smooth.level)
    inside = (time >= carrier.time[0]) & (time <= carrier.time[-1])
    at = time[inside]
    left = (signal - _wave(carrier, time))[inside]
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
) -> _Tone | None:
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
    return _Tone(float(near[best]), float(np.abs(lines[best])), wave)


def _usable(reading: _Reading) -> slice:
    """The longest stretch of instants in which the mode dominates inside the filter's band."""
    company = np.abs(reading.smooth.off) ** 2
    around = gaussian_filter1d(company, reading.sigma * PER_CYCLE, mode="nearest")
    good = np.concatenate([[False], around < MOST_COMPANY, [False]])
    edges = np.flatnonzero(np.diff(good.astype(int)))
    runs = [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    longest = max(runs, key=lambda run: run.stop - run.start, default=slice(0, 0))
    level = reading.carrier.value[longest]
    if level.size > 1 and enough_cycles(
        float(np.ptp(level.imag)) / HERTZ + 0.5, float(level[0].real - level[-1].real)
    ):
        return longest
    raise ValueError(_refusal(reading, slice(None)))


def _refusal(reading: _Reading, part: slice) -> str:
    """Why the mode cannot be isolated."""
    off = reading.smooth.off[part]
    off = off * np.minimum(1.0, 1 / np.maximum(np.abs(off), 1e-300))
    low, high = (edge / HERTZ for edge in _band(reading, part))
    share = float(np.median(np.abs(off) ** 2))
    where = f"inside its band of {low:.4g} to {high:.4g} Hz"
    what = "noise"
    if share > 2 * float(np.median(2 * reading.noise[part] ** 2)):
        order = np.fft.fftfreq(len(off), 1 / PER_CYCLE)
        line = np.abs(np.fft.fft((off - off.mean()) * np.hanning(len(off))))
        away = 1 + float(order[np.argmax(line)])
        other = float(np.median(reading.rate.imag[part])) / HERTZ * away
        what = f"another motion near {other:.3g} Hz"
    return (
        f"the mode cannot be isolated: {where} {what} has about {100 * share:.2g} % of its energy, "
        "which hides how it decays."
    )


def _edge(sigma: float) -> float:
    """Part of the mode's frequency beyond which the filter passes less than 1 %."""
    return float(np.sqrt(-2 * np.log(1 - 0.99 ** (1 / ROUNDS))) / (2 * np.pi * sigma))


def _band(reading: _Reading, part: slice) -> tuple[float, float]:
    omega, edge = reading.rate.imag[part], _edge(reading.sigma)
    return float(omega.min() * max(0.0, 1 - edge)), float(omega.max() * (1 + edge))


def _isolated(
    time: np.ndarray,
    signal: np.ndarray,
    reading: _Reading,
    part: slice,
    hum: list[tuple[float, float]],
) -> IsolatedDecay:
    """The usable part with its standard deviations."""
    every = POINTS * PER_CYCLE
    rows = np.arange(part.start, part.stop, every)
    at, sigma = reading.carrier.time[rows], reading.sigma
    read = local_fit(time, signal, reading.before, at, sigma, rows=True)
    # The same filter on the mode that it found alone: nothing else differs.
    alone = _wave(reading.carrier, time)
    again = reading.start
    for _ in range(ROUNDS):
        refound = local_fit(time, alone, again, reading.carrier.time, sigma)
        again = Carrier(reading.carrier.time, refound.level)
    bias = (refound.rate - reading.carrier.curve()(reading.carrier.time, 1))[rows]
    mode = alone + _harmonics(time, signal - alone, reading, part)
    left = signal - mode
    level_std, noise, white_only, white = _noise_of(left, read, sigma, time[1] - time[0])
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
    if np.median(np.abs(beyond / reading.smooth.rate.real[rows])) > NOT_KNOWN:
        raise ValueError(_refusal(reading, part))
    # Ends of the record, at which the filter sees one side alone, are left out of it.
    one_sided = round(sigma * PER_CYCLE)
    ends = part.start + one_sided, part.stop - 1 - one_sided
    inside = slice(*np.searchsorted(time, reading.carrier.time[list(ends)]))
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
        reading.smooth.bend[rows],
        white,
        bias,
        float(at[0] - time[0]),
        _band(reading, part),
        _company(time[: inside.stop], mode[: inside.stop], left[: inside.stop], hum),
    )


def _excess(off: np.ndarray, std: np.ndarray, sigma: float) -> np.ndarray:
    """How many times 1σ readings scatter about their own smooth course, over 4σ of the filter."""
    wide, weight = _SCATTER * sigma * PER_CYCLE, 1 / std**2

    def smooth(values: np.ndarray) -> np.ndarray:
        return gaussian_filter1d(values, wide, mode="nearest")

    swings = (off - smooth(weight * off) / smooth(weight)) / std
    return np.sqrt(smooth(swings**2))


def _harmonics(
    time: np.ndarray, left: np.ndarray, reading: _Reading, part: slice
) -> Float[np.ndarray, " sample"]:
    """Harmonics that turn with the mode, of sizes (c + d A²) A^h.

    Each is read by a filter as long as the mode's own, and left out where company or noise has a
    tenth of what is found there.
    """
    carrier = reading.carrier
    at, phase = carrier.time, carrier.value.imag
    size = np.exp(carrier.value.real - carrier.value.real[part].max())
    near = (time >= at[0]) & (time <= at[-1])
    level = carrier.curve()(time[near])
    of_time = np.exp(level.real - carrier.value.real[part].max())
    waves = np.zeros_like(time)
    for order in _HARMONICS:
        if order * float(np.max(np.diff(level.imag))) > np.pi:
            break
        turning = Carrier(at, 1j * order * phase)
        read = local_fit(time, left, turning, at, order * reading.sigma).level
        seen = np.exp(read - turning.value)[part]
        design = np.stack([size**order, size ** (order + 2)], axis=1)[part]
        solved = np.linalg.lstsq(design, seen, rcond=None)[0]
        without, rest = (float(np.sum(np.abs(one) ** 2)) for one in (seen, seen - design @ solved))
        if rest < _COHERENT * without:
            wave = (solved[0] + solved[1] * of_time**2) * np.exp(1j * order * level.imag)
            waves[near] += (wave * of_time**order).real * (of_time <= 1)
    return waves


def _noise_of(
    left: np.ndarray, read: LocalFit, sigma: float, step: float
) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray], float]:
    """1σ that the residual's spectrum makes of ln A and of both parts of the rate.

    Of these also what its white part makes, and that part's 1σ of a sample.
    """
    width = read.level_rows.shape[1]
    index = read.first[:, None] + np.arange(width)
    taper = np.hanning(width + 2)[1:-1]
    power = np.abs(np.fft.rfft(left[index] * taper, axis=1)) ** 2 / np.sum(taper**2)
    power = gaussian_filter1d(power, 1.0, axis=0, mode="nearest")
    omega = HERTZ * np.fft.rfftfreq(width, step)
    away = np.abs(omega / read.rate.imag[:, None] - 1)
    beside = (away > _BAND) & (away < _BESIDE)
    density = np.nanmedian(np.where(beside, power, np.nan), axis=1) / _MEDIAN_OF_POWER
    inside = away <= _BAND
    nu = np.linspace(0, 1 / sigma, 400)
    gains = [np.sum((nu**k * passed(nu, sigma)) ** 2) for k in (0, 1)]
    once = [np.sum((nu**k * np.exp(-((2 * np.pi * sigma * nu) ** 2) / 2)) ** 2) for k in (0, 1)]
    found, white = [], []
    for k, weights in (
        (0, read.level_rows.real), (1, read.rate_rows.real), (1, read.rate_rows.imag),
    ):  # fmt: skip
        response = np.abs(np.fft.rfft(weights, axis=1)) ** 2 / width
        response[:, 1 : (width + 1) // 2] *= 2
        within = density * np.sum(response * inside, axis=1) * gains[k] / once[k]
        beyond = np.sum(response * ~inside * power, axis=1) * ROUNDS**2
        found.append(np.sqrt(within + beyond))
        white.append(np.sqrt(within + density * np.sum(response * ~inside, axis=1)))
    return found[0], found[1:], white[1:], float(np.sqrt(np.median(density)))


def _company(
    time: np.ndarray, mode: np.ndarray, left: np.ndarray, hum: list[tuple[float, float]]
) -> Company:
    total = float(np.sum(mode**2) + np.sum(left**2))
    power = np.abs(np.fft.rfft((left - left.mean()) * np.hanning(len(left)))) ** 2
    omega = HERTZ * np.fft.rfftfreq(len(left), time[1] - time[0])
    power[0] = 0.0
    line = float(omega[np.argmax(power)])
    near = np.abs(omega / line - 1) < 0.1
    other = float(np.sum(left**2)) / total
    share = float(power[near].sum() / max(power.sum(), 1e-300))
    return Company(float(np.sum(mode**2)) / total, other, line, other * share, tuple(hum))
