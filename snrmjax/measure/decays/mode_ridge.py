"""The ridge of one mode in a decay's spectrogram: its frequency and amplitude, frame by frame.

Frames of eight cycles of the model's mode are weighted by a Hann window. From every peak of the
last frames a ridge is traced back in time, each step to the largest peak within the window's
resolution of the linear prediction. The mode is the ridge with most energy whose frequency,
extrapolated to amplitude zero, agrees with the model's to about 10 %.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.numerics.units import HERTZ

FRAME_CYCLES = 8  # of the model's mode, per frame
_HOPS = 4  # frames per frame length
_PADDED = 4
_RANGE = 2.0  # largest ratio of a ridge's first frequency to the mode's, or its inverse
_REACH = 2.5  # largest ratio along a ridge, or its inverse
_TRUST = 0.1  # 1σ of the log frequency of the model
_ABOVE = 10.0  # times a frame's median power, which noise exceeds in fewer than 1 of 1000 bins
_OCTAVES, _AROUND = 12, 2  # of a spectrum, and largest ratio of frequencies in a local median
_BEGIN = 3  # least number of frames of a ridge
_PATIENCE = 3  # frames in which a ridge may be missing


class Ridge(NamedTuple):
    """One component by frames, in the order of time."""

    time: Float[np.ndarray, " frame"]  # s
    frequency: Float[np.ndarray, " frame"]  # rad/s
    amplitude: Float[np.ndarray, " frame"]  # m/s

    def at_rest(self) -> float:
        """Frequency in rad/s at amplitude zero, by a line over the squared amplitude."""
        last = self.frequency[-1]
        if len(self.time) < 4:
            return float(last)
        square = (self.amplitude / self.amplitude.max()) ** 2
        rest = np.polyfit(square, self.frequency, 1, w=self.amplitude)[1]
        return float(np.clip(rest, last / _RANGE, last * _RANGE))


class SpectralPeaks(NamedTuple):
    """Spectral peaks of every frame, padded with NaN."""

    time: Float[np.ndarray, " frame"]
    frequency: Float[np.ndarray, "frame peak"]  # rad/s
    amplitude: Float[np.ndarray, "frame peak"]
    width: float  # rad/s, half width of the window's main lobe


def spectral_peaks(
    time: Float[np.ndarray, " sample"], signal: Float[np.ndarray, " sample"], frequency: float
) -> SpectralPeaks:
    """Spectral peaks of all frames above noise; `frequency` (rad/s) sets the frame length."""
    from scipy.signal import find_peaks

    step = float(np.mean(np.diff(time)))
    length = min(len(signal), max(16, round(FRAME_CYCLES * HERTZ / frequency / step)))
    hop = max(1, length // _HOPS)
    starts = np.arange(0, len(signal) - length + 1, hop)
    window = np.hanning(length + 2)[1:-1]
    frames = np.lib.stride_tricks.sliding_window_view(signal, length)[starts]
    frames = (frames - frames.mean(axis=1, keepdims=True)) * window
    n_fft = 2 ** int(np.ceil(np.log2(_PADDED * length)))
    spectrum = np.abs(np.fft.rfft(frames, n_fft, axis=1)) * 2 / window.sum()
    bin_width = HERTZ / (n_fft * step)
    peaks = []
    for row in spectrum:
        floor = np.sqrt(_ABOVE) * _noise_level(row)
        at, _ = find_peaks(row, height=floor)
        at = at[(at > 0) & (at < len(row) - 1)]
        before, here, after = (np.log(row[at + k] + 1e-300) for k in (-1, 0, 1))
        shift = 0.5 * (before - after) / (before - 2 * here + after)
        peaks.append(((at + shift) * bin_width, np.exp(here - 0.25 * (before - after) * shift)))
    most = max((len(one[0]) for one in peaks), default=0)
    table = np.full((2, len(peaks), max(most, 1)), np.nan)
    for k, (omega, amplitude) in enumerate(peaks):
        table[0, k, : len(omega)], table[1, k, : len(omega)] = omega, amplitude
    middle = time[starts] + (length - 1) / 2 * step
    return SpectralPeaks(middle, table[0], table[1], 2 * HERTZ / (length * step))


def _noise_level(row: Float[np.ndarray, " bin"]) -> Float[np.ndarray, " bin"]:
    """Median of a spectrum over an octave to either side; at least that of all bins.

    Noise of an integrated acceleration is far above the median of all bins at low frequencies.
    """
    centres = np.unique(np.geomspace(1, len(row) - 1, 2 * _OCTAVES).astype(int))
    local = [np.median(row[k // _AROUND : k * _AROUND + 1]) for k in centres]
    return np.maximum(np.interp(np.arange(len(row)), centres, local), np.median(row))


def ridge_of_mode(peaks: SpectralPeaks, frequency: float) -> Ridge | None:
    """The ridge of the mode whose natural frequency is `frequency` (rad/s), or None."""
    ridges = ridges_of(peaks, frequency)
    if not ridges:
        return None

    def score(ridge: Ridge) -> float:
        away = np.log(ridge.at_rest() / frequency) / _TRUST
        return float(np.log(np.sum(ridge.amplitude**2)) - away**2 / 2)

    return max(ridges, key=score)


def ridges_of(peaks: SpectralPeaks, frequency: float) -> list[Ridge]:
    """Distinct ridges that begin near a frequency in the last frames with peaks."""
    near = (peaks.frequency > frequency / _RANGE) & (peaks.frequency < frequency * _RANGE)
    frames = np.flatnonzero(near.any(axis=1))[::-1]
    ridges: list[Ridge] = []
    taken = np.zeros(peaks.frequency.shape, dtype=bool)
    for frame in frames:
        for column in np.flatnonzero(near[frame] & ~taken[frame]):
            rows, columns = _followed(peaks, frame, int(column), frequency)
            new = ~taken[rows, columns]
            taken[rows, columns] = True
            if len(rows) >= _BEGIN and new.sum() > len(rows) / 2:
                ridges.append(
                    Ridge(
                        peaks.time[rows],
                        peaks.frequency[rows, columns],
                        peaks.amplitude[rows, columns],
                    )
                )
    return ridges


def _followed(
    peaks: SpectralPeaks, frame: int, column: int, frequency: float
) -> tuple[np.ndarray, np.ndarray]:
    """Frames and columns of a ridge traced back from one peak."""
    rows, columns = [frame], [column]
    for k in range(frame - 1, -1, -1):
        if rows[-1] - k > _PATIENCE:
            break
        last = peaks.frequency[rows[-1], columns[-1]]
        old = min(len(rows), _HOPS) - 1
        before = peaks.frequency[rows[-1 - old], columns[-1 - old]]
        predicted = last
        if old:
            predicted = last + (last - before) * (rows[-1] - k) / (rows[-1 - old] - rows[-1])
        off = np.minimum(np.abs(peaks.frequency[k] - predicted), np.abs(peaks.frequency[k] - last))
        inside = (off < peaks.width / 2) & (peaks.frequency[k] < _REACH * frequency)
        inside &= peaks.frequency[k] > frequency / _REACH
        if inside.any():
            rows.append(k)
            columns.append(int(np.argmax(np.where(inside, peaks.amplitude[k], -1.0))))
    return np.array(rows[::-1]), np.array(columns[::-1])
