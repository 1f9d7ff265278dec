"""Harmonics of a stretch of a record in blocks, by least squares in NumPy.

All blocks have the same length and their phases are relative to their middles, so that one small
matrix serves every block and channel: the cost is one matrix product for any length of record.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.recordings.time_recording import TimeRecording

_MOST_SAMPLES = 2**20  # of all channels together, per read
_BLOCKS = 64  # of a stretch, about
_LONGEST_BLOCK = 2**16  # samples
_FEWEST_SAMPLES = 3  # per unknown of a block
_FLAT = 0.06  # of a cycle at the largest value, above which a record is clipped
_FLAT_SAMPLES = 3
_FLAT_PEAKS = 3


class BlockPhasors(NamedTuple):
    """Phasors of neighbouring blocks: x(t) = m + Re Σ_k z_k e^{ikΩ(t − reference)}.

    Non-finite samples make the phasors of their block NaN.
    """

    time: Float[np.ndarray, " block"]  # s, middles
    phasors: Complex[np.ndarray, "channel order block"]  # SI of each channel
    mean: Float[np.ndarray, "channel block"]
    noise: Float[np.ndarray, "channel block"]  # mean square of the residual, per degree of freedom
    unit_variance: Float[np.ndarray, " order"]  # of a complex phasor for a noise variance of one
    frequency: float  # rad/s
    reference: float  # s
    clipped: tuple[int, ...]  # channels that stay at their largest value

    def shifted(self, shift: float) -> "BlockPhasors":
        """The same phasors at a frequency higher by `shift` (rad/s)."""
        order = 1 + np.arange(self.phasors.shape[1])
        rotation = np.exp(-1j * shift * np.outer(order, self.time - self.reference))
        return self._replace(phasors=self.phasors * rotation, frequency=self.frequency + shift)


def block_length(samples: int, cycle: float, unknowns: int) -> int:
    """Samples per block: about whole cycles, about 64 blocks, long enough for the fit.

    `cycle` in samples.
    """
    least = np.ceil(_FEWEST_SAMPLES * unknowns / cycle)
    cycles = max(1.0, least, min(np.floor(samples / cycle / _BLOCKS), _LONGEST_BLOCK // cycle))
    return round(cycles * cycle)


def block_phasors(
    recording: TimeRecording,
    names: tuple[str, ...],
    start: int,
    stop: int,
    frequency: float,
    highest: int,
) -> BlockPhasors:
    """Phasors of harmonics 1 to `highest` of samples `start` to `stop`, in about 64 blocks.

    Arguments: `frequency` in rad/s. The stretch is read in pieces.
    """
    step = frequency / recording.sampling_rate
    length = block_length(stop - start, 2 * np.pi / step, 2 * highest + 1)
    count = max(1, (stop - start) // length)
    angle = step * (np.arange(length) - (length - 1) / 2)
    angles = np.outer(np.arange(1, highest + 1), angle)
    design = np.concatenate([np.ones((1, length)), np.cos(angles), -np.sin(angles)])
    inverse = np.linalg.inv(design @ design.T)
    solver = inverse @ design
    at_once = max(1, _MOST_SAMPLES // (length * len(names)))
    fits, noise = [], []
    largest, flat = np.zeros(len(names)), np.zeros(len(names), dtype=int)
    for first in range(0, count, at_once):
        last = min(count, first + at_once)
        values = recording.values(names, start + first * length, start + last * length)
        largest, flat = _flat_peaks(values, largest, flat, 2 * np.pi / step)
        rows = values.reshape(-1, length)  # blocks of all channels, stacked
        coefficients = rows @ solver.T
        rest = rows - coefficients @ design
        shape = (len(names), last - first)
        fits.append(coefficients.reshape(*shape, -1))
        noise.append(np.einsum("bl,bl->b", rest, rest).reshape(shape) / (length - len(design)))
    coefficient = np.concatenate(fits, axis=1)
    middle = start + length * np.arange(count) + (length - 1) / 2
    order = np.arange(1, highest + 1)
    reference = (start + stop) / 2
    rotation = np.exp(-1j * step * np.outer(order, middle - reference))
    amplitude = coefficient[:, :, 1 : highest + 1] + 1j * coefficient[:, :, highest + 1 :]
    spread = np.diag(inverse)
    return BlockPhasors(
        recording.start_time + middle / recording.sampling_rate,
        np.moveaxis(amplitude, 2, 1) * rotation,
        coefficient[:, :, 0],
        np.concatenate(noise, axis=1),
        spread[1 : highest + 1] + spread[highest + 1 :],
        frequency,
        recording.start_time + reference / recording.sampling_rate,
        tuple(int(k) for k in np.flatnonzero(flat >= _FLAT_PEAKS)),
    )


def _flat_peaks(
    values: np.ndarray, largest: np.ndarray, flat: np.ndarray, cycle: float
) -> tuple[np.ndarray, np.ndarray]:
    """Largest magnitudes so far, and the number of peaks at which a channel stays at it.

    A sine with few samples or few quantisation steps is flat at its peaks too, but for less than
    `_FLAT` of a cycle.
    """
    run = max(_FLAT_SAMPLES, int(np.ceil(_FLAT * cycle)))
    maxima = np.abs(values).max(axis=1, initial=0.0)
    counts = []
    for row, maximum, before, count in zip(values, maxima, largest, flat, strict=True):
        at = np.flatnonzero(np.abs(row) >= max(maximum, before) * (1 - 1e-9))
        together = at[run - 1 :] - at[: len(at) - run + 1] == run - 1 if len(at) >= run else at[:0]
        begins = np.flatnonzero(together)
        peaks = 1 + np.count_nonzero(np.diff(at[begins]) > 1) if len(begins) else 0
        counts.append(peaks + (count if maximum <= before * (1 + 1e-9) else 0))
    return np.fmax(largest, maxima), np.array(counts)
