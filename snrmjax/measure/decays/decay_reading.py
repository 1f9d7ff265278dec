"""A decay read by a mode-tracking filter, and the smooth decay fitted to it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.ndimage import gaussian_filter1d

from snrmjax.measure.decays.decay_record import QUARTER
from snrmjax.measure.decays.local_fit import (
    ROUNDS,
    Carrier,
    LocalFit,
    instants,
    local_fit,
    passed,
)
from snrmjax.measure.decays.mode_ridge import FRAME_CYCLES, Ridge
from snrmjax.measure.decays.slow_flow import SlowFlow, slow_flow
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

PER_CYCLE = 2  # readings per cycle
POINTS = 4  # cycles between nearly independent readings
_SIGMA = (1.0, 3.0)  # smallest and largest σ of the filter's weights, cycles
_CYCLES_A_SIGMA = 8 / 3  # of a decay to a quarter, per σ of the filter
_BAND = 0.25  # of the mode's frequency: half width of the filter's passband
_NEIGHBOURHOOD = 0.6  # of it: half width of the range for the noise density
_MEDIAN_OF_POWER = float(np.log(2))  # over the mean, of a spectrum's bins
_SMOOTH_ERROR = 0.005  # relative error of the smooth decay without noise


class DecayReading(NamedTuple):
    """A carrier read at half cycles, and the smooth decay through it."""

    start: Carrier
    before: Carrier  # before the last round
    carrier: Carrier
    rate: Complex[np.ndarray, " k"]
    smooth: SlowFlow
    noise: Float[np.ndarray, " k"]  # 1σ of ln A from the residual's spectrum
    sigma: float


def reading_of(
    time: Float[np.ndarray, " sample"],
    signal: Float[np.ndarray, " sample"],
    ridge: Ridge,
    frequency: float,
) -> DecayReading:
    """Read the mode starting from its ridge, then from the smooth decay, accurate up to the ends.

    A frame of the ridge has eight cycles of `frequency` (rad/s).
    """
    start, sigma = _extended(ridge, time, frequency), _width(ridge)
    at = instants(start, PER_CYCLE)
    first = _read_from(time, signal, start, sigma, at)
    return _read_from(time, signal, Carrier(at, first.smooth.level), sigma, at)


def _extended(ridge: Ridge, time: np.ndarray, frequency: float) -> Carrier:
    """A carrier from the ridge, extrapolated to the ends of the record if within a frame."""
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
    """σ of the weights in cycles: 3, or less if the motion decays to a quarter in few cycles."""
    cycles = float(np.sum(np.diff(ridge.time) * ridge.frequency[1:])) / HERTZ
    fall = float(np.log(ridge.amplitude[0] / ridge.amplitude[-1]))
    quarter = QUARTER * cycles / fall if fall > 0 else np.inf
    return float(np.clip(quarter / _CYCLES_A_SIGMA, *_SIGMA))


def _read_from(
    time: np.ndarray, signal: np.ndarray, start: Carrier, sigma: float, at: np.ndarray
) -> DecayReading:
    before, carrier, rate = start, start, start.value
    for _ in range(ROUNDS):
        before = carrier
        local = local_fit(time, signal, carrier, at, sigma)
        lost = np.flatnonzero(~np.isfinite(local.level))
        if lost.size:
            raise InputError(
                f"the mode cannot be isolated: at {at[lost[0]]:.4g} s it is lost in noise or in "
                "other motion: cut the record before."
            )
        carrier, rate = Carrier(at, local.level), local.rate
    backwards = np.flatnonzero(rate.imag <= 0)
    if backwards.size:
        raise InputError(
            f"the mode cannot be isolated: at {at[backwards[0]]:.4g} s its phase runs backwards, "
            "as in a beat with another motion of similar amplitude."
        )
    rows = np.unique([*range(0, len(at), POINTS * PER_CYCLE), len(at) - 1])
    read = local_fit(time, signal, before, at[rows], sigma, rows=True)
    residual = signal - wave_of(carrier, time)
    noise = np.interp(at, at[rows], noise_of(residual, read, sigma, time[1] - time[0])[0])
    independent = _independent(carrier.value.imag, sigma)
    weight = 1 / np.hypot(noise, _SMOOTH_ERROR)
    smooth = slow_flow(at, carrier.value, weight, independent)
    return DecayReading(start, before, carrier, rate, smooth, noise, sigma)


def _independent(phase: np.ndarray, sigma: float) -> float:
    """Number of independent readings, from the bandwidth of the filter."""
    nu = np.linspace(0, 1 / sigma, 400)
    return float(np.ptp(phase)) / HERTZ * 2 * float(np.sum(passed(nu, sigma) ** 2)) * nu[1]


def wave_of(carrier: Carrier, time: np.ndarray) -> np.ndarray:
    """The carrier's signal; zero outside its time range."""
    inside = (time >= carrier.time[0]) & (time <= carrier.time[-1])
    wave = np.zeros_like(time)
    wave[inside] = np.exp(carrier.curve()(time[inside])).real
    return wave


def noise_of(
    residual: np.ndarray, read: LocalFit, sigma: float, step: float
) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray], float]:
    """1σ of ln A and of both parts of the rate, propagated from the residual's spectrum.

    Also 1σ of the rate for white noise alone, and the 1σ of a sample of that noise.
    """
    width = read.level_rows.shape[1]
    index = read.first[:, None] + np.arange(width)
    taper = np.hanning(width + 2)[1:-1]
    power = np.abs(np.fft.rfft(residual[index] * taper, axis=1)) ** 2 / np.sum(taper**2)
    power = gaussian_filter1d(power, 1.0, axis=0, mode="nearest")
    omega = HERTZ * np.fft.rfftfreq(width, step)
    away = np.abs(omega / read.rate.imag[:, None] - 1)
    neighbourhood = (away > _BAND) & (away < _NEIGHBOURHOOD)
    density = np.nanmedian(np.where(neighbourhood, power, np.nan), axis=1) / _MEDIAN_OF_POWER
    inside = away <= _BAND
    nu = np.linspace(0, 1 / sigma, 400)
    gains = [np.sum((nu**k * passed(nu, sigma)) ** 2) for k in (0, 1)]
    once = [np.sum((nu**k * np.exp(-((2 * np.pi * sigma * nu) ** 2) / 2)) ** 2) for k in (0, 1)]
    total, white = [], []
    for k, weights in (
        (0, read.level_rows.real), (1, read.rate_rows.real), (1, read.rate_rows.imag),
    ):  # fmt: skip
        response = np.abs(np.fft.rfft(weights, axis=1)) ** 2 / width
        response[:, 1 : (width + 1) // 2] *= 2
        within = density * np.sum(response * inside, axis=1) * gains[k] / once[k]
        beyond = np.sum(response * ~inside * power, axis=1) * ROUNDS**2
        total.append(np.sqrt(within + beyond))
        white.append(np.sqrt(within + density * np.sum(response * ~inside, axis=1)))
    return total[0], total[1:], white[1:], float(np.sqrt(np.median(density)))


def band_edge(sigma: float) -> float:
    """Half width of the filter's band over the mode's frequency, at a gain of 1 %."""
    return float(np.sqrt(-2 * np.log(1 - 0.99 ** (1 / ROUNDS))) / (2 * np.pi * sigma))
