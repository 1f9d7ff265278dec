"""The settled part of a step, and its mean phasors with errors valid for coloured noise.

After a step every phasor is z(t) = z∞ + c e^{−t/τ + iδt}: one decaying mode, which beats with the
drive. τ and δ are searched on a grid for all channels together, z∞ and c follow by least squares.
The start of the settled part follows from the remaining transient.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from snrmjax.measure.recordings.block_phasors import BlockPhasors

_BLOCKS = 64  # after averaging, for the detection of a transient
_DECAYS, _BEATS = 12, 41  # points of the grid
_ZOOMS = 14  # finer grids about the best point
_SURE = 15.0  # half the gain in squared standard deviations for a significant transient
_FEWEST = 6  # least number of blocks used
_LEAST_KEPT = 0.2  # least fraction of the step used
_LEAST_LEFT_OUT = 0.15  # least fraction of the step discarded, if it is long
_ROUNDING = 1e-7  # relative: smaller changes are ignored
_CHANCE = 1e-4  # significance level of a trend
_BATCHES = 16
_FEW_BATCHES = 12  # below which Student's distribution is used for the scatter


class Settled(NamedTuple):
    """The first settled block of a step, and the remaining transient."""

    first: int  # block
    latest: int  # latest possible first block
    remaining: Float[np.ndarray, "channel block"]  # mean of the transient from each block on, SI
    decay_time: float  # s, NaN if no transient was detected


class Means(NamedTuple):
    """Mean phasors relative to the first channel's (its fundamental real and positive)."""

    phasors: Complex[np.ndarray, "channel order"]  # SI
    mean: Float[np.ndarray, " channel"]  # SI
    amplitude_std: Float[np.ndarray, " channel"]  # 1σ of the fundamental, SI
    phase_std: Float[np.ndarray, " channel"]  # rad, relative to the first channel
    harmonic_std: Float[np.ndarray, "channel order"]  # rms of the complex error, SI
    colour: Float[np.ndarray, " channel"]  # scatter of blocks over that of white noise


def steady_frequency(blocks: BlockPhasors, channel: int = 0) -> float:
    """Frequency of the tone of a channel relative to that of the blocks, rad/s.

    From a linear fit to the phase of the last two thirds.
    """
    late = slice(len(blocks.time) // 3, None)
    phasor = blocks.phasors[channel, 0, late]
    good = np.isfinite(phasor)
    if np.count_nonzero(good) < 2:
        return 0.0
    away = blocks.time[late][good] - blocks.reference
    return float(np.polyfit(away, np.unwrap(np.angle(phasor[good])), 1)[0])


def settled_part(blocks: BlockPhasors, skip: float | None) -> Settled:
    """Find the end of the transient of a step.

    Arguments: `skip` in s is discarded instead of a detected transient.
    """
    count = len(blocks.time)
    most = max(0, min(count - _FEWEST, int(count * (1 - _LEAST_KEPT))))
    if skip is not None:
        begin = blocks.time[0] - (blocks.time[1] - blocks.time[0]) / 2 if count > 1 else 0.0
        first = int(np.searchsorted(blocks.time, begin + skip))
        return Settled(first, first, np.zeros((len(blocks.phasors), count)), np.nan)
    times, series = _joined(blocks.time, blocks.phasors[:, 0, :])
    # Channels are weighted by the trend-free scatter between blocks.
    noise = np.mean(np.abs(np.diff(series, 2, axis=1)) ** 2, axis=1) / 6 if len(times) > 2 else 0.0
    magnitude = np.abs(series).mean(axis=1)
    weight = 1 / np.sqrt(np.maximum(noise, (_ROUNDING * magnitude) ** 2 + np.finfo(float).tiny))
    away = times - times[0]
    span = max(float(away[-1]), np.finfo(float).tiny)
    rest = (series - series.mean(axis=1, keepdims=True)) * weight[:, None]
    grid = _grid(span, len(times))
    for _ in range(1 + _ZOOMS):
        gains, projected = _explained(rest, away, *grid)
        best = int(np.argmax(gains))
        decay, beat = float(grid.decay[best]), float(grid.beat[best])
        grid = grid.around(best)
    left_over = np.sum(np.abs(rest) ** 2) - gains[best]
    freedom = 2 * rest.size - 4 * len(rest) - 2
    scale = max(left_over / max(freedom, 1) * 2, np.finfo(float).tiny)
    least = min(most, int(count * _LEAST_LEFT_OUT))
    if gains[best] < 2 * _SURE * scale * max(1, len(rest) / 2):
        return Settled(least, most, np.zeros((len(rest), count)), np.nan)
    whole = np.exp((-1 / decay + 1j * beat) * (blocks.time - times[0]))
    # For the means from each block on: the remaining transient, and the noise.
    counts = np.arange(count, 0, -1)
    means = np.abs(np.cumsum(whole[::-1])[::-1] / counts)
    transient = np.abs(projected[:, best]) / weight
    random = np.sqrt(scale) / weight[:, None] * np.sqrt(count / len(times) / counts)
    allowed = np.maximum(0.3 * random, _ROUNDING * magnitude[:, None])
    # Within a beat the mean may cross zero: it must not be below a tenth of the envelope.
    envelope = np.maximum(means, 0.1 * np.abs(whole))
    enough = np.all(transient[:, None] * envelope <= allowed, axis=0)
    late = np.flatnonzero(enough[: most + 1])
    first = max(least, int(late[0]) if late.size else most)
    return Settled(first, most, transient[:, None] * envelope, decay)


def moves(blocks: BlockPhasors, tolerance: float) -> float:
    """Largest relative trend of amplitude or phase over the blocks, 0 if not significant.

    A trend counts if it exceeds `tolerance` and is statistically significant.
    """
    _, series = _joined(blocks.time, _relative(blocks)[:, 0, :])
    n = series.shape[1]
    if n < 4:
        return 0.0
    mean = series.mean(axis=1)
    fraction = series / mean[:, None] - 1
    parts = np.stack([fraction.real, fraction.imag])  # of amplitude and phase
    position = (np.arange(n) - (n - 1) / 2) / n
    slope = parts @ position / (position @ position)
    rest = parts - parts.mean(axis=2, keepdims=True) - slope[:, :, None] * position
    noise = np.sqrt(np.sum(rest**2, axis=2) / (n - 2) / (position @ position))
    significant = (np.abs(slope) > _student_quantile(_CHANCE / 2, n - 2) * noise) & (
        np.abs(slope) > tolerance
    )
    return float(np.max(np.where(significant, np.abs(slope), 0.0)))


def mean_phasors(blocks: BlockPhasors) -> Means:
    """Means over the blocks; 1σ is the larger of white noise and scatter of blocks."""
    relative = _relative(blocks)
    mean = relative.mean(axis=2)
    count = relative.shape[2]
    white = blocks.noise.mean(axis=1)[:, None] * blocks.unit_variance / count  # complex
    batches = min(_BATCHES, count)
    parts = np.array_split(relative, batches, axis=2)
    series = np.stack([part.mean(axis=2) for part in parts], axis=2)
    scatter = series - mean[:, :, None]
    across = np.sum(np.abs(scatter) ** 2, axis=2) / max(batches - 1, 1) / batches
    unit = mean[:, 0] / np.abs(mean[:, 0])
    along = scatter[:, 0] * unit.conj()[:, None]
    widened = _student(batches)
    radial = widened * _std_of_mean(along.real)
    tangential = widened * _std_of_mean(along.imag) / np.abs(mean[:, 0])
    plain = np.sqrt(white[:, 0] / 2)
    angle = plain / np.abs(mean[:, 0])
    white_angle = np.hypot(angle, angle[0])
    white_angle[0] = angle[0]
    return Means(
        mean,
        blocks.mean.mean(axis=1),
        np.maximum(plain, radial),
        np.maximum(white_angle, tangential),
        np.sqrt(np.maximum(white, widened**2 * across)),
        np.sqrt(across[:, 0] / np.maximum(white[:, 0], np.finfo(float).tiny)),
    )


def _relative(blocks: BlockPhasors) -> Complex[np.ndarray, "channel order block"]:
    """Phasors relative to the first channel's fundamental, block by block."""
    unit = blocks.phasors[0, 0] / np.abs(blocks.phasors[0, 0])
    order = 1 + np.arange(blocks.phasors.shape[1])
    return blocks.phasors * unit.conj() ** order[:, None]


def _joined(times: np.ndarray, series: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most `_BLOCKS` means of neighbouring blocks."""
    if len(times) <= _BLOCKS:
        return times, series
    each = len(times) // _BLOCKS
    kept = each * _BLOCKS
    shape = (*series.shape[:-1], _BLOCKS, each)
    return (
        times[-kept:].reshape(_BLOCKS, each).mean(axis=1),
        series[..., -kept:].reshape(shape).mean(axis=-1),
    )


class _Grid(NamedTuple):
    """Trial decay times (s) and beat frequencies (rad/s), and their spacing."""

    decay: Float[np.ndarray, " point"]
    beat: Float[np.ndarray, " point"]
    ratio: float  # of neighbouring decay times
    step: float  # between beats

    def around(self, best: int) -> "_Grid":
        """A finer grid about one of the points."""
        offsets = np.linspace(-1, 1, 5)
        points = np.meshgrid(
            self.decay[best] * self.ratio**offsets, self.beat[best] + self.step * offsets
        )
        return _Grid(points[0].ravel(), points[1].ravel(), self.ratio**0.5, self.step / 2)


def _grid(span: float, count: int) -> _Grid:
    decay = span * np.geomspace(1 / min(count, 40), 1 / 1.5, _DECAYS)
    fastest = np.pi * (count - 1) / span
    beat = np.linspace(-1, 1, _BEATS) * min(fastest, 60 * np.pi / span)
    points = np.meshgrid(decay, beat)
    return _Grid(
        points[0].ravel(), points[1].ravel(), float(decay[1] / decay[0]), float(beat[1] - beat[0])
    )


def _explained(
    rest: np.ndarray, away: np.ndarray, decay: np.ndarray, beat: np.ndarray, *_: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sum of squares of `rest` explained by each transient, and its amplitude by channel."""
    shape = np.exp(-np.outer(1 / decay, away) + 1j * np.outer(beat, away))
    centred = shape - shape.mean(axis=1, keepdims=True)
    power = np.sum(np.abs(centred) ** 2, axis=1)
    projected = rest @ centred.conj().T / power
    return np.sum(np.abs(projected) ** 2 * power, axis=0), projected


def _std_of_mean(values: np.ndarray) -> np.ndarray:
    n = values.shape[-1]
    if n < 2:
        return np.zeros(values.shape[:-1])
    return np.sqrt(np.sum(values**2, axis=-1) / (n - 1) / n)


def _student(batches: int) -> float:
    """Ratio of Student's 95 % interval to the normal one, for few batches."""
    if batches < 2 or batches >= _FEW_BATCHES:
        return 1.0
    return _student_quantile(0.025, batches - 1) / 1.959963984540054


def _student_quantile(above: float, freedom: int) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 1 - above))
