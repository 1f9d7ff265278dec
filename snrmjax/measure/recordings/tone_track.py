"""A tone tracked through a record: frequency, amplitude and phase of every frame.

Frames have a power of two of samples and three to six cycles, so that they shorten with rising
frequency. Each is weighted by a Hann window; its frequency follows from the ratio of neighbouring
bins, its phase from the largest bin, whose phase in the middle of a symmetric window is that of
the tone. Reference: T. Grandke, IEEE Trans. Instrum. Meas. 32 (1983) 350.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.numerics.rules import InputError
from snrmjax.numerics.units import HERTZ

_BLOCK = 2**18  # samples per block
_SHORTEST, _LONGEST = 4, 16  # log2 of the samples of a frame
_CYCLES = (3, 6)  # per frame, from and to
_BINS = 9
_FRACTION = 0.01  # of a block's power, for an octave to be evaluated
_TONE = 0.5  # least fraction of a frame's power in the tone
_FEWEST_SAMPLES = 4  # per cycle


class ToneTrack(NamedTuple):
    """The frames that contain a tone, in the order of time."""

    middle: Float[np.ndarray, " frame"]  # samples
    length: Int[np.ndarray, " frame"]  # samples
    frequency: Float[np.ndarray, " frame"]  # rad per sample
    phase: Float[np.ndarray, " frame"]  # rad in the middle, cosine
    amplitude: Float[np.ndarray, " frame"]  # SI

    def part(self, rows: slice | np.ndarray) -> "ToneTrack":
        """Some of the frames."""
        return ToneTrack._make(column[rows] for column in self)


def track_tone(recording: TimeRecording, name: str) -> ToneTrack:
    """Track the strongest tone of a channel, in blocks.

    Raises `ValueError` if no frame contains a tone with four samples per cycle or more.
    """
    pieces = list(_blocks(recording, name))
    columns = [np.concatenate(part) for part in zip(*pieces, strict=True)]
    if not columns[0].size:
        raise InputError(
            f"channel {name} has no tone: in no stretch of {_CYCLES[0]} to {_CYCLES[1]} cycles has "
            f"one frequency half of the power, with {_FEWEST_SAMPLES} samples per cycle or more."
        )
    return ToneTrack._make(columns)


def unwrapped_phase(track: ToneTrack) -> Float[np.ndarray, " frame"]:
    """Phase in rad, unwrapped from frame to frame by their mean frequency."""
    advance = np.diff(track.middle) * (track.frequency[1:] + track.frequency[:-1]) / 2
    rest = np.angle(np.exp(1j * (np.diff(track.phase) - advance)))
    return track.phase[0] + np.concatenate([[0.0], np.cumsum(advance + rest)])


def check_rate(recording: TimeRecording, frequency: float, name: str) -> None:
    """Raises `ValueError` for a frequency (rad/s) with fewer than four samples per cycle."""
    samples = HERTZ * recording.sampling_rate / frequency
    if samples < _FEWEST_SAMPLES * (1 - 1e-9):
        raise InputError(
            f"a record needs {_FEWEST_SAMPLES} samples per cycle, but channel {name} has "
            f"{samples:.3g} at {frequency / HERTZ:.6g} Hz, sampled at "
            f"{recording.sampling_rate:.6g} Hz."
        )


def _blocks(recording: TimeRecording, name: str) -> Iterator[ToneTrack]:
    """Tracks of neighbouring stretches."""
    overlap = min(2**_LONGEST, recording.n_samples // 4)
    length = max(_BLOCK, 2 * overlap + 1)
    for block in recording.blocks(length, [name], overlap=overlap):
        values = block.values[0]
        end = block.start + len(values) == recording.n_samples
        # Frames that begin in the overlap belong to the next block.
        new = len(values) if end else len(values) - overlap
        yield _of_block(values, block.start, new)


def _of_block(values: np.ndarray, start: int, new: int) -> ToneTrack:
    frames = []
    for power in _octaves(values):
        size = 2**power
        first = -start % (size // 2)
        last = min(new, len(values) - size + 1)
        if last <= first:
            continue
        windows = np.lib.stride_tricks.sliding_window_view(values, size)
        frames.append(_frames(windows[first : last : size // 2], start + first, size))
    if not frames:
        empty = np.empty(0)
        return ToneTrack(empty, np.empty(0, dtype=int), empty, empty, empty)
    return _shortest_first(frames)


def _octaves(values: np.ndarray) -> list[int]:
    """log2 of the frame lengths for the octaves with significant power."""
    kept = np.where(np.isfinite(values), values, 0.0)
    spectrum = np.abs(np.fft.rfft(kept - kept.mean())) ** 2
    per_sample = np.arange(len(spectrum)) / len(values)  # cycles per sample
    powers = []
    total = spectrum.sum()
    if total == 0:
        return []
    for power in range(_SHORTEST, _LONGEST + 1):
        low, high = _CYCLES[0] / 2**power, _CYCLES[1] / 2**power
        inside = (per_sample >= low * 0.98) & (per_sample < high * 1.02)
        if spectrum[inside].sum() > _FRACTION * total:
            powers.append(power)
    return powers


def _frames(windows: np.ndarray, start: int, size: int) -> ToneTrack:
    """The frames of one length that contain a tone of three to six cycles."""
    away = np.arange(size) - (size - 1) / 2
    window = 0.5 + 0.5 * np.cos(2 * np.pi * away / size)
    kernel = np.exp(-2j * np.pi * np.outer(away, np.arange(_BINS)) / size)
    weights = window[:, None] * kernel
    basis = np.concatenate([weights.real, weights.imag[:, 1:]], axis=1)
    mean = windows.mean(axis=1, keepdims=True)
    centred = windows - mean
    projected = centred @ basis
    bins = projected[:, :_BINS].astype(complex)
    bins[:, 1:] += 1j * projected[:, _BINS:]
    energy = np.einsum("fs,fs,s->f", centred, centred, window**2)
    magnitudes = np.abs(bins)
    largest = np.where(np.isfinite(magnitudes).all(axis=1), magnitudes.T, 0.0).T.argmax(axis=1)
    usable = (largest >= 1) & (largest < _BINS - 1) & np.isfinite(energy) & (energy > 0)
    rows, peak = np.flatnonzero(usable), largest[usable]
    left, at, right = (magnitudes[rows, peak + k] for k in (-1, 0, 1))
    ratio = np.maximum(left, right) / at
    shift = np.clip(np.where(right >= left, 1, -1) * (2 * ratio - 1) / (1 + ratio), -0.6, 0.6)
    amplitude = 2 * at * (1 - shift**2) / np.sinc(shift) / (size / 2)
    fraction = amplitude**2 / 2 * np.sum(window**2) / energy[rows]
    cycles = peak + shift
    good = (fraction > _TONE) & (cycles >= _CYCLES[0] * 0.985) & (cycles < _CYCLES[1] * 1.03)
    good &= cycles <= size / _FEWEST_SAMPLES * 1.01
    rows, peak = rows[good], peak[good]
    middle = start + rows * (size // 2) + (size - 1) / 2
    return ToneTrack(
        middle,
        np.full(len(rows), size),
        2 * np.pi * cycles[good] / size,
        np.angle(bins[rows, peak]),
        amplitude[good],
    )


def _shortest_first(tracks: list[ToneTrack]) -> ToneTrack:
    """Frames of all lengths by time; longer frames covered by a shorter one are omitted."""
    kept = tracks[0]
    for longer in tracks[1:]:
        if kept.middle.size and longer.middle.size:
            index = np.searchsorted(kept.middle, longer.middle)
            before = np.abs(longer.middle - kept.middle[np.maximum(index - 1, 0)])
            after = np.abs(longer.middle - kept.middle[np.minimum(index, kept.middle.size - 1)])
            longer = longer.part(np.minimum(before, after) > longer.length / 2)
        joined = [np.concatenate(pair) for pair in zip(kept, longer, strict=True)]
        order = np.argsort(joined[0], kind="stable")
        kept = ToneTrack._make(column[order] for column in joined)
    return kept
