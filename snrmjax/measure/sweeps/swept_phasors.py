"""Phasors of a swept record at given moments, with derivatives: local least squares.

Around each moment the record is m + m't + Re Σ_k (z_k + ż_k t + …) e^{ikθ(t)} with the phase θ of
the drive cubic in time. The fundamental is cubic, higher harmonics are linear, so that the phasor
and its first two derivatives follow with their errors.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.measure.recordings.tone_track import ToneTrack
from snrmjax.numerics.units import HERTZ

DEGREE = 3
_FEWEST_FRAMES = 5
_FINE = (3, 12)  # bins next to the fundamental, for the noise level


class SweptPhasors(NamedTuple):
    """Phasors at one moment; series are coefficients of t⁰ to t³, in SI units."""

    time: float  # s
    rate: Float[np.ndarray, " power"]  # Ω(t), rad/s: three coefficients
    series: Complex[np.ndarray, "channel power"]  # of the fundamental
    std: Float[np.ndarray, "channel power"]  # rms of its complex errors, each coefficient
    harmonics: Complex[np.ndarray, "channel order"]  # orders 1, 2, …
    harmonic_std: Float[np.ndarray, "channel order"]
    mean: Float[np.ndarray, " channel"]
    clipped: bool


def swept_phasors(
    recording: TimeRecording,
    names: tuple[str, ...],
    track: ToneTrack,
    phase: Float[np.ndarray, " frame"],
    wanted: float,
    sample: float,
    cycles: float,
    highest: int,
) -> SweptPhasors | None:
    """Phasors at the moment when the drive has the frequency `wanted` (rad/s).

    Arguments: `track` and its unwrapped `phase`; `sample` is a first estimate of that moment;
    `cycles` is the width of the window. None if the window leaves the track or has non-finite
    samples.
    """
    rate = recording.sampling_rate
    width = HERTZ * cycles / wanted * rate
    for _ in range(3):
        law = _phase_law(track, phase, sample, width)
        if law is None:
            return None
        step = (wanted / rate - law[1]) / (2 * law[2]) if law[2] else 0.0
        sample += float(np.clip(step, -width / 4, width / 4))
    law = _phase_law(track, phase, sample, width)
    middle = round(sample)
    half = int(width / 2)
    start, stop = middle - half, middle + half + 1
    if law is None or start < 0 or stop > recording.n_samples:
        return None
    values = recording.values(names, start, stop)
    if not np.isfinite(values).all():
        return None
    away = np.arange(start, stop) - sample
    whole = _fit(values, away, law, highest)
    inner = np.abs(away) <= half / 2
    narrow = _fit(values[:, inner], away[inner], law, highest)
    # The difference to the narrower window, beyond noise, is the bias of the wider one.
    differs = np.abs(narrow.series - whole.series) ** 2
    bias = np.maximum(0.0, differs - 2 * narrow.std**2)
    powers = rate ** np.arange(DEGREE + 1)
    frequency = np.array([law[1], 2 * law[2], 3 * law[3]]) * rate ** np.arange(1, 4)
    largest = np.abs(values).max(axis=1, keepdims=True)
    flat = np.count_nonzero(np.abs(values) >= largest * (1 - 1e-9), axis=1)
    return SweptPhasors(
        recording.start_time + sample / rate,
        frequency,
        whole.series * powers,
        np.sqrt(whole.std**2 + bias) * powers,
        whole.harmonics,
        whole.harmonic_std,
        whole.mean,
        bool(np.any(flat > 0.06 * values.shape[1])),
    )


class _Fit(NamedTuple):
    series: Complex[np.ndarray, "channel power"]
    std: Float[np.ndarray, "channel power"]
    harmonics: Complex[np.ndarray, "channel order"]
    harmonic_std: Float[np.ndarray, "channel order"]
    mean: Float[np.ndarray, " channel"]


def _phase_law(
    track: ToneTrack, phase: np.ndarray, sample: float, width: float
) -> Float[np.ndarray, " power"] | None:
    """Coefficients of the phase (rad) by time in samples from `sample`, from nearby frames."""
    near = int(np.searchsorted(track.middle, sample))
    if near in (0, len(track.middle)):
        return None
    reach = width / 2 + track.length[near]
    rows = slice(
        int(np.searchsorted(track.middle, sample - reach)),
        int(np.searchsorted(track.middle, sample + reach)),
    )
    away = track.middle[rows] - sample
    if len(away) < _FEWEST_FRAMES or away[0] > -width / 4 or away[-1] < width / 4:
        return None
    scale = np.abs(away).max()
    start = phase[rows][0]
    law = np.polynomial.polynomial.polyfit(away / scale, phase[rows] - start, DEGREE)
    law[0] += start
    return law / scale ** np.arange(DEGREE + 1)


def _fit(values: np.ndarray, away: np.ndarray, law: np.ndarray, highest: int) -> _Fit:
    half = np.abs(away).max()
    scaled = away / half
    carrier = np.exp(1j * np.polynomial.polynomial.polyval(away, law))
    powers = scaled ** np.arange(DEGREE + 1)[:, None]
    columns = [*powers[:2]]
    parts = [(powers * carrier.real, -powers * carrier.imag)]
    for order in range(2, highest + 1):
        parts.append((powers[:2] * (carrier**order).real, -powers[:2] * (carrier**order).imag))
    design = np.concatenate([np.stack(columns), *(row for pair in parts for row in pair)])
    inverse = np.linalg.inv(design @ design.T)
    fitted = values @ (inverse @ design).T
    rest = values - fitted @ design
    noise = np.sum(rest**2, axis=1) / (values.shape[1] - len(design))
    noise *= _colour(rest, law[1])
    spread = np.diag(inverse)
    n = DEGREE + 1
    back = half ** -np.arange(n, dtype=float)
    series = (fitted[:, 2 : 2 + n] + 1j * fitted[:, 2 + n : 2 + 2 * n]) * back
    std = np.sqrt(noise[:, None] * (spread[2 : 2 + n] + spread[2 + n : 2 + 2 * n])) * back
    first = 2 + 2 * n + 4 * np.arange(highest - 1)
    harmonics = np.concatenate(
        [series[:, :1], fitted[:, first] + 1j * fitted[:, first + 2]], axis=1
    )
    others = np.sqrt(noise[:, None] * (spread[first] + spread[first + 2]))
    return _Fit(series, std, harmonics, np.concatenate([std[:, :1], others], axis=1), fitted[:, 0])


def _colour(rest: np.ndarray, step: float) -> np.ndarray:
    """Power of the residual next to the fundamental over its mean, at least 1."""
    n = rest.shape[1]
    power = np.abs(np.fft.rfft(rest * np.hanning(n), axis=1)) ** 2
    centre = round(step * n / (2 * np.pi))
    bins = np.arange(power.shape[1])
    near = (np.abs(bins - centre) >= _FINE[0]) & (np.abs(bins - centre) <= _FINE[1])
    mean = power.mean(axis=1)
    return np.maximum(1.0, power[:, near].mean(axis=1) / np.where(mean > 0, mean, 1.0))


def displacement_series(
    series: Complex[np.ndarray, "channel power"],
    rate: Float[np.ndarray, " power"],
    integrations: int,
) -> Complex[np.ndarray, "channel power"]:
    """Phasor of the displacement and its derivatives from that of a velocity or acceleration.

    A velocity w e^{iθ} is the derivative of a e^{iθ}: w = ȧ + iΩ a, solved for a by iteration.
    """
    i_omega = np.zeros(series.shape[-1], dtype=complex)
    i_omega[: len(rate)] = 1j * rate
    for _ in range(integrations):
        solved = _divided(series, i_omega)
        for _ in range(DEGREE):
            solved = _divided(series - _derivative(solved), i_omega)
        series = solved
    return series


def _derivative(series: np.ndarray) -> np.ndarray:
    moved = np.zeros_like(series)
    moved[..., :-1] = series[..., 1:] * np.arange(1, series.shape[-1])
    return moved


def _divided(series: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Quotient of two power series."""
    quotient = np.zeros_like(series)
    for k in range(series.shape[-1]):
        before = sum(quotient[..., m] * by[k - m] for m in range(k))
        quotient[..., k] = (series[..., k] - before) / by[0]
    return quotient
