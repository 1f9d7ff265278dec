"""Free decays in a record: stretches of ring-down after the drive stops."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from snrmjax.measure.recordings.channels import channel_number
from snrmjax.measure.recordings.time_recording import TimeRecording
from snrmjax.numerics.rules import BETWEEN_ZERO_AND_ONE, InputError, require

_BLOCK = 2**18  # samples per block
_FRAME = 2  # cycles of the response per value of the drive's envelope
_BEFORE = 6  # frames before a stop, for the level of the drive
_FADING = 3  # frames in which a stopping drive decays
_LOUD = 0.01  # of the largest drive: smaller ones are ignored
_FEWEST_CYCLES = 12


class RingDown(NamedTuple):
    """A stretch of a record without excitation."""

    start: int  # sample
    stop: int  # sample, exclusive
    frequency: float  # rad/s, approximate, of the response before it
    drive: float  # largest value of the drive before it, SI


def find_ring_downs(
    recording: TimeRecording, drive: str, response: str, *, quiet: float = 0.05
) -> list[RingDown]:
    """Stretches of free decay, from the drop of the drive to `quiet` of its level to its return.

    Arguments: `drive` names the channel of the excitation, best the voltage of the generator or a
    hammer's force (the force of an attached shaker continues during the decay); `response` a
    channel of the motion; `quiet` is a fraction of the drive before it stopped.
    Returns `RingDown`s in the order of time, each of twelve cycles or more.
    Raises `ValueError` for unknown channels, a `quiet` not between 0 and 1, no tone in the
    response, and a drive that never stops for twelve cycles.

    >>> from snrmjax.measure import Channel, time_recording
    >>> t = np.arange(4000) / 1000
    >>> tip = np.cos(300 * t) * np.where(t < 1, 1, np.exp(1 - t))
    >>> record = time_recording(
    ...     np.stack([np.where(t < 1, np.cos(300 * t), 0), tip]),
    ...     [Channel("generator", "voltage"), Channel("tip", "velocity")], 1000)
    >>> [(one.start, one.stop) for one in find_ring_downs(record, "generator", "tip")]
    [(1000, 4000)]
    """
    for name in (drive, response):
        channel_number(recording.channels, name)
    require("`quiet`", quiet, BETWEEN_ZERO_AND_ONE)
    step = _strongest(recording, response)
    length = max(8, round(_FRAME * 2 * np.pi / step))
    offset, envelope = _envelope(recording, drive, length)
    decays = [
        _at_sample(recording, drive, offset, length, rows, level, quiet, step)
        for rows, level in _stops(envelope, quiet, max(1, round(_FEWEST_CYCLES / _FRAME)))
    ]
    if not decays:
        raise InputError(
            f"channel {drive} never stops for {_FEWEST_CYCLES} cycles: it does not fall to "
            f"{100 * quiet:g} % of its level (noise above that? state a larger `quiet`)."
        )
    return decays


def _strongest(recording: TimeRecording, name: str) -> float:
    """Frequency of the strongest line of the block with most power, rad per sample."""
    loudest, frequency = 0.0, 0.0
    for block in recording.blocks(_BLOCK, [name]):
        values = np.where(np.isfinite(block.values[0]), block.values[0], 0.0)
        power = float(np.var(values))
        if power > loudest and len(values) > 16:
            spectrum = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(len(values))))
            spectrum[:2] = 0.0
            loudest, frequency = power, 2 * np.pi * float(np.argmax(spectrum)) / len(values)
    if frequency == 0:
        raise InputError(f"channel {name} does not move: there is no free decay.")
    return frequency


def _envelope(
    recording: TimeRecording, name: str, length: int
) -> tuple[float, Float[np.ndarray, " frame"]]:
    """Median of the drive's first block and the largest deviation from it in every frame."""
    offset, largest = None, []
    for block in recording.blocks(_BLOCK // length * length + length, [name]):
        values = block.values[0]
        if offset is None:
            offset = float(np.nanmedian(values)) if np.isfinite(values).any() else 0.0
        whole = len(values) // length * length
        away = np.abs(values[:whole] - offset).reshape(-1, length)
        largest.append(np.where(np.isfinite(away), away, np.inf).max(axis=1))
    return offset or 0.0, np.concatenate(largest)


def _stops(
    envelope: Float[np.ndarray, " frame"], quiet: float, fewest: int
) -> list[tuple[slice, float]]:
    """Frames without drive, and the level of the drive before."""
    finite = envelope[np.isfinite(envelope)]
    least = _LOUD * float(finite.max(initial=0.0))
    stops, k, n = [], 1, len(envelope)
    while k < n:
        level = float(envelope[max(0, k - _BEFORE) : k].max())
        if not (np.isfinite(level) and level > least and envelope[k] <= quiet * level):
            k += 1
            continue
        louder = np.flatnonzero(envelope[k:] > quiet * level)
        end = k + int(louder[0]) if louder.size else n
        if end - k >= fewest:
            stops.append((slice(k, end), level))
        k = end + 1
    return stops


def _at_sample(
    recording: TimeRecording,
    drive: str,
    offset: float,
    length: int,
    rows: slice,
    level: float,
    quiet: float,
    step: float,
) -> RingDown:
    """The stretch with sample accuracy, after the drive's last value above `quiet`."""
    first = max(0, (rows.start - _FADING) * length)
    near = np.abs(recording.values([drive], first, rows.start * length + length)[0] - offset)
    active = np.flatnonzero(near > quiet * level)
    start = first + (int(active[-1]) + 1 if active.size else 0)
    # The last stretch extends to the last sample, also beyond the last complete frame.
    frames = recording.n_samples // length
    stop = recording.n_samples if rows.stop >= frames else rows.stop * length
    return RingDown(start, stop, step * recording.sampling_rate, level)
