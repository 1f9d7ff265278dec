"""Steps of a stepped sine: stretches of constant frequency and amplitude of the drive.

The phase of a steady tone is linear in time. The track of the drive is partitioned into linear
phase and constant log amplitude, with a penalty per change point (optimal partitioning with
pruning), and pieces that differ by less than a step are merged: the force of a shaker still changes
while the structure settles. The phase may jump or be continuous between steps.

Reference: R. Killick, P. Fearnhead & I. A. Eckley, J. Am. Stat. Assoc. 107 (2012) 1590,
doi:10.1080/01621459.2012.737745.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from snrmjax.measure.recordings.tone_track import ToneTrack, unwrapped_phase

_PENALTY = 25.0  # of a change point, in squared standard deviations
_PHASE_FLOOR = 0.01  # rad: smaller changes are ignored
_AMPLITUDE_FLOOR = 0.01  # of the amplitude
_AT_ONCE = 1500  # frames per partitioning
_FEWEST_FRAMES = 3
_GAP = 1.6  # hops between frames, above which data are missing
_SAME_PHASE = 0.01  # largest phase drift between pieces of one step, cycles over the shorter one
_CONTINUOUS = 0.25  # rad, largest phase jump within a step
_NEAR = 4  # frames at an end, for the trend of the amplitude
_AROUND = 41  # frames of a running median of the scatter
_NORMAL = 0.6745  # median of |x| over σ of a normal distribution


class Step(NamedTuple):
    """A stretch of a record with one frequency of the drive."""

    start: int  # sample
    stop: int  # sample, exclusive
    frequency: float  # rad/s
    amplitude: float  # of the drive, SI; NaN for a step from a table


class _Piece(NamedTuple):
    rows: slice  # of the track
    frequency: float  # rad per sample
    level: float  # log amplitude
    slope: float  # log amplitude per sample
    middle: float  # sample
    phase: float  # rad in the middle, unwrapped
    length: float  # samples


def recognise_steps(
    track: ToneTrack, sampling_rate: float, *, least_amplitude_step: float, least_step: float
) -> list[Step]:
    """Steps of a track in the order of time.

    Arguments: `least_amplitude_step` relative to the amplitude; `least_step` in rad/s, the
    smallest frequency difference of a step (0: the smallest that can be resolved).
    """
    phase = unwrapped_phase(track)
    level = np.log(track.amplitude)
    cuts = _cuts(track, phase, level)
    pieces = [
        _piece(track, phase, level, slice(start, stop))
        for start, stop in itertools.pairwise(cuts)
        if stop - start >= _FEWEST_FRAMES
    ]
    steps: list[tuple[_Piece, _Piece, _Piece]] = []  # first, longest and last piece of each
    for piece in pieces:
        if steps and _one_step(
            steps[-1], piece, track, level, least_amplitude_step, least_step / sampling_rate
        ):
            first, longest, _ = steps[-1]
            longest = piece if piece.length > longest.length else longest
            steps[-1] = (first, longest, piece)
        else:
            steps.append((piece, piece, piece))
    return [
        Step(
            # Only the middles of frames are certain to lie in the step.
            int(np.ceil(track.middle[first.rows.start])),
            int(track.middle[last.rows.stop - 1]) + 1,
            longest.frequency * sampling_rate,
            float(np.exp(longest.level)),
        )
        for first, longest, last in steps
    ]


def moves_within_steps(steps: Sequence[Step], track: ToneTrack, sampling_rate: float) -> float:
    """Change of frequency within a step over the distance to the next: the median.

    About zero for steps, about one for a sweep that was partitioned into short pieces. The change
    is that of a parabola fitted to the phase, whose noise has either sign.
    """
    phase = unwrapped_phase(track)
    moves = [0.0]
    for step, after in itertools.pairwise(steps):
        rows = slice(*np.searchsorted(track.middle, (step.start, step.stop)))
        distance = (after.frequency - step.frequency) / sampling_rate
        if rows.stop - rows.start > 2 and distance:
            away = track.middle[rows] - track.middle[rows].mean()
            rate = 2 * np.polyfit(away, phase[rows], 2)[0]
            moves.append(rate * (after.start + after.stop - step.start - step.stop) / 2 / distance)
    return float(np.median(moves))


def _deviations(values: np.ndarray, middle: np.ndarray, floor: float) -> np.ndarray:
    """1σ of values from their second differences, as a running median."""
    from scipy.ndimage import median_filter

    if len(values) < 5:
        return np.full(len(values), floor)
    fraction = (middle[1:-1] - middle[:-2]) / (middle[2:] - middle[:-2])
    roughness = values[1:-1] - (1 - fraction) * values[:-2] - fraction * values[2:]
    # Frames overlap by half: white noise in neighbouring frames has a correlation of one sixth.
    around = median_filter(np.abs(roughness), size=_AROUND, mode="nearest")
    middle_of = np.concatenate([around[:1], around, around[-1:]])
    return np.maximum(floor, middle_of / (_NORMAL * np.sqrt(1.5)))


def _cuts(track: ToneTrack, phase: np.ndarray, level: np.ndarray) -> list[int]:
    """First frames of the pieces, with the end as the last entry."""
    weight = _deviations(phase, track.middle, _PHASE_FLOOR) ** -2
    level_weight = _deviations(level, track.middle, _AMPLITUDE_FLOOR) ** -2
    hop = np.maximum(track.length[1:], track.length[:-1]) / 2
    broken = np.flatnonzero(np.diff(track.middle) > _GAP * hop) + 1
    cuts = [0]
    for begin, end in zip([0, *broken], [*broken, len(phase)], strict=True):
        start = int(begin)
        while start < end:
            stop = min(start + _AT_ONCE, int(end))
            rows = slice(start, stop)
            starts = _partition(
                track.middle[rows], phase[rows], level[rows], weight[rows], level_weight[rows]
            )
            if stop < end:
                # The last piece may continue: the next round begins with it, or in its middle.
                starts = [k for k in starts if k < stop - start]
                late = starts[-1] if starts[-1] > 0 else (stop - start) // 2
                starts = [*starts[:-1], late] if starts[-1] > 0 else [0, late]
            cuts += [start + k for k in starts if start + k > cuts[-1]]
            start = cuts[-1] if stop < end else int(end)
    return cuts


def _partition(
    time: np.ndarray,
    phase: np.ndarray,
    level: np.ndarray,
    weight: np.ndarray,
    level_weight: np.ndarray,
) -> list[int]:
    """Starts of the pieces of least cost, with the end as the last entry."""
    n = len(time)
    time = (time - time.mean()) / max(float(np.ptp(time)), 1.0)
    phase = phase - np.polyval(np.polyfit(time, phase, min(1, n - 1)), time)
    level = level - level.mean()

    def summed(values: np.ndarray) -> np.ndarray:
        return np.concatenate([[0.0], np.cumsum(values)])

    w, wt, wtt = summed(weight), summed(weight * time), summed(weight * time**2)
    wp, wtp, wpp = summed(weight * phase), summed(weight * time * phase), summed(weight * phase**2)
    v, vl, vll = summed(level_weight), summed(level_weight * level), summed(level_weight * level**2)
    best, before = np.full(n + 1, np.inf), np.zeros(n + 1, dtype=int)
    best[0] = -_PENALTY
    open_starts = np.array([0])
    for stop in range(1, n + 1):
        k = open_starts
        s, st, sp = w[stop] - w[k], wt[stop] - wt[k], wp[stop] - wp[k]
        stt = wtt[stop] - wtt[k] - st**2 / s
        stp = wtp[stop] - wtp[k] - st * sp / s
        spp = wpp[stop] - wpp[k] - sp**2 / s
        line = np.where(stt > 1e-12 * s, stp**2 / np.where(stt > 1e-12 * s, stt, 1.0), 0.0)
        constant = vll[stop] - vll[k] - (vl[stop] - vl[k]) ** 2 / (v[stop] - v[k])
        cost = best[k] + np.maximum(spp - line, 0.0) + np.maximum(constant, 0.0)
        least = int(np.argmin(cost))
        best[stop], before[stop] = cost[least] + _PENALTY, k[least]
        open_starts = np.append(k[cost <= best[stop]], stop)
    cuts = [n]
    while cuts[-1] > 0:
        cuts.append(int(before[cuts[-1]]))
    return cuts[::-1]


def _piece(track: ToneTrack, phase: np.ndarray, level: np.ndarray, rows: slice) -> _Piece:
    middle = float(track.middle[rows].mean())
    away = track.middle[rows] - middle
    slope, at = np.polyfit(away, phase[rows], 1)
    drift, mean_level = np.polyfit(away, level[rows], 1)
    return _Piece(
        rows, float(slope), float(mean_level), float(drift), middle, float(at), np.ptp(away)
    )


def _one_step(
    step: tuple[_Piece, _Piece, _Piece],
    piece: _Piece,
    track: ToneTrack,
    level: np.ndarray,
    least_amplitude_step: float,
    least_step: float,
) -> bool:
    """Whether a piece continues the previous step."""
    _, longest, last = step
    gap = track.middle[piece.rows.start] - track.middle[last.rows.stop - 1]
    if gap > (_FEWEST_FRAMES + 1) * track.length[piece.rows.start] / 2:
        return False
    shorter = min(longest.length, piece.length)
    tolerance = max(least_step, 2 * np.pi * _SAME_PHASE / shorter)
    if abs(longest.frequency - piece.frequency) > tolerance:
        return False
    between = (last.middle + piece.middle) / 2
    jump = (
        last.phase
        + last.frequency * (between - last.middle)
        - piece.phase
        - piece.frequency * (between - piece.middle)
    )
    if abs(np.angle(np.exp(1j * jump))) > _CONTINUOUS:
        return False
    difference = abs(longest.level - piece.level)
    if difference < least_amplitude_step:
        return True
    flat = [abs(part.slope) * part.length < difference / 2 for part in (longest, piece)]
    ends = _at_end(track, level, last, piece)
    return not all(flat) and ends < least_amplitude_step


def _at_end(track: ToneTrack, level: np.ndarray, last: _Piece, piece: _Piece) -> float:
    """Jump of the log amplitude between two pieces, each extrapolated by its trend there."""
    before = slice(max(last.rows.start, last.rows.stop - _NEAR), last.rows.stop)
    after = slice(piece.rows.start, min(piece.rows.stop, piece.rows.start + _NEAR))
    between = (track.middle[before.stop - 1] + track.middle[after.start]) / 2
    ends = [
        np.polyval(np.polyfit(track.middle[rows] - between, level[rows], 1), 0.0)
        for rows in (before, after)
    ]
    return float(abs(ends[0] - ends[1]))
